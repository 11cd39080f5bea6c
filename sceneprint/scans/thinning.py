"""Fewer points, one to a voxel.

points (N, 3)  --thinned-->  points (n, 3), edge of the voxels
"""

from __future__ import annotations

import math
import secrets

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.types import Floats32

#: Edge of the smallest voxels, metres: 2^21 of them are more than 20 km.
_FINEST = 0.01

Keys = NDArray[np.int64]


def thinned(points: Floats32, most: int) -> tuple[Floats32, float]:
    """At most so many of the points: of each voxel the first, in their order.

    Voxels are the smallest of 1 cm, 1.4 cm, 2 cm, ... that leave no more.

    Parameters
    ----------
    points : (N, 3) metres, none beyond 10 km
    most : at least 8: so many voxels meet at the origin, of any size

    Returns
    -------
    points : (n, 3)
    edge : of the voxels, metres
    """
    slots = 1 << max(4, math.ceil(math.log2(1.5 * most)))
    table, kept = np.empty(slots, np.int64), np.empty(most, np.int32)
    # who knows the hash can write a file all of whose voxels share a slot; which point is kept
    # does not depend on it
    secret, step = secrets.randbits(62), 0
    while True:
        edge = _FINEST * math.sqrt(2.0) ** step
        n = _firsts(points, 1.0 / edge, secret, table, kept)
        if n >= 0:
            return points[kept[:n]], edge
        step += 1


@kernel
def _firsts(
    points: Floats32, scale: float, secret: int, table: Keys, kept: NDArray[np.int32]
) -> int:
    """Indices of the first point of each voxel, and how many; -1 if more than there is room."""
    table[:] = -1
    mask, n = len(table) - 1, 0
    for i in range(len(points)):
        key = 0
        for k in range(3):
            key = (key << 21) | (math.floor(points[i, k] * scale) + (1 << 20))
        h = (key ^ secret) * 0x9E3779B97F4A7C1
        h ^= h >> 31
        h *= 0x1D8E4E27C47D124F
        slot = (h >> 20) & mask
        while table[slot] >= 0 and table[slot] != key:
            slot = (slot + 1) & mask
        if table[slot] < 0:
            if n == len(kept):
                return -1
            table[slot] = key
            kept[n] = i
            n += 1
    return n
