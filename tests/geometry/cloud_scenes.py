"""Exact clouds of a room with six planes, for any number of directions."""

import numpy as np

from sceneprint.types import Cloud

#: Walls of the room relative to the viewpoint: x, y, z from -> to, metres.
LOW, HIGH = np.array([-2.0, -1.6, -1.1]), np.array([2.6, 1.9, 1.4])


def directions(n, seed=0, half_deg=180.0):
    """Return unit vectors (n, 3), uniform within an angle of the x axis."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(np.cos(np.radians(half_deg)), 1.0, n)
    turn = rng.uniform(0, 2 * np.pi, n)
    flat = np.sqrt(1 - x * x)
    return np.column_stack([x, flat * np.cos(turn), flat * np.sin(turn)])


def in_room(rays):
    """Return the points where rays meet the walls, and the normals there, (n, 3) each."""
    with np.errstate(divide="ignore"):
        reach = np.where(rays > 0, HIGH / rays, LOW / rays)
    wall = reach.argmin(axis=1)
    row = np.arange(len(rays))
    normals = np.zeros_like(rays)
    normals[row, wall] = -np.sign(rays[row, wall])
    return rays * reach[row, wall][:, None], normals


def room(n=40_000, seed=0, half_deg=180.0):
    """Return an exact cloud of the room around the viewpoint."""
    return Cloud(in_room(directions(n, seed, half_deg))[0].astype(np.float32))


def off_walls(points):
    """Return the distances of points from the nearest wall, metres."""
    gaps = np.concatenate([points - LOW, HIGH - points], axis=-1)
    return np.abs(gaps).min(axis=-1)


def rotation(seed):
    """Return a uniformly random rotation (3, 3)."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    q[:, 0] *= np.linalg.det(q)
    return np.asarray(q, float)


def shuffled(cloud, seed=1):
    order = np.random.default_rng(seed).permutation(len(cloud.points))
    return Cloud(cloud.points[order], cloud.has_viewpoint, cloud.name)


def turned(cloud, R):
    return Cloud((cloud.points @ R.T).astype(np.float32), cloud.has_viewpoint, cloud.name)
