"""Overlap of clouds, by hand: walls of points."""

from __future__ import annotations

import numpy as np
import pytest

from sceneprint.types import Cloud, DepthFrame, Floats, Intrinsics
from sceneprint_lab.evaluation.protocol import POINTS, SAMPLES, overlap, view_of

CAMERA = Intrinsics(80, 60, 70.0, 70.0, 39.5, 29.5)


def wall(
    left: float, right: float, ahead: float = 2.0, *, at: float = 0.0, has_viewpoint: bool = True
) -> Cloud:
    """A wall of points 1 cm apart across x, 5 cm up, seen from `at` on the x axis."""
    x, y = np.meshgrid(np.arange(left, right - 1e-9, 0.01), np.arange(-0.5, 0.5, 0.05))
    points = np.column_stack([x.ravel() - at, y.ravel(), np.full(x.size, ahead)])
    pose: Floats = np.eye(4)
    pose[0, 3] = at
    return Cloud(points.astype(np.float32), has_viewpoint, pose=pose)


def test_half_of_a_wall() -> None:
    mean, least = overlap(view_of(wall(0, 1)), view_of(wall(0.5, 1.5, at=0.3)))
    # half, and what lies within 5 cm + 3 % (or 10 cm + 3 %) of 2 m beyond the edge
    assert mean == pytest.approx(0.5 + 0.11, abs=0.02)
    assert least == pytest.approx(0.5 + 0.16, abs=0.02)


def test_the_two_tolerances_grow_with_range() -> None:
    near, far = wall(0, 1), wall(0, 1, 20.0)
    assert overlap(view_of(near), view_of(wall(0, 1, 2.13))) == (0.0, 1.0)  # 11 to 16 cm
    assert overlap(view_of(near), view_of(wall(0, 1, 2.3))) == (0.0, 0.0)
    assert overlap(view_of(far), view_of(wall(0, 1, 20.6))) == (1.0, 1.0)  # 65 cm at 20 m


def test_without_a_viewpoint_they_do_not() -> None:
    far = view_of(wall(0, 1, 20.0, has_viewpoint=False))
    assert overlap(far, view_of(wall(0, 1, 20.2, has_viewpoint=False))) == (0.0, 0.0)
    assert overlap(far, view_of(wall(0, 1, 20.08, has_viewpoint=False))) == (0.0, 1.0)


def test_a_turned_cloud_in_its_place_is_the_same() -> None:
    turned = wall(0, 1)
    turn: Floats = np.eye(4)
    turn[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    assert turned.pose is not None
    pose = turned.pose @ np.linalg.inv(turn)
    other = Cloud((turned.points @ turn[:3, :3].T).astype(np.float32), pose=pose)
    assert overlap(view_of(turned), view_of(other)) == (1.0, 1.0)


def test_a_cloud_beside_a_depth_image() -> None:
    pose: Floats = np.eye(4)
    image = DepthFrame(np.full((60, 80), 2.0, np.float32), CAMERA, pose=pose)
    # of 4 m of wall the image is 80 / 70 * 2 wide; of its three rows of samples the wall, half a
    # metre up and down, is within 11 cm of two
    mean, _ = overlap(view_of(wall(-2, 2)), view_of(image))
    assert mean == pytest.approx((80 / 70 * 2 / 4 + 2 / 3) / 2, abs=0.005)
    assert overlap(view_of(wall(-2, 2, 3.0)), view_of(image)) == (0.0, 0.0)


def test_large_clouds_are_thinned() -> None:
    points = np.random.default_rng(0).random((POINTS + 5, 3)).astype(np.float32)
    view = view_of(Cloud(points, pose=np.eye(4)))
    assert len(view.samples) <= SAMPLES
    few = view_of(Cloud(points[:9], pose=np.eye(4)))
    np.testing.assert_allclose(few.samples, points[:9])


def test_a_cloud_without_a_pose_has_no_overlap() -> None:
    with pytest.raises(ValueError, match="has no pose"):
        view_of(Cloud(np.zeros((10, 3), np.float32), name="lost"))
