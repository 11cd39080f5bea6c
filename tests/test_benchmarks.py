"""The measurements themselves: overlap by hand, and a missing open3d that stops nothing."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.__main__ import table
from benchmarks.encode import measure
from benchmarks.machine import peak_megabytes_of_signing
from benchmarks.overlap import overlaps
from benchmarks.retrieval import recall_at_10
from sceneprint.datasets import Camera, write_depth_png, write_intrinsics
from sceneprint.pipeline import Signer
from sceneprint.types import Floats, Frame, Intrinsics

CAMERA = Intrinsics(80, 60, 70.0, 70.0, 39.5, 29.5)


def wall(shift: float = 0.0, distance: float = 2.0) -> Frame:
    """A wall across the whole image, seen from `shift` metres to the right."""
    pose: Floats = np.eye(4)
    pose[0, 3] = shift
    return Frame(np.full((60, 80), distance, np.float32), CAMERA, pose=pose)


def test_overlap_by_hand() -> None:
    # the grid has 4 columns at 10, 30, 50, 70; 2 m away, 40 px are 40 / 70 * 2 m: two columns
    half = 40 / 70 * 2
    found = overlaps([wall()], [wall(), wall(half), wall(100.0), wall(0.0, 3.0)])
    np.testing.assert_allclose(found, [[1.0, 0.5, 0.0, 0.0]], atol=1e-12)


def test_recall_by_hand() -> None:
    exact = np.arange(20.0)[None]
    assert recall_at_10(exact, exact) == 1.0
    # the nearest four move behind all others: six of the first ten remain
    moved = np.where(exact < 4, exact + 100, exact)
    assert recall_at_10(moved, exact) == pytest.approx(0.6)


def test_without_open3d_the_row_says_so_and_the_rest_runs(
    small_signer: Signer, room_frames: tuple[Frame, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    figures = measure(list(room_frames[:3]), small_signer, warm_up=1)
    assert (figures.fpfh, figures.ratio, figures.fpfh_stages) == (None, None, {})
    assert figures.signing > 0
    assert len(figures.stages) == 7
    lines = "\n".join(table("small", figures, 100.0))
    assert "FPFH | not measured: open3d cannot be imported" in lines
    assert "apt install" in lines


@pytest.mark.parametrize("preset", ["paper", "compact"])
def test_signing_stays_under_its_memory(
    preset: str, room_frames: tuple[Frame, ...], tmp_path: Path
) -> None:
    """The budget is 700 MB; a process that has done its imports alone needs over 50."""
    write_intrinsics(tmp_path, Camera(room_frames[0].intrinsics))
    write_depth_png(tmp_path / "frame.png", room_frames[0].depth, 1000.0)
    assert 50 < peak_megabytes_of_signing(tmp_path, preset) < 700
