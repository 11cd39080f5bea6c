"""Tests of overlap against manual results and a simple loop."""

import numpy as np
import pytest

from sceneprint.types import DepthFrame, Intrinsics
from sceneprint_lab.evaluation.protocol import (
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
