"""Tests of undistortion and of ranges along rays against a simple loop and known planes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from sceneprint.geometry.surface.camera import ray_to_axis, undistort
from sceneprint.types import Intrinsics

LENS = (-0.28, 0.09, 0.0015, -0.0022, -0.012)  # every term of the model is at work
CAMERA = Intrinsics(64, 48, 50.0, 52.0, 30.5, 24.25, LENS)
#: A lens whose radial factor is a quotient, as that of an Azure Kinect.
QUOTIENT = replace(CAMERA, distortion=(0.1, 0.05, 0.0015, -0.0022, 0.012, 0.45, 0.12, 0.03))


def seen(x, y, k):
    """OpenCV's formula, written a second time from its documentation."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*k, *[0.0] * 4)[:8]
    r = math.hypot(x, y)
    radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
    radial /= 1 + k4 * r**2 + k5 * r**4 + k6 * r**6
    return (
        x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
        y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
    )


def true_ray(u, v, c):
    """Direction whose picture is (u, v), by a general solver."""
    target = ((u - c.cx) / c.fx, (v - c.cy) / c.fy)
    solution = least_squares(
        lambda q: np.subtract(seen(q[0], q[1], c.distortion), target), target, xtol=1e-14
    )
    return float(solution.x[0]), float(solution.x[1])


def test_undistort_by_hand():
    # x = (u - 2) / 2; k1 = 1: x = 1/2 is seen at 1/2 (1 + 1/4) = 0.625, u = 3.25 -> 3;
    # x = 1 is seen at 2, u = 6, outside
    camera = Intrinsics(5, 1, 2.0, 2.0, 2.0, 0.0, (1.0, 0.0, 0.0, 0.0))
    depth = np.array([[1, 2, 3, 4, 5]], np.float32)
    assert undistort(depth, camera).tolist() == [[0, 2, 3, 4, 0]]
    # k1 = -0.4: x = 1 is seen at 0.6, u = 3.2 -> 3, but 1 + 3 k1 x^2 < 0: folded
    camera = Intrinsics(5, 1, 2.0, 2.0, 2.0, 0.0, (-0.4, 0.0, 0.0, 0.0))
    assert undistort(depth, camera).tolist() == [[0, 2, 3, 4, 0]]


@pytest.mark.parametrize("camera", [CAMERA, QUOTIENT])
def test_undistort_equals_the_loop(camera):
    numbers = np.arange(1, camera.width * camera.height + 1, dtype=np.float32)
    image = numbers.reshape(camera.height, camera.width)
    expected = np.zeros_like(image)
    for v in range(camera.height):
        for u in range(camera.width):
            x, y = seen((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, camera.distortion)
            column = math.floor(x * camera.fx + camera.cx + 0.5)
            row = math.floor(y * camera.fy + camera.cy + 0.5)
            if 0 <= column < camera.width and 0 <= row < camera.height:
                expected[v, u] = image[row, column]
    result = undistort(image, camera)
    np.testing.assert_array_equal(result, expected)
    assert (result > 0).mean() > 0.8


@pytest.mark.parametrize("camera", [CAMERA, QUOTIENT])
def test_a_plane_seen_through_a_lens_comes_back(camera):
    """n . p = 2 is filmed as ranges through the lens; z must be right at every sixth pixel."""
    normal, offset = np.array([0.3, -0.2, 0.933]), 2.0
    ranges = np.zeros((camera.height, camera.width), np.float32)
    z_taken = np.zeros_like(ranges)
    for v in range(0, camera.height, 6):
        for u in range(0, camera.width, 6):
            ray = np.array([*true_ray(u, v, camera), 1.0])
            z_taken[v, u] = offset / (normal @ ray)
            ranges[v, u] = z_taken[v, u] * np.linalg.norm(ray)
    z = ray_to_axis(ranges, camera)
    np.testing.assert_allclose(z[::6, ::6], z_taken[::6, ::6], rtol=2e-6)


@pytest.mark.parametrize("k1", [-0.8, -3.0])
def test_a_fold_has_rays_only_before_it(k1):
    """The picture of r ends at r = 1/sqrt(-3 k1), at 2/3 of it; beyond there is no ray."""
    camera = Intrinsics(81, 61, 60.0, 60.0, 40.0, 30.0, (k1, 0.0, 0.0, 0.0))
    z = ray_to_axis(np.ones((61, 81), np.float32), camera)
    v, u = np.indices(z.shape)
    r_seen = np.hypot(u - 40.0, v - 30.0) / 60.0
    fold = 1.0 / math.sqrt(-3.0 * k1)
    assert (z[r_seen > 2 / 3 * fold] == 0).all()
    inner = r_seen < 0.98 * 2 / 3 * fold
    assert inner.sum() > 50
    # cosine of the true ray: root of k1 r^3 + r = r_seen below the fold
    for rs, response in zip(r_seen[inner][::7], z[inner][::7], strict=True):
        roots = np.roots([k1, 0.0, 1.0, -rs])
        r = min(q.real for q in roots if abs(q.imag) < 1e-9 and q.real > -1e-9)
        assert response == pytest.approx(1.0 / math.hypot(1.0, r), rel=1e-5)


def test_nothing_is_taken_behind_a_pole():
    """1 / (1 - 4 r^2) has a pole at r = 1/2, beyond which it is negative."""
    lens = (0.0, 0.0, 0.0, 0.0, 0.0, -4.0, 0.0, 0.0)
    camera = Intrinsics(201, 3, 100.0, 100.0, 100.0, 1.0, lens)
    seen_x = np.flatnonzero(undistort(np.ones((3, 201), np.float32), camera)[1]) / 100 - 1
    # r / (1 - 4 r^2) = 1 at r = (sqrt(17) - 1) / 8 = .39
    np.testing.assert_allclose([seen_x.min(), seen_x.max()], [-0.39, 0.39])


def test_nothing_is_taken_behind_a_narrow_fold():
    """Growth (1 - r^2 / a)(1 - r^2 / b) is negative for 0.51 < r < 0.53 and positive beyond."""
    a, b = 0.51**2, 0.53**2
    k1, k2 = -(1 / a + 1 / b) / 3, 1 / (a * b) / 5
    camera = Intrinsics(201, 3, 100.0, 100.0, 100.0, 1.0, (k1, k2, 0.0, 0.0))
    result = undistort(np.ones((3, 201), np.float32), camera)
    assert result[1, 100 - 50 : 100 + 51].all()
    assert not result[:, : 100 - 51].any()
    assert not result[:, 100 + 52 :].any()


coefficient = st.one_of(
    st.floats(-3, 3), st.floats(allow_nan=False, allow_infinity=False), st.just(0.0)
)
length = st.one_of(st.floats(1.0, 100.0), st.floats(1e-3, 1e7))
centre = st.one_of(st.floats(-10, 20), st.floats(-1e7, 1e7))


@settings(max_examples=50)
@given(length, length, centre, centre, st.lists(coefficient, min_size=8, max_size=8))
def test_any_camera_gives_samples_or_nothing(fx, fy, cx, cy, k):
    camera = Intrinsics(9, 7, fx, fy, cx, cy, tuple(k))
    image = np.linspace(1, 5, 63, dtype=np.float32).reshape(7, 9)
    z = ray_to_axis(image, camera)
    assert np.isfinite(z).all()
    assert ((z >= 0) & (z <= image)).all()
    assert np.isin(undistort(image, camera), [0.0, *image.ravel()]).all()


def test_blocks_fit_together():
    """An image of more than one block: undistorted pixel by pixel as a shifted crop."""
    camera = Intrinsics(1024, 600, 900.0, 900.0, 512.0, 300.0, (-0.2, 0.05, 0.001, 0.001))
    image = np.arange(1, 1024 * 600 + 1, dtype=np.int64).reshape(600, 1024)
    result = undistort((image % 65521).astype(np.float32), camera)
    for v, u in ((0, 512), (255, 1023), (256, 0), (300, 512), (512, 100), (599, 700)):
        x, y = seen((u - 512.0) / 900.0, (v - 300.0) / 900.0, camera.distortion)
        row, column = math.floor(y * 900 + 300.5), math.floor(x * 900 + 512.5)
        assert result[v, u] == image[row, column] % 65521
