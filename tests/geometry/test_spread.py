"""Tests of points that are spread over a scan, and of their use."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sceneprint.geometry.registration.overlap import first_per_cube
from sceneprint.geometry.surface.range_image import SPREAD_POINTS
from sceneprint.geometry.validation.validation import refine_transform
from sceneprint.models import read_model
from sceneprint.pipeline import geometry_of
from sceneprint.signing import see
from sceneprint.types import Cloud


def hall(at, turn=0.0, half=math.pi):
    """A hall of 30 x 20 x 6 m with three pillars, scanned from a place in it, without noise."""
    azimuth = np.linspace(-half, half, 900, endpoint=False)
    elevation = np.radians(np.linspace(-30, 30, 48))
    a, e = (x.ravel() for x in np.meshgrid(azimuth, elevation))
    rays = np.stack([np.cos(e) * np.cos(a + turn), np.cos(e) * np.sin(a + turn), np.sin(e)], axis=1)
    low, high = np.array([-15.0, -10.0, 0.0]), np.array([15.0, 10.0, 6.0])
    origin = np.array(at)
    with np.errstate(divide="ignore"):
        ranges = np.maximum((low - origin) / rays, (high - origin) / rays).min(axis=1)
    for x, y in ((-6.0, 3.0), (2.0, -4.0), (8.0, 5.0)):  # of a square plan
        with np.errstate(divide="ignore"):
            sides = (np.array([[x - 0.6, y - 0.6], [x + 0.6, y + 0.6]]) - origin[:2])[
                :, None
            ] / rays[:, :2]
        enter, leave = sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)
        hit = (enter < leave) & (enter > 0)
        ranges = np.where(hit, np.minimum(ranges, enter), ranges)
    away = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    points = (away * ranges[:, None]).astype(np.float32)
    return Cloud(points)


@pytest.fixture(scope="module")
def lidar():
    return read_model("lidar")


def geometry(cloud, model):
    return geometry_of(see(cloud, model.parameters), model)


@pytest.fixture(scope="module")
def surface(lidar):
    """What a scan of the hall shows."""
    return geometry(hall((1.0, 0.5, 1.5)), lidar).surface


def test_points_lie_on_what_is_shown_and_evenly(surface):
    spread = surface.spread
    assert SPREAD_POINTS * 0.8 < spread.points.shape[1] <= SPREAD_POINTS
    assert spread.valid.all()
    assert spread.camera is None
    points = spread.points[0] + np.array([1.0, 0.5, 1.5])
    # on floor, ceiling or a wall, or a pillar's side
    off = np.minimum(np.abs(points[:, 2]), np.abs(points[:, 2] - 6.0))
    off = np.minimum(off, np.abs(np.abs(points[:, 0]) - 15.0))
    off = np.minimum(off, np.abs(np.abs(points[:, 1]) - 10.0))
    for x, y in ((-6.0, 3.0), (2.0, -4.0), (8.0, 5.0)):
        beside = np.abs(np.maximum(np.abs(points[:, 0] - x), np.abs(points[:, 1] - y)) - 0.6)
        off = np.minimum(off, beside)
    assert np.quantile(off, 0.9) < 0.04  # of the others, planes were fitted across a corner
    # the far wall has a share of the points that a range image does not give it
    far = (points[:, 0] < -14.9).mean()
    shown = surface.points[surface.valid] + np.array([1.0, 0.5, 1.5])
    assert far > 1.5 * (shown[:, 0] < -14.9).mean()


def test_a_scan_that_sees_a_part_keeps_its_image_alone(lidar):
    part = geometry(hall((1.0, 0.5, 1.5), half=1.0), lidar).surface
    assert part.spread is None
    assert part.fitted is part


def test_refinement_works_on_the_points(lidar):
    """From the truth, 14 m apart, where the image alone is 2 cm off or more."""
    places = (-7.0, -3.0, 1.5), (6.0, 2.0, 1.5)
    a, b = (geometry(hall(at), lidar) for at in places)
    T = np.eye(4)
    T[:3, 3] = np.array(places[0]) - np.array(places[1])
    fine = lidar.parameters.validation.alignment.fine
    result = refine_transform(a, b, T, fine)
    assert np.linalg.norm(result[:3, 3] - T[:3, 3]) < 0.02
    plain = [replace(shot, surface=replace(shot.surface, spread=None)) for shot in (a, b)]
    coarse = refine_transform(plain[0], plain[1], T, fine)
    off = math.inf if coarse is None else float(np.linalg.norm(coarse[:3, 3] - T[:3, 3]))
    assert np.linalg.norm(result[:3, 3] - T[:3, 3]) < off


@pytest.mark.parametrize("at", [0.0, 3e5])
def test_the_first_point_in_each_cube_is_kept(at):
    """Beside sorting; on both sides of the origin and far from it, on the cubes' faces too."""
    rng = np.random.default_rng(5)
    points = np.concatenate(
        [rng.normal(at, 0.5, (900, 3)), rng.integers(-9, 9, (900, 3)) * 0.25, [[at, -at, at]] * 3]
    ).astype(np.float32)
    rng.shuffle(points)
    for cube in (0.25, 0.31, 40.0):
        cells = np.floor(points / np.float32(cube)).astype(np.int64)
        _, first = np.unique(cells, axis=0, return_index=True)
        assert first_per_cube(points, cube).tolist() == sorted(first.tolist())
    assert first_per_cube(points[:0], 1.0).tolist() == []
    assert first_per_cube(points, 40.0).dtype == np.int32
