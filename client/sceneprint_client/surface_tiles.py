"""Tiles of a map's surface as the service packs them: docs/surface.md.

bytes  --decode_tile-->  SurfaceCells
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint_client.api.surface import SurfaceTile
from sceneprint_client.errors import Refused

#: A cell: place in its tile, how often and when it was seen, and by which session.
CELL = np.dtype([("at", "u1", 3), ("seen", "u1"), ("session", "<u2"), ("taken", "<u2")])
#: Cells along each side of a tile; shares of a side that a place is told in.
SIDE, STEPS = 64, 256
#: Number of frames that saw a cell, as a byte: so many steps for each doubling.
SEEN_STEPS = 16.0
#: Of a cell that no frame with a session saw, and of one that no frame with a time did.
NO_SESSION, NO_TIME = 65535, 65535


@dataclass(frozen=True, eq=False)
class SurfaceCells:
    """Cells of a tile.

    Parameters
    ----------
    points : (N, 3) mean of what was seen in each cell, metres, in the parent frame
    seen : (N,) frames that saw it, within 3 percent
    sessions : (N,) int32 index of the last session that saw it; -1 where that is not known
    taken : (N,) int32 when it was last seen, in steps of the surface; -1 where that is not known
    """

    points: NDArray[np.float64]
    seen: NDArray[np.float64]
    sessions: NDArray[np.int32]
    taken: NDArray[np.int32]


def cell_points(
    rows: NDArray[Any], place: tuple[int, int, int], tile_m: float
) -> NDArray[np.float64]:
    """(N, 3) where cells lie, metres in the parent frame.

    Parameters
    ----------
    rows : of CELL
    place : column, row and floor of their tile
    tile_m : width of the tile
    """
    points: NDArray[np.float64] = (np.array(place) + (rows["at"] + 0.5) / STEPS) * tile_m
    return points


def decode_tile(data: bytes, tile: SurfaceTile, tile_m: float) -> SurfaceCells:
    """The cells of a tile.

    Parameters
    ----------
    data : of `surface_tile`
    tile : which one it is
    tile_m : of its level

    Raises
    ------
    Refused : the bytes are not so many as the tile has.
    """
    if len(data) != tile.cells * CELL.itemsize:
        raise Refused(
            f"The service sent {len(data)} bytes, which are not {tile.cells} cells. Install a "
            "client of the service's version: `sceneprint doctor` tells it.",
            200,
            {},
        )
    rows = np.frombuffer(data, CELL)
    sessions, taken = rows["session"].astype(np.int32), rows["taken"].astype(np.int32)
    return SurfaceCells(
        points=cell_points(rows, (tile.column, tile.row, tile.floor), tile_m),
        seen=2.0 ** (rows["seen"] / SEEN_STEPS) - 1.0,
        sessions=np.where(sessions == NO_SESSION, -1, sessions),
        taken=np.where(taken == NO_TIME, -1, taken),
    )
