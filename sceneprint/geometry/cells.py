"""Fusion of views into the cells of a grid, and comparison of the cells of two sessions.

    points of a view  --view_cells-->  CELL_SUM by tile
    CELL_SUM of views  --fuse_cells-->  CELL_SUM
    CELL_SUM  --encode_cells-->  CELL  --coarsen_cells-->  part of a tile of the next level

    points of a session's frames  --merge_views-->  SessionCells
    cells, a frame of the other session  --frame_verdicts-->  a verdict per cell
    counts of the verdicts of all these frames  --cell_states-->  same, changed or unseen

A tile has 64 x 64 x 64 cells. Fusion is exact and independent of order: it sums integers, and the
last view has the latest time, then the greatest number. A changed cell of the earlier session has
disappeared; a changed cell of the later session is new. Verdicts use the tolerances of validation,
but accept both sides of a surface: cells have no normals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.registration.overlap import (
    AGREES,
    UNKNOWN,
    VIOLATES,
    OverlapParameters,
    look_up,
    overlap_target,
    tolerances,
)
from sceneprint.geometry.rigid import inverse
from sceneprint.types import Bytes, Floats, Surface
from sceneprint_client.surface_encoding import CELL, NO_SESSION, NO_TIME, SEEN_STEPS, SIDE, STEPS

#: Integer coordinates (x, y, z) of a tile.
TilePlace = tuple[int, int, int]
#: A cell with sums over its views: its position in the tile (z, y and x, 6 bits each); the number
#: of views; the sums of the observed positions, in 256ths of a cell; and the time, number and
#: session of the last view.
CELL_SUM = np.dtype(
    [
        ("key", "<u4"), ("views", "<u4"), ("sums", "<u4", 3), ("taken", "<f8"),
        ("number", "<i8"), ("session", "<u2"), ("spare", "<u2"),
    ]
)  # fmt: skip
CellSums = NDArray[Any]
Cells = NDArray[Any]
#: Ratio of the cell widths of successive levels.
FACTOR = 4
#: Number of steps per axis into which a cell is divided to encode a position within it.
_FINE = 256
#: Maximum coordinate of a point, in cells; larger coordinates would give inexact tile coordinates.
_FARTHEST = 2.0**40
#: Maximum number of tiles per view; a view keeps the tiles with the most occupied cells.
MOST_TILES = 256


@dataclass(frozen=True)
class ViewStamp:
    """The identity and time of a view.

    Parameters
    ----------
    number : view number; of two views with equal times, the one with the greater number is later
    taken : seconds since 1970, or None if unknown; an unknown time sorts before all other times
    session : index of the view's session, or NO_SESSION
    """

    number: int
    taken: float | None
    session: int


@dataclass(frozen=True)
class TimeScale:
    """A 16-bit encoding of times, in steps of `step_s` seconds since `start`."""

    start: float
    step_s: float

    def holds(self, first: float, last: float) -> bool:
        """Return whether the scale can represent all times from `first` to `last`."""
        return self.start <= first and (last - self.start) / self.step_s < NO_TIME


def time_scale(first: float, last: float) -> TimeScale:
    """Return a scale for times from `first` to `last`, with margins before and after them."""
    span = max(4.0 * (last - first), float(NO_TIME - 1))
    step = 2.0 ** np.ceil(np.log2(span / (NO_TIME - 1)))
    return TimeScale(float(np.floor(first - span / 8.0)), float(step))


def view_cells(points: Floats, cell_m: float, stamp: ViewStamp) -> dict[TilePlace, CellSums]:
    """Return the cells of a view by tile, as CELL_SUM sorted by key.

    A cell has the mean position of its points, as the sum of a single view. If there are more than
    MOST_TILES tiles, those with the most cells are returned. NaN and very distant points are
    omitted.

    Parameters
    ----------
    points : (N, 3) metres, in the frame of the grid
    cell_m : width of a cell, metres
    """
    places = points / cell_m
    places = places[(np.abs(places) < _FARTHEST).all(axis=1)]  # this removes NaN too
    cells = np.floor(places).astype(np.int64)
    fine = np.minimum((places - cells) * _FINE, _FINE - 1).astype(np.int64)
    tiles, local = cells // SIDE, cells % SIDE
    keys = (local[:, 2] * SIDE + local[:, 1]) * SIDE + local[:, 0]
    order = np.lexsort((keys, tiles[:, 0], tiles[:, 1], tiles[:, 2]))
    keys, tiles, fine = keys[order], tiles[order], fine[order]
    if not len(keys):
        return {}
    is_tile = np.ones(len(keys), bool)
    is_tile[1:] = (tiles[1:] != tiles[:-1]).any(axis=1)
    is_cell = is_tile.copy()
    is_cell[1:] |= keys[1:] != keys[:-1]
    starts = np.flatnonzero(is_cell)
    counts = np.diff(np.append(starts, len(keys)))
    rows = np.zeros(len(starts), CELL_SUM)
    rows["key"], rows["views"] = keys[starts], 1
    rows["sums"] = np.add.reduceat(fine, starts) // counts[:, None]
    rows["taken"] = -np.inf if stamp.taken is None else stamp.taken
    rows["number"], rows["session"] = stamp.number, stamp.session
    begins = np.flatnonzero(is_tile[starts])
    ends = np.append(begins[1:], len(rows))
    by_tile = [
        (tuple(tiles[starts[a]].tolist()), rows[a:b]) for a, b in zip(begins, ends, strict=True)
    ]
    if len(by_tile) > MOST_TILES:
        by_tile = sorted(by_tile, key=lambda item: (-len(item[1]), item[0]))[:MOST_TILES]
    return dict(by_tile)


def fuse_cells(parts: Sequence[CellSums]) -> CellSums:
    """Fuse the cells of a tile from several views or groups of views; sort them by key."""
    rows = np.concatenate(parts) if parts else np.zeros(0, CELL_SUM)
    if len(rows) == 0:
        return rows
    rows = rows[np.lexsort((rows["number"], rows["taken"], rows["key"]))]
    starts = np.flatnonzero(np.append(True, rows["key"][1:] != rows["key"][:-1]))
    last = np.append(starts[1:], len(rows)) - 1
    result: CellSums = rows[last]  # the latest view of each cell
    result["views"] = np.add.reduceat(rows["views"].astype(np.int64), starts)
    result["sums"] = np.add.reduceat(rows["sums"], starts)
    return result


def encode_cells(rows: CellSums, scale: TimeScale | None) -> Cells:
    """Encode a tile of `fuse_cells` as CELL, sorted by z, y and x.

    Parameters
    ----------
    scale : scale of times; None if no view has a time
    """
    cells = np.zeros(len(rows), CELL)
    key, views = rows["key"].astype(np.int64), rows["views"].astype(np.float64)
    mean = rows["sums"] / (views[:, None] * _FINE)
    steps = STEPS // SIDE
    within = np.minimum(np.floor(mean * steps), steps - 1).astype(np.int64)
    place = np.stack([key % SIDE, key // SIDE % SIDE, key // SIDE**2], axis=1)
    cells["at"] = place * steps + within
    cells["seen"] = np.minimum(np.rint(SEEN_STEPS * np.log2(1.0 + views)), 255)
    cells["session"] = rows["session"]
    has_time = np.isfinite(rows["taken"])
    cells["taken"] = NO_TIME
    if scale is not None:
        steps_since = np.floor((rows["taken"][has_time] - scale.start) / scale.step_s)
        cells["taken"][has_time] = np.clip(steps_since, 0, NO_TIME - 1)
    return cells


def coarsen_cells(parts: Mapping[TilePlace, Cells]) -> Cells:
    """Combine finer tiles into one tile of the next coarser level; return its cells (CELL).

    A coarse cell has the mean position of the finer cells in it, their maximum `seen`, and the
    session and time of the finer cell that was seen last.

    Parameters
    ----------
    parts : cells (CELL) of each finer tile, by tile position; the coarser tile that contains tile
        (x, y, z) is (x // 4, y // 4, z // 4)
    """
    rows = [np.zeros(0, CELL)]
    for place, part in parts.items():
        scaled = part.copy()
        corner = np.array(place) % FACTOR
        scaled["at"] = (part["at"].astype(np.int64) + STEPS * corner) // FACTOR
        rows.append(scaled)
    cells = np.concatenate(rows)
    if len(cells) == 0:
        return cells
    at = cells["at"].astype(np.int64)
    key = _cell_keys(at)
    # NO_TIME sorts before all times; sessions break ties, so that the order is fixed
    when = (cells["taken"].astype(np.int64) + 1) % (NO_TIME + 1)
    session = (cells["session"].astype(np.int64) + 1) % (NO_SESSION + 1)
    order = np.lexsort((session, when, key))
    cells, at, key = cells[order], at[order], key[order]
    starts = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
    ends = np.append(starts[1:], len(cells))
    result: Cells = cells[ends - 1]
    result["at"] = np.add.reduceat(at, starts) // (ends - starts)[:, None]
    result["seen"] = np.maximum.reduceat(cells["seen"], starts)
    return result


def remove_tile(cells: Cells, place: TilePlace) -> Cells:
    """Return the cells of a tile, except those that cover the finer tile at `place`."""
    corner = np.array(place) % FACTOR
    outside: Cells = cells[(cells["at"] // (STEPS // FACTOR) != corner).any(axis=1)]
    return outside


def merge_cells(cells: Cells, others: Cells) -> Cells:
    """Merge the cells of two disjoint parts of a tile; sort them by z, y and x."""
    merged = np.concatenate([cells, others])
    return merged[np.argsort(_cell_keys(merged["at"].astype(np.int64)), kind="stable")]


def _cell_keys(at: NDArray[np.int64]) -> NDArray[np.int64]:
    cell = at // (STEPS // SIDE)
    return (cell[:, 2] * SIDE + cell[:, 1]) * SIDE + cell[:, 0]


#: Cells of a session, by tile.
SessionCells = dict[TilePlace, CellSums]
#: States of a cell: not observed by the other session, confirmed by it, or contradicted by it.
UNSEEN, SAME, CHANGED = 0, 1, 2
#: Minimum number of frames that must see through a cell for it to be CHANGED; if the session has
#: fewer frames, all of them must.
LEAST_THROUGH = 2


@dataclass(frozen=True, eq=False)
class VerdictCounts:
    """Counts of the verdicts that the frames of another session give on each cell.

    Parameters
    ----------
    agreeing : (N,) uint16 number of frames that observed a surface in the cell
    through : (N,) uint16 number of frames that observed free space in the cell
    """

    agreeing: NDArray[np.uint16]
    through: NDArray[np.uint16]

    def add(self, verdicts: Bytes) -> None:
        """Add the verdicts (N,) of a frame, from `frame_verdicts`."""
        self.agreeing[verdicts == AGREES] += 1
        self.through[verdicts == VIOLATES] += 1


def empty_counts(count: int) -> VerdictCounts:
    """Return verdict counts of zero for `count` cells."""
    return VerdictCounts(np.zeros(count, np.uint16), np.zeros(count, np.uint16))


def merge_views(cells: SessionCells, views: Sequence[SessionCells]) -> SessionCells:
    """Fuse the cells of a session with the cells of further views from `view_cells`."""
    parts: dict[TilePlace, list[CellSums]] = {place: [rows] for place, rows in cells.items()}
    for view in views:
        for place, rows in view.items():
            parts.setdefault(place, []).append(rows)
    return {place: fuse_cells(parts[place]) for place in sorted(parts)}


def count_cells(cells: SessionCells) -> int:
    """Return the number of cells in all tiles."""
    return sum(len(rows) for rows in cells.values())


def cell_positions(cells: SessionCells, cell_m: float) -> Floats:
    """Return the mean observed position (N, 3) in each cell, metres, in the order of `cells`."""
    positions = [np.zeros((0, 3))]
    for place in sorted(cells):
        rows = cells[place]
        key = rows["key"].astype(np.int64)
        corner = np.stack([key % SIDE, key // SIDE % SIDE, key // SIDE**2], axis=1)
        within = (rows["sums"] + 0.5 * rows["views"][:, None]) / (rows["views"][:, None] * _FINE)
        positions.append((np.array(place) * SIDE + corner + within) * cell_m)
    return np.concatenate(positions)


def frame_verdicts(
    positions: Floats, surface: Surface, T_parent_sensor: Floats, p: OverlapParameters
) -> Bytes:
    """Return a frame's verdicts on cells, (N,) uint8.

    AGREES: the cell is on the surface, regardless of its normal. VIOLATES: the frame sees through
    the cell; never for unordered points. UNKNOWN: the cell is outside the view, behind the surface,
    near an edge, or not measured.

    Parameters
    ----------
    positions : (N, 3) positions of the cells, metres in the parent frame
    surface : surface of the frame, in the sensor frame
    T_parent_sensor : (4, 4) pose of the frame
    p : tolerances of the model
    """
    verdicts = np.full(len(positions), UNKNOWN, np.uint8)
    ranges = np.linalg.norm(surface.points[surface.valid].astype(np.float64), axis=1)
    if not len(ranges):
        return verdicts
    # float32 resolves millimetres near the sensor, but not far from the origin
    offsets = positions - T_parent_sensor[:3, 3]
    reach = 1.1 * float(ranges.max()) + p.point_tolerance
    near = np.flatnonzero(np.einsum("ij,ij->i", offsets, offsets) < reach * reach)
    source = np.zeros((len(near), 6), np.float32)
    source[:, :3] = offsets[near]
    rotation = np.eye(4)
    rotation[:3, :3] = T_parent_sensor[:3, :3]
    either_side = tolerances(replace(p, normal_cosine=-2.0))
    verdicts[near] = look_up(source, overlap_target(surface, p), inverse(rotation), either_side)
    return verdicts


def cell_states(counts: VerdictCounts, frames: int) -> Bytes:
    """Return the state of each cell, UNSEEN, SAME or CHANGED, (N,) uint8.

    Parameters
    ----------
    counts : counts over the frames of the other session
    frames : number of frames of the other session
    """
    states = np.full(len(counts.agreeing), UNSEEN, np.uint8)
    states[counts.through >= min(LEAST_THROUGH, frames)] = CHANGED
    states[counts.agreeing > 0] = SAME
    if frames == 0:
        states[:] = UNSEEN
    return states
