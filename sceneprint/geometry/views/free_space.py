"""Detection of a surface's floors, and of places for a sensor above them.

    surfels  --find_floors-->  Floors
    Floors, parameters  --candidate_places-->  places (C, 3)

All coordinates are in level axes with z upwards. A floor is the lowest surface that is level over a
few metres, or another such surface at least a storey above the previous floor. `lookout.py` checks
whether a place is free.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.views.parameters import ViewParameters
from sceneprint.geometry.views.samples import Surfels
from sceneprint.types import Floats, Ints64

#: Minimum cosine between up and the normal of a level surface.
_LEVEL = 0.9
#: Maximum difference in height within a floor, metres.
_STEP = 0.15
#: Minimum height of a storey, metres.
_STOREY = 2.0
#: Minimum share of the cells around a column that the lowest floor must fill, and that a higher
#: floor must fill.
_LEAST_FLOOR, _LEAST_STOREY = 0.12, 0.3
#: Maximum share of a surface seen by cameras that may lie below a floor. If more does, the level
#: surface is a table in a room whose floor was not observed. For scanners there is no limit:
#: outdoors, much surface may lie below the ground.
_MOST_BELOW = 0.07
#: Maximum number of places in a grid, and maximum number of bins (columns times heights).
_MOST_COLUMNS, _MOST_BINS = 1_000_000, 8_000_000
#: Maximum number of storeys, and maximum number of heights for places without a floor.
_MOST_HEIGHTS = 50
_MOST_STOREYS = 12


@dataclass(frozen=True, eq=False)
class Floors:
    """The heights of floors in a grid of columns.

    Parameters
    ----------
    low : (2,) corner of the grid, metres
    side : width of a column, metres
    heights : (S, nx, ny) height of each storey's floor, metres; NaN where there is none
    level : (L, 3) points of level surfaces
    """

    low: Floats
    side: float
    heights: Floats
    level: Floats

    @property
    def lowest(self) -> float | None:
        """Return the median height of the lowest floor; None if there is no floor."""
        heights = self.heights[0][np.isfinite(self.heights[0])]
        return float(np.median(heights)) if len(heights) else None


def robust_extent(pieces: Surfels) -> tuple[Floats, Floats]:
    """Return the lower and upper corners of a surface's extent, ignoring distant stray points."""
    n = len(pieces.points)
    stray = max(n // 2000, min(n // 100, 4))
    ordered = np.sort(pieces.points.astype(np.float64), axis=0)
    return ordered[stray], ordered[n - 1 - stray]


def find_floors(pieces: Surfels, side: float, *, has_tables: bool = True) -> Floors:
    """Find the floors of a surface.

    Parameters
    ----------
    pieces : surfels in level axes
    side : minimum width of a column, metres; columns are wider if there would be too many
    has_tables : whether level surfaces may be furniture, as in a depth camera's surface
    """
    # both sides count: a mesh may be inside out, and places above a ceiling are not free
    level = pieces.points[np.abs(pieces.normals[:, 2]) > _LEVEL].astype(np.float64)
    low, high = robust_extent(pieces)
    level = level[((level >= low) & (level <= high)).all(axis=1)]
    step = max(_STEP, float(high[2] - low[2]) / 2000.0)
    while True:
        shape = np.floor((high - low) / (side, side, step)).astype(np.int64) + 1
        if math.prod(shape.tolist()) <= _MOST_BINS:
            break
        side *= 1.3
    bins = np.floor((level - low) / (side, side, step)).astype(np.int64)
    counts, sums = np.zeros(shape), np.zeros(shape)
    np.add.at(counts, tuple(bins.T), 1.0)
    np.add.at(sums, tuple(bins.T), level[:, 2])
    counts, sums = _sum_neighbours(counts), _sum_neighbours(sums)
    whole = 9.0 * (side / pieces.cell) ** 2
    storeys, base = [], np.full(shape[:2], -np.inf)
    centres = low[2] + (np.arange(shape[2]) + 0.5) * step
    for storey in range(_MOST_STOREYS):
        least = _LEAST_STOREY if storey else _LEAST_FLOOR
        is_floor = (counts >= least * whole) & (centres > (base + _STOREY)[..., None])
        exists = is_floor.any(axis=2)
        if not exists.any():
            break
        # a noisy floor may fill several bins; select the fullest bin
        first = is_floor.argmax(axis=2)
        near = np.abs(np.arange(shape[2]) - first[..., None]) <= 1
        at = np.where(near, counts, -1.0).argmax(axis=2)[..., None]
        height = np.take_along_axis(sums, at, 2)[..., 0]
        height /= np.maximum(np.take_along_axis(counts, at, 2)[..., 0], 1.0)
        storeys.append(np.where(exists, height, np.nan))
        base = np.where(exists, height, np.inf)
    heights = np.stack(storeys) if storeys else np.full((1, *shape[:2]), np.nan)
    column = np.floor((pieces.points[:, :2] - low[:2]) / side).astype(np.int64)
    column = np.clip(column, 0, shape[:2] - 1)
    floor = heights[0][column[:, 0], column[:, 1]]
    if has_tables and np.isfinite(floor).any():
        floor = np.where(np.isfinite(floor), floor, np.nanmedian(floor))
        if (pieces.points[:, 2] < floor - 2 * _STEP).mean() > _MOST_BELOW:
            heights = np.full((1, *shape[:2]), np.nan)
    return Floors(low[:2], side, heights, level)


def _sum_neighbours(values: Floats) -> Floats:
    """Return, for each bin, the sum over 3 x 3 columns and over the bin itself, above and below."""
    for axis in range(3):
        padded = np.pad(values, [(1, 1) if a == axis else (0, 0) for a in range(3)])
        before, own, after = (padded.take(range(k, k + values.shape[axis]), axis) for k in range(3))
        values = before + own + after
    return values


def candidate_places(floors: Floors, pieces: Surfels, p: ViewParameters, spacing: float) -> Floats:
    """Return places at the heights of the sensor above the floors, (C, 3) in level axes.

    In a cloud, a place requires a floor below it. In a mesh, places above an unobserved floor are
    included too, because the front of a mesh indicates free space. If no floor was found, places
    are distributed over all heights.

    Parameters
    ----------
    floors : result of `find_floors`
    pieces : surfels in level axes
    spacing : distance between places, metres
    """
    low, high = robust_extent(pieces)
    spacing = max(spacing, math.sqrt(float(np.prod((high - low)[:2])) / _MOST_COLUMNS))
    axes = [np.arange(a + spacing / 2, b, spacing) for a, b in zip(low[:2], high[:2], strict=True)]
    if any(len(axis) == 0 for axis in axes):
        return np.zeros((0, 3))
    flat = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    main = floors.lowest
    if main is None:
        step = max(spacing, 0.4, float(high[2] - low[2]) / _MOST_HEIGHTS)
        rise = np.arange(low[2] + p.clearance, high[2] - p.clearance, step)
        places = [np.column_stack([flat, np.full(len(flat), z)]) for z in rise]
        return np.concatenate(places) if places else np.zeros((0, 3))
    column = np.floor((flat - floors.low) / floors.side).astype(np.int64)
    column = np.clip(column, 0, np.array(floors.heights.shape[1:]) - 1)
    places = []
    for storey, heights in enumerate(floors.heights):
        height = heights[column[:, 0], column[:, 1]]
        if storey == 0 and pieces.one_sided:
            height = np.where(np.isnan(height), main, height)
        own, height = flat[~np.isnan(height)], height[~np.isnan(height)]
        if not pieces.one_sided:
            on_floor = _has_floor(floors.level, own, height, max(2.0 * pieces.cell, p.clearance))
            own, height = own[on_floor], height[on_floor]
        places += [np.column_stack([own, height + above]) for above in p.heights]
    return np.concatenate(places)


def _has_floor(level: Floats, places: Floats, heights: Floats, reach: float) -> NDArray[np.bool_]:
    """Return a mask of the places (P, 2) with a level surface at the height of their floor."""
    low = np.minimum(level.min(axis=0), np.append(places.min(axis=0), heights.min())) - 2 * reach
    size = np.array([reach, reach, 2 * _STEP])
    span = np.floor((level.max(axis=0) - low) / size).astype(np.int64) + 4

    def key(cells: Ints64) -> Ints64:
        inside = ((cells >= 0) & (cells < span)).all(axis=-1)
        numbers: Ints64 = (cells[..., 0] * span[1] + cells[..., 1]) * span[2] + cells[..., 2]
        return np.where(inside, numbers, -1)

    occupied = np.unique(key(np.floor((level - low) / size).astype(np.int64)))
    at = np.floor((np.column_stack([places, heights]) - low) / size).astype(np.int64)
    around = np.zeros(len(places), np.int64)
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            near = np.zeros(len(places), np.bool_)
            for dz in (-1, 0, 1):
                near |= np.isin(key(at + np.array([dx, dy, dz])), occupied)
            around += near
    return around >= 6  # a smaller number of the nine cells would admit places beside a floor
