"""Rows of `make bench`: what they compare is the same work, and pages hold what was measured."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import registration, scan
from benchmarks.machine import peak_megabytes_of_signing
from benchmarks.pairs import FramePair, pairs_among
from sceneprint.formats.dataset import Camera, write_depth_png, write_intrinsics
from sceneprint.models import Model
from sceneprint.types import DepthFrame, Floats, Intrinsics

CAMERA = Intrinsics(80, 60, 70.0, 70.0, 39.5, 29.5)


def wall(shift: float = 0.0) -> DepthFrame:
    """A wall 2 m away, seen by a camera `shift` metres to the right, and turned upside down."""
    pose: Floats = np.diag([-1.0, -1.0, 1.0, 1.0])
    pose[0, 3] = shift
    return DepthFrame(np.full((60, 80), 2.0, np.float32), CAMERA, f"{shift:g} m", pose)


def pair_of(frames: tuple[DepthFrame, ...]) -> FramePair:
    """A frame with itself."""
    return FramePair(frames[0], frames[0], 1.0, np.eye(4))


def test_scan_compares_a_read_and_four_scans() -> None:
    lines = scan.measure(signatures=5, length=64, runs=3)
    assert "5 signatures of 64 bytes (0.0 MB)" in lines[0]
    rows = [line.strip("| ").split(" | ") for line in lines if line.startswith("| L")]
    assert [row[0] for row in rows] == [
        f"{norm}, {queries}" for norm in ("L1", "L2")
        for queries in ("one query", f"{scan.TOGETHER} queries at once")
    ]  # fmt: skip
    for _, ms, share, quartiles in rows:
        low, high = map(float, quartiles.split(" to "))
        assert float(ms) >= 0
        assert 0 <= low <= float(share) <= high


def test_pairs_by_hand() -> None:
    half = 40 / 70 * 2  # half of the width that is seen
    pairs = pairs_among([wall(), wall(half), wall(2 * half), wall(2.5 * half)])
    names = [(pair.query.name, pair.match.name) for pair in pairs]
    assert names == [
        (wall(half).name, wall().name),
        (wall(2 * half).name, wall(half).name),
        (wall(2.5 * half).name, wall(2 * half).name),
    ]
    assert pairs[0].overlap == 0.5
    # both cameras stand on their heads: what is to the right in the room is to their left
    np.testing.assert_allclose(pairs[0].T_match_query[:3, 3], [-half, 0, 0], atol=1e-12)
    np.testing.assert_allclose(pairs[0].T_match_query[:3, :3], np.eye(3), atol=1e-12)
    assert pairs_among([wall(), wall(), wall()], apart=2)[0].match.name == "0 m"
    assert len(pairs_among([wall(), wall(), wall()], apart=2)) == 1


def test_without_open3d_the_row_says_so(
    small_model: Model, room_frames: tuple[DepthFrame, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    lines = registration.measure([pair_of(room_frames)], small_model, warm_up=0)
    rows = dict(line.strip("| ").split(" | ", 1) for line in lines if line.startswith("| "))
    stages = [float(rows[name]) for name in ("geometry of both frames", "validation")]
    assert float(rows["**ours, sum**"].strip("*")) == pytest.approx(sum(stages), abs=0.11)
    assert rows["Open3D"].startswith("not measured: FPFH needs Open3D, which cannot be imported")
    assert not any("ours / Open3D" in line or "Open3D's" in line for line in lines)
    assert "truth: 1.00 of the pairs." in "\n".join(lines)


@pytest.mark.parametrize("preset", ["paper", "depth"])
def test_signing_stays_under_its_memory(
    preset: str, room_frames: tuple[DepthFrame, ...], tmp_path: Path
) -> None:
    """The budget is 700 MB; a process that has done its imports alone needs over 50."""
    write_intrinsics(tmp_path, Camera(room_frames[0].intrinsics))
    write_depth_png(tmp_path / "frame.png", room_frames[0].depth, 1000.0)
    assert 50 < peak_megabytes_of_signing(tmp_path, preset) < 700
