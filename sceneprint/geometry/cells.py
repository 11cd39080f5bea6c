"""Input of Sec. III, clouds: the points in each cell of a grid become one.

points (N, 3), axes  --thinned-->  means (V, 4), side of a cell
"""

from __future__ import annotations

import math
import secrets

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.clouds import CloudParameters
from sceneprint.geometry.kernel import kernel
from sceneprint.types import Floats, Floats32

#: Steps of a number from 0 to 1 in sums: those of 5 million points stay below 2^63.
_STEPS = 2.0**38
#: Cells of an axis, either way, where there is no viewpoint: three of them are one key.
_REACH = 1 << 20
#: Cells that are counted before all are made larger, times the most that are wanted.
_ROOM = 4

Ints64 = NDArray[np.int64]


@kernel
def direction_cell(x: float, y: float, z: float, angle: float) -> int:
    """Cell of a direction on the cube about the viewpoint, its sides cut into equal angles."""
    n = int(np.ceil(np.pi / 2 / angle))
    ax, ay, az = abs(x), abs(y), abs(z)
    if az >= ax and az >= ay:
        face, along, a, b = 4, z, x, y
    elif ay >= ax:
        face, along, a, b = 2, y, z, x
    else:
        face, along, a, b = 0, x, y, z
    if along < 0:
        face += 1
    depth = max(abs(along), 1e-300)
    u = int((np.arctan(a / depth) + np.pi / 4) / angle)
    v = int((np.arctan(b / depth) + np.pi / 4) / angle)
    return (face * n + min(max(u, 0), n - 1)) * n + min(max(v, 0), n - 1)


@kernel
def metric_cell(x: float, y: float, z: float, size: float) -> int:
    """Cell of a place on a grid of cubes."""
    a = min(max(int(np.floor(x / size)), -_REACH), _REACH - 1) + _REACH
    b = min(max(int(np.floor(y / size)), -_REACH), _REACH - 1) + _REACH
    c = min(max(int(np.floor(z / size)), -_REACH), _REACH - 1) + _REACH
    return (a * 2 * _REACH + b) * 2 * _REACH + c


@kernel
def mixed(key: int, secret: int) -> int:
    """Where a key goes in a hash table whose size is a power of two.

    Who knows the hash can make a cloud all of whose cells share a slot, so there is a secret;
    what comes of it must not depend on it.
    """
    h = (key ^ secret) * 0x9E3779B97F4A7C1
    h ^= h >> 31
    h *= 0x1D8E4E27C47D124F
    return h >> 20


@kernel
def _gather(
    points: Floats32, axes: Floats, centre: Floats, seen: bool, side: float, step: float,
    unit: float, secret: int, keys: Ints64, bins: Ints64, sums: Ints64,
) -> int:  # fmt: skip
    """Sums of the points in each occupied cell; how many there are, or -1 for too many.

    seen: number, unit / r, direction; else: number, 0, coordinates in units.
    """
    size = 16
    while size < 2 * len(keys):
        size *= 2
    table = np.full(size, -1, np.int32)
    mask = size - 1
    n = 0
    for i in range(len(points)):
        px, py, pz = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        x = axes[0, 0] * px + axes[0, 1] * py + axes[0, 2] * pz
        y = axes[1, 0] * px + axes[1, 1] * py + axes[1, 2] * pz
        z = axes[2, 0] * px + axes[2, 1] * py + axes[2, 2] * pz
        if seen:
            r = np.sqrt(px * px + py * py + pz * pz)
            key = direction_cell(x, y, z, side)
            shell = np.int64(np.log(r / unit) / step)
            scale, inverse = _STEPS / r, unit / r * _STEPS
        else:
            key, shell = metric_cell(x, y, z, side), np.int64(0)
            scale, inverse = _STEPS / unit, 0.0
        at = mixed(int(key * 1000003 + shell), secret) & mask
        while table[at] >= 0 and (keys[table[at]] != key or bins[table[at]] != shell):
            at = (at + 1) & mask
        k = table[at]
        if k < 0:
            if n == len(keys):
                return -1
            k = n
            table[at] = np.int32(n)
            keys[n], bins[n] = key, shell
            sums[n] = 0
            n += 1
        sums[k, 0] += 1
        sums[k, 1] += np.int64(np.rint(inverse))
        sums[k, 2] += np.int64(np.rint(px * scale))
        sums[k, 3] += np.int64(np.rint(py * scale))
        sums[k, 4] += np.int64(np.rint(pz * scale))
    return n


@kernel
def _joined(keys: Ints64, bins: Ints64, order: Ints64, sums: Ints64, out: Ints64) -> int:
    """Cells in order of their keys; two in one direction, one behind the other, become one."""
    n, i = 0, 0
    while i < len(order):
        out[n] = sums[order[i]]
        if i + 1 < len(order):
            a, b = order[i], order[i + 1]
            if keys[a] == keys[b] and bins[a] + 1 == bins[b]:
                out[n] += sums[b]
                i += 1
        n += 1
        i += 1
    return n


def centroid(points: Floats32) -> Floats:
    """Mean of points (N, 3), the same in any order."""
    unit = max(float(np.abs(points).max()) * 2, 1e-9)
    whole = np.rint(points.astype(float) * (_STEPS / unit)).astype(np.int64)
    mean: Floats = whole.sum(axis=0) / len(points) * (unit / _STEPS)
    return mean


def thinned(
    points: Floats32, axes: Floats, centre: Floats, seen: bool, unit: float, p: CloudParameters
) -> tuple[Floats, float]:
    """Means of the occupied cells (V, 4), and the side of a cell."""
    side = p.voxel_angle if seen else p.voxel_size
    room = min(_ROOM * p.maximum_pixels, len(points))
    keys, bins = np.empty(room, np.int64), np.empty(room, np.int64)
    sums, out = np.empty((room, 5), np.int64), np.empty((room, 5), np.int64)
    step, secret = math.log1p(p.same_surface), secrets.randbits(62)
    while True:
        n = _gather(points, axes, centre, seen, side, step, unit, secret, keys, bins, sums)
        if 0 <= n <= p.maximum_pixels:
            break
        wider = max(math.sqrt(n / p.maximum_pixels), 1.05) if n > 0 else math.sqrt(_ROOM)
        side, step = side * wider, step * wider
    order = np.lexsort((bins[:n], keys[:n]))
    n = _joined(keys[:n], bins[:n], order, sums, out)
    return out[:n, 1:] / out[:n, :1] / _STEPS, side
