"""Rows of points: what every parser hands to the door, what it may not exceed, and rows of text.

text, start  --parse_rows-->  coordinates (n, 3), place after them, what is wrong

A row of text has a point to a line, of which three columns are wanted. Python's own `float` would
take a minute for the largest file.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import UnreadableCloud
from sceneprint.geometry.kernel import kernel
from sceneprint.types import Bytes, Floats
from sceneprint_client.sidecars import Position

#: Most points of a file that is read; more is refused by its header.
MAXIMUM_POINTS = 20_000_000

#: Most bytes that a compressed file is inflated to at once: 20 million points of x, y, z and one
#: more, and what several uploads at a time may hold together.
MAXIMUM_INFLATED = 400 << 20

#: Points that are parsed at a time: what they take beside the file stays in the cache.
BLOCK = 1 << 16


#: Bytes of a file, in memory or mapped from the disk.
FileBytes = bytes | mmap.mmap


@dataclass(frozen=True, eq=False)
class FilePoints:
    """Points in the units and axes of their file.

    Parameters
    ----------
    count : of the points, checked against the length of the file
    blocks : their coordinates in order, (n, 3) float64 each; NaN or infinite where missing, and
        whoever takes them lets numpy's warnings be
    viewpoint : that the file itself tells, or None
    """

    count: int
    blocks: Iterator[Floats]
    viewpoint: Position | None = None


def check_count(count: int, most: int) -> None:
    """Refuse a header that announces more points than are read."""
    if count > most:
        raise UnreadableCloud(
            f"The file announces {count} points, and at most {most} are read. "
            "Thin the cloud out, to a voxel grid of a few centimetres, or send it in parts."
        )


def steps(count: int) -> Iterator[tuple[int, int]]:
    """First index and length of each block of so many rows."""
    return ((first, min(BLOCK, count - first)) for first in range(0, count, BLOCK))


def axis_names(names: list[str]) -> list[str]:
    """The names of fields with x, y and z for X, Y and Z, as PDAL writes them."""
    if {"x", "y", "z"}.isdisjoint(names):
        return [name.lower() if name in ("X", "Y", "Z") else name for name in names]
    return names


def record_blocks(
    data: FileBytes, start: int, count: int, fields: Iterable[tuple[str, str, int]]
) -> Iterator[Floats]:
    """Yield x, y and z of packed records, which the file has room for, a block at a time.

    Parameters
    ----------
    data, start, count : the file, and place and number of its records
    fields : name, type of numpy and number of values of each field; one each is x, y and z
    """
    packed = [(name if name in ("x", "y", "z") else f"{place}", kind, (n,) * (n != 1))
              for place, (name, kind, n) in enumerate(fields)]  # fmt: skip
    table = np.frombuffer(data, np.dtype(packed), count, start)
    for first, n in steps(count):
        rows = table[first : first + n]
        yield np.stack([rows[name] for name in "xyz"], axis=1, dtype=np.float64)


# Numbers written out, a row to a line.

#: Why a row cannot be read.
GOOD, ENDS, FEW, MANY, NO_NUMBER, CORNERS = 0, 1, 2, 3, 4, 5

ROW_ERRORS = {
    ENDS: "the file ends before it",
    FEW: "it has fewer values than the header announces",
    MANY: "it has more values than the header announces",
    NO_NUMBER: "one of its values is no number",
    CORNERS: "its polygon has fewer than 3 corners, or more than 1024",
}

#: Powers of ten that float64 holds exactly.
_TENS = np.array([float(f"1e{k}") for k in range(23)])


def parse_blocks(
    text: Bytes, start: int, count: int, wanted: NDArray[np.int8], lists: NDArray[np.bool_]
) -> Iterator[Floats]:
    """Yield the coordinates of so many rows, (n, 3) each; see `parse_rows`.

    Raises
    ------
    UnreadableCloud : a row is missing or is none; names it.
    """
    for first, n in steps(count):
        block = np.full((n, 3), np.nan)
        start, rows, state = parse_rows(text, start, block, wanted, lists)
        if state != GOOD:
            raise UnreadableCloud(
                f"Row {first + rows + 1} of {count} cannot be read: {ROW_ERRORS[state]}. "
                "Copy or write the file again."
            )
        yield block


def skip_lines(text: Bytes, start: int, count: int) -> int:
    """Where the line after so many begins, empty ones not counted.

    Raises
    ------
    UnreadableCloud : there are not so many.
    """
    place, lines = _skip(text, start, count)
    if lines < count:
        raise UnreadableCloud(
            f"The file ends after {lines} of {count} rows before its points. "
            "Copy or write the file again."
        )
    return place


def check_room(text: Bytes, start: int, count: int, columns: int) -> None:
    """Refuse a header that announces more rows than can be written into what follows."""
    if count * columns * 2 - 1 > len(text) - start:  # a digit and a space each
        raise UnreadableCloud(
            f"The header announces {count} rows of {columns} values, and {len(text) - start} "
            "bytes follow. Copy or write the file again."
        )


@kernel
def parse_rows(
    text: Bytes, start: int, out: Floats, wanted: NDArray[np.int8], lists: NDArray[np.bool_]
) -> tuple[int, int, int]:
    """Read as many rows as `out` has; empty lines are passed over.

    Parameters
    ----------
    text : (N,) bytes
    start : where the first row begins
    out : (n, 3), filled
    wanted : (c,) column of `out` that each value goes to, or -1
    lists : (c,) whether this is the length of a list that follows on the same line

    Returns
    -------
    place after the last row, rows that were read, and why there are no more
    """
    i, size = start, len(text)
    for row in range(len(out)):
        while i < size and text[i] <= 32 and text[i] >= 9:
            i += 1
        if i >= size:
            return i, row, ENDS
        for c in range(len(wanted)):
            first, i = word(text, i)
            if first == i:  # a line's end, or a sign that belongs in no text
                return i, row, FEW
            if lists[c]:
                value, good = number(text, first, i)
                if not good or not (0.0 <= value < 2147483648.0) or value != int(value):
                    return i, row, NO_NUMBER
                for _ in range(int(value)):
                    first, i = word(text, i)
                    if first == i:
                        return i, row, FEW
            elif wanted[c] >= 0:
                value, good = number(text, first, i)
                if not good:
                    return i, row, NO_NUMBER
                out[row, wanted[c]] = value
        first, i = word(text, i)
        if first != i:
            return i, row, MANY
        if i < size and text[i] != 10 and text[i] != 13:
            return i, row, NO_NUMBER
    return i, len(out), GOOD


@kernel
def _skip(text: Bytes, start: int, count: int) -> tuple[int, int]:
    i, size = start, len(text)
    for line in range(count):
        while i < size and (text[i] == 10 or text[i] == 13):
            i += 1
        if i >= size:
            return i, line
        while i < size and text[i] != 10 and text[i] != 13:
            i += 1
    return i, count


@kernel
def word(text: Bytes, start: int) -> tuple[int, int]:
    """Where the next word of this line begins and ends; of no length where there is none."""
    first = start
    while first < len(text) and (text[first] == 32 or text[first] == 9):
        first += 1
    end = first
    while end < len(text) and text[end] > 32:
        end += 1
    return first, end


@kernel
def number(text: Bytes, start: int, end: int) -> tuple[float, bool]:
    """The number of a word, to the last bit but one, and whether it is one; NaN for any NaN or
    infinity, as printf writes them anywhere.
    """
    i = start
    negative = i < end and text[i] == 45
    if i < end and (text[i] == 45 or text[i] == 43):
        i += 1
    if end - i >= 3:
        a, b, c = text[i] | 32, text[i + 1] | 32, text[i + 2] | 32
        if (a == 110 and b == 97 and c == 110) or (a == 105 and b == 110 and c == 102):
            return np.nan, True
    mantissa, taken, digits, exponent, point = 0, 0, 0, 0, False
    while i < end:
        sign = text[i]
        if 48 <= sign <= 57:
            digits += 1
            if taken < 18:  # more digits than a float64 tells apart
                mantissa = 10 * mantissa + (int(sign) - 48)
                if mantissa > 0:
                    taken += 1
                if point:
                    exponent -= 1
            elif not point:
                exponent += 1
        elif sign == 46 and not point:
            point = True
        elif sign == 35 and point:  # 1.#QNAN, of Windows
            return np.nan, True
        else:
            break
        i += 1
    if digits == 0:
        return 0.0, False
    if i < end and (text[i] | 32) == 101:
        i += 1
        down = i < end and text[i] == 45
        if i < end and (text[i] == 45 or text[i] == 43):
            i += 1
        first, power = i, 0
        while i < end and 48 <= text[i] <= 57:
            power = min(10 * power + (int(text[i]) - 48), 100_000)
            i += 1
        if i == first:
            return 0.0, False
        exponent += -power if down else power
    if i < end:
        return 0.0, False
    value = float(mantissa)
    if mantissa > 0:
        left = min(max(exponent, -400), 400)
        while left > 0:
            value *= _TENS[min(left, 22)]
            left -= min(left, 22)
        while left < 0:
            value /= _TENS[min(-left, 22)]
            left += min(-left, 22)
    return (-value if negative else value), True
