"""Where furniture stands: a grid of the floor keeps pieces inside the room and apart.

Piece, place (x, y, yaw)  --Floor.claim-->  its share of the floor, or a refusal
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.types import Floats

CELL = 0.05  #: metres a cell of a room's grid


@dataclass(frozen=True)
class Place:
    """Where a piece stands: x, y metres; yaw radians."""

    x: float
    y: float
    yaw: float


class Floor:
    """The floor within an outline (n, 2), and what has been claimed of it.

    Parameters
    ----------
    outline : corners, counter-clockwise, metres
    cell : side of the grid's cells, metres
    """

    def __init__(self, outline: Floats, cell: float = CELL) -> None:
        low, high = outline.min(axis=0), outline.max(axis=0)
        shape = np.ceil((high - low) / cell).astype(int)
        x = low[0] + (np.arange(shape[0]) + 0.5) * cell
        y = low[1] + (np.arange(shape[1]) + 0.5) * cell
        self.cell, self._low = cell, low
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
        part, cells = self._cells(place, width, depth)
        total = width * depth / self.cell**2
        within = np.count_nonzero(cells & self.inside[part])
        free = np.count_nonzero(cells & ~self.claimed[part])
        # a strip of half a cell along the walls may round away
        slack = (width + depth) / self.cell + 2
        if within < total - slack or free < within * (1 - overlap) - 1e-9:
            return False
        self.claimed[part] |= cells
        return True

    def take(self, place: Place, width: float, depth: float) -> None:
        """Claim a turned rectangle whatever lies there, inside the outline or not."""
        part, cells = self._cells(place, width, depth)
        self.claimed[part] |= cells

    def _cells(
        self, place: Place, width: float, depth: float
    ) -> tuple[tuple[slice, slice], NDArray[np.bool_]]:
        """A part of the grid that holds the rectangle, and which of its cells it covers."""
        reach = math.hypot(width, depth) / 2 + self.cell
        middle = np.array([place.x, place.y])
        first = np.floor((middle - reach - self._low) / self.cell).astype(int).clip(0)
        last = np.ceil((middle + reach - self._low) / self.cell).astype(int).clip(0)
        part = (slice(first[0], last[0]), slice(first[1], last[1]))
        points = self.points[part]
        c, s = math.cos(place.yaw), math.sin(place.yaw)
        dx, dy = points[..., 0] - place.x, points[..., 1] - place.y
        along, across = np.abs(c * dx + s * dy), np.abs(c * dy - s * dx)
        return part, (along <= width / 2) & (across <= depth / 2)


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
