"""Tests of plans of scans: up, height and relative pose."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneprint.geometry.registration.plan_search import (
    PlanParameters,
    _slice_heights,
    dominant_up,
    draw_plan,
    plan_hypotheses,
    slice_hypotheses,
)
from sceneprint.geometry.retrieval.ranking import Ranking
from sceneprint.geometry.rigid import inverse, pose_difference, select_distinct, transform_points
from sceneprint.models import read_model
from sceneprint.pipeline import associate, geometry_of, validate
from sceneprint.signing import see
from sceneprint.types import Sphere, Surface
from sceneprint_lab.synth import synthesise_survey

P = PlanParameters(cell=0.5, voxel=0.2, height_step=0.25, height_range=15.0)


def patch(corner, a, b, step=0.2):
    """Points and normals of a parallelogram, which faces a x b."""
    u, v = np.linalg.norm(a), np.linalg.norm(b)
    s, t = np.meshgrid(np.arange(0.05, 1, step / u), np.arange(0.05, 1, step / v))
    points = corner + s.reshape(-1, 1) * a + t.reshape(-1, 1) * b
    normal = np.cross(a, b) / (u * v)
    return points, np.tile(normal, (len(points), 1))


def building():
    """A hall of 16 m by 10 m with an alcove, a table and a pillar; no symmetry. z is up."""
    x, y, z = np.eye(3)
    parts = [
        patch(np.zeros(3), 16 * x, 10 * y),
        patch(np.zeros(3), 10 * y, 4 * z),  # faces +x
        patch(10 * y, 16 * x, 4 * z),  # faces -y
        patch(16 * x, 4 * z, 10 * y),
        patch(0 * x, 4 * z, 9 * x),
        patch(9 * x - 3 * y, 4 * z, 7 * x),
        patch(9 * x - 3 * y, 3 * y, 4 * z),
        patch(3 * x + 6 * y + 0.9 * z, 2 * x, y),
        patch(12 * x + 6 * y, 4 * z, y),
        patch(12 * x + 6 * y, x, 4 * z),
    ]
    return np.concatenate([p for p, _ in parts]), np.concatenate([n for _, n in parts])


def seen_from(T):
    """All of the building in a sensor's coordinates, as points in no order."""
    points, normals = building()
    points, normals = transform_points(inverse(T), points), normals @ T[:3, :3]
    shape = (1, len(points))
    return Surface(
        points[None].astype(np.float32), normals[None].astype(np.float32),
        np.ones(shape, np.bool_), np.zeros(shape, np.float32), None,
    )  # fmt: skip


def pose(x, y, z, yaw, pitch=0, roll=0):
    """Upright but for pitch and roll; angles in degrees."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
    T[:3, 3] = x, y, z
    return T


def nearest(transforms, true):
    """Metres and degrees of the hypothesis that is nearest to a transform, and its rank."""
    errors = [pose_difference(T, true) for T in transforms]
    best = min(range(len(errors)), key=lambda k: errors[k][0] + errors[k][1])
    return errors[best][0], math.degrees(errors[best][1]), best


@pytest.mark.parametrize(("pitch", "roll"), [(0, 0), (20, -15), (-40, 10)])
def test_up_is_what_floors_face_and_walls_stand_across(pitch, roll):
    T = pose(5, 4, 1, 30, pitch, roll)
    surface = seen_from(T)
    up = dominant_up(surface.normals[0].astype(float), np.array([0.0, 0, 1]), P.tilt)
    assert up @ T[2, :3] == pytest.approx(1.0, abs=1e-6)  # the third row: world z in the sensor


def test_without_a_normal_near_the_axis_up_is_the_axis():
    walls = np.tile([1.0, 0.0, 0.0], (50, 1))
    assert dominant_up(walls, np.array([0.0, 0, 1]), math.radians(50)).tolist() == [0, 0, 1]


def test_a_known_up_is_taken_as_it_is():
    T = pose(5, 4, 1, 30, 20, 0)
    up = np.array([0.0, 0.6, 0.8])
    plan = draw_plan(seen_from(T), P, up=up)
    np.testing.assert_allclose(plan.R[2], up)
    np.testing.assert_allclose(plan.R @ plan.R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(plan.R) == pytest.approx(1.0)


@pytest.mark.parametrize("yaw", [3, 90, 178])
def test_the_true_transform_is_proposed(yaw):
    source, target = pose(4, 5, 1.2, 12, 8, -5), pose(10, 3, 2.0, 12 + yaw, -4, 10)
    a, b = draw_plan(seen_from(source), P), draw_plan(seen_from(target), P)
    transforms = plan_hypotheses([(a, b)], P)
    metres, degrees, rank = nearest(transforms, inverse(target) @ source)
    # half a cell, half a yaw (2.5 degrees, on a lever of some metres), half a step of height
    assert metres < 0.7
    assert degrees < 3.0
    assert rank < 4
    assert len(transforms) == P.n_kept * P.n_heights


def test_slices_are_heights_above_the_lowest_point_of_the_neighbourhood():
    # cells of .5 m: slices end at .4, 1.2, 2.6 and 12 m above the ground, in squares of 4 m
    ground = [(1.0, 1.0, -1.5)]
    above = [(5.0, 5.0, z - 1.5) for z in (0.3, 0.5, 1.1, 1.3, 2.7, 11.9, 12.1)]
    apart = [(13.0, 1.0, 0.0)]  # two squares from the others, so it is its own ground
    slices = _slice_heights(np.array(ground + above + apart), P)
    assert slices.tolist() == [0, 0, 1, 1, 2, 3, 3, 0, 0]


@pytest.mark.parametrize("yaw", [3, 90, 178, 268])
def test_slices_propose_the_true_transform(yaw):
    source, target = pose(4, 5, 1.2, 12, 8, -5), pose(10, 3, 2.0, 12 + yaw, -4, 10)
    a, b = draw_plan(seen_from(source), P), draw_plan(seen_from(target), P)
    transforms, values = slice_hypotheses(a, b, P)
    metres, degrees, rank = nearest(transforms, inverse(target) @ source)
    # half a cell of 1 m along both axes, half a yaw (2.5 degrees), half a step of height
    assert metres < 1.2
    assert degrees < 3.0
    assert rank < 4
    assert len(transforms) == len(values) <= P.n_sliced * P.n_heights
    assert (np.diff(values) <= 0).all()


def test_the_axis_of_a_range_image_is_its_pole():
    surface = seen_from(pose(4, 5, 1.2, 0, 0, 90))
    sphere = Sphere(60, 16, 0.1, -math.pi, 0.5, pole=1)
    on_its_side = replace(surface, camera=sphere)
    up = draw_plan(on_its_side, P).R[2]
    np.testing.assert_allclose(up, [0, 1, 0], atol=1e-6)


def test_distinct_by_hand():
    transforms = np.stack([pose(x, 0, 0, yaw) for x, yaw in ((0, 0), (0.4, 0), (0.4, 20), (2, 0))])
    assert select_distinct(transforms, np.array([3.0, 4, 1, 2]), 0.5, math.radians(10), 9) == [
        1,
        3,
        2,
    ]
    assert select_distinct(transforms, np.array([3.0, 4, 1, 2]), 0.5, math.radians(10), 2) == [1, 3]
    assert select_distinct(transforms[:0], np.empty(0), 0.5, 0.1, 5) == []


@pytest.fixture(scope="module")
def hall():
    """Two scans of a synthetic hall that are aligned where both scanners stand upright."""
    return read_model("lidar"), list(synthesise_survey(7100, 0, 2, kind="hall").clouds)


def turned_cloud(cloud, R):
    """The same points as a scanner sees them that is turned in its mount."""
    T = cloud.pose.copy()
    T[:3, :3] = cloud.pose[:3, :3] @ R.T
    return replace(cloud, points=(cloud.points @ R.T).astype(np.float32), pose=T)


def test_a_query_upside_down_is_found_when_nothing_else_is_accepted(hall):
    model, (first, second) = hall
    match, upright = (geometry_of(see(one, model.parameters), model) for one in (first, second))
    ranking = Ranking(np.array([0]), np.array([1]), np.array([0.5]))
    assert second.pose is not None
    [found] = associate(upright, ranking, [0], lambda _: match)
    assert found.validation.status == "accepted"
    over = turned_cloud(second, Rotation.from_euler("x", 180, degrees=True).as_matrix())
    query = geometry_of(see(over, model.parameters), model)
    assert validate(query, match).status != "accepted"
    [found] = associate(query, ranking, [0], lambda _: match)
    assert found.validation.status == "accepted"
    metres, radians = pose_difference(
        found.validation.T_match_query, inverse(first.pose) @ over.pose
    )
    assert metres < 0.3
    assert radians < math.radians(3)
    # a known up says at once what the other axes had to be tried for
    result = validate(query, match, ups=(np.array([0.0, 0, -1]), np.array([0.0, 0, 1])))
    assert result.status == "accepted"
