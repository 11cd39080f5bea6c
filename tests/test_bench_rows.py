"""Rows of `make bench`: what they compare is the same work."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.machine import peak_megabytes_of_signing
from benchmarks.pairs import FramePair, pairs_among
from sceneprint.formats.dataset import Camera, write_depth_png, write_intrinsics
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


@pytest.mark.parametrize("preset", ["paper", "depth"])
def test_signing_stays_under_its_memory(
    preset: str, room_frames: tuple[DepthFrame, ...], tmp_path: Path
) -> None:
    """The budget is 700 MB; a process that has done its imports alone needs over 50."""
    write_intrinsics(tmp_path, Camera(room_frames[0].intrinsics))
    write_depth_png(tmp_path / "frame.png", room_frames[0].depth, 1000.0)
    assert 50 < peak_megabytes_of_signing(tmp_path, preset) < 700
