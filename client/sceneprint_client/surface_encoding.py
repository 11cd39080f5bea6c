"""Decoders of surfaces that the service sends: points of frames, and tiles of a map.

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
#: Header flags that state which attributes the points have.
NORMALS, PATCHES, RESIDUALS = 1, 2, 4
#: Patch index of points that lie on no validation patch.
NO_PATCH = 65535
#: Maximum value of a stored coordinate, on the far side of the bounding box.
_STEPS = 65535.0


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Sampled surface of a frame.

    Parameters
    ----------
    points : (N, 3) metres, in the requested coordinate frame
    normals : (N, 3) unit normals, rounded to 1/127; None if not requested
    patches : (N,) index of the validation patch, -1 for none; None if not requested
    residuals : (N,) bytes, see docs/reference.md; None if not requested
    tolerance_m : distance that a residual of 250 represents, metres; 0 if there are none
    total : number of points before subsampling
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64] | None
    patches: NDArray[np.int32] | None
    residuals: NDArray[np.uint8] | None
    tolerance_m: float
    total: int


def decode_points(data: bytes) -> SurfacePoints:
    """Return the points of an answer of type `application/vnd.sceneprint.points`.

    Raise Refused if the format version differs, or the length does not match the header.
    """
    if len(data) < HEADER.size or data[:4] != MAGIC:
        raise _refusal("the header is wrong")
    _, version, flags, count, stride, *box, total, tolerance = HEADER.unpack_from(data)
    if (version, stride) != (VERSION, POINT.itemsize):
        raise _refusal(f"the version is {version}, with {stride} bytes per point")
    if len(data) != HEADER.size + count * POINT.itemsize:
        raise _refusal(f"{len(data)} bytes do not hold {count} points")
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
        f"The service sent invalid data: {why}. Install a client of the service's version, which "
        "`sceneprint doctor` shows.",
        200,
        {},
    )


# Tiles of a map's surface: docs/surface.md.

#: A cell: position in its tile, number of sightings, and session and time of the last one.
CELL = np.dtype([("at", "u1", 3), ("seen", "u1"), ("session", "<u2"), ("taken", "<u2")])
#: Number of cells along each side of a tile, and number of position steps along each side.
SIDE, STEPS = 64, 256
#: A cell stores log2(1 + number of frames that saw it) in steps of 1 / SEEN_STEPS.
SEEN_STEPS = 16.0
#: Values of `session` and `taken` if no frame with a session, or with a time, saw the cell.
NO_SESSION, NO_TIME = 65535, 65535


@dataclass(frozen=True, eq=False)
class SurfaceCells:
    """Decoded cells of a tile.

    Parameters
    ----------
    points : (N, 3) mean position of the points in each cell, metres, in the parent frame
    seen : (N,) number of frames that saw the cell, within 3 percent
    sessions : (N,) int32 index of the last session that saw the cell; -1 if unknown
    taken : (N,) int32 time of the last sighting, in steps of the surface; -1 if unknown
    """

    points: NDArray[np.float64]
    seen: NDArray[np.float64]
    sessions: NDArray[np.int32]
    taken: NDArray[np.int32]


def cell_points(
    rows: NDArray[Any], place: tuple[int, int, int], tile_m: float
) -> NDArray[np.float64]:
    """Return the positions (N, 3) of cells, metres, in the parent frame.

    Parameters
    ----------
    rows : (N,) CELL
    place : column, row and floor of the tile
    tile_m : width of the tile, metres
    """
    points: NDArray[np.float64] = (np.array(place) + (rows["at"] + 0.5) / STEPS) * tile_m
    return points


def decode_tile(data: bytes, tile: SurfaceTile, tile_m: float) -> SurfaceCells:
    """Return the cells of a tile.

    Parameters
    ----------
    data : bytes from `surface_tile`
    tile : the tile
    tile_m : width of the tiles of this level, metres

    Raises
    ------
    Refused : If the length does not match the number of cells of the tile.
    """
    if len(data) != tile.cells * CELL.itemsize:
        raise _refusal(f"{len(data)} bytes do not hold {tile.cells} cells")
    rows = np.frombuffer(data, CELL)
    sessions, taken = rows["session"].astype(np.int32), rows["taken"].astype(np.int32)
    return SurfaceCells(
        points=cell_points(rows, (tile.column, tile.row, tile.floor), tile_m),
        seen=2.0 ** (rows["seen"] / SEEN_STEPS) - 1.0,
        sessions=np.where(sessions == NO_SESSION, -1, sessions),
        taken=np.where(taken == NO_TIME, -1, taken),
    )
