"""Tests of deterministic bounds on accuracy, with recordings and synthetic rooms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sceneprint.formats.dataset import find_sequences
from sceneprint.geometry.retrieval.ranking import cross_distances
from sceneprint.geometry.signature.fisher_vector import quantise
from sceneprint.pipeline import distance, sign
from sceneprint.signing import (
    describe,
    exact_statistics,
    float_signature,
    open_signer,
    table_statistics,
)
from sceneprint.types import DepthFrame, Intrinsics
from sceneprint_lab.evaluation.protocol import overlaps, view_of
from sceneprint_lab.synth import render, synthesise_room
from sceneprint_lab.synth.dataset import room_and_rng

#: Of the recording, for the database and for queries.
SPLIT = (range(0, 600, 8), range(650, 1000, 8))


def ranks(rows):
    """Database indices by rising distance, ties by index."""
    return np.argsort(rows, axis=1, kind="stable")


def recall_at_10(stored, exact):
    """Share of the exact first ten that stored signatures keep among their first ten."""
    kept = [
        len(set(a[:10]) & set(b[:10])) / 10
        for a, b in zip(ranks(stored), ranks(exact), strict=True)
    ]
    return float(np.mean(kept))


#: A square sensor with the pixels of a Kinect, behind a round lens.
SQUARE = Intrinsics(480, 480, 585.0, 585.0, 239.5, 239.5)

#: Seed of rooms that no shipped model was trained on.
SEED = 7

ANGLES = (10, 30, 45, 90, 135, 180, 250)


def rolled(number, degrees):
    """A noise-free view in a room, after a roll about the optical axis."""
    pose = synthesise_room(SEED, number, 1).frames[0].pose
    a = math.radians(degrees)
    roll = np.eye(4)
    roll[:2, :2] = [[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]]
    depth = render(room_and_rng(SEED, number)[0], pose @ roll, SQUARE)
    y, x = np.mgrid[: SQUARE.height, : SQUARE.width]
    inside = (x - SQUARE.cx) ** 2 + (y - SQUARE.cy) ** 2 < 239.0**2
    return DepthFrame(np.where(inside, depth, np.float32(0)), SQUARE)


def shares_of_d0(number, signer):
    """Distance to the unrolled view, for each angle, as a share of d0."""
    still, *turned = (sign(rolled(number, a), signer) for a in (0, *ANGLES))
    return [distance(still, one) / signer.model.unrelated_distance for one in turned]


@pytest.fixture(scope="module", params=[pytest.param("paper", marks=pytest.mark.thorough), "depth"])
def signer(request):
    return open_signer(request.param)


@pytest.fixture(scope="module")
def paper():
    return open_signer("paper")


def every(path, step):
    return [f for s in find_sequences(path) for f in s.frames][::step]


def pairwise(rows):
    upper = np.triu_indices(len(rows), 1)
    return np.array([[np.abs(a - b).sum() for b in rows] for a in rows])[upper]


def test_the_table_keeps_the_distances_of_the_exact_path(data_root, signer):
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


def test_retrieval(data_root, paper):
    """Every fourth frame of a split of docs/model.md: .604, .84."""
    (sequence,) = find_sequences(data_root / "7scenes/redkitchen")
    database, queries = ([sequence.frames[i].read_depth() for i in part] for part in SPLIT)
    d, q = psi_of(database, paper), psi_of(queries, paper)
    step, metric = paper.model.quantiser_step, paper.model.metric
    stored = cross_distances(quantise(q, step), quantise(d, step), metric).astype(float)
    exact = np.stack([np.abs(d - one).sum(axis=1) for one in q])
    truth = overlaps([view_of(f) for f in queries], [view_of(f) for f in database]).mean
    first = np.take_along_axis(truth, ranks(stored), axis=1)[:, 0]
    assert truth.max(axis=1).mean() == pytest.approx(0.630, abs=0.002)
    assert first.mean() >= 0.59
    assert (first >= 0.5).mean() >= 0.81
    assert (first >= 0.3).mean() >= 0.97
    assert recall_at_10(stored, exact) >= 0.99


def psi_of(frames, signer):
    """(N, D) psi before any rounding."""
    found = []
    for frame in frames:
        patches = describe(frame, signer.model.parameters).levels
        statistics = [table_statistics(patches[level], signer) for level in signer.model.levels]
        found.append(float_signature(statistics, signer.model, frame.name))
    return np.stack(found)


def test_another_rooms_frame_is_farther(signer, room_frames):
    signed = [sign(frame, signer) for frame in room_frames]
    across = [distance(a, b) for a in signed[:3] for b in signed[3:]]
    assert np.median(across) / signer.model.unrelated_distance == pytest.approx(1.0, abs=0.25)


@pytest.mark.thorough
def test_a_roll_of_the_camera_changes_little(signer):
    """The same content at every angle: what is left is the segmentation's own noise.

    A third of d0 is what we want; one of the 84 measurements misses it, as docs/limits.md
    says.
    """
    shares = np.array([shares_of_d0(i, signer) for i in range(12)])
    assert np.median(shares) <= 0.2
    assert (shares <= 1 / 3).mean() >= 0.98
    assert shares.max() <= 0.35
