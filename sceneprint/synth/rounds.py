"""Where a scanner is carried: poses on a walk through large premises, or here and there.

Premises, n, rng  --walk, scattered-->  T_world_sensor (4, 4), n of them
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from sceneprint.synth.mesh import rotation_x, rotation_z
from sceneprint.synth.premises import Premises
from sceneprint.types import Floats

STEP = 1.5  #: metres from scan to scan on a walk
COARSE = 3  #: cells of the floor's grid to one of the grid that walks go on


def scattered(premises: Premises, n: int, rng: np.random.Generator) -> list[Floats]:
    """Poses anywhere in the premises, facing anywhere."""
    spots = premises.floor.points[premises.walkable]
    height = float(rng.uniform(0.5, 1.9))
    chosen = spots[rng.integers(0, len(spots), n)]
    return [_pose(x, y, height, rng.uniform(-math.pi, math.pi), rng) for x, y in chosen]


def walk(premises: Premises, n: int, rng: np.random.Generator, step: float = STEP) -> list[Floats]:
    """Poses every `step` metres on a walk from place to place, facing ahead; it comes back often.

    Parameters
    ----------
    premises : see there
    n : how many
    rng : of places, heights and wobble
    step : metres
    """
    spots, graph = _ways(premises)
    path = [spots[0][None]]
    at, length = int(rng.integers(0, len(spots))), 0.0
    aims = rng.integers(0, len(spots), max(3, n // 12))
    while length < n * step:
        aim = int(aims[int(rng.integers(0, len(aims)))])
        _, before = dijkstra(graph, indices=[aim], return_predecessors=True)
        leg = [at]
        while leg[-1] != aim and before[0, leg[-1]] >= 0:
            leg.append(int(before[0, leg[-1]]))
        line = spots[leg]
        length += max(float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()), 1e-3)
        path.append(line)
        at = leg[-1]
        if len(path) > 50 * n:  # premises of a single spot
            break
    line = np.concatenate(path[1:])
    line = ndimage.gaussian_filter1d(line, 1.5, axis=0, mode="nearest")
    along = np.append(0.0, np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum())
    s = np.minimum(np.arange(n) * step, along[-1])
    xy = np.column_stack([np.interp(s, along, line[:, k]) for k in range(2)])
    ahead = np.column_stack([np.interp(s + 0.5, along, line[:, k]) for k in range(2)]) - xy
    height = float(rng.uniform(0.5, 1.9))
    mounted = float(rng.uniform(-math.pi, math.pi))
    return [
        _pose(x, y, height, mounted + math.atan2(dy, dx), rng)
        for (x, y), (dx, dy) in zip(xy, ahead, strict=True)
    ]


def _pose(x: float, y: float, z: float, yaw: float, rng: np.random.Generator) -> Floats:
    roll, pitch = rng.normal(0, math.radians(1.5), 2)
    T = np.eye(4)
    across = rotation_z(math.pi / 2) @ rotation_x(float(pitch)) @ rotation_z(-math.pi / 2)
    T[:3, :3] = rotation_z(yaw) @ across @ rotation_x(float(roll))
    T[:3, 3] = x, y, z + rng.normal(0, 0.02)
    return T


def _ways(premises: Premises) -> tuple[Floats, csr_array]:
    """Spots (n, 2) that one can walk on, and the distances of neighbours."""
    free = premises.walkable[::COARSE, ::COARSE]
    parts, count = ndimage.label(free, np.ones((3, 3)))
    if count:
        free = parts == 1 + int(np.bincount(parts.ravel())[1:].argmax())
    else:
        free = np.zeros_like(free)
        free.flat[0] = True
    spots = premises.floor.points[::COARSE, ::COARSE][free]
    number = np.full(free.shape, -1)
    number[free] = np.arange(len(spots))
    rows, columns, lengths = [], [], []
    pitch = COARSE * premises.floor.cell
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
        a = number[: free.shape[0] - dx, max(0, -dy) : free.shape[1] - max(0, dy)]
        b = number[dx:, max(0, dy) : free.shape[1] + min(0, dy)]
        both = (a >= 0) & (b >= 0)
        rows.append(a[both])
        columns.append(b[both])
        lengths.append(np.full(int(both.sum()), pitch * math.hypot(dx, dy)))
    i, j, d = np.concatenate(rows), np.concatenate(columns), np.concatenate(lengths)
    n = len(spots)
    both_ways = np.append(i, j), np.append(j, i)
    return spots, csr_array((np.append(d, d), both_ways), shape=(n, n))
