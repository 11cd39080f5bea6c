"""Bounds on accuracy, on real recordings and on synthetic rooms; deterministic."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.retrieval import measure
from benchmarks.roll import RolledView, shares_of_d0, view
from sceneprint.datasets import FrameReference, find_sequences
from sceneprint.signing import (
    Signer,
    describe,
    exact_statistics,
    float_signature,
    open_signer,
    table_statistics,
)
from sceneprint.types import Floats, Frame


@pytest.fixture(scope="module", params=["paper", "depth"])
def signer(request: pytest.FixtureRequest) -> Signer:
    return open_signer(request.param)


@pytest.fixture(scope="module")
def paper() -> Signer:
    return open_signer("paper")


@pytest.fixture(scope="module")
def views() -> list[RolledView]:
    """Rendered once for both models."""
    return [view(i) for i in range(12)]


def every(path: Path, step: int) -> list[FrameReference]:
    return [f for s in find_sequences(path) for f in s.frames][::step]


def pairwise(rows: list[Floats]) -> Floats:
    upper = np.triu_indices(len(rows), 1)
    return np.array([[np.abs(a - b).sum() for b in rows] for a in rows])[upper]


def test_the_table_keeps_the_distances_of_the_exact_path(data_root: Path, signer: Signer) -> None:
    """Twelve real frames of three sensors; fewer patches only so that the oracle ends soon."""
    p = signer.model.parameters
    p = replace(p, segmentation=replace(p.segmentation, n_patches=200))
    frames = [
        reference.read()
        for reference in (
            *every(data_root / "7scenes/redkitchen", 150)[:6],
            *every(data_root / "tum/fr1_rpy", 120)[:3],
            *every(data_root / "sun3d/studyroom2", 33)[:3],
        )
    ]
    levels = [describe(frame, p).levels for frame in frames]
    table = [
        float_signature([table_statistics(x, signer) for x in h], signer.model) for h in levels
    ]
    exact = [
        float_signature([exact_statistics(x, signer.model) for x in h], signer.model)
        for h in levels
    ]
    assert len(frames) == 12
    assert np.corrcoef(pairwise(table), pairwise(exact))[0, 1] >= 0.995


@pytest.mark.parametrize(
    ("split", "oracle", "mean_overlap", "top1"),
    [("forward", 0.630, 0.59, 0.81), ("reverse", 0.628, 0.59, 0.70)],
)
def test_retrieval(
    data_root: Path, paper: Signer, split: str, oracle: float, mean_overlap: float, top1: float
) -> None:
    """Every fourth frame of the splits of docs/performance.md: .604 and .603, .84 and .73.

    `python -m benchmarks.retrieval` takes all of them.
    """
    (sequence,) = find_sequences(data_root / "7scenes/redkitchen")
    figures = measure(split, sequence, paper, every=4)
    assert figures.oracle_mean_overlap == pytest.approx(oracle, abs=0.002)
    assert figures.mean_overlap >= mean_overlap
    assert figures.top1_overlap_50 >= top1
    assert figures.top1_overlap_30 >= 0.97
    assert figures.recall_at_10_of_float >= 0.99


def test_another_rooms_frame_is_farther(signer: Signer, room_frames: tuple[Frame, ...]) -> None:
    from sceneprint.pipeline import distance, sign

    signed = [sign(frame, signer) for frame in room_frames]
    across = [distance(a, b) for a in signed[:3] for b in signed[3:]]
    assert np.median(across) / signer.model.unrelated_distance == pytest.approx(1.0, abs=0.25)


def test_a_roll_of_the_camera_changes_little(signer: Signer, views: list[RolledView]) -> None:
    """The same content at every angle: what is left is the segmentation's own noise.

    A third of d0 is what we want; one of the 84 measurements misses it, as docs/performance.md
    says, and a rectangular sensor, whose content changes, is not held to it.
    """
    shares = np.array([shares_of_d0(one, signer, round_lens=True) for one in views])
    assert np.median(shares) <= 0.2
    assert (shares <= 1 / 3).mean() >= 0.98
    assert shares.max() <= 0.35


def test_a_rectangular_sensor_turned_upside_down_sees_the_same(
    signer: Signer, views: list[RolledView]
) -> None:
    shares = [shares_of_d0(one, signer, False, angles=(180,))[0] for one in views[:4]]
    assert max(shares) <= 1 / 3
