"""Points as readers return them, their limits, and a parser for rows of text.

text, start  --parse_rows-->  coordinates (n, 3), offset after the rows, status

A line of text is a point; the parser reads three of its columns. Python's `float` would take a
minute for the largest file.
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

#: Maximum number of points of a file. Files whose headers declare more are rejected.
MAXIMUM_POINTS = 20_000_000

#: Maximum size of data that is decompressed at once, bytes: sufficient for 20 million points of
#: four values. Several uploads may need this memory at the same time.
MAXIMUM_INFLATED = 400 << 20

#: Number of points in a block that fits into the processor's cache.
BLOCK = 1 << 16


#: Bytes of a file, in memory or mapped from a disk.
FileBytes = bytes | mmap.mmap


@dataclass(frozen=True, eq=False)
class FilePoints:
    """The points of a file, in its units and axes.

    Parameters
    ----------
    count : number of points, which the file is long enough to contain
    blocks : coordinates in order, in blocks (n, 3) of float64; missing points are NaN or infinite,
        and may cause numpy warnings
    viewpoint : viewpoint that the file states; None if it states none
    """

    count: int
    blocks: Iterator[Floats]
    viewpoint: Position | None = None


def check_count(count: int, most: int) -> None:
    """Raise UnreadableCloud if a header declares more than `most` points."""
    if count > most:
        raise UnreadableCloud(
            f"The file declares {count} points; the limit is {most}. Downsample the cloud to a "
            "voxel grid of a few centimetres, or send it in parts."
        )


def steps(count: int) -> Iterator[tuple[int, int]]:
    """Yield the first index and the length of each block of `count` rows."""
    return ((first, min(BLOCK, count - first)) for first in range(0, count, BLOCK))


def axis_names(names: list[str]) -> list[str]:
    """Return the names of fields, with X, Y, Z (written by PDAL) replaced by x, y, z."""
    if {"x", "y", "z"}.isdisjoint(names):
        return [name.lower() if name in ("X", "Y", "Z") else name for name in names]
    return names


def record_blocks(
    data: FileBytes, start: int, count: int, fields: Iterable[tuple[str, str, int]]
) -> Iterator[Floats]:
    """Yield x, y and z of packed records in blocks (n, 3).

    Parameters
    ----------
    data, start, count : the file, and the offset and number of its records; they must fit into it
    fields : name, numpy type and number of values of each field, including x, y and z
    """
    packed = [(name if name in ("x", "y", "z") else f"{place}", kind, (n,) * (n != 1))
              for place, (name, kind, n) in enumerate(fields)]  # fmt: skip
    table = np.frombuffer(data, np.dtype(packed), count, start)
    for first, n in steps(count):
        rows = table[first : first + n]
        yield np.stack([rows[name] for name in "xyz"], axis=1, dtype=np.float64)


#: Status of a row: readable, or the reason why it is unreadable.
GOOD, ENDS, FEW, MANY, NO_NUMBER, CORNERS = 0, 1, 2, 3, 4, 5

ROW_ERRORS = {
    ENDS: "the file ends before it",
    FEW: "it has fewer values than the header declares",
    MANY: "it has more values than the header declares",
    NO_NUMBER: "one of its values is not a number",
    CORNERS: "its polygon has fewer than 3 corners, or more than 1024",
}

#: Powers of ten that float64 represents exactly.
_TENS = np.array([float(f"1e{k}") for k in range(23)])


def parse_blocks(
    text: Bytes, start: int, count: int, axes: NDArray[np.int8], lists: NDArray[np.bool_],
    further: int = 0,
) -> Iterator[Floats]:  # fmt: skip
    """Yield the coordinates of `count` rows of text in blocks (n, 3); see `parse_rows`.

    Raise UnreadableCloud if a row is missing or malformed, with its number, or if more than
    `further` lines follow.
    """
    for first, n in steps(count):
        block = np.full((n, 3), np.nan)
        start, rows, state = parse_rows(text, start, block, axes, lists)
        if state != GOOD:
            raise UnreadableCloud(
                f"Row {first + rows + 1} of {count} cannot be read: {ROW_ERRORS[state]}. "
                "Copy or write the file again."
            )
        yield block
    check_end(text, _skip_lines(text, start, min(further, len(text)))[0])


def check_end(data: Bytes, start: int) -> None:
    """Raise UnreadableCloud if more than blanks and zeros follows after the declared rows."""
    if any((data[place : place + BLOCK] > 32).any() for place in range(start, len(data), BLOCK)):
        raise UnreadableCloud(
            f"{len(data) - start} bytes follow after the rows that the header declares. Correct "
            "the number of points, or write the file again."
        )


def skip_lines(text: Bytes, start: int, count: int) -> int:
    """Return the offset after `count` lines, not counting empty lines.

    Raise UnreadableCloud if there are fewer lines.
    """
    place, lines = _skip_lines(text, start, count)
    if lines < count:
        raise UnreadableCloud(
            f"The file ends after {lines} of the {count} rows that precede its points. "
            "Copy or write the file again."
        )
    return place


def check_room(text: Bytes, start: int, count: int, columns: int) -> None:
    """Raise UnreadableCloud if a header declares more rows than fit into the rest of the file."""
    if count * columns * 2 - 1 > len(text) - start:  # a value has at least a digit and a space
        raise UnreadableCloud(
            f"The header declares {count} rows of {columns} values, but only "
            f"{len(text) - start} bytes follow. Copy or write the file again."
        )


@kernel
def parse_rows(
    text: Bytes, start: int, out: Floats, axes: NDArray[np.int8], lists: NDArray[np.bool_]
) -> tuple[int, int, int]:
    """Parse rows of text until `out` is full; empty lines are skipped.

    Parameters
    ----------
    text : (N,) bytes
    start : offset of the first row
    out : (n, 3) output
    axes : (c,) column of `out` for each value of a row; -1 for skipped values
    lists : (c,) whether a value is the length of a list that follows on the same line

    Returns
    -------
    end, rows, status : offset after the last row, number of rows, and status of the next row
    """
    i, size = start, len(text)
    for row in range(len(out)):
        while i < size and text[i] <= 32 and text[i] >= 9:
            i += 1
        if i >= size:
            return i, row, ENDS
        for c in range(len(axes)):
            first, i = word(text, i)
            if first == i:  # the end of the line, or an unexpected character
                return i, row, FEW
            if lists[c]:
                value, good = number(text, first, i)
                if not good or not (0.0 <= value < 2147483648.0) or value != int(value):
                    return i, row, NO_NUMBER
                for _ in range(int(value)):
                    first, i = word(text, i)
                    if first == i:
                        return i, row, FEW
            elif axes[c] >= 0:
                value, good = number(text, first, i)
                if not good:
                    return i, row, NO_NUMBER
                out[row, axes[c]] = value
        first, i = word(text, i)
        if first != i:
            return i, row, MANY
        if i < size and text[i] != 10 and text[i] != 13:
            return i, row, NO_NUMBER
    return i, len(out), GOOD


@kernel
def _skip_lines(text: Bytes, start: int, count: int) -> tuple[int, int]:
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
    """Return the start and end of the next word on this line; they are equal if there is none."""
    first = start
    while first < len(text) and (text[first] == 32 or text[first] == 9):
        first += 1
    end = first
    while end < len(text) and text[end] > 32:
        end += 1
    return first, end


@kernel
def number(text: Bytes, start: int, end: int) -> tuple[float, bool]:
    """Parse a word; return its value, exact except for the last bit, and whether it is a number.

    Every spelling of NaN or infinity that printf writes gives NaN.
    """
    i = start
    negative = i < end and text[i] == 45
    if i < end and (text[i] == 45 or text[i] == 43):
        i += 1
    if end - i >= 3:
        a, b, c = text[i] | 32, text[i + 1] | 32, text[i + 2] | 32
        if (a == 110 and b == 97 and c == 110) or (a == 105 and b == 110 and c == 102):
            return np.nan, True
    mantissa, significant, digits, exponent, point = 0, 0, 0, 0, False
    while i < end:
        sign = text[i]
        if 48 <= sign <= 57:
            digits += 1
            if significant < 18:  # further digits do not affect a float64
                mantissa = 10 * mantissa + (int(sign) - 48)
                if mantissa > 0:
                    significant += 1
                if point:
                    exponent -= 1
            elif not point:
                exponent += 1
        elif sign == 46 and not point:
            point = True
        elif sign == 35 and point:  # Windows writes 1.#QNAN
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
        tens = min(max(exponent, -400), 400)
        while tens > 0:
            value *= _TENS[min(tens, 22)]
            tens -= min(tens, 22)
        while tens < 0:
            value /= _TENS[min(-tens, 22)]
            tens += min(-tens, 22)
    return (-value if negative else value), True
