"""Tests of the estimated up direction and units of rotated rooms and halls."""

import math
from functools import cache
from itertools import product

import numpy as np
import pytest

from sceneprint.geometry.surface.upright import estimate_units, estimate_up
from sceneprint_lab.synth.dataset import room_and_rng, synthesise_survey

Z = np.array([0.0, 0.0, 1.0])
#: Rotations that take z to each end of each axis.
TURNS = {
    "z": np.eye(3),
    "-z": np.diag([1.0, -1.0, -1.0]),
    "y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "-y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "x": np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]]),
    "-x": np.array([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]]),
}


@cache
def room(index):
    """A furnished room: vertices and triangles."""
    mesh, _ = room_and_rng(4242, index)
    return mesh.vertices, mesh.faces


@cache
def samples(index):
    """Points spread evenly over the surface of a room."""
    vertices, faces = room(index)
    rng = np.random.default_rng(0)
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(faces), 200_000, p=areas / areas.sum())
    u, v = rng.random((2, len(chosen), 1))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    points = a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]
    return (points + rng.normal(0, 0.005, points.shape)).astype(np.float32)


@cache
def survey(index):
    """The scans of a hall, a storey or a block, in one frame."""
    clouds = synthesise_survey(4242, index, 6).clouds
    parts = [cloud.points @ cloud.pose[:3, :3].T + cloud.pose[:3, 3] for cloud in clouds]
    return np.concatenate(parts).astype(np.float32)


def turned(points, R):
    return (points.astype(np.float64) @ R.T).astype(np.float32)


def angle(result, truth):
    return math.degrees(math.acos(min(1.0, max(-1.0, float(result.up @ truth)))))


@pytest.mark.parametrize(("index", "axis"), [(0, "-x"), (4, "-z"), (6, "-y")])
def test_up_of_a_mesh_of_a_furnished_room(index, axis):
    vertices, faces = room(index)
    estimate = estimate_up(turned(vertices, TURNS[axis]), faces, Z)
    np.testing.assert_array_equal(estimate.up, TURNS[axis] @ Z)  # an axis is taken exactly
    assert estimate.is_clear


@pytest.mark.parametrize(("index", "axis"), [(4, "-y")])
def test_up_of_a_cloud_of_a_furnished_room(index, axis):
    estimate = estimate_up(turned(samples(index), TURNS[axis]), None, Z)
    np.testing.assert_array_equal(estimate.up, TURNS[axis] @ Z)
    assert estimate.is_clear


@pytest.mark.parametrize(("index", "axis"), [(1, "y"), (3, "-z")])
def test_up_of_scans(index, axis):
    estimate = estimate_up(turned(survey(index), TURNS[axis]), None, Z)
    assert angle(estimate, TURNS[axis] @ Z) < 2.0


def test_a_tilted_room_is_upright_along_its_walls():
    tilt = math.radians(26)
    R = np.array(
        [[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]]
    )
    for turn in (TURNS["z"], TURNS["-y"]):
        estimate = estimate_up(turned(samples(4), turn @ R), None, Z)
        assert angle(estimate, turn @ R @ Z) < 1.0


def test_ground_that_slopes_leaves_the_usual_axis():
    slope = math.radians(5)
    R = np.array(
        [[math.cos(slope), 0, math.sin(slope)], [0, 1, 0], [-math.sin(slope), 0, math.cos(slope)]]
    )
    estimate = estimate_up(turned(survey(3), R), None, Z)
    np.testing.assert_array_equal(estimate.up, Z)


def test_an_empty_cube_is_as_usual_and_not_clear():
    corners = np.array(list(product((-1, 1), repeat=3)), np.float32)
    faces = np.array(
        [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
         (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)], np.int32
    )  # fmt: skip
    for usual in (*np.eye(3), *-np.eye(3)):
        estimate = estimate_up(corners, faces, usual)
        np.testing.assert_array_equal(estimate.up, usual)
        assert not estimate.is_clear


@pytest.mark.parametrize("n", [1, 2, 11, 500])
def test_surfaces_that_show_nothing_are_as_usual(n):
    spread = np.random.default_rng(0).normal(size=(n, 3)).astype(np.float32)
    for points in (spread, np.zeros((n, 3), np.float32), spread * np.array([1, 0, 0], np.float32)):
        estimate = estimate_up(points, None, Z)
        assert math.isclose(float(np.linalg.norm(estimate.up)), 1.0)
        assert not (estimate.is_clear and n < 12)


@pytest.mark.parametrize(
    ("extent", "units"),
    [
        ((5, 4, 2.6), 1), ((1100, 95, 55), 1), ((8000, 9000, 140), 1), ((9000, 9000, 400), 1),
        ((5000, 4000, 2600), 1000), ((1e6, 8e5, 1200), 1000), ((500, 400, 260), 100),
        ((2500, 1200, 270), 100), ((0.4, 0.3, 0.2), 1),
    ],
)  # fmt: skip
def test_units_by_the_height_and_extent_of_a_place(extent, units):
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (20_000, 3)) * extent / 0.98
    for turn in (TURNS["z"], TURNS["-x"]):
        assert estimate_units(turned(points.astype(np.float32), turn), turn @ Z) == units
