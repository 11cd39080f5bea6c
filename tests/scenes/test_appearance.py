"""Tests of outlines and colours against manual results."""

import numpy as np

from sceneprint_client.api.base import CameraIntrinsics
from sceneprint_viewers.scene import (
    FRUSTUM_M,
    SMALL_M,
    frustum,
    height_colours,
    small_outline,
    up_of_sensors,
)

#: 4 x 2 pixels, 90 degrees wide, its axis in the middle.
CAMERA = CameraIntrinsics(width=4, height=2, fx=2, fy=2, cx=1.5, cy=0.5)


def test_the_outline_of_a_camera():
    drawn = frustum(CAMERA, (1, 2, 3))
    d, h = FRUSTUM_M, FRUSTUM_M / 2
    corners = [(-d, -h, d), (d, -h, d), (d, h, d), (-d, h, d)]
    for strip, corner in zip(drawn.strips[:4], corners, strict=True):
        np.testing.assert_allclose(strip, [(0, 0, 0), corner])
    np.testing.assert_allclose(drawn.strips[4], [*corners, corners[0]])
    np.testing.assert_allclose(drawn.strips[5], [corners[0], (0, -h - 0.2 * d, d), corners[1]])
    assert set(drawn.colours) == {(1, 2, 3)}
    assert len(drawn.colours) == len(drawn.strips) == 6
    small = small_outline(CAMERA, (1, 2, 3))
    np.testing.assert_allclose(small.strips[0][1], np.array(corners[0]) * SMALL_M / FRUSTUM_M)
    assert small.width_px < drawn.width_px


def test_colours_rise_with_height():
    points = np.zeros((101, 3))
    points[:, 1] = np.linspace(0, -5, 101)  # y down
    up = np.array([0.0, -1.0, 0.0])
    colours = height_colours(points, up)
    assert colours[0].tolist() == [41, 1, 50]  # 0.6 of viridis's violet (68, 1, 84)
    assert colours[-1].tolist() == [152, 139, 22]  # and of its yellow (253, 231, 37)
    assert (np.diff(colours[:, 1].astype(int)) >= 0).all()
    outlier = height_colours(np.vstack([points, [0, -500, 0]]), up)
    assert abs(outlier[:101].astype(int) - colours).max() < 12
    assert height_colours(np.zeros((0, 3)), up).shape == (0, 3)
    assert len({tuple(one) for one in height_colours(np.ones((5, 3)), up).tolist()}) == 1


def test_up_is_where_sensors_are_carried_upright():
    level = np.eye(4)  # x right, y down, z forward in a parent whose z is up
    level[:3, :3] = np.array([(1, 0, 0), (0, 0, -1), (0, 1, 0)]).T
    tilted = level.copy()
    c, s = np.cos(0.5), np.sin(0.5)
    tilted[:3, :3] = level[:3, :3] @ [(1, 0, 0), (0, c, -s), (0, s, c)]
    assert up_of_sensors([level, tilted], cameras=True).tolist() == [0, 0, 1]
    assert up_of_sensors([np.eye(4)], cameras=False).tolist() == [0, 0, 1]
    assert up_of_sensors([np.eye(4)], cameras=True).tolist() == [0, -1, 0]
    assert up_of_sensors([], cameras=True).tolist() == [0, 0, 1]
