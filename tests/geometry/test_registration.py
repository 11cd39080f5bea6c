"""Tests of refinement: single steps, convergence and failure."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sceneprint.geometry.registration import icp as module
from sceneprint.geometry.registration.icp import COARSE, FINE, RefinementParameters, refine
from sceneprint.geometry.registration.overlap import sample_points
from sceneprint.geometry.rigid import pose_difference


def off(rng, metres, degrees):
    """A motion by that much, any way."""
    axis, shift = rng.normal(size=(2, 3))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    T[:3, 3] = metres * shift / np.linalg.norm(shift)
    return T


def step_oracle(source, target, T, p):
    """Information, step and points of one Gauss-Newton step, from the definition."""
    J, r, w = [], [], []
    k = target.camera
    for row in source.astype(float):
        point, normal = T[:3, :3] @ row[:3] + T[:3, 3], T[:3, :3] @ row[3:]
        u = int(np.floor(point[0] / point[2] * k.fx + k.cx + 0.5))
        v = int(np.floor(point[1] / point[2] * k.fy + k.cy + 0.5))
        if not (1 <= u < k.width - 1 and 1 <= v < k.height - 1):
            continue
        nine = target.points[v - 1 : v + 2, u - 1 : u + 2].reshape(9, 3).astype(float)
        facing = target.normals[v - 1 : v + 2, u - 1 : u + 2].reshape(9, 3).astype(float)
        gaps = np.linalg.norm(nine - point, axis=1)
        best = int(gaps.argmin())
        residual = (point - nine[best]) @ facing[best]
        gate = p.first_gate * max(1.0, point[2] ** 2 / p.reference_depth**2)
        if abs(residual) > gate or gaps[best] > 3 * gate or normal @ facing[best] < p.normal_cosine:
            continue
        J.append([*np.cross(point, facing[best]), *facing[best]])
        r.append(residual)
        sigma = 0.25 + (row[2] ** 4 + point[2] ** 4) / 8
        w.append((1 - (residual / gate) ** 2) ** 2 / sigma)
    j = np.array(J)
    A = (j * np.array(w)[:, None]).T @ j
    return A / len(j), np.linalg.solve(A, -(j.T @ (np.array(w) * r))), len(j)


def test_by_hand(validation_goldens):
    validation_goldens.check_registration(module)
    validation_goldens.check_registration_of_clouds(module)


def test_one_step_equals_the_oracle(scenes):
    rng = np.random.default_rng(0)
    corner, _ = scenes.corner()
    p = RefinementParameters(3, 1, 0.1, 0.1)
    source = sample_points(corner, p.stride)
    for _ in range(5):
        T = off(rng, 0.04, 1.5)
        information, step, points = step_oracle(source, corner, T, p)
        found = refine(source, corner, T, p)
        assert found.points == points
        np.testing.assert_allclose(found.information, information, atol=1e-6)
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        # a little damping: 1e-6 beside the information
        np.testing.assert_allclose(found.T[:3, :3], turn @ T[:3, :3], atol=1e-4)
        np.testing.assert_allclose(found.T[:3, 3], turn @ T[:3, 3] + step[3:], atol=1e-4)


def test_an_exact_corner_is_found_exactly(scenes):
    rng = np.random.default_rng(1)
    corner, _ = scenes.corner()
    source = sample_points(corner, 2)
    for _ in range(5):
        start = off(rng, 0.05, 3.0)
        before = start.copy()
        found = refine(source, corner, start, replace(COARSE, iterations=20))
        np.testing.assert_array_equal(start, before)  # the caller's is left alone
        metres, radians = pose_difference(found.T, np.eye(4))
        assert metres < 1e-5
        assert radians < 1e-5
        R = found.T[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_what_does_not_overlap_is_not_refined(scenes):
    corner, _ = scenes.corner()
    source = sample_points(corner, 2)
    far, behind = np.eye(4), np.diag([-1.0, 1, -1, 1])
    far[2, 3] = 5.0
    blank = replace(corner, points=np.zeros_like(corner.points))
    for surface, T in ((corner, far), (corner, behind), (blank, np.eye(4))):
        for p in (COARSE, FINE):
            assert refine(source, surface, T, p) is None
    assert refine(source[:0], corner, np.eye(4), FINE) is None
    assert refine(source[:19], corner, np.eye(4), FINE) is None  # 20 are the fewest
    assert refine(source, corner, np.eye(4), FINE) is not None
    assert refine(source, corner, np.full((4, 4), np.nan), FINE) is None
