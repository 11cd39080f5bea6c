"""Tests of the spinning scanner in a box: ranges and angles."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sceneprint_lab.synth.mesh import box
from sceneprint_lab.synth.sensors import Caster, Spinning, scan

HALF = np.array([6.0, 4.0, 2.0])  #: of the box scanned from within, metres
SENSOR = Spinning(
    rings=16,
    lowest=math.radians(-15),
    highest=math.radians(15),
    azimuth_step=math.radians(0.4),
    blind_width=0.0,
)


def inside_out(mesh):
    return replace(mesh, faces=mesh.faces[:, ::-1].copy())


@pytest.fixture(scope="module")
def shell():
    return Caster(inside_out(box(2 * HALF[0], 2 * HALF[1], 2 * HALF[2], (0.0, 0.0, -HALF[2]))))


def pose(yaw, at):
    T = np.eye(4)
    T[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    T[:3, 3] = at
    return T


def ranges(points):
    return np.asarray(np.linalg.norm(points.astype(float), axis=1))


def from_walls(points, T):
    """Distance of each point from the nearest of the six sides."""
    world = points @ T[:3, :3].T + T[:3, 3]
    return np.asarray(np.abs(np.abs(world) - HALF).min(axis=1))


def test_every_point_lies_on_a_wall_within_noise(shell):
    T = pose(0.7, (1.0, -0.5, 0.3))
    points = scan(shell, T, SENSOR, np.random.default_rng(0))
    assert points.dtype == np.float32
    assert points.shape[1] == 3
    off = from_walls(points, T)
    # noise is along the ray, so off the wall it is no more: three sigmas hold 99.7 %
    assert (off < 3 * math.hypot(SENSOR.sigma, SENSOR.ring_sigma)).mean() > 0.99
    assert 0.003 < off.mean() < SENSOR.sigma


def test_without_errors_nothing_is_lost_and_all_is_exact(shell):
    T = pose(-2.0, (0.0, 1.0, 0.0))
    ideal = replace(SENSOR, sigma=0.0, ring_sigma=0.0, loss=0.0, grazing=0.0)
    points = scan(shell, T, ideal, np.random.default_rng(0))
    assert len(points) == 16 * 900
    assert from_walls(points, T).max() < 1e-4
    # straight ahead of the turned sensor, by hand: the wall x = -6 lies along azimuth pi + 2
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    ahead = np.abs(azimuth - (2.0 + math.pi - 2 * math.pi)) < math.radians(0.21)
    lowest = np.abs(elevation - elevation.min()) < 1e-4
    expected = 6.0 / (math.cos(math.radians(15)) * np.cos(math.radians(0.2)))
    assert ranges(points[ahead & lowest]) == pytest.approx(expected, abs=2e-3)
