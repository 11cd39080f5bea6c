"""Tests of rigid transforms against NumPy and SciPy, including degenerate cases."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneprint.geometry.rigid import (
    apply_rotation,
    inverse,
    nearest_rotation,
    pose_difference,
    rotation_angle,
    rotation_of_covariance,
    solve_positive,
    transform_points,
)
from tests.geometry.scenes import rigid


def fitted(a, b, weights=None):
    """The rotation that turns vectors a onto b, by the kernel."""
    w = np.ones(len(a)) if weights is None else weights
    R = np.empty((3, 3))
    rotation_of_covariance((b * w[:, None]).T @ a, R)
    return R


def assert_rotation(R):
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-12)


def test_inverse_equals_numpys():
    rng = np.random.default_rng(0)
    for _ in range(50):
        T = rigid(rng, 3)
        np.testing.assert_allclose(inverse(T), np.linalg.inv(T), atol=1e-12)
        np.testing.assert_array_equal(inverse(inverse(T))[:3, :3], T[:3, :3])
        x = rng.normal(size=(4, 3))
        np.testing.assert_allclose(
            transform_points(inverse(T), transform_points(T, x)), x, atol=1e-12
        )


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.01, 1.0, 3.0, math.pi - 1e-9, math.pi])
def test_rotation_angle_where_acos_fails(angle):
    rng = np.random.default_rng(1)
    for _ in range(20):
        axis = rng.normal(size=3)
        R = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
        assert rotation_angle(R) == pytest.approx(angle, abs=1e-15, rel=1e-9)
        assert rotation_angle(R.T) == pytest.approx(angle, abs=1e-15, rel=1e-9)


def test_difference_by_hand_and_without_a_favourite():
    a, b = np.eye(4), np.eye(4)
    a[:3, 3] = 1, 2, 3
    b[:3, 3] = 1, 5, 7
    b[:3, :3] = Rotation.from_euler("y", 0.3).as_matrix()
    metres, radians = pose_difference(a, b)
    assert (metres, radians) == (5.0, pytest.approx(0.3, abs=1e-12))
    assert pose_difference(b, a) == pytest.approx((metres, radians), abs=1e-12)
    assert pose_difference(b, b) == (0.0, pytest.approx(0.0, abs=1e-15))
    # the same motion of the target frame afterwards changes neither
    T = rigid(np.random.default_rng(2), 3)
    assert pose_difference(T @ a, T @ b) == pytest.approx((metres, radians), abs=1e-12)


def test_nearest_rotation():
    rng = np.random.default_rng(3)
    for _ in range(50):
        R = Rotation.random(rng=rng).as_matrix()
        np.testing.assert_allclose(nearest_rotation(2.5 * R), R, atol=1e-12)
        M = rng.normal(size=(3, 3))  # half of them mirror
        result = nearest_rotation(M)
        assert_rotation(result)
        gap = np.linalg.norm(result - M)
        others = Rotation.random(200, rng=rng).as_matrix()
        assert gap <= np.linalg.norm(others - M, axis=(1, 2)).min()
        small = Rotation.from_rotvec(rng.normal(0, 1e-3, (50, 3))).as_matrix() @ result
        assert gap <= np.linalg.norm(small - M, axis=(1, 2)).min() + 1e-12


def test_fit_equals_scipys():
    rng = np.random.default_rng(4)
    for case in range(200):
        n = int(rng.integers(3, 30))
        a = rng.normal(size=(n, 3)) * 10.0 ** rng.uniform(-1, 1)
        if case % 4 == 1:
            a[:, 2] = 0.0  # coplanar: a mirror image fits as well, and must not be taken
        b = Rotation.random(rng=rng).apply(a)
        if case % 4 >= 2:
            b += rng.normal(0, 0.1, b.shape) * np.abs(a).max()
        weights = rng.uniform(0.1, 2.0, n)
        expected = Rotation.align_vectors(b, a, weights=weights)[0].as_matrix()
        R = fitted(a, b, weights)
        assert_rotation(R)
        assert rotation_angle(R @ expected.T) < 1e-7  # measured: 3e-9


def test_fit_where_the_rotation_is_not_determined():
    # of one direction only: any rotation that carries it over
    rng = np.random.default_rng(6)
    for _ in range(50):
        line = rng.normal(size=3)
        a = np.outer(rng.normal(size=5), line)
        b = Rotation.random(rng=rng).apply(a)
        R = fitted(a, b)
        assert_rotation(R)
        np.testing.assert_allclose(a @ R.T, b, atol=1e-9)
    # of nothing: no turn
    R = np.empty((3, 3))
    rotation_of_covariance(np.zeros((3, 3)), R)
    np.testing.assert_array_equal(R, np.eye(3))


@pytest.mark.parametrize("angle", [0.0, 1e-10, 1e-4, 1.0, math.pi, 5.0])
def test_turned_equals_scipys(angle):
    rng = np.random.default_rng(8)
    for _ in range(20):
        axis = rng.normal(size=3)
        omega, R = angle * axis / np.linalg.norm(axis), Rotation.random(rng=rng).as_matrix()
        result = np.empty((3, 3))
        apply_rotation(R, omega, result)
        expected = Rotation.from_rotvec(omega).as_matrix() @ R
        np.testing.assert_allclose(result, expected, atol=1e-14)


def test_solve_positive_equals_numpys():
    rng = np.random.default_rng(9)
    for n in (1, 2, 6, 9):
        for _ in range(20):
            J = rng.normal(size=(n + 3, n))
            A, b, x = J.T @ J, rng.normal(size=n), np.empty(n)
            expected = np.linalg.solve(A, b)
            assert solve_positive(A.copy(), b, x)
            np.testing.assert_allclose(x, expected, rtol=1e-8, atol=1e-10)


def test_solve_positive_says_no():
    rng = np.random.default_rng(10)
    J, x = rng.normal(size=(4, 6)), np.empty(6)
    singular = J.T @ J  # of rank 4
    not_positive = np.diag([1.0, 1, 1, -1, 1, 1])
    lost = np.full((6, 6), np.nan)
    for A in (singular, not_positive, lost, np.zeros((6, 6))):
        assert not solve_positive(A.copy(), np.ones(6), x)
