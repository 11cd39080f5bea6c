"""Tests of refinement: single steps, convergence and failure."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sceneprint.geometry.registration import icp as module
from sceneprint.geometry.registration.icp import COARSE, FINE, refine
from sceneprint.geometry.registration.overlap import sample_points
from sceneprint.geometry.rigid import pose_difference
from tests.geometry import scenes, validation_goldens


def off(rng, metres, degrees):
    """A motion by that much, any way."""
    axis, shift = rng.normal(size=(2, 3))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    T[:3, 3] = metres * shift / np.linalg.norm(shift)
    return T


def test_by_hand():
    validation_goldens.check_registration(module)
    validation_goldens.check_registration_of_clouds(module)


def test_an_exact_corner_is_found_exactly():
    rng = np.random.default_rng(1)
    corner, _ = scenes.corner()
    source = sample_points(corner, 2)
    for _ in range(5):
        start = off(rng, 0.05, 3.0)
        before = start.copy()
        result = refine(source, corner, start, replace(COARSE, iterations=20))
        np.testing.assert_array_equal(start, before)  # the caller's is left alone
        metres, radians = pose_difference(result.T, np.eye(4))
        assert metres < 1e-5
        assert radians < 1e-5
        R = result.T[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_what_does_not_overlap_is_not_refined():
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
