"""Tests of pictures of surfaces: pixels of points, and rotation."""

import math

import numpy as np
import pytest

from sceneprint.pictures import vista_of
from sceneprint.types import Sphere, Surface


def surface(points, camera):
    """Of points (h, w, 3), all of them valid but those at the origin."""
    valid = points.any(axis=-1)
    normals = np.where(valid[..., None], -points, 0).astype(np.float32)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    return Surface(points.astype(np.float32), normals, valid, valid.astype(np.float32), camera)


def around(pole):
    """Four by three pixels about the axis ahead of a pole, ranges 1, 2, ... in their order."""
    camera = Sphere(4, 3, math.radians(10), math.radians(-15), math.radians(10), pole)
    azimuth = camera.left + camera.step * np.arange(4)
    elevation = (camera.top - camera.step * np.arange(3))[:, None]
    level = np.cos(elevation)
    rays = np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth),
         np.broadcast_to(np.sin(elevation), (3, 4))], axis=-1
    )  # fmt: skip
    ranges = np.arange(1.0, 13.0).reshape(3, 4, 1)
    return surface(np.roll(rays, pole - 2, axis=-1) * ranges, camera)


@pytest.mark.parametrize("pole", [0, 1, 2])
def test_a_range_image_is_no_mirror_image(pole):
    seen = around(pole)
    vista = vista_of(seen)
    assert vista.what == "range"
    assert np.allclose(vista.distances, np.arange(1, 13), atol=1e-6)
    shown = vista.of(seen.points.reshape(-1, 3)).astype(float)
    right, down = shown[1, 3] - shown[1, 0], shown[2, 1] - shown[0, 1]
    # right, down and ahead are a right-handed frame, as they are of a camera
    assert np.linalg.det([right, down, shown[1, 1]]) > 0
    if pole == 1:  # of an optical frame: x to the right, y down
        assert right[0] > 0
        assert down[1] > 0
    else:
        assert down[pole] < 0  # the pole is above


def test_points_in_no_order_are_seen_from_above():
    """A floor of 4 m x 2 m with a step on it, laid along other axes than the grid's."""
    x, y = np.meshgrid(np.linspace(0, 4, 41), np.linspace(0, 2, 21))
    z = np.where((x > 3) & (y > 1), 0.3, 0.0)
    floor = np.stack([x, y, z], axis=-1).reshape(1, -1, 3) + 1.0
    under = np.concatenate([floor, [[[1.0, 1.0, 0.95]]]], axis=1)  # hidden below a corner
    vista = vista_of(surface(under, None))
    assert vista.what == "height"
    rows, columns = vista.pixels.shape
    assert columns > rows  # the longer side lies across
    highest = vista.of(vista.distances)[vista.shown].max()
    at = np.argwhere(np.isclose(np.where(vista.shown, vista.of(vista.distances), -9), highest))
    assert at[:, 0].max() < rows / 2 < rows - 1  # y is up
    assert at[:, 1].min() > columns / 2  # x to the right
    assert under.shape[1] - 1 not in vista.pixels
