"""Tests of overlap against manual results and a simple loop."""

import numpy as np
import pytest

from sceneprint.types import DepthFrame, Intrinsics
from sceneprint_lab.evaluation.protocol import (
    GRID,
    PAIR_TOLERANCE,
    RELATIVE_TOLERANCE,
    TOLERANCE,
    overlap,
    overlaps,
    view_of,
)

CAMERA = Intrinsics(80, 60, 70.0, 70.0, 39.5, 29.5)


def wall(shift=0.0, distance=2.0):
    """A wall across the whole image, seen from `shift` metres to the right."""
    pose = np.eye(4)
    pose[0, 3] = shift
    return DepthFrame(np.full((60, 80), distance, np.float32), CAMERA, pose=pose)


def test_by_hand():
    # the grid has 4 columns at 10, 30, 50, 70; 2 m away, 40 px are 40 / 70 * 2 m: two columns
    half = 40 / 70 * 2
    others = [wall(), wall(half), wall(100.0), wall(0.0, 3.0)]
    found = overlaps([view_of(wall())], [view_of(one) for one in others])
    np.testing.assert_allclose(found.mean, [[1.0, 0.5, 0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(found.least, [[1.0, 0.5, 0.0, 0.0]], atol=1e-12)


def test_the_two_tolerances():
    # 10.5 cm apart at 2 m: within 5 cm + 3 % (11 cm), not within 10 cm
    assert overlap(view_of(wall()), view_of(wall(0.0, 2.105))) == (1.0, 0.0)
    assert overlap(view_of(wall()), view_of(wall(0.0, 2.095))) == (1.0, 1.0)


def test_the_mean_and_the_smaller_direction():
    half = wall()
    half.depth[:, 40:] = 0  # sees two of the four columns, and all it sees is seen by the other
    assert overlap(view_of(wall()), view_of(half)) == (0.75, 0.5)
    empty = wall()
    empty.depth[:] = 0
    assert overlap(view_of(wall()), view_of(empty)) == (0.0, 0.0)


def test_a_frame_without_a_pose_has_no_overlap():
    with pytest.raises(ValueError, match="has no pose"):
        view_of(DepthFrame(wall().depth, CAMERA, "lost"))


def plain_shares(a, b):
    """Of the samples of a, those that b sees where they are."""
    assert b.pose is not None
    k, seen, loose, strict = a.intrinsics, 0, 0, 0
    for v in range(GRID // 2, k.height, GRID):
        for u in range(GRID // 2, k.width, GRID):
            z = float(a.depth[v, u])
            if z <= 0:
                continue
            seen += 1
            point = np.array([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z, 1.0])
            x, y, z, _ = np.linalg.inv(b.pose) @ a.pose @ point
            if z <= 1e-6:
                continue
            column = round(x / z * b.intrinsics.fx + b.intrinsics.cx)
            row = round(y / z * b.intrinsics.fy + b.intrinsics.cy)
            if 0 <= column < b.intrinsics.width and 0 <= row < b.intrinsics.height:
                there = float(b.depth[row, column])
                loose += there > 0 and abs(there - z) < TOLERANCE + RELATIVE_TOLERANCE * z
                strict += there > 0 and abs(there - z) < PAIR_TOLERANCE
    return loose / seen, strict / seen


def test_against_the_plain_loop(room_frames):
    from sceneprint_lab.synth import synthesise_room

    frames = [*room_frames[:3], *synthesise_room(3, 0, 25, along_path=True, step=12).frames]
    views = [view_of(frame) for frame in frames]
    found = overlaps(views, views)
    for i, a in enumerate(frames):
        for j, b in enumerate(frames):
            there, back = plain_shares(a, b), plain_shares(b, a)
            # a sample may fall on a pixel's edge, where a rounding decides
            assert found.mean[i, j] == pytest.approx((there[0] + back[0]) / 2, abs=0.004)
            assert found.least[i, j] == pytest.approx(min(there[1], back[1]), abs=0.004)
    assert 0.2 < found.mean[3, 4] < 1
    np.testing.assert_allclose(found.mean, found.mean.T)
