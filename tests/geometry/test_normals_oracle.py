"""Tests of the two-pass fit against lstsq for each pixel, in double precision."""

import numpy as np

from sceneprint.geometry.surface.depth_image import NormalParameters, fit_surface
from sceneprint.types import Intrinsics

CAMERA = Intrinsics(26, 18, 40.0, 37.0, 12.0, 9.5)
PARAMETERS = NormalParameters(
    radius_px=2,
    depth_gate=0.06,
    plane_gate=0.004,
    minimum_samples=8,
    minimum_spread=0.25,
    minimum_cosine=0.15,
)


def one_fit(q, y, x, radius, plane, gate):
    """Least squares over the window's samples near `plane`: (q, a, b), their number, spread."""
    samples = []
    for v in range(max(y - radius, 0), min(y + radius + 1, q.shape[0])):
        for u in range(max(x - radius, 0), min(x + radius + 1, q.shape[1])):
            expected = plane[0] + plane[1] * (u - x) + plane[2] * (v - y)
            if q[v, u] > 0 and abs(q[v, u] - expected) < gate:
                samples.append((u - x, v - y, q[v, u]))
    s = np.array(samples).reshape(-1, 3)
    spread = float(np.linalg.det(np.cov(s[:, :2].T, ddof=0))) if len(s) > 1 else 0.0
    if spread < 1e-3:
        return np.array([q[y, x], 0.0, 0.0]), len(s), spread
    design = np.column_stack([np.ones(len(s)), s[:, :2]])
    return np.linalg.lstsq(design, s[:, 2], rcond=None)[0], len(s), spread


def naive(q, y, x, p):
    """Point and normal of a pixel, or None."""
    if q[y, x] == 0:
        return None
    first = one_fit(q, y, x, p.radius_px, np.array([q[y, x], 0, 0]), p.depth_gate * q[y, x])
    # the second pass expects its samples near the first plane, moved to the centre's sample
    # only by what the first fit says
    second = one_fit(q, y, x, p.radius_px, first[0], p.plane_gate * (1 + q[y, x]))
    (at, a, b), n, spread = second
    if n < p.minimum_samples or spread < p.minimum_spread or not 0.8 <= at / q[y, x] <= 1.25:
        return None
    ray = np.array([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, 1.0])
    # 1/z = A X/z + B Y/z + C, so A X + B Y + C Z = 1
    normal = -np.array([a * CAMERA.fx, b * CAMERA.fy, 0.0])
    normal[2] = -(at + normal[0] * ray[0] + normal[1] * ray[1])
    normal /= np.linalg.norm(normal)
    if -normal @ ray / np.linalg.norm(ray) < p.minimum_cosine:
        return None
    return ray / at, normal


def test_equals_least_squares_pixel_by_pixel():
    rng = np.random.default_rng(5)
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    q = 0.5 + 0.08 * np.sin(x / 6 + 0.3) + 0.06 * np.cos(y / 5) + rng.normal(0, 8e-4, x.shape)
    q[:, 17:] *= 0.8  # a step
    q[rng.random(q.shape) < 0.12] = 0.0  # and holes
    q[:2, :3] = 0.0
    # the oracle works on what the kernel is given
    values = q.astype(np.float32)
    seen = fit_surface(values, CAMERA, PARAMETERS)
    expected = np.zeros(q.shape, bool)
    for v in range(q.shape[0]):
        for u in range(q.shape[1]):
            fitted = naive(values.astype(float), v, u, PARAMETERS)
            expected[v, u] = fitted is not None
            if fitted is not None and seen.valid[v, u]:
                np.testing.assert_allclose(seen.points[v, u], fitted[0], rtol=1e-4, atol=1e-6)
                np.testing.assert_allclose(seen.normals[v, u], fitted[1], rtol=0, atol=1e-4)
    np.testing.assert_array_equal(seen.valid, expected)
    assert 200 < expected.sum() < (q > 0).sum()  # and some pixels do fix no plane
