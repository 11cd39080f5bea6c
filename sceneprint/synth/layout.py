"""Where furniture stands: a grid of the floor keeps pieces inside the room and apart.

Piece, place (x, y, yaw)  --Floor.claim-->  its share of the floor, or a refusal
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.types import Floats

CELL = 0.05  #: metres a cell of the grid


@dataclass(frozen=True)
class Place:
    """Where a piece stands: x, y metres; yaw radians."""

    x: float
    y: float
    yaw: float


class Floor:
    """The floor of one room and what has been claimed of it."""

    def __init__(self, outline: Floats) -> None:
        low, high = outline.min(axis=0), outline.max(axis=0)
        shape = np.ceil((high - low) / CELL).astype(int)
        x = low[0] + (np.arange(shape[0]) + 0.5) * CELL
        y = low[1] + (np.arange(shape[1]) + 0.5) * CELL
        self.points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        self.inside = inside(outline, self.points)
        self.claimed = ~self.inside

    def claim(self, place: Place, width: float, depth: float, overlap: float = 0.0) -> bool:
        """Take a turned rectangle of the floor, or refuse and change nothing.

        Parameters
        ----------
        place : middle and yaw of the rectangle
        width, depth : its extents, metres
        overlap : share of it that others may have claimed already, [0, 1]; none of it may
            lie outside the room
        """
        cells = self._cells(place, width, depth)
        total = width * depth / CELL**2
        within = np.count_nonzero(cells & self.inside)
        free = np.count_nonzero(cells & ~self.claimed)
        # a strip of half a cell along the walls may round away
        slack = (width + depth) / CELL + 2
        if within < total - slack or free < within * (1 - overlap) - 1e-9:
            return False
        self.claimed |= cells
        return True

    def _cells(self, place: Place, width: float, depth: float) -> NDArray[np.bool_]:
        c, s = math.cos(place.yaw), math.sin(place.yaw)
        dx, dy = self.points[..., 0] - place.x, self.points[..., 1] - place.y
        along, across = np.abs(c * dx + s * dy), np.abs(c * dy - s * dx)
        return (along <= width / 2) & (across <= depth / 2)


def inside(outline: Floats, points: Floats) -> NDArray[np.bool_]:
    """(...,) whether floor points (..., 2) lie in the outline (n, 2): crossings of a ray."""
    x, y = points[..., 0], points[..., 1]
    result = np.zeros(x.shape, bool)
    for (ax, ay), (bx, by) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if ay == by:
            continue
        crosses = (ay > y) != (by > y)
        result ^= crosses & (x < ax + (y - ay) / (by - ay) * (bx - ax))
    return result
