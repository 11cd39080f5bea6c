"""Reading of whole map files in a confined process.

file, name, options  --read_surface_confined-->  ReadSurface, checked again

The process inherits the open file, which avoids a copy.
"""

from __future__ import annotations

import math
import os
from typing import Any, get_args

import numpy as np

from sceneprint.decoders.pool import ConfinedDecoder, DecoderProcess
from sceneprint.formats.points.cloud import FARTHEST_M
from sceneprint.formats.surface_file.raw_surface import (
    MOST_FILE_POINTS,
    MOST_TRIANGLES,
    MOST_VERTICES,
)
from sceneprint.formats.surface_file.reading import (
    FAR_M,
    ReadSurface,
    Source,
    SurfaceOptions,
    surface_format,
)
from sceneprint.types import Floats, Floats32, Ints32, ReferenceSurface
from sceneprint_client.files import naming
from sceneprint_client.formats import HEAD

_PROGRAM = "sceneprint.decoders.surface_process"
#: Maximum number of notes on a file, and maximum length of a note, characters.
_MOST_NOTES, _LONGEST_NOTE = 20, 1000


def read_surface_confined(
    file: int, name: str, options: SurfaceOptions, *, seconds: float = 600.0,
    more_bytes: int = 2 << 30,
) -> ReadSurface:  # fmt: skip
    """Read the surface of a file in a confined process; see `read_surface`.

    Parameters
    ----------
    file : descriptor of a regular file, which must not change in the meantime
    name : name of the file for errors; its suffix identifies formats without a magic number
    options : units and up direction
    seconds : maximum processor time
    more_bytes : maximum further memory, besides the file and the result, bytes; 0 for no limit

    Raises
    ------
    UnreadableCloud, UselessFrame, MissingDependency : See `read_surface`.
    DecoderFailure : If the process crashes, takes too long, or needs too much memory.
    Busy : If no process can be started.
    """
    with naming(name):
        form = surface_format(os.pread(file, HEAD, 0), name, os.fstat(file).st_size)
    request = {
        "task": "surface", "name": name, "up": options.up,
        "units_per_metre": options.units_per_metre,
    }  # fmt: skip
    decoder = ConfinedDecoder(_PROGRAM, more_bytes, seconds, files=(file,), more=(form,))
    try:
        read: ReadSurface = decoder.run(request, b"", _check, compiled=True)
        return read
    finally:
        decoder.end()


def _check(process: DecoderProcess, reply: dict[str, Any]) -> ReadSurface:
    """Return the result of a reply; raise an error if the reply is invalid."""
    n, m, file_points = reply["points"], reply["triangles"], reply["file_points"]
    _require(_is_integer(n, 1, MOST_VERTICES), "points")
    _require(_is_integer(file_points, n, MOST_FILE_POINTS), "points of the file")
    points: Floats32 = process.array_of("<f4", (n, 3))
    far = 2 * FARTHEST_M + FAR_M
    _require(bool(points.min() >= -far and points.max() <= far), "a point is too far away")
    triangles: Ints32 | None = None
    if m is not None:
        _require(_is_integer(m, 1, MOST_TRIANGLES), "triangles")
        triangles = process.array_of("<i4", (m, 3))
        _require(bool(triangles.min() >= 0 and triangles.max() < n), "indices of triangles")
    offset, up = _checked_vector(reply["offset"]), _checked_vector(reply["up"])
    _require(abs(float(np.linalg.norm(up)) - 1.0) < 1e-6, "up direction")
    units, voxel, notes = reply["units_per_metre"], reply["voxel"], reply["notes"]
    _require(math.isfinite(units) and units > 0 and (voxel is None or 0 < voxel < far), "lengths")
    sources = get_args(Source)
    _require(reply["units"] in sources and reply["up_from"] in sources, "sources")
    _require(isinstance(notes, list) and len(notes) <= _MOST_NOTES, "notes")
    return ReadSurface(
        ReferenceSurface(points, triangles, offset, up), reply["units"], reply["up_from"],
        tuple(str(note)[:_LONGEST_NOTE] for note in notes), float(units), file_points,
        voxel,
    )  # fmt: skip


def _require(holds: bool, what: str) -> None:
    if not holds:
        raise ValueError(what)


def _is_integer(value: object, least: int, most: int) -> bool:
    return type(value) is int and least <= value <= most


def _checked_vector(values: list[float]) -> Floats:
    x, y, z = map(float, values)
    numbers = np.array([x, y, z])
    _require(bool(np.isfinite(numbers).all()), "coordinates")
    return numbers
