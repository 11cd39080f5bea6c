"""Fixtures of the export tests: a room with a known surface, and its images and scans."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

Floats = NDArray[np.float64]
SIZE = np.array([5.0, 4.0, 2.6])  #: corner opposite the origin, metres; z is up


@dataclass(frozen=True)
class Lens:
    """A camera without distortion; pixel centres have integer coordinates."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @property
    def rays(self):
        """Return rays (H, W, 3) in optical axes, z = 1."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        x, y = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        return np.stack((x, y, np.ones_like(x)), axis=-1)


class Room:
    """A box seen from inside, which is not symmetric about any of the poses."""

    lens = Lens(105.0, 103.0, 38.5, 31.0, 80, 60)

    @staticmethod
    def poses():
        """Return T_world_camera (4, 4) in optical axes at three places with different rotations."""
        results = []
        for x, y, z, turn, pitch, roll in (
            (1.2, 1.1, 1.3, 20, 15, 5), (3.1, 2.6, 1.0, 130, -10, -8), (4.0, 0.9, 1.8, -75, 25, 90),
        ):  # fmt: skip
            a, b, c = map(math.radians, (turn, pitch, roll))
            forward = np.array([math.cos(a) * math.cos(b), math.sin(a) * math.cos(b), -math.sin(b)])
            right = np.array([math.sin(a), -math.cos(a), 0.0])
            down = np.cross(forward, right)
            T = np.eye(4)
            T[:3, 0] = math.cos(c) * right + math.sin(c) * down
            T[:3, 1] = -math.sin(c) * right + math.cos(c) * down
            T[:3, 2] = forward
            T[:3, 3] = x, y, z
            results.append(T)
        return results

    @staticmethod
    def distances(origin, directions):
        """Return the distances to the walls from within, in lengths of the directions (..., 3)."""
        with np.errstate(divide="ignore"):
            reach = np.where(directions > 0, SIZE - origin, -origin) / directions
        reach[directions == 0] = np.inf
        return reach.min(axis=-1)

    def depth(self, T_world_camera, lens=None):
        """Return depth (H, W) along the optical axis, metres."""
        rays = (lens or self.lens).rays @ T_world_camera[:3, :3].T
        return self.distances(T_world_camera[:3, 3], rays)

    def points(self, T_world_scan, count=2000):
        """Return points (N, 3) of the walls in the axes of a scanner, in all directions."""
        directions = np.random.default_rng(5).normal(size=(count, 3))
        world = directions @ T_world_scan[:3, :3].T
        return directions * self.distances(T_world_scan[:3, 3], world)[:, None]

    @staticmethod
    def error(points):
        """Return the greatest distance of points (N, 3) from the walls, metres."""
        outside = np.linalg.norm(np.maximum(0, np.maximum(-points, points - SIZE)), axis=1)
        within = np.minimum(np.abs(points), np.abs(points - SIZE)).min(axis=1)
        return float(np.maximum(outside, np.where(outside > 0, 0, within)).max())

    def error_of_frame(self, frame, T):
        """Return the greatest error of a complete depth frame at a pose, metres."""
        k = frame.intrinsics
        lens = Lens(k.fx, k.fy, k.cx, k.cy, k.width, k.height)
        return self.error_of_depth(frame.depth, lens, T)

    def error_of_depth(self, depth, lens, T):
        """Return the greatest error of a complete depth image at a pose, metres."""
        assert (depth > 0).all()
        points = (lens.rays * depth[..., None]).reshape(-1, 3)
        return self.error(points @ T[:3, :3].T + T[:3, 3])


@pytest.fixture(scope="session")
def room():
    return Room()
