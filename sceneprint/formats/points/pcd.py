"""Reading of PCD files of the Point Cloud Library (ascii, binary and binary_compressed).

bytes  --read_pcd-->  FilePoints
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sceneprint.errors import UnreadableCloud
from sceneprint.formats.points.rows import (
    MAXIMUM_INFLATED,
    MAXIMUM_POINTS,
    FileBytes,
    FilePoints,
    axis_names,
    check_count,
    check_end,
    check_room,
    parse_blocks,
    record_blocks,
    steps,
)
from sceneprint.geometry.kernel import kernel
from sceneprint.types import Bytes, Floats
from sceneprint_client.formats import HEAD, format_of
from sceneprint_client.sidecars import Position

# LZF, the compression of binary_compressed PCD files (M. Lehmann's liblzf 3.6).
#
# packed, size  --inflate-->  bytes
#
# After a control byte c below 32, c + 1 literal bytes follow. Other control bytes are back
# references: the upper three bits are the number of bytes to repeat minus two (for 7, the next byte
# is added), and the lower five bits are the upper part of the distance.

#: Maximum compression ratio: the three bytes of a back reference expand to 264.
MOST_RATIO = 88


def inflate(packed: Bytes, size: int) -> Bytes:
    """Decompress LZF data.

    Parameters
    ----------
    packed : (n,) compressed bytes
    size : exact size of the result, bytes; the caller has limited it

    Raises
    ------
    UnreadableCloud : If the result has another size, or the compressed bytes are damaged.
    """
    if size > MOST_RATIO * len(packed):  # this check must precede the allocation
        raise UnreadableCloud(
            f"The file declares {size} bytes compressed to {len(packed)}, but the maximum ratio "
            f"of LZF is {MOST_RATIO}. Copy or write the file again."
        )
    out = np.empty(size, np.uint8)
    if _inflate(packed, out) != size:
        raise UnreadableCloud(
            f"The compressed points are damaged: they do not expand to {size} bytes. "
            "Copy or write the file again."
        )
    return out


@kernel
def _inflate(packed: Bytes, out: Bytes) -> int:
    """Decompress to `out`; return the number of bytes, or -1 if they are damaged or do not fit."""
    i, o, size, room = 0, 0, len(packed), len(out)
    while i < size:
        control = int(packed[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > size or o + length > room:
                return -1
            for k in range(length):
                out[o + k] = packed[i + k]
            i += length
        else:
            length = control >> 5
            if length == 7:
                if i >= size:
                    return -1
                length += int(packed[i])
                i += 1
            if i >= size:
                return -1
            length += 2
            back = o - ((control & 31) << 8) - int(packed[i]) - 1
            i += 1
            if back < 0 or o + length > room:
                return -1
            for k in range(length):  # source and target may overlap
                out[o + k] = out[back + k]
        o += length
    return o


_MAXIMUM_HEADER = 65_536  #: bytes
_MAXIMUM_FIELDS = 1000
_MAXIMUM_COUNT = 65_536  #: maximum number of values of a field
_AGAIN = "Copy or write the file again."
_XYZ = ("x", "y", "z")
_TYPES = {
    "F4": "<f4", "F8": "<f8", "I1": "<i1", "I2": "<i2", "I4": "<i4", "I8": "<i8",
    "U1": "<u1", "U2": "<u2", "U4": "<u4", "U8": "<u8",
}  # fmt: skip
_ENTRIES = (
    "VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT",
    "POINTS", "DATA",
)  # fmt: skip


@dataclass(frozen=True)
class Field:
    """A field of a row: one or more values of the same type."""

    name: str
    kind: str  #: numpy type
    count: int

    @property
    def size(self) -> int:
        """Return the size of the field in a row, bytes."""
        return self.count * np.dtype(self.kind).itemsize


def read_pcd(data: FileBytes, most: int = MAXIMUM_POINTS) -> FilePoints:
    """Read the points of a PCD file, and its VIEWPOINT unless it is the origin.

    Raise UnreadableCloud if the file is not PCD, its points lack x, y or z, there are more than
    `most` points, or the header contradicts the rest of the file.
    """
    entries, start = _read_header(data)
    fields, count = _parse_fields(entries), _count_points(entries)
    names = [field.name for field in fields]
    wrong = [k for k in _XYZ if names.count(k) != 1 or fields[names.index(k)].count != 1]
    if wrong:
        raise UnreadableCloud(
            f"The points of the PCD file do not have exactly one field {' or '.join(wrong)}. "
            "Write x, y and z of each point."
        )
    check_count(count, most)
    form = " ".join(entries["DATA"])
    width = sum(field.size for field in fields)
    if form == "ascii":
        blocks = _ascii_blocks(data, start, count, fields)
    elif form == "binary":
        if len(data) - start < count * width:  # some files are padded, so zeros may follow
            raise UnreadableCloud(
                f"The PCD header declares {count} points of {width} bytes, but "
                f"{len(data) - start} of {count * width} bytes follow. {_AGAIN}"
            )
        check_end(np.frombuffer(data, np.uint8), start + count * width)
        kinds = [(field.name, field.kind, field.count) for field in fields]
        blocks = record_blocks(data, start, count, kinds)
    elif form == "binary_compressed":
        blocks = _compressed_blocks(data, start, count, fields, most)
    else:
        raise UnreadableCloud(
            f"The PCD file has DATA {form!r:.40}; ascii, binary and binary_compressed are "
            f"supported. {_AGAIN}"
        )
    return FilePoints(count, blocks, _parse_viewpoint(entries.get("VIEWPOINT")))


def _ascii_blocks(data: FileBytes, start: int, count: int, fields: list[Field]) -> Iterator[Floats]:
    text, counts = np.frombuffer(data, np.uint8), [field.count for field in fields]
    width = sum(counts)
    if not count:  # the header of an empty file must not cause an allocation
        return iter(())
    check_room(text, start, count, width)
    column = [_XYZ.index(field.name) if field.name in _XYZ else -1 for field in fields]
    axes = np.repeat(np.array(column, np.int8), counts)
    return parse_blocks(text, start, count, axes, np.zeros(width, np.bool_))


def _compressed_blocks(
    data: FileBytes, start: int, count: int, fields: list[Field], most: int
) -> Iterator[Floats]:
    """Yield the blocks of a compressed body; it stores one field after the other."""
    size = count * sum(field.size for field in fields)
    if len(data) - start < 8:
        raise UnreadableCloud(f"The PCD file ends before its compressed points. {_AGAIN}")
    packed, inflated = struct.unpack_from("<II", data, start)
    if inflated != size or packed > len(data) - start - 8:
        raise UnreadableCloud(
            f"The PCD header declares {size} bytes of points, but the body states {inflated} "
            f"bytes compressed to {packed}, of which {len(data) - start - 8} exist. {_AGAIN}"
        )
    most_bytes = MAXIMUM_INFLATED // MAXIMUM_POINTS * most
    if size > most_bytes:
        raise UnreadableCloud(
            f"The decompressed points have {size} bytes; the limit is {most_bytes}. "
            "Write only x, y and z."
        )
    check_end(np.frombuffer(data, np.uint8), start + 8 + packed)
    everything = inflate(np.frombuffer(data, np.uint8, packed, start + 8), size)
    begins, columns = 0, dict[str, np.ndarray[tuple[int], np.dtype[np.number]]]()
    for field in fields:
        if field.name in _XYZ:
            columns[field.name] = everything[begins : begins + count * field.size].view(field.kind)
        begins += count * field.size
    return (np.stack([columns[k][i : i + n] for k in _XYZ], axis=1, dtype=np.float64)
            for i, n in steps(count))  # fmt: skip


def _read_header(data: FileBytes) -> tuple[dict[str, list[str]], int]:
    """Return the entries of the header by name, and the offset of the points."""
    head = data[:_MAXIMUM_HEADER]
    if format_of(head[:HEAD]) != "pcd":
        raise UnreadableCloud(
            "This is not a PCD file: it does not start with VERSION or FIELDS. Write it as PCD."
        )
    entries, start = dict[str, list[str]](), 0
    while "DATA" not in entries:
        end = head.find(b"\n", start)
        if end < 0:
            raise UnreadableCloud(
                f"The PCD header has no DATA line in its first {_MAXIMUM_HEADER} bytes. {_AGAIN}"
            )
        line = head[start:end].decode("latin-1").strip()
        start = end + 1
        if not line or line.startswith("#"):
            continue
        name, *words = line.split()
        if name not in _ENTRIES or name in entries:
            raise UnreadableCloud(f"The PCD header has the invalid line {line!r:.60}. {_AGAIN}")
        entries[name] = words
    return entries, start


def _parse_fields(entries: dict[str, list[str]]) -> list[Field]:
    names = axis_names(entries.get("FIELDS", entries.get("COLUMNS", [])))
    kinds, sizes = entries.get("TYPE", []), entries.get("SIZE", [])
    counts = entries.get("COUNT", ["1"] * len(names))
    if not 1 <= len(names) <= _MAXIMUM_FIELDS or not len(names) == len(kinds) == len(sizes) == len(
        counts
    ):
        raise UnreadableCloud(
            f"The PCD header has {len(names)} FIELDS, {len(sizes)} SIZE, {len(kinds)} TYPE and "
            f"{len(counts)} COUNT; these numbers must be equal. {_AGAIN}"
        )
    fields = []
    for name, kind, size, count in zip(names, kinds, sizes, counts, strict=True):
        dtype, values = _TYPES.get(f"{kind}{size}"), _parse_integer("COUNT", count)
        if dtype is None or values > _MAXIMUM_COUNT:
            raise UnreadableCloud(
                f"The PCD field {name!r:.40} has COUNT {count}, TYPE {kind!r:.20} and SIZE "
                f"{size!r:.20}. Supported are COUNT up to {_MAXIMUM_COUNT}, TYPE F with SIZE 4 "
                f"or 8, and TYPE I or U with SIZE 1, 2, 4 or 8. {_AGAIN}"
            )
        fields.append(Field(name, dtype, values))
    return fields


def _count_points(entries: dict[str, list[str]]) -> int:
    """Return the number of points according to POINTS, or to WIDTH and HEIGHT."""
    counts = []
    if "POINTS" in entries:
        counts.append(_parse_integer("POINTS", " ".join(entries["POINTS"])))
    if "WIDTH" in entries:
        rows = _parse_integer("HEIGHT", " ".join(entries.get("HEIGHT", ["1"])))
        counts.append(_parse_integer("WIDTH", " ".join(entries["WIDTH"])) * rows)
    if not counts or counts[0] != counts[-1]:
        raise UnreadableCloud(
            "The PCD header must state the number of points in POINTS or in WIDTH and HEIGHT, but "
            f"it states {' and '.join(map(str, counts)) or 'nothing'}. {_AGAIN}"
        )
    return counts[0]


def _parse_integer(name: str, word: str) -> int:
    if not (word.isascii() and word.isdigit() and len(word) <= 18):
        raise UnreadableCloud(f"The PCD header has the invalid {name} {word!r:.40}. {_AGAIN}")
    return int(word)


def _parse_viewpoint(words: list[str] | None) -> Position | None:
    """Parse the translation of VIEWPOINT; return None for the origin."""
    if words is None:
        return None
    try:
        x, y, z, *rotation = (float(word) for word in words)
    except ValueError:
        x = y = z = math.nan
        rotation = []
    if len(rotation) not in (0, 4) or not all(map(math.isfinite, (x, y, z))):
        raise UnreadableCloud(
            f"The PCD header has VIEWPOINT {' '.join(words)!r:.80}, which is not x y z and a "
            f"quaternion. {_AGAIN}"
        )
    return (x, y, z) if (x, y, z) != (0.0, 0.0, 0.0) else None
