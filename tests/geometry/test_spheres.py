"""Tests of range images: exact planes, cropping, closed gaps and preserved edges."""

from dataclasses import replace

import numpy as np
import pytest

from sceneprint.errors import UselessFrame
from sceneprint.geometry.surface.cloud import CloudParameters
from sceneprint.geometry.surface.range_image import directions, pole_of, range_image
from sceneprint.types import Cloud, Sphere
from tests.geometry import cloud_scenes

P = CloudParameters(image_angle=0.02)


def camera_of(cloud, p=P):
    camera = range_image(cloud, p).camera
    assert isinstance(camera, Sphere)
    return camera


def test_planes_are_exact():
    surface = range_image(cloud_scenes.room(60_000), P)
    assert surface.valid.mean() > 0.93
    points, normals = surface.points[surface.valid], surface.normals[surface.valid]
    # away from edges, where windows see two walls
    inner = np.abs(normals).max(axis=1) > 0.99999
    assert inner.mean() > 0.75
    off = cloud_scenes.off_walls(points[inner].astype(float))
    assert np.quantile(off, 0.9) < 1e-6
    assert off.max() < 2e-3
    assert ((points * normals).sum(axis=1) < 0).all()  # towards the viewpoint
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    # 4 pi of the sphere, or the walls of the room: what is lost is at the edges
    size = cloud_scenes.HIGH - cloud_scenes.LOW
    whole = 2 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0])
    assert surface.areas.sum() == pytest.approx(whole, rel=0.12)


@pytest.mark.parametrize("pole", [0, 1, 2])
def test_pixels_are_where_the_camera_says(pole):
    rays = cloud_scenes.directions(20_000)
    rays = rays[np.abs(rays[:, pole]) < 0.5]  # the pole is where nothing is
    surface = range_image(Cloud(cloud_scenes.in_room(rays)[0].astype(np.float32)), P)
    camera = surface.camera
    assert isinstance(camera, Sphere)
    assert camera.pole == pole
    y, x = np.nonzero(surface.valid)
    at = surface.points[y, x].astype(float)
    at /= np.linalg.norm(at, axis=1)[:, None]
    a, b = (pole + 1) % 3, (pole + 2) % 3
    azimuth = np.mod(np.arctan2(at[:, b], at[:, a]) - camera.left, 2 * np.pi) / camera.step
    offset = np.mod(azimuth - x + camera.width / 2, 2 * np.pi / camera.step) - camera.width / 2
    np.testing.assert_allclose(offset, 0, atol=1e-3)
    np.testing.assert_allclose((camera.top - np.arcsin(at[:, pole])) / camera.step, y, atol=1e-3)
    np.testing.assert_allclose(directions(camera)[y, x], at, atol=1e-5)


def test_cropped_to_what_is_seen():
    full = camera_of(cloud_scenes.room(60_000))
    assert full.is_closed
    assert full.width == 315
    assert full.sees_around
    cone = camera_of(cloud_scenes.room(20_000, half_deg=25))
    assert not cone.is_closed
    assert not cone.sees_around
    degree = np.pi / 180
    assert [Sphere(n, 9, degree, 0.0, 0.1).sees_around for n in (269, 271, 360)] == [
        False,
        True,
        True,
    ]
    assert cone.width == pytest.approx(50 * np.pi / 180 / cone.step, abs=2)
    # a cone across the seam of azimuth is no wider
    back = cloud_scenes.room(20_000, half_deg=25).points * np.float32(-1)
    assert camera_of(Cloud(back)).width == pytest.approx(cone.width, abs=1)


def test_pixels_grow_until_there_are_few_enough():
    camera = camera_of(cloud_scenes.room(5000), replace(P, maximum_pixels=900))
    assert camera.width * camera.height <= 900
    assert camera.step > 0.04


def wall(rows, columns, distance):
    """Points at x = distance, at every azimuth of columns and elevation of rows."""
    azimuth, elevation = np.meshgrid(columns, rows)
    x = np.broadcast_to(distance[:, None], azimuth.shape)
    flat = x / np.cos(azimuth)
    return np.stack([x, x * np.tan(azimuth), flat * np.tan(elevation)], axis=2).reshape(-1, 3)


def test_the_nearest_surface_is_seen():
    grid = np.arange(-0.3, 0.3, 0.008)
    near = wall(grid[:30], grid, np.full(30, 2.0))
    far = wall(grid, grid, np.full(len(grid), 2.5))
    surface = range_image(Cloud(np.concatenate([far, near]).astype(np.float32)), P)
    x = surface.points[..., 0]
    height = surface.valid.shape[0]
    assert surface.valid[height // 2 + 4 :].any()
    np.testing.assert_allclose(
        x[height * 3 // 4 :][surface.valid[height * 3 // 4 :]], 2.0, rtol=1e-3
    )
    np.testing.assert_allclose(x[: height // 3][surface.valid[: height // 3]], 2.5, rtol=1e-3)


def test_gaps_between_rings_are_closed_on_one_plane_only():
    rings = np.arange(-5, 6) * 3 * P.image_angle  # two pixels between rings
    columns = np.arange(-0.5, 0.5, 0.01)
    one = range_image(Cloud(wall(rings, columns, np.full(11, 3.0)).astype(np.float32)), P)
    open_ = range_image(
        Cloud(wall(rings, columns, np.full(11, 3.0)).astype(np.float32)), replace(P, gap_px=0)
    )
    assert open_.valid.mean() < 0.4
    assert one.valid.mean() > 0.95
    np.testing.assert_allclose(one.points[one.valid][:, 0], 3.0, rtol=1e-4)
    step = np.where(rings > 0, 4.0, 3.0)
    two = range_image(Cloud(wall(rings, columns, step).astype(np.float32)), P)
    rows = two.valid.mean(axis=1)
    empty = np.flatnonzero(rows < 0.05)
    assert len(empty) == 2  # the gap at the step
    x = two.points[two.valid][:, 0]
    assert (np.minimum(np.abs(x - 3), np.abs(x - 4)) < 1e-3).all()


def test_points_in_one_direction_show_no_surface():
    ray = np.linspace(1, 9, 5000)[:, None] * np.array([1.0, 0.1, 0.1])
    with pytest.raises(UselessFrame, match="1 pixels"):
        range_image(Cloud(ray.astype(np.float32)), P)


@pytest.mark.parametrize(("spread", "pole"), [((3, 3, 1), 2), ((1, 3, 3), 0), ((3, 1, 3), 1)])
def test_the_pole_is_the_axis_that_fewest_points_are_near(spread, pole):
    points = (np.random.default_rng(1).normal(size=(5000, 3)) * spread).astype(np.float32)
    lengths = np.linalg.norm(points, axis=1)
    near = [(np.abs(points[:, c]) > np.cos(np.pi / 6) * lengths).sum() for c in range(3)]
    assert pole_of(points) == int(np.argmin(near)) == pole
    assert pole_of(points[:, [0, 1, 2]] * 0) == 2  # all tie
