"""Surfaces as the service packs them: points of frames, and tiles of a map.

bytes  --decode_points-->  SurfacePoints: docs/reference.md, Points
bytes  --decode_tile-->  SurfaceCells: docs/surface.md
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint_client.api.surface import SurfaceTile
from sceneprint_client.errors import Refused

MAGIC, VERSION = b"SPPT", 1
HEADER = struct.Struct("<4sHHII3f3fIf")
POINT = np.dtype(
    [("position", "<u2", 3), ("patch", "<u2"), ("normal", "i1", 3), ("residual", "u1")]
)
#: Flags of the header: what is told of each point.
NORMALS, PATCHES, RESIDUALS = 1, 2, 4
#: Index of the validation patch of a point that lies on none.
NO_PATCH = 65535
#: Largest coordinate of a point; the shares of the box that they lie in.
_STEPS = 65535.0


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """The surface that a frame saw.

    Parameters
    ----------
    points : (N, 3) metres, in the coordinates that were asked for
    normals : (N, 3) to 1/127; None where not told
    patches : (N,) index of the validation patch, -1 for none; None where not told
    residuals : (N,) bytes, see docs/reference.md; None where not told
    tolerance_m : metres that a residual of 250 stands for; 0 where none is told
    total : points that there are, of which these were chosen
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64] | None
    patches: NDArray[np.int32] | None
    residuals: NDArray[np.uint8] | None
    tolerance_m: float
    total: int


def decode_points(data: bytes) -> SurfacePoints:
    """Return the points of an answer of type `application/vnd.sceneprint.points`.

    Raises
    ------
    Refused : the bytes are not of this version, or their number is not what they say.
    """
    if len(data) < HEADER.size or data[:4] != MAGIC:
        raise _refusal("they do not begin as points do")
    _, version, flags, count, stride, *box, total, tolerance = HEADER.unpack_from(data)
    if (version, stride) != (VERSION, POINT.itemsize):
        raise _refusal(f"they are of version {version} with {stride} bytes a point")
    if len(data) != HEADER.size + count * POINT.itemsize:
        raise _refusal(f"{len(data)} bytes are not those of {count} points")
    rows = np.frombuffer(data, POINT, count, HEADER.size)
    origin, extent = np.array(box[:3]), np.array(box[3:])
    patches = rows["patch"].astype(np.int32)
    return SurfacePoints(
        points=origin + rows["position"] / _STEPS * extent,
        normals=rows["normal"] / 127.0 if flags & NORMALS else None,
        patches=np.where(patches == NO_PATCH, -1, patches) if flags & PATCHES else None,
        residuals=rows["residual"].copy() if flags & RESIDUALS else None,
        tolerance_m=tolerance,
        total=total,
    )


def _refusal(why: str) -> Refused:
    return Refused(
        f"The service sent bytes that are not points: {why}. Install a client of the service's "
        "version: `sceneprint doctor` tells it.",
        200,
        {},
    )


# Tiles of a map's surface: docs/surface.md.

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
    """Return the cells of a tile.

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
