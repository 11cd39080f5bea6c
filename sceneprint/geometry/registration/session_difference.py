"""Two sessions of one place compared: which cells are gone, and which are new.

    points of the frames of a session  --add_views-->  SessionCells
    cells, a frame of the other session  --frame_verdicts-->  what it says of each of them
    verdicts of all these frames, counted  --cell_states-->  same, changed or unseen

A cell of the earlier session that changed is gone; one of the later session that changed is new.
A frame agrees with a cell, or saw through it, by the same tolerances as in validation in the map,
but from either side: cells have no normals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.pose.rigid import inverse
from sceneprint.geometry.registration.overlap import (
    AGREES,
    UNKNOWN,
    VIOLATES,
    OverlapParameters,
    look_up,
    looked_up,
    tolerances,
)
from sceneprint.geometry.surface.cell_fusion import CellSums, TilePlace, fused
from sceneprint.types import Bytes, Floats, Surface
from sceneprint_client.surface_encoding import SIDE

#: Cells of a session, by tile; see cell_fusion.
SessionCells = dict[TilePlace, CellSums]
#: States of a cell: nothing is known of it, the other session has it too, or has not.
UNSEEN, SAME, CHANGED = 0, 1, 2
#: Frames that must have seen through a cell that changed, where there are so many.
LEAST_THROUGH = 2
#: Steps of a place within a cell.
_FINE = 256


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
    surface : of the frame
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
