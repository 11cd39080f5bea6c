"""Points, meshes and graphs as PLY files, which every viewer of clouds opens.

points, normals, colours, faces, edges  --write_ply-->  bytes
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sceneprint.types import Bytes, Floats, Floats32, Surface

Ints = NDArray[np.int32] | NDArray[np.int64]

#: What PLY calls the types that are written.
_WORDS = {"<f4": "float", "u1": "uchar"}


def write_ply(
    points: Floats | Floats32,
    normals: Floats | Floats32 | None = None,
    colours: Bytes | None = None,
    faces: Ints | None = None,
    edges: Ints | None = None,
    comments: Sequence[str] = (),
) -> bytes:
    """A PLY file, binary little-endian; the same bytes for the same arrays.

    Parameters
    ----------
    points : (N, 3) metres
    normals : (N, 3) unit length
    colours : (N, 3) red, green, blue
    faces : (F, 3) triangles, as indices of points
    edges : (E, 2) lines, as indices of points
    comments : of the header, one line each: the coordinate frame belongs there. What is no
        printable ASCII is escaped

    Raises
    ------
    ValueError : arrays of other shapes, or indices of no point.
    """
    n = len(points)
    kinds = [(name, "<f4") for name in "xyz"]
    columns = [_checked(points, n, 3)]
    if normals is not None:
        kinds += [(name, "<f4") for name in ("nx", "ny", "nz")]
        columns.append(_checked(normals, n, 3))
    if colours is not None:
        kinds += [(name, "u1") for name in ("red", "green", "blue")]
        columns.append(_checked(colours, n, 3))
    rows = np.empty(n, np.dtype(kinds))
    for i, (name, _) in enumerate(kinds):
        rows[name] = columns[i // 3][:, i % 3]
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {_one_line(comment)}" for comment in comments]
    lines += [f"element vertex {n}"]
    lines += [f"property {_WORDS[kind]} {name}" for name, kind in kinds]
    parts = [rows.tobytes()]
    if faces is not None:
        table = np.empty(len(faces), np.dtype([("count", "u1"), ("points", "<i4", 3)]))
        table["count"], table["points"] = 3, _indices(faces, 3, n)
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        parts.append(table.tobytes())
    if edges is not None:
        lines += [f"element edge {len(edges)}", "property int vertex1", "property int vertex2"]
        parts.append(_indices(edges, 2, n).astype("<i4").tobytes())
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii") + b"".join(parts)


def points_of(surface: Surface) -> tuple[Floats32, Floats32]:
    """What a sensor saw as a cloud: points (N, 3) and normals (N, 3) of its valid pixels, row by
    row, in the sensor's frame.
    """
    return surface.points[surface.valid], surface.normals[surface.valid]


def _checked(values: Floats | Floats32 | Bytes, n: int, width: int) -> Floats | Floats32 | Bytes:
    if values.shape != (n, width):
        raise ValueError(f"an array of shape {values.shape}, not ({n}, {width})")
    return values


def _indices(values: Ints, width: int, n: int) -> Ints:
    if values.ndim != 2 or values.shape[1] != width:
        raise ValueError(f"indices of shape {values.shape}, not (any, {width})")
    if values.size and (values.min() < 0 or values.max() >= n):
        raise ValueError(f"indices from {values.min()} to {values.max()} of {n} points")
    return values


def _one_line(comment: str) -> str:
    """Without what would end the line or is not ASCII: a frame may be called anything."""
    return comment.encode("unicode_escape").decode("ascii")
