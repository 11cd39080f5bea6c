"""Reading of a PLY file's faces, and conversion of polygons to fans of triangles.

bytes  --read_faces-->  triangles (M, 3)
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import UnreadableCloud
from sceneprint.formats.points.ply import Element, element_end, ply_header, value_offsets
from sceneprint.formats.points.rows import (
    CORNERS,
    ENDS,
    FEW,
    GOOD,
    MANY,
    NO_NUMBER,
    ROW_ERRORS,
    FileBytes,
    check_room,
    number,
    skip_lines,
    word,
)
from sceneprint.formats.surface_file.raw_surface import MOST_TRIANGLES
from sceneprint.geometry.kernel import kernel
from sceneprint.types import Bytes, Ints32

Indices = NDArray[np.int64]

_NAMES = ("vertex_indices", "vertex_index")
#: Maximum number of corners of a polygon.
_MOST_CORNERS = 1024
_AGAIN = "Copy or write the file again."


def read_faces(data: FileBytes) -> Ints32 | None:
    """Read the faces of an ascii or binary file as triangles (M, 3); polygons become fans.

    Return None if the element `face` is missing or has no rows. Indices are not compared with the
    number of vertices; those below 0 or beyond int32 become -1.

    Raise UnreadableCloud if the faces do not have exactly one list of vertices, or contradict the
    header, a polygon has fewer than 3 or more than 1024 corners, or there are too many triangles.
    """
    order, elements, start = ply_header(data)
    names = [element.name for element in elements]
    if "face" not in names or elements[names.index("face")].count == 0:
        return None
    before, face = elements[: names.index("face")], elements[names.index("face")]
    lists = [k for k, prop in enumerate(face.properties) if prop.name in _NAMES and prop.length]
    if len(lists) != 1 or face.properties[lists[0]].kind[0] == "f":
        raise UnreadableCloud(
            "The faces of the PLY file do not have exactly one list of integers called "
            f"{' or '.join(_NAMES)}. Write each face as a list of its vertices."
        )
    check_triangles(face.count)
    if order == "":
        blocks = _ascii_triangles(data, start, before, face, lists[0])
    else:
        for element in before:
            start = element_end(data, start, element, order)
        blocks = _binary_fans(data, start, face, lists[0], order)
    triangles, count = list[Ints32](), 0
    for block in blocks:
        count += len(block)
        check_triangles(count)
        triangles.append(np.where((block < 0) | (block >= 1 << 31), -1, block).astype(np.int32))
    return np.concatenate(triangles) if triangles else None


def check_triangles(count: int) -> None:
    """Raise UnreadableCloud if a mesh has too many triangles."""
    if count > MOST_TRIANGLES:
        raise UnreadableCloud(
            f"The file has at least {count} triangles; the limit is {MOST_TRIANGLES}. "
            "Simplify the mesh, or write only its vertices, as a cloud."
        )


def _binary_fans(
    data: FileBytes, start: int, face: Element, at: int, order: str
) -> Iterator[Indices]:
    element_end(data, start, face, order)  # check that the rows fit into the file
    view = np.frombuffer(data, np.uint8)
    kinds = [(prop.kind, prop.length) for prop in face.properties]
    chosen = face.properties[at]
    index, length = np.dtype(order + chosen.kind), np.dtype(order + (chosen.length or ""))
    for places, _ in value_offsets(view, start, face.count, kinds, (at, at, at), order):
        begins = places[:, 0]
        sizes = _numbers(view, begins, length, 1)[:, 0]
        _check_corners(int(sizes.min()), int(sizes.max()))
        for corners in np.unique(sizes):
            first = begins[sizes == corners] + length.itemsize
            yield _fans(_numbers(view, first, index, corners))


def _numbers(view: Bytes, begins: Indices, kind: np.dtype[np.integer], count: int) -> Indices:
    """Read `count` numbers at each offset (n,); return them as (n, count)."""
    picked = view[begins[:, None] + np.arange(count * kind.itemsize)]
    return np.ascontiguousarray(picked).view(kind).astype(np.int64)


def _fans(polygons: Indices) -> Indices:
    """Split polygons (n, c) into fans of triangles (n (c - 2), 3)."""
    c = polygons.shape[1]
    fan = np.array([(0, k, k + 1) for k in range(1, c - 1)])
    return polygons[:, fan].reshape(-1, 3)


def _check_corners(fewest: int, most: int) -> None:
    if fewest < 3 or most > _MOST_CORNERS:
        raise UnreadableCloud(
            f"A face of the PLY file has {fewest if fewest < 3 else most} corners; it must have 3 "
            f"to {_MOST_CORNERS}. {_AGAIN}"
        )


def _ascii_triangles(
    data: FileBytes, start: int, before: list[Element], face: Element, at: int
) -> Iterator[Indices]:
    text = np.frombuffer(data, np.uint8)
    for element in before:
        start = skip_lines(text, start, element.count)
    check_room(text, start, face.count, len(face.properties))
    lists = np.array([prop.length is not None for prop in face.properties])
    room = np.empty((1 << 16, 3), np.int64)
    done = 0
    while done < face.count:
        start, rows, triangles, state = _parse_faces(
            text, start, face.count - done, lists, at, room
        )
        if state != GOOD:
            raise UnreadableCloud(
                f"Row {done + rows + 1} of {face.count} faces cannot be read: "
                f"{ROW_ERRORS[state]}. {_AGAIN}"
            )
        done += rows
        yield room[:triangles]


@kernel
def _parse_faces(
    text: Bytes, start: int, most: int, lists: NDArray[np.bool_], at: int, out: Indices
) -> tuple[int, int, int, int]:
    """Parse faces into triangles while `out` has space for the largest polygon.

    Returns
    -------
    end, rows, triangles, status : offset after the last row, number of rows, number of triangles,
        and status of the next row
    """
    i, size, n, row = start, len(text), 0, 0
    while row < most and n + _MOST_CORNERS <= len(out):
        while i < size and text[i] <= 32 and text[i] >= 9:
            i += 1
        for c in range(len(lists)):
            first, i = word(text, i)
            if first == i:
                return i, row, n, ENDS if i >= size else FEW
            if not lists[c]:
                continue
            length, good = number(text, first, i)
            if not good or not (0.0 <= length <= 1e6) or length != int(length):
                return i, row, n, NO_NUMBER
            corners = int(length)
            if c == at and (corners < 3 or corners > _MOST_CORNERS):
                return i, row, n, CORNERS
            a, b = 0, 0
            for k in range(corners):
                first, i = word(text, i)
                if first == i:
                    return i, row, n, FEW
                if c != at:
                    continue
                value, good = number(text, first, i)
                if not good or value != np.floor(value) or abs(value) > 4e9:
                    return i, row, n, NO_NUMBER
                if k == 0:
                    a = int(value)
                elif k > 1:
                    out[n, 0], out[n, 1], out[n, 2] = a, b, int(value)
                    n += 1
                b = int(value)
        first, i = word(text, i)
        if first != i:
            return i, row, n, MANY
        row += 1
    return i, row, n, GOOD
