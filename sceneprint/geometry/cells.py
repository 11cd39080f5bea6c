"""Surfaces as cells of a grid: views fused to cells, and the cells of two sessions compared.

    points of a view  --seen_cells-->  CELL_SUM by tile
    CELL_SUM of views  --fused-->  CELL_SUM
    CELL_SUM  --encoded-->  cells as bytes hold them  --coarser-->  a part of the next level's tile

    points of the frames of a session  --add_views-->  SessionCells
    cells, a frame of the other session  --frame_verdicts-->  what it says of each of them
    verdicts of all these frames, counted  --cell_states-->  same, changed or unseen

A tile has 64 x 64 x 64 cells. Fusing is exact and of no order: sums are of integers, and of views
the last counts by its time, then by its number. So a tile depends on the views that touch it, and
on nothing else.

A cell of the earlier session that changed is gone; one of the later session that changed is new.
A frame agrees with a cell, or saw through it, by the same tolerances as in validation in the map,
but from either side: cells have no normals.
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
    looked_up,
    tolerances,
)
from sceneprint.geometry.rigid import inverse
from sceneprint.types import Bytes, Floats, Surface
from sceneprint_client.surface_encoding import CELL, NO_SESSION, NO_TIME, SEEN_STEPS, SIDE, STEPS

#: Column, row and floor of a tile.
TilePlace = tuple[int, int, int]
#: What views saw in a cell: its place in the tile as z, y, x of 6 bits each; how many views; sums
#: of where each saw it, in 256ths of a cell; and the last view's time, number and session.
CELL_SUM = np.dtype(
    [
        ("key", "<u4"), ("views", "<u4"), ("sums", "<u4", 3), ("taken", "<f8"),
        ("number", "<i8"), ("session", "<u2"), ("spare", "<u2"),
    ]
)  # fmt: skip
CellSums = NDArray[Any]
Cells = NDArray[Any]
#: Cells of the next level are so many times as wide.
FACTOR = 4
#: Steps of a place within a cell.
_FINE = 256
#: Points farther from the origin are left out, in cells: tiles are numbered exactly there.
_FARTHEST = 2.0**40
#: Tiles that one view is fused into, at most: those in which it fills most cells.
MOST_TILES = 256


@dataclass(frozen=True)
class ViewStamp:
    """Who saw it, and when.

    Parameters
    ----------
    number : of the view; of two of one time, the greater counts as later
    taken : seconds since 1970; None where that is not known, which counts as before all others
    session : index of its session, or NO_SESSION
    """

    number: int
    taken: float | None
    session: int


@dataclass(frozen=True)
class TimeScale:
    """How times are told in 16 bits: steps of so many seconds since a time."""

    start: float
    step_s: float

    def holds(self, first: float, last: float) -> bool:
        """Whether times between two can be told."""
        return self.start <= first and (last - self.start) / self.step_s < NO_TIME


def time_scale(first: float, last: float) -> TimeScale:
    """A scale for times between two, and for some that come before and many that come after."""
    span = max(4.0 * (last - first), float(NO_TIME - 1))
    step = 2.0 ** np.ceil(np.log2(span / (NO_TIME - 1)))
    return TimeScale(float(np.floor(first - span / 8.0)), float(step))


def seen_cells(points: Floats, cell_m: float, stamp: ViewStamp) -> dict[TilePlace, CellSums]:
    """What one view saw, by tile.

    Parameters
    ----------
    points : (N, 3) metres, in the frame of the grid
    cell_m : width of a cell
    stamp : of the view

    Returns
    -------
    cells : CELL_SUM of each tile, by key; of at most MOST_TILES tiles
    """
    places = points / cell_m
    places = places[(np.abs(places) < _FARTHEST).all(axis=1)]  # false for NaN
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
    found = [
        (tuple(tiles[starts[a]].tolist()), rows[a:b]) for a, b in zip(begins, ends, strict=True)
    ]
    if len(found) > MOST_TILES:
        found = sorted(found, key=lambda one: (-len(one[1]), one[0]))[:MOST_TILES]
    return dict(found)


def fused(parts: Sequence[CellSums]) -> CellSums:
    """What several views saw of one tile, or several groups of them, together; by key."""
    rows = np.concatenate(parts) if parts else np.zeros(0, CELL_SUM)
    if len(rows) == 0:
        return rows
    rows = rows[np.lexsort((rows["number"], rows["taken"], rows["key"]))]
    starts = np.flatnonzero(np.append(True, rows["key"][1:] != rows["key"][:-1]))
    last = np.append(starts[1:], len(rows)) - 1
    found: CellSums = rows[last]  # the latest of each cell
    found["views"] = np.add.reduceat(rows["views"].astype(np.int64), starts)
    found["sums"] = np.add.reduceat(rows["sums"], starts)
    return found


def encoded(rows: CellSums, scale: TimeScale | None) -> Cells:
    """A tile as it is given out: CELL, in the order of z, y and x of the cells.

    Parameters
    ----------
    rows : of `fused`
    scale : of times; None where no view has one
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
    known = np.isfinite(rows["taken"])
    cells["taken"] = NO_TIME
    if scale is not None:
        told = np.floor((rows["taken"][known] - scale.start) / scale.step_s)
        cells["taken"][known] = np.clip(told, 0, NO_TIME - 1)
    return cells


def coarser(parts: Mapping[TilePlace, Cells]) -> Cells:
    """A tile of the next level.

    Parameters
    ----------
    parts : CELL of tiles in it, by their places; a tile (x, y, z) lies in the next level's
        (x // 4, y // 4, z // 4)

    Returns
    -------
    cells : CELL. A cell lies at the mean of the finer ones in it, was seen as often as the most
        seen of them, and by whom and when the last seen of them was
    """
    rows = [_shrunk(cells, place) for place, cells in parts.items()]
    found = np.concatenate(rows) if rows else np.zeros(0, CELL)
    if len(found) == 0:
        return found
    at = found["at"].astype(np.int64)
    key = _key(at)
    # NO_TIME is before all times; of equal times, the greater session: some order, and always it
    when = (found["taken"].astype(np.int64) + 1) % (NO_TIME + 1)
    who = (found["session"].astype(np.int64) + 1) % (NO_SESSION + 1)
    order = np.lexsort((who, when, key))
    found, at, key = found[order], at[order], key[order]
    starts = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
    ends = np.append(starts[1:], len(found))
    result: Cells = found[ends - 1]
    result["at"] = np.add.reduceat(at, starts) // (ends - starts)[:, None]
    result["seen"] = np.maximum.reduceat(found["seen"], starts)
    return result


def without(cells: Cells, place: TilePlace) -> Cells:
    """The cells of a coarser tile that are not of one tile of the level below."""
    corner = np.array(place) % FACTOR
    inside = (cells["at"] // (STEPS // FACTOR) == corner).all(axis=1)
    kept: Cells = cells[~inside]
    return kept


def joined(kept: Cells, added: Cells) -> Cells:
    """Cells of two parts of one tile that share none, in order."""
    both = np.concatenate([kept, added])
    return both[np.argsort(_key(both["at"].astype(np.int64)), kind="stable")]


def _shrunk(cells: Cells, place: TilePlace) -> Cells:
    """Cells with their places as shares of the next level's tile."""
    corner = np.array(place) % FACTOR
    found = cells.copy()
    found["at"] = (cells["at"].astype(np.int64) + STEPS * corner) // FACTOR
    return found


def _key(at: NDArray[np.int64]) -> NDArray[np.int64]:
    cell = at // (STEPS // SIDE)
    return (cell[:, 2] * SIDE + cell[:, 1]) * SIDE + cell[:, 0]


# Cells of two sessions compared.

#: Cells of a session, by tile; see cell_fusion.
SessionCells = dict[TilePlace, CellSums]
#: States of a cell: nothing is known of it, the other session has it too, or has not.
UNSEEN, SAME, CHANGED = 0, 1, 2
#: Frames that must have seen through a cell that changed, where there are so many.
LEAST_THROUGH = 2


@dataclass(frozen=True, eq=False)
class VerdictCounts:
    """What the frames of the other session said of cells.

    Parameters
    ----------
    agreeing : (N,) uint16 frames that saw a surface there
    through : (N,) uint16 frames that saw through
    """

    agreeing: NDArray[np.uint16]
    through: NDArray[np.uint16]

    def add(self, said: Bytes) -> None:
        """Count what one more frame said, (N,) of `frame_verdicts`."""
        self.agreeing[said == AGREES] += 1
        self.through[said == VIOLATES] += 1


def no_verdicts(count: int) -> VerdictCounts:
    """Of so many cells that nothing was said of yet."""
    return VerdictCounts(np.zeros(count, np.uint16), np.zeros(count, np.uint16))


def add_views(cells: SessionCells, views: Sequence[SessionCells]) -> SessionCells:
    """Cells of a session and what more of its frames saw, each of `seen_cells`, together."""
    parts: dict[TilePlace, list[CellSums]] = {place: [rows] for place, rows in cells.items()}
    for view in views:
        for place, rows in view.items():
            parts.setdefault(place, []).append(rows)
    return {place: fused(parts[place]) for place in sorted(parts)}


def count_cells(cells: SessionCells) -> int:
    """How many there are in all tiles."""
    return sum(len(rows) for rows in cells.values())


def cell_positions(cells: SessionCells, cell_m: float) -> Floats:
    """(N, 3) means of what frames saw in each cell, metres; by tile, then as they lie in it."""
    found = [np.zeros((0, 3))]
    for place in sorted(cells):
        rows = cells[place]
        key = rows["key"].astype(np.int64)
        corner = np.stack([key % SIDE, key // SIDE % SIDE, key // SIDE**2], axis=1)
        within = (rows["sums"] + 0.5 * rows["views"][:, None]) / (rows["views"][:, None] * _FINE)
        found.append((np.array(place) * SIDE + corner + within) * cell_m)
    return np.concatenate(found)


def frame_verdicts(
    positions: Floats, surface: Surface, T_parent_sensor: Floats, p: OverlapParameters
) -> Bytes:
    """What one frame says of cells.

    Parameters
    ----------
    positions : (N, 3) of the cells, metres in the parent frame
    T_parent_sensor : (4, 4)
    p : tolerances, of the model

    Returns
    -------
    (N,) uint8: UNKNOWN, AGREES or VIOLATES
    """
    said = np.full(len(positions), UNKNOWN, np.uint8)
    ranges = np.linalg.norm(surface.points[surface.valid].astype(np.float64), axis=1)
    if not len(ranges):
        return said
    # about the sensor: float32 holds millimetres there, wherever the parent frame begins
    offsets = positions - T_parent_sensor[:3, 3]
    reach = 1.1 * float(ranges.max()) + p.point_tolerance
    near = np.flatnonzero(np.einsum("ij,ij->i", offsets, offsets) < reach * reach)
    source = np.zeros((len(near), 6), np.float32)
    source[:, :3] = offsets[near]
    turn = np.eye(4)
    turn[:3, :3] = T_parent_sensor[:3, :3]
    either_side = tolerances(replace(p, normal_cosine=-2.0))
    said[near] = look_up(source, looked_up(surface, p), inverse(turn), either_side)
    return said


def cell_states(counts: VerdictCounts, frames: int) -> Bytes:
    """UNSEEN, SAME or CHANGED of each cell, (N,) uint8.

    Parameters
    ----------
    counts : of what the other session's frames said
    frames : how many they were
    """
    states = np.full(len(counts.agreeing), UNSEEN, np.uint8)
    states[counts.through >= min(LEAST_THROUGH, frames)] = CHANGED
    states[counts.agreeing > 0] = SAME
    if frames == 0:
        states[:] = UNSEEN
    return states
