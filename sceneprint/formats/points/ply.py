"""Reading of the elements of PLY files, including their points.

bytes  --read_ply-->  FilePoints

Headers are not trusted: memory is allocated only for elements that fit into the rest of the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import UnreadableCloud
from sceneprint.formats.points.rows import (
    MAXIMUM_POINTS,
    FileBytes,
    FilePoints,
    axis_names,
    check_count,
    check_room,
    parse_blocks,
    record_blocks,
    skip_lines,
    steps,
)
from sceneprint.geometry.kernel import kernel
from sceneprint.types import Bytes, Floats

# Binary rows with lists have different lengths.
#
# bytes, start, count, kinds  --skip_rows-->  offset after the rows
#                             --list_blocks-->  three of their values (n, 3)

Places = NDArray[np.int64]

#: numpy type of each value or list element, and of the list's length; None for a single value.
Kinds = Sequence[tuple[str, str | None]]


def skip_rows(view: Bytes, start: int, count: int, kinds: Kinds, order: str) -> int:
    """Return the offset after `count` rows with lists.

    Raise UnreadableCloud if the file ends before the last row.
    """
    end = start
    for _, behind in value_offsets(view, start, count, kinds, (0, 0, 0), order):
        end = behind
    return end


def list_blocks(
    view: Bytes, start: int, count: int, kinds: Kinds, picked: tuple[int, int, int], order: str
) -> Iterator[Floats]:
    """Yield `picked` values of rows with lists in blocks (n, 3); for errors, see `skip_rows`."""
    for places, _ in value_offsets(view, start, count, kinds, picked, order):
        block = np.empty((len(places), 3))
        for k, value in enumerate(picked):
            kind = np.dtype(order + kinds[value][0])
            gathered = view[places[:, k, None] + np.arange(kind.itemsize)]
            block[:, k] = np.ascontiguousarray(gathered).view(kind)[:, 0]
        yield block


def value_offsets(
    view: Bytes, start: int, count: int, kinds: Kinds, picked: tuple[int, int, int], order: str
) -> Iterator[tuple[Places, int]]:
    """Yield the offsets (n, 3) of `picked` values in each block of rows, and the block's end.

    For errors, see `skip_rows`.
    """
    sizes = np.array([np.dtype(kind).itemsize for kind, _ in kinds])
    lengths = np.array([np.dtype(length).itemsize if length else 0 for _, length in kinds])
    signed = np.array([length is not None and length[0] == "i" for _, length in kinds])
    values = np.array(picked)
    for first, n in steps(count):
        places = np.zeros((n, 3), np.int64)
        start, rows = _fill_offsets(
            view, start, places, sizes, lengths, signed, values, order == "<"
        )
        if rows < n:
            raise UnreadableCloud(
                f"The file ends in row {first + rows + 1} of {count}, whose lists declare more "
                "bytes than remain. Copy or write the file again."
            )
        yield places, start


@kernel
def _fill_offsets(
    view: Bytes, start: int, places: Places, sizes: Places, lengths: Places,
    signed: NDArray[np.bool_], values: Places, little: bool,
) -> tuple[int, int]:  # fmt: skip
    """Fill `places` with offsets; return the end of the complete rows, and their number."""
    at, end = start, len(view)
    for row in range(len(places)):
        for p in range(len(sizes)):
            for k in range(3):
                if values[k] == p:
                    places[row, k] = at
            repeats = 1
            if lengths[p] > 0:
                if lengths[p] > end - at:
                    return at, row
                repeats = 0
                for b in range(lengths[p]):
                    byte = int(view[at + (lengths[p] - 1 - b if little else b)])
                    if b == 0 and signed[p] and byte > 127:  # the length is negative
                        return at, row
                    repeats = 256 * repeats + byte
                at += lengths[p]
            if sizes[p] * repeats > end - at:
                return at, row
            at += sizes[p] * repeats
    return at, len(places)


_MAXIMUM_HEADER = 65_536  #: bytes
_MAXIMUM_PROPERTIES = 1000  #: maximum number of properties of an element, and of elements
_AGAIN = "Copy or write the file again."
_XYZ = ("x", "y", "z")
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class Property:
    """A property of an element: a value, or a list of values after its length."""

    name: str
    kind: str  #: numpy type without byte order
    length: str | None = None  #: numpy type of a list's length


@dataclass(frozen=True)
class Element:
    """An element of a file: rows with the same properties."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def least(self) -> int:
        """Return the minimum size of a binary row, bytes; the exact size if it has no lists."""
        return sum(np.dtype(p.length or p.kind).itemsize for p in self.properties)

    @property
    def has_lists(self) -> bool:
        """Return whether rows have lists, so that their sizes vary."""
        return any(p.length for p in self.properties)


def read_ply(data: FileBytes, most: int = MAXIMUM_POINTS) -> FilePoints:
    """Read the vertices of a PLY file.

    Raise UnreadableCloud if the file is not PLY, its vertices lack x, y or z, there are more than
    `most`, or the header contradicts the rest of the file.
    """
    order, elements, start = ply_header(data)
    names = [element.name for element in elements]
    if names.count("vertex") != 1:
        raise UnreadableCloud(
            f"The PLY file has {names.count('vertex')} elements called vertex. Write the points as "
            "one element vertex with the properties x, y, z."
        )
    at = names.index("vertex")
    vertex = elements[at]
    own = [p.name for p in vertex.properties]
    wrong = [name for name in _XYZ if own.count(name) != 1]
    if wrong or any(p.name in _XYZ and p.length for p in vertex.properties):
        raise UnreadableCloud(
            "The vertices of the PLY file do not have exactly one property "
            f"{' or '.join(wrong or _XYZ)}. Write x, y and z of each point."
        )
    check_count(vertex.count, most)
    if order == "":
        return FilePoints(vertex.count, _ascii_blocks(data, start, elements, at))
    view, begins = np.frombuffer(data, np.uint8), 0
    for i, element in enumerate(elements):
        begins = start if i == at else begins
        start = element_end(data, start, element, order)
    rest = len(data) - start
    # a header with a wrong type or count leaves bytes
    if rest > _MAXIMUM_HEADER or data[start:].strip(b"\r\n"):
        raise UnreadableCloud(f"{rest} bytes follow after the elements of the PLY header. {_AGAIN}")
    if vertex.has_lists:
        kinds = [(p.kind, p.length) for p in vertex.properties]
        picked = (own.index("x"), own.index("y"), own.index("z"))
        return FilePoints(
            vertex.count, list_blocks(view, begins, vertex.count, kinds, picked, order)
        )
    packed = [(p.name, order + p.kind, 1) for p in vertex.properties]
    return FilePoints(vertex.count, record_blocks(data, begins, vertex.count, packed))


def element_end(data: FileBytes, start: int, element: Element, order: str) -> int:
    """Return the offset after a binary element; raise UnreadableCloud if it exceeds the file."""
    remaining = len(data) - start
    if element.count * element.least > remaining:
        raise UnreadableCloud(
            f"The PLY header declares {element.count} rows of {element.name!r:.40}, at least "
            f"{element.count * element.least} bytes, but {remaining} bytes remain. {_AGAIN}"
        )
    if not element.has_lists:
        return start + element.count * element.least
    kinds = [(p.kind, p.length) for p in element.properties]
    return skip_rows(np.frombuffer(data, np.uint8), start, element.count, kinds, order)


def _ascii_blocks(
    data: FileBytes, start: int, elements: list[Element], at: int
) -> Iterator[Floats]:
    """Return the coordinates of the element with the index `at` in an ascii file, in blocks."""
    text, vertex = np.frombuffer(data, np.uint8), elements[at]
    for element in elements[:at]:
        start = skip_lines(text, start, element.count)
    check_room(text, start, vertex.count, len(vertex.properties))
    axes = np.array(
        [_XYZ.index(p.name) if p.name in _XYZ else -1 for p in vertex.properties], np.int8
    )
    lists = np.array([p.length is not None for p in vertex.properties])
    further = sum(element.count for element in elements[at + 1 :])
    return parse_blocks(text, start, vertex.count, axes, lists, further)


def ply_header(data: FileBytes) -> tuple[str, list[Element], int]:
    """Parse the byte order ("" for ascii), the elements, and the offset of the rows."""
    head = data[:_MAXIMUM_HEADER]
    old = head[3:4] == b"\r" and head[4:5] != b"\n"  # line endings of classic Mac OS
    ending = b"\r" if old else b"\n"
    lines, start = [], 0
    while True:
        end = head.find(ending, start)
        if end < 0:
            raise UnreadableCloud(
                f"The PLY header has no end_header in its first {_MAXIMUM_HEADER} bytes. {_AGAIN}"
            )
        line = head[start:end].decode("latin-1").strip()
        start = end + 1
        if line == "end_header":
            break
        lines.append(line)
    if not lines or lines[0] != "ply":
        raise UnreadableCloud("This is not a PLY file: its first line is not ply. Write it as PLY.")
    return *_parse_header(lines[1:]), start


def _parse_header(lines: list[str]) -> tuple[str, list[Element]]:
    order, elements = None, list[Element]()
    for line in lines:
        word, *rest = line.split() or ["comment"]
        if word in ("comment", "obj_info"):
            continue
        if word == "format" and len(rest) == 2 and rest[0] in _ORDERS and order is None:
            order = _ORDERS[rest[0]]
        elif word == "element" and len(rest) == 2 and len(elements) < _MAXIMUM_PROPERTIES:
            elements.append(Element(rest[0], _parse_count(rest[1]), ()))
        elif word == "property" and elements:
            last = elements[-1]
            if len(last.properties) == _MAXIMUM_PROPERTIES:
                raise UnreadableCloud(
                    f"{last.name!r:.40} has more than {_MAXIMUM_PROPERTIES} properties. {_AGAIN}"
                )
            elements[-1] = Element(last.name, last.count, (*last.properties, _parse_property(rest)))
        else:
            raise UnreadableCloud(f"The PLY header has the invalid line {line!r:.60}. {_AGAIN}")
    if order is None:
        raise UnreadableCloud(f"The PLY header does not state the format. {_AGAIN}")
    for element in elements:
        if element.count and not element.properties:
            raise UnreadableCloud(
                f"The PLY header declares {element.count} rows of {element.name!r:.40} without "
                f"properties. {_AGAIN}"
            )
    return order, [_with_axis_names(element) for element in elements]


def _with_axis_names(element: Element) -> Element:
    names = axis_names([item.name for item in element.properties])
    named = zip(element.properties, names, strict=True)
    return replace(element, properties=tuple(replace(item, name=name) for item, name in named))


def _parse_property(words: list[str]) -> Property:
    if len(words) == 2 and words[0] in _TYPES:
        return Property(words[1], _TYPES[words[0]])
    if len(words) == 4 and words[0] == "list" and words[1] in _TYPES and words[2] in _TYPES:
        length = _TYPES[words[1]]
        if length[0] != "f":
            return Property(words[3], _TYPES[words[2]], length)
    raise UnreadableCloud(
        f"The PLY header has the property {' '.join(words)!r:.60}; only the types "
        f"{', '.join(list(_TYPES)[:8])} and lists of them are supported. {_AGAIN}"
    )


def _parse_count(word: str) -> int:
    if not (word.isascii() and word.isdigit() and len(word) <= 18):
        raise UnreadableCloud(f"The PLY header has the invalid count {word!r:.40}. {_AGAIN}")
    return int(word)
