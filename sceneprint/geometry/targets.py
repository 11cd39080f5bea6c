"""Sec. III-E, a surface made ready to be looked up: by its camera, or by place where it has none.

    Surface  --target_of-->  Target        Target, point  --nearest_alike-->  index

Points in no order are found in a hash of cubes. Of the points in a small cube one is kept, so that
a cube holds a bounded number of them, however many a cloud has in one place.
"""

from __future__ import annotations

import secrets
from dataclasses import dataclass

import numpy as np

from sceneprint.geometry.cells import mixed
from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.projecting import camera_of
from sceneprint.types import Floats, Floats32, Ints32, Surface

#: Small cubes along the reach; a cube of the hash is two reaches wide.
FINENESS = 5.0


@dataclass(frozen=True, eq=False)
class Target:
    """A surface as kernels look it up.

    Parameters
    ----------
    points, normals : (h, w, 3); (1, N, 3) of a cloud in no order
    camera : (7,) of `camera_of`; of a cloud in no order its third number is the reach, and its
        fourth the secret of the hash
    heads, chain : of the hash: the first point of each slot, the next of each point, -1 for none
    """

    points: Floats32
    normals: Floats32
    camera: Floats
    heads: Ints32
    chain: Ints32


@kernel
def _slot(i: int, j: int, k: int, slots: int, secret: int) -> int:
    """Of a cube: slots is a power of two."""
    return mixed((((i << 21) + j) << 21) + k, secret) & (slots - 1)


@kernel
def _fill(points: Floats32, cube: float, secret: int, heads: Ints32, chain: Ints32) -> None:
    """Every point in the slot of its cube, the last first."""
    for n in range(len(points)):
        slot = _slot(
            int(np.floor(points[n, 0] / cube)), int(np.floor(points[n, 1] / cube)),
            int(np.floor(points[n, 2] / cube)), len(heads), secret,
        )  # fmt: skip
        chain[n] = heads[slot]
        heads[slot] = n


@kernel
def nearest_alike(
    points: Floats32, normals: Floats32, camera: Floats, heads: Ints32, chain: Ints32,
    at: Floats, facing: Floats, least_cosine: float,
) -> tuple[int, float]:  # fmt: skip
    """The nearest point within reach whose normal is alike: index, -1 for none, and squared."""
    reach, secret, slots = camera[2], int(camera[3]), len(heads)
    cube = 2.0 * reach
    # the eight cubes that a ball of this reach can touch
    i0 = int(np.floor(at[0] / cube - 0.5))
    j0 = int(np.floor(at[1] / cube - 0.5))
    k0 = int(np.floor(at[2] / cube - 0.5))
    found, least = -1, reach * reach
    for i in range(i0, i0 + 2):
        for j in range(j0, j0 + 2):
            for k in range(k0, k0 + 2):
                n = heads[_slot(i, j, k, slots, secret)]
                while n >= 0:
                    ex, ey, ez = (
                        at[0] - points[0, n, 0], at[1] - points[0, n, 1], at[2] - points[0, n, 2]
                    )  # fmt: skip
                    square = ex * ex + ey * ey + ez * ez
                    # of two as near the first, in whatever order slots are walked
                    if square < least or (square == least and found > n):
                        cosine = (
                            facing[0] * normals[0, n, 0]
                            + facing[1] * normals[0, n, 1]
                            + facing[2] * normals[0, n, 2]
                        )
                        if cosine > least_cosine:
                            found, least = n, square
                    n = chain[n]
    return found, least


def one_of_each(points: Floats32, cube: float) -> Ints32:
    """Indices, rising, of the first point (N, 3) in each occupied cube of this width, metres."""
    cells = np.floor(points / cube).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    spans = cells.max(axis=0, initial=0) + 1
    keys = (cells[:, 0] * spans[1] + cells[:, 1]) * spans[2] + cells[:, 2]
    _, first = np.unique(keys, return_index=True)
    return np.sort(first).astype(np.int32)


def target_of(surface: Surface, nearest: float, reach: float) -> Target:
    """A surface made ready to be looked up.

    Parameters
    ----------
    surface : of any kind
    nearest : points this near its camera are not looked up, metres of depth
    reach : how far off a point may be that is in no order, metres
    """
    camera, none = camera_of(surface.camera, nearest), np.zeros(0, np.int32)
    if surface.camera is not None:
        return Target(surface.points, surface.normals, camera, none, none)
    secret = secrets.randbits(52)  # what a float64 holds whole
    camera[2:4] = reach, secret
    points, normals = surface.points[surface.valid], surface.normals[surface.valid]
    kept = one_of_each(points, reach / FINENESS)
    points, normals = points[kept], normals[kept]
    slots = 1 << max(int(2 * len(points) - 1).bit_length(), 1)
    heads, chain = np.full(slots, -1, np.int32), np.full(len(points), -1, np.int32)
    _fill(points, 2.0 * reach, secret, heads, chain)
    return Target(points[None], normals[None], camera, heads, chain)


def thinned(surface: Surface, most: int) -> Surface:
    """At most so many of a surface's points in no order, spread over all that it shows.

    Parameters
    ----------
    surface : without a camera
    most : at least 1

    Returns
    -------
    surface : the first point in each cube of a grid, as wide as it must be; the valid points
        themselves where they are no more than that
    """
    points = surface.points[surface.valid]
    kept = np.arange(len(points), dtype=np.int32)
    cube = float(np.ptp(points, axis=0).max(initial=0.0)) / 4096 if len(points) > most else 0.0
    while len(kept) > most:
        # of n cubes about a surface half are left when they are wider by the root of 2
        cube *= max((len(kept) / most) ** 0.5, 1.02)
        kept = one_of_each(points, cube) if cube > 0 else kept[:1]
    return Surface(
        points[kept][None],
        surface.normals[surface.valid][kept][None],
        np.ones((1, len(kept)), np.bool_),
        surface.areas[surface.valid][kept][None],
        None,
    )
