"""Tests of views of a surface: content, viewpoints and coverage."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sceneprint.errors import InvalidRequest
from sceneprint.geometry.rigid import transform_points
from sceneprint.geometry.views import Renderer, choose_views, view_parameters
from sceneprint.geometry.views.plan import level_axes
from sceneprint.geometry.views.raster import draw_triangles, pinhole
from sceneprint.geometry.views.render import rays_of
from sceneprint.models import read_model
from sceneprint.types import Intrinsics, ReferenceSurface

CAMERA = Intrinsics(80, 60, 73.0, 73.0, 39.5, 29.5)
ROOM = np.array([6.0, 5.0, 2.5])
UP = np.array([0.0, 0.0, 1.0])


def box(size, *, inwards):
    """The corners and the triangles of a box from the origin; their fronts inside, or outside."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * size
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))], np.int32)
    return corners.astype(np.float32), triangles[:, ::-1] if inwards else triangles


def room(*, inwards=True, up=UP):
    points, triangles = box(ROOM, inwards=inwards)
    return ReferenceSurface(points, np.ascontiguousarray(triangles), np.zeros(3), up)


def cloud_of_room(spacing=0.04):
    """Points on the walls, the floor and the ceiling of the room, on a grid."""
    sheets = []
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        grid = np.meshgrid(*(np.arange(spacing / 2, ROOM[k], spacing) for k in (a, b)))
        for at in (0.0, ROOM[axis]):
            sheet = np.full((grid[0].size, 3), at)
            sheet[:, a], sheet[:, b] = grid[0].ravel(), grid[1].ravel()
            sheets.append(sheet)
    points = np.concatenate(sheets).astype(np.float32)
    return ReferenceSurface(points, None, np.zeros(3), UP)


def depth_parameters(camera=CAMERA):
    p = view_parameters(read_model("depth").parameters, camera)
    return replace(p, spacing=0.8, cell=0.15)


def looking(place, yaw, pitch):
    """T_map_sensor of a camera in a place, z up."""
    flat = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    ahead = math.cos(pitch) * flat + math.sin(pitch) * UP
    right = np.cross(flat, UP)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    T[:3, 3] = place
    return T


def depth_in_room(T, camera):
    """The depth (H, W) of the walls of the room, seen from inside: each ray leaves by the first."""
    rays = rays_of(camera).astype(float) @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        leaves = np.where(rays > 0, (ROOM - T[:3, 3]) / rays, -T[:3, 3] / rays)
    return np.asarray(leaves.min(axis=2))


POSES = [
    looking((1.5, 2.0, 1.2), 0.3, -0.2),
    looking((4.4, 3.1, 0.9), 2.9, 0.3),
    looking((3.0, 2.5, 1.6), -1.4, -0.6),
]


@pytest.mark.parametrize("T", POSES)
@pytest.mark.parametrize("inwards", [True, False])
def test_a_view_of_a_mesh_shows_the_depth_of_its_walls(T, inwards):
    # a mesh that is inside out is shown as well, as all of it is seen from behind
    seen = Renderer(room(inwards=inwards), depth_parameters()).view(T)
    assert seen.dtype == np.float32
    np.testing.assert_allclose(seen, depth_in_room(T, CAMERA), rtol=1e-4)


@pytest.mark.parametrize("T", POSES)
def test_a_view_of_a_cloud_shows_the_depth_of_its_walls(T):
    seen, expected = Renderer(cloud_of_room(), depth_parameters()).view(T), depth_in_room(T, CAMERA)
    assert (seen > 0).mean() > 0.97
    error = np.abs(seen - expected)[seen > 0]
    # only where walls meet does a disc reach beyond its own
    assert np.quantile(error, 0.8) < 1e-3
    assert error.max() < 0.25


def test_what_is_out_of_range_is_missing():
    T, p = POSES[0], depth_parameters()
    expected = depth_in_room(T, CAMERA)
    seen = Renderer(room(), replace(p, nearest=1.6, farthest=3.0)).view(T)
    within = (expected > 1.6) & (expected < 3.0)
    assert (seen[within] > 0).all()
    assert (seen[~within] == 0).all()
    assert 0 < within.mean() < 1


def test_a_nearer_surface_hides_what_is_behind_it_in_a_cloud_as_in_a_mesh():
    grid = np.stack(np.meshgrid(np.arange(-2, 2, 0.03), np.arange(-2, 2, 0.03)), axis=-1)
    wall = np.column_stack([np.full(grid[..., 0].size, 3.0), grid.reshape(-1, 2)])
    board = wall[np.abs(wall[:, 1:]).max(axis=1) < 0.5] - (1.0, 0.0, 0.0)
    points = np.concatenate([wall, board]).astype(np.float32)
    surface = ReferenceSurface(points, None, np.zeros(3), UP)
    seen = Renderer(surface, depth_parameters()).view(looking((0, 0, 0), 0.0, 0.0))
    rays = np.abs(rays_of(CAMERA)[..., :2]).max(axis=2)
    np.testing.assert_allclose(seen[rays < 0.23], 2.0, atol=1e-4)
    np.testing.assert_allclose(seen[(rays > 0.27) & (rays < 0.4)], 3.0, atol=1e-4)


def test_a_surface_that_is_seen_from_behind_is_missing_and_hides_what_is_behind_it():
    # a wall whose front faces the camera; before a third of it a board that turns its back
    wall = np.array([[3, -3, -3], [3, -3, 3], [3, 3, 3], [3, 3, -3]], np.float32)
    board = np.array([[2, -0.3, -0.3], [2, 0.3, -0.3], [2, 0.3, 0.3], [2, -0.3, 0.3]], np.float32)
    quads = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    surface = ReferenceSurface(np.concatenate([wall, board]), quads, np.zeros(3), UP)
    seen = Renderer(surface, depth_parameters()).view(looking((0, 0, 0), 0.0, 0.0))
    rays = np.abs(rays_of(CAMERA)[..., :2]).max(axis=2)
    assert (seen[rays < 0.149] == 0).all()
    np.testing.assert_allclose(seen[rays > 0.151], 3.0, rtol=1e-5)


def test_a_scanner_sees_all_around():
    p = replace(view_parameters(read_model("lidar").parameters), nearest=0.1)
    T = looking((2.0, 3.0, 1.0), 0.7, 0.1)
    points = transform_points(T, Renderer(room(), p).view(T).astype(float))
    to_wall = np.minimum(np.abs(points), np.abs(points - ROOM)).min(axis=1)
    assert to_wall.max() < 1e-3
    rays = (points - T[:3, 3]) @ T[:3, :3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    assert np.abs(rays[:, 2]).max() <= math.sin(p.elevation) + 1e-6


def test_triangles_are_drawn_as_rays_meet_them():
    rng = np.random.default_rng(5)
    # some behind the camera, some across its plane
    middles = rng.uniform(-2, 2, (60, 1, 3)) + np.array([0, 0, 1.5])
    points = (middles + rng.uniform(-1, 1, (60, 3, 3))).reshape(-1, 3).astype(np.float32)
    triangles = np.arange(180, dtype=np.int32).reshape(-1, 3)
    depth = np.full((60, 80), np.inf, np.float32)
    back = np.zeros((60, 80), np.uint8)
    whole = np.array([0]), np.array([60])
    draw_triangles(points, triangles, *whole, np.eye(4), pinhole(CAMERA), depth, back)
    rays = rays_of(CAMERA).reshape(-1, 3).astype(float)
    nearest, behind = np.full(len(rays), np.inf), np.zeros(len(rays), bool)
    edge = np.full(len(rays), np.inf)  # how near a ray comes to the rim of a triangle
    for a, b, c in points[triangles].astype(float):
        normal = np.cross(b - a, c - a)
        t = (normal @ a) / (rays @ normal)
        solution = np.linalg.lstsq(np.stack([b - a, c - a], 1), (rays * t[:, None] - a).T)[0]
        rim = np.minimum(solution.min(axis=0), 1 - solution.sum(axis=0))
        edge = np.minimum(edge, np.abs(rim))
        first = (rim >= 0) & (t > 1e-3) & (t < nearest)
        nearest[first], behind[first] = t[first], (rays @ normal > 0)[first]
    sure = edge > 1e-4
    np.testing.assert_allclose(depth.ravel()[sure], nearest[sure], rtol=1e-4)
    seen = sure & np.isfinite(nearest)
    assert seen.mean() > 0.3
    assert (back.ravel()[seen] == behind[seen]).all()


@pytest.mark.parametrize("inwards", [True, False])
def test_cameras_stand_in_the_room_at_their_heights(inwards):
    p = replace(depth_parameters(), heights=(0.5, 1.5))
    plan = choose_views(room(inwards=inwards), p)
    assert len(plan.poses) > 10
    assert plan.floor == pytest.approx(0.0, abs=0.02)
    places = np.concatenate([plan.poses, plan.held_out])[:, :3, 3]
    assert (places > 0.3).all()
    assert (places < ROOM - 0.3).all()
    np.testing.assert_allclose(np.sort(np.unique(places[:, 2].round(3))), (0.5, 1.5), atol=0.03)
    # right-handed, upright: x of the camera is level, y looks down
    for T in plan.poses:
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
        assert T[2, 0] == pytest.approx(0.0, abs=1e-9)
        assert T[2, 1] < 0


def test_a_table_is_no_floor():
    # walls alone, and a table as large as a third of the room
    points, triangles = box(ROOM, inwards=True)
    upright = np.ptp(points[triangles][..., 2], axis=1) > 0
    table = np.array([[1, 1, 1], [5, 1, 1], [5, 4, 1], [1, 4, 1]], np.float32)
    faces = np.concatenate([triangles[upright], np.array([[8, 9, 10], [8, 10, 11]], np.int32)])
    surface = ReferenceSurface(np.concatenate([points, table]), faces, np.zeros(3), UP)
    plan = choose_views(surface, depth_parameters())
    assert plan.floor is None
    heights = plan.poses[:, 2, 3]
    assert heights.min() < 0.9
    assert heights.max() > 1.5


def test_a_scanner_stands_on_both_sides_of_a_partition():
    """A room of 12 x 8 m, and across it a wall of 5 m whose only front faces away from y = 0."""
    points, triangles = box(np.array([12.0, 8.0, 3.0]), inwards=True)
    wall = np.array([[3, 4, 0], [8, 4, 0], [8, 4, 3], [3, 4, 3]], np.float32)
    faces = np.concatenate([triangles, np.array([[10, 9, 8], [11, 10, 8]], np.int32)])
    surface = ReferenceSurface(np.concatenate([points, wall]), faces, np.zeros(3), UP)
    p = view_parameters(read_model("lidar").parameters)
    plan = choose_views(surface, p)
    places = np.concatenate([plan.poses, plan.held_out])[:, :3, 3]
    before_wall = (places[:, 0] > 3.0) & (places[:, 0] < 8.0)
    assert (before_wall & (places[:, 1] < 3.5)).sum() >= 3
    assert (before_wall & (places[:, 1] > 4.5)).sum() >= 3
    assert (places > 0).all()  # and nowhere outside, behind the walls
    assert (places < (12.0, 8.0, 3.0)).all()


def test_up_may_be_any_axis_and_the_same_views_are_chosen_each_time():
    up = np.array([0.0, -1.0, 0.0])
    axes = level_axes(up)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    points, triangles = box(ROOM, inwards=True)
    surface = ReferenceSurface(
        (points @ axes.astype(np.float32)).astype(np.float32),
        np.ascontiguousarray(triangles), np.zeros(3), up,
    )  # fmt: skip
    p = depth_parameters()
    first, second = choose_views(surface, p), choose_views(surface, p)
    np.testing.assert_array_equal(first.poses, second.poses)
    np.testing.assert_array_equal(first.held_out, second.held_out)
    heights = first.poses[:, :3, 3] @ up
    assert first.floor == pytest.approx(0.0, abs=0.02)
    assert (heights > 0.3).all()
    assert (heights < ROOM[2] - 0.3).all()


def test_a_surface_without_free_space_has_no_views():
    points = np.random.default_rng(9).uniform(0, 0.2, (500, 3)).astype(np.float32)
    plan = choose_views(ReferenceSurface(points, None, np.zeros(3), UP), depth_parameters())
    assert plan.poses.shape == (0, 4, 4)
    assert plan.covered == 0.0
    for triangles in (None, np.zeros((0, 3), np.int32)):
        empty = ReferenceSurface(np.zeros((0, 3), np.float32), triangles, np.zeros(3), UP)
        assert choose_views(empty, depth_parameters()).poses.shape == (0, 4, 4)


def test_parameters_follow_the_model():
    own = view_parameters(read_model("lidar").parameters, CAMERA, (0.7, 0.2))
    assert (own.camera, own.heights, own.nearest, own.farthest) == (CAMERA, (0.2, 0.7), 0.6, 60.0)
    for wrong in ([], [0.0], [-1.0, 1.0], [math.nan]):
        with pytest.raises(InvalidRequest, match="above 0 m"):
            view_parameters(read_model("depth").parameters, heights=wrong)
