"""Tests of plane fits in inverse depth against planes, a sphere and a simple loop."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneprint.geometry.surface.depth_image import NormalParameters, fit_surface
from sceneprint.types import Intrinsics
from tests.geometry import scenes

PARAMETERS = NormalParameters(
    radius_px=3,
    depth_gate=0.05,
    plane_gate=0.006,
    minimum_samples=9,
    minimum_spread=0.3,
    minimum_cosine=0.12,
)
KINECT = Intrinsics(160, 120, 146.25, 146.25, 79.5, 59.5)


def fit(q, camera, p=PARAMETERS):
    return fit_surface(np.ascontiguousarray(q, np.float32), camera, p)


def tilted(degrees, about):
    """A normal towards the sensor, leaning by so much in the direction `about`."""
    turn = Rotation.from_euler("zx", [about, degrees], degrees=True)
    return -turn.inv().apply([0.0, 0.0, 1.0])


def on_plane(u, v, camera, normal, point):
    ray = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
    return ray * (normal @ point) / (normal @ ray)


@pytest.mark.parametrize(("tilt", "about"), [(0, 0), (50, 130)])
@pytest.mark.parametrize("block", [(2, 3, 30, 25), (5, 5, 155, 115)])
def test_areas_sum_to_the_rectangle(tilt, about, block):
    normal, point = tilted(tilt, about), np.array([0.0, 0.0, 2.0])
    seen = fit(scenes.plane(KINECT, normal, point), KINECT)
    x0, y0, x1, y1 = block
    assert seen.valid[y0:y1, x0:x1].all()
    # pixels reach half a pixel around their centres; the quadrilateral is two triangles
    a, b, c, d = (
        on_plane(u - 0.5, v - 0.5, KINECT, normal, point)
        for u, v in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
    )
    area = (np.linalg.norm(np.cross(b - a, c - a)) + np.linalg.norm(np.cross(c - a, d - a))) / 2
    assert seen.areas[y0:y1, x0:x1].sum(dtype=float) == pytest.approx(area, rel=2e-3)


def test_grazing_surfaces_are_not_valid():
    # a floor 0.5 m below; gates wide open, so that only the angle of incidence rejects
    floor = np.array([0.0, -1.0, 0.0])
    q = scenes.plane(KINECT, floor, np.array([0.0, 0.5, 0.0]))
    p = NormalParameters(
        radius_px=3, depth_gate=0.9, plane_gate=0.006,
        minimum_samples=9, minimum_spread=0.3, minimum_cosine=0.2,
    )  # fmt: skip
    seen = fit(q, KINECT, p)
    rays = scenes.rays(KINECT)
    cosine = rays[..., 1] / np.linalg.norm(rays, axis=2)
    assert seen.valid[cosine > 0.201].all()
    assert not seen.valid[cosine < 0.199].any()
    assert 0.2 < seen.valid.mean() < 0.4


def test_too_few_samples_fix_no_plane():
    q = np.zeros((20, 20))
    q[3, :] = 0.5  # a line: no spread
    q[10:12, 10:14] = 0.5  # eight samples
    q[15:18, 10:13] = 0.5  # nine
    valid = fit(q, Intrinsics(20, 20, 70.0, 70.0, 9.5, 9.5)).valid
    expected = np.zeros((20, 20), bool)
    expected[15:18, 10:13] = True
    np.testing.assert_array_equal(valid, expected)
