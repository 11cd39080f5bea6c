"""Tests of plane fits in inverse depth against planes, a sphere and a simple loop."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneprint.geometry.surface.depth_image import (
    DepthParameters,
    NormalParameters,
    fit_surface,
    inverse_depth,
)
from sceneprint.types import DepthFrame, Intrinsics

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


@pytest.mark.parametrize("distance", [0.5, 2.0, 6.0])
@pytest.mark.parametrize(("tilt", "about"), [(0, 0), (30, 20), (50, 200), (60, 110)])
def test_planes_are_exact(scenes, distance, tilt, about):
    normal, point = tilted(tilt, about), np.array([0.0, 0.0, distance])
    q = scenes.plane(KINECT, normal, point)
    seen = fit(q, KINECT)
    rays = scenes.rays(KINECT)
    cosine = -(rays @ normal) / np.linalg.norm(rays, axis=2)
    at = seen.valid
    assert at[cosine > 0.5].all()
    assert not at[cosine < 0.1].any()
    assert at.mean() > 0.9
    assert (
        scenes.degrees_between(seen.normals[at].astype(float), normal).max() < 0.005
    )  # measured: 0.0001
    off_plane = (seen.points[at] - point) @ normal
    assert np.abs(off_plane / seen.points[at][:, 2]).max() < 1e-5  # measured: 1e-7
    # the point lies on its pixel's ray
    sideways = seen.points[at] / seen.points[at][:, 2:] - rays[at]
    assert np.abs(sideways).max() < 1e-5


def test_normals_are_unit_and_face_the_sensor(scenes):
    rng = np.random.default_rng(0)
    smooth = scenes.plane(KINECT, tilted(40, 70), np.array([0, 0, 2.0]))
    seen = fit(smooth * (1 + 0.02 * rng.normal(size=smooth.shape)), KINECT)
    at = seen.valid
    assert at.mean() > 0.5
    assert ((seen.normals[at] * seen.points[at]).sum(axis=1) < 0).all()
    np.testing.assert_allclose(np.linalg.norm(seen.normals[at], axis=1), 1, atol=1e-6)
    assert not seen.points[~at].any()
    assert not seen.normals[~at].any()
    assert not seen.areas[~at].any()


def test_step_edge_does_not_bleed(scenes):
    # walls at 1.5 and 2.0 m, the nearer on the left: exact up to the last column before the edge
    q = np.full((120, 160), 1 / 2.0)
    q[:, :70] = 1 / 1.5
    seen = fit(q, KINECT)
    assert seen.valid.all()
    assert scenes.degrees_between(seen.normals.astype(float), np.array([0, 0, -1.0])).max() < 0.05
    np.testing.assert_allclose(1 / seen.points[..., 2], q, rtol=1e-5)


def test_crease_is_sharp(scenes):
    # two walls that meet in a vertical edge 2 m ahead, leaning 45 degrees each
    left, right = scenes.unit(1, 0, -1), scenes.unit(-1, 0, -1)
    edge = np.array([0.0, 0.0, 2.0])
    q = np.maximum(scenes.plane(KINECT, left, edge), scenes.plane(KINECT, right, edge))
    seen = fit(q, KINECT)
    rays = scenes.rays(KINECT)
    is_right = rays @ right / (right @ edge) > rays @ left / (left @ edge)
    truth = np.where(is_right[..., None], right, left)
    off = scenes.degrees_between(seen.normals.astype(float), truth)
    columns = np.abs(np.arange(160) - 79.5) - 0.5  # 0, 0 at the edge
    away = seen.valid & (columns >= PARAMETERS.radius_px)  # windows that do not reach over it
    assert away.sum() == seen.valid[:, columns >= PARAMETERS.radius_px].size
    assert off[away].max() < 0.05


def kinect_noise(q, camera, rng):
    """Depth of a structured-light sensor: disparity off by 0.1 px, in steps of 1/8 px."""
    per_disparity = 1 / (camera.fx * 0.075)  # 1/m for a pixel, over a baseline of 75 mm
    disparity = np.rint((q / per_disparity + rng.normal(0, 0.1, q.shape)) * 8) / 8
    return (1 / (disparity * per_disparity)).astype(np.float32)


@pytest.mark.parametrize(("tilt", "bound"), [(10, 1.0), (45, 0.65)])
def test_noise_of_a_kinect_at_two_metres(scenes, tilt, bound):
    camera = Intrinsics(640, 480, 585.0, 585.0, 319.5, 239.5)
    normal = tilted(tilt, 33)
    depth = kinect_noise(
        scenes.plane(camera, normal, np.array([0, 0, 2.0])), camera, np.random.default_rng(3)
    )
    reduction = DepthParameters(
        minimum_depth=0.3, maximum_depth=9.0, same_surface=0.03,
        focal_length_px=146.0, maximum_pixels=160 * 120 * 4, minimum_valid=64,
    )  # fmt: skip
    q, reduced = inverse_depth(DepthFrame(depth, camera), reduction)
    seen = fit(q, reduced)
    near = seen.valid & (np.abs(seen.points[..., 2] - 2) < 0.3)
    assert near.sum() > 2000
    off = scenes.degrees_between(seen.normals[near].astype(float), normal)
    assert np.median(off) < bound  # measured, over three seeds: 0.84-0.88 and 0.52-0.55


def test_sphere(scenes):
    centre, radius = np.array([0.1, -0.1, 2.0]), 0.6
    rays = scenes.rays(KINECT)
    # |t ray - centre| = radius, the nearer root
    a, b = (rays**2).sum(axis=2), rays @ centre
    inside = b**2 - a * (centre @ centre - radius**2)
    z = (b - np.sqrt(np.maximum(inside, 0))) / a
    seen = fit(np.where(inside > 0, 1 / z, 0.0), KINECT)
    truth = (rays * z[..., None] - centre) / radius
    off = scenes.degrees_between(seen.normals.astype(float), truth)
    cosine = -(truth * rays).sum(axis=2) / np.linalg.norm(rays, axis=2)
    facing = (inside > 0) & (cosine > 0.6)
    assert facing.sum() > 3000
    assert seen.valid[facing].all()
    # only the curvature within the window bends the fit
    assert np.median(off[facing]) < 0.2  # measured: 0.12
    assert off[facing].max() < 0.7  # 0.44
    distance = np.linalg.norm(seen.points[facing] - centre, axis=1)
    assert np.abs(distance - radius).max() < 0.002  # 0.0014: the fit cuts the cap off


def on_plane(u, v, camera, normal, point):
    ray = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
    return ray * (normal @ point) / (normal @ ray)


@pytest.mark.parametrize(("tilt", "about"), [(0, 0), (35, 0), (50, 130)])
@pytest.mark.parametrize("block", [(60, 40, 100, 80), (2, 3, 30, 25), (5, 5, 155, 115)])
def test_areas_sum_to_the_rectangle(scenes, tilt, about, block):
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


def test_grazing_surfaces_are_not_valid(scenes):
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
