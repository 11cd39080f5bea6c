"""Tests of refinement: single steps, convergence and failure."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneprint.geometry.registration import icp as module
from sceneprint.geometry.registration.icp import COARSE, FINE, RefinementParameters, refine
from sceneprint.geometry.registration.overlap import sample_points
from sceneprint.geometry.rigid import pose_difference
from sceneprint.models import Model
from sceneprint.signing import see
from sceneprint.types import DepthFrame, Floats, Floats32, Surface
from sceneprint_lab.synth import KINECT, render, trajectory
from sceneprint_lab.synth.dataset import room_and_rng

NEAR = replace(COARSE, stride=2)


def off(rng: np.random.Generator, metres: float, degrees: float) -> Floats:
    """A motion by that much, any way."""
    axis, shift = rng.normal(size=(2, 3))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    T[:3, 3] = metres * shift / np.linalg.norm(shift)
    return T


def step_oracle(
    source: Floats32, target: Surface, T: Floats, p: RefinementParameters
) -> tuple[Floats, Floats, int]:
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


@pytest.fixture(scope="module")
def room_surface(small_model: Model) -> Surface:
    """A furnished room, without noise."""
    room, rng = room_and_rng(11, 0)
    pose = trajectory(room, 20, rng)[10]
    return see(DepthFrame(render(room, pose, KINECT), KINECT), small_model.parameters)


def test_by_hand(validation_goldens: ModuleType) -> None:
    validation_goldens.check_registration(module)
    validation_goldens.check_registration_of_clouds(module)


def test_one_step_equals_the_oracle(scenes: ModuleType) -> None:
    rng = np.random.default_rng(0)
    corner, _ = scenes.corner()
    p = RefinementParameters(3, 1, 0.1, 0.1)
    source = sample_points(corner, p.stride)
    for _ in range(5):
        T = off(rng, 0.04, 1.5)
        information, step, points = step_oracle(source, corner, T, p)
        found = refine(source, corner, T, p)
        assert found is not None
        assert found.points == points
        np.testing.assert_allclose(found.information, information, atol=1e-6)
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        # a little damping: 1e-6 beside the information
        np.testing.assert_allclose(found.T[:3, :3], turn @ T[:3, :3], atol=1e-4)
        np.testing.assert_allclose(found.T[:3, 3], turn @ T[:3, 3] + step[3:], atol=1e-4)


def test_an_exact_corner_is_found_exactly(scenes: ModuleType) -> None:
    rng = np.random.default_rng(1)
    corner, _ = scenes.corner()
    source = sample_points(corner, 2)
    for _ in range(5):
        start = off(rng, 0.05, 3.0)
        before = start.copy()
        found = refine(source, corner, start, replace(COARSE, iterations=20))
        np.testing.assert_array_equal(start, before)  # the caller's is left alone
        assert found is not None
        metres, radians = pose_difference(found.T, np.eye(4))
        assert metres < 1e-5
        assert radians < 1e-5
        R = found.T[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_a_room_is_found_to_a_millimetre(room_surface: Surface) -> None:
    rng = np.random.default_rng(2)
    source = sample_points(room_surface, FINE.stride)
    for _ in range(5):
        coarse = refine(source, room_surface, off(rng, 0.05, 3.0), COARSE)
        assert coarse is not None
        fine = refine(source, room_surface, coarse.T, FINE)
        assert fine is not None
        metres, radians = pose_difference(fine.T, np.eye(4))
        assert metres < 1e-3
        assert np.degrees(radians) < 0.05
        assert fine.points > 0.9 * len(source)


def test_information_is_symmetric_and_positive(room_surface: Surface, scenes: ModuleType) -> None:
    for surface in (room_surface, scenes.corner()[0]):
        found = refine(sample_points(surface, 2), surface, np.eye(4), FINE)
        assert found is not None
        np.testing.assert_array_equal(found.information, found.information.T)
        values = np.linalg.eigvalsh(found.information)
        # a corner holds all six directions; where a depth sensor sees 3 planes, to 1 in 100
        assert values[0] > 1e-3 * values[-1]


def test_a_plane_leaves_three_directions_free(scenes: ModuleType) -> None:
    towards = scenes.unit(0.3, -0.2, -1.0)
    q = scenes.plane(scenes.CAMERA, towards, np.array([0.0, 0.0, 2.0]))
    wall = scenes.lifted(scenes.CAMERA, q, np.broadcast_to(towards, (60, 80, 3)))
    start = off(np.random.default_rng(3), 0.02, 1.0)
    found = refine(sample_points(wall, 2), wall, start, FINE)
    assert found is not None
    values = np.linalg.eigvalsh(found.information)
    assert np.abs(values[:3]).max() < 1e-9 * values[-1]
    assert values[3] > 1e-2 * values[-1]
    # along those it stays where it was, on the others it is on the plane
    np.testing.assert_allclose(found.T[:3, :3] @ towards, towards, atol=1e-5)
    assert abs(found.T[:3, 3] @ towards) < 1e-5
    along = found.T[:3, 3] - start[:3, 3]
    assert np.linalg.norm(along) < 0.04


def test_what_does_not_overlap_is_not_refined(scenes: ModuleType) -> None:
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


def test_far_points_weigh_less(scenes: ModuleType) -> None:
    # two walls at 1 m and 4 m, the far one 4 cm farther in the target: the near one prevails
    towards = np.array([0.0, 0.0, -1.0])
    q = np.full((60, 80), 1.0)
    q[:, 40:] = 0.25
    walls = scenes.lifted(scenes.CAMERA, q, np.broadcast_to(towards, (60, 80, 3)))
    other = replace(walls, points=walls.points.copy())
    other.points[:, 40:, 2] += 0.04
    p = RefinementParameters(2, 1, 0.1, 0.1)
    source = sample_points(walls, 2)
    source[:, :2] = 0.0  # all on the optical axis: no turn, only a shift
    found = refine(source, other, np.eye(4), p)
    assert found is not None
    assert found.points == 1200
    # at 1 m the gate is 10 cm and the weight 1 / (.25 + 2 / 8); at 4 m the gate is 32 cm
    near, far = 2.0, (1 - 0.125**2) ** 2 / (0.25 + 64)
    assert found.T[2, 3] == pytest.approx(0.04 * far / (near + far), rel=1e-4)  # 0.3 mm
