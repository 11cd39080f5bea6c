"""Rows of points: the result of every reader, its limits, and the parser of rows of text.

text, start  --parse_rows-->  coordinates (n, 3), offset after them, status

Each line of text is a point, of which three columns are read. Python's `float` would take a minute
for the largest file.
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

#: Maximum number of points of a file; a larger one is refused by its header.
MAXIMUM_POINTS = 20_000_000

#: Maximum size that a compressed file is decompressed to at once, bytes: 20 million points of four
#: values, and a size that several uploads may take at a time.
MAXIMUM_INFLATED = 400 << 20

#: Number of points that are parsed at a time, so that they stay in the processor's cache.
BLOCK = 1 << 16


#: The bytes of a file, in memory or mapped from the disk.
FileBytes = bytes | mmap.mmap


@dataclass(frozen=True, eq=False)
class FilePoints:
    """Points in the units and axes of their file.

    Parameters
    ----------
    count : number of points, checked against the length of the file
    blocks : coordinates in order, (n, 3) float64 each; missing ones are NaN or infinite, and may
        cause warnings of numpy
    viewpoint : viewpoint that the file states, or None
    """

    count: int
    blocks: Iterator[Floats]
    viewpoint: Position | None = None


def check_count(count: int, most: int) -> None:
    """Raise UnreadableCloud if a header announces more than `most` points."""
    if count > most:
        raise UnreadableCloud(
            f"The file announces {count} points, and at most {most} are read. "
            "Thin the cloud out, to a voxel grid of a few centimetres, or send it in parts."
        )


def steps(count: int) -> Iterator[tuple[int, int]]:
    """Yield first index and length of each block of `count` rows."""
    return ((first, min(BLOCK, count - first)) for first in range(0, count, BLOCK))


def axis_names(names: list[str]) -> list[str]:
    """Return the names of fields with x, y, z in place of X, Y, Z, which PDAL writes."""
    if {"x", "y", "z"}.isdisjoint(names):
        return [name.lower() if name in ("X", "Y", "Z") else name for name in names]
    return names


def record_blocks(
    data: FileBytes, start: int, count: int, fields: Iterable[tuple[str, str, int]]
) -> Iterator[Floats]:
    """Yield x, y and z of packed records, a block at a time.

    Parameters
    ----------
    data, start, count : the file, and offset and number of its records, which fit into it
    fields : name, type in numpy and number of values of each field; x, y and z are among them
    """
    packed = [(name if name in ("x", "y", "z") else f"{place}", kind, (n,) * (n != 1))
              for place, (name, kind, n) in enumerate(fields)]  # fmt: skip
    table = np.frombuffer(data, np.dtype(packed), count, start)
    for first, n in steps(count):
        rows = table[first : first + n]
        yield np.stack([rows[name] for name in "xyz"], axis=1, dtype=np.float64)


# Rows of text, one on each line.

#: Status of a row: readable, or the reason why not.
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
    """Yield the coordinates of `count` rows, (n, 3) each; see `parse_rows`.

    Raises
    ------
    UnreadableCloud : A row is missing or malformed; the message names it.
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
    """Return the offset after `count` lines that are not empty.

    Raises
    ------
    UnreadableCloud : There are fewer lines.
    """
    place, lines = _skip(text, start, count)
    if lines < count:
        raise UnreadableCloud(
            f"The file ends after {lines} of {count} rows before its points. "
            "Copy or write the file again."
        )
    return place


def check_room(text: Bytes, start: int, count: int, columns: int) -> None:
    """Raise UnreadableCloud if a header announces more rows than fit into the rest of the file."""
    if count * columns * 2 - 1 > len(text) - start:  # a digit and a space for each value
        raise UnreadableCloud(
            f"The header announces {count} rows of {columns} values, and {len(text) - start} "
            "bytes follow. Copy or write the file again."
        )


@kernel
def parse_rows(
    text: Bytes, start: int, out: Floats, wanted: NDArray[np.int8], lists: NDArray[np.bool_]
) -> tuple[int, int, int]:
    """Parse rows of text until `out` is full; empty lines are skipped.

    Parameters
    ----------
    text : (N,) bytes
    start : offset of the first row
    out : (n, 3) output
    wanted : (c,) column of `out` for each value, or -1
    lists : (c,) whether a value is the length of a list that follows on the same line

    Returns
    -------
    offset after the last row, number of rows, and status
    """
    i, size = start, len(text)
    for row in range(len(out)):
        while i < size and text[i] <= 32 and text[i] >= 9:
            i += 1
        if i >= size:
            return i, row, ENDS
        for c in range(len(wanted)):
            first, i = word(text, i)
            if first == i:  # the end of a line, or a character that does not belong in text
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
    """Return start and end of the next word on this line; equal if there is none."""
    first = start
    while first < len(text) and (text[first] == 32 or text[first] == 9):
        first += 1
    end = first
    while end < len(text) and text[end] > 32:
        end += 1
    return first, end


@kernel
def number(text: Bytes, start: int, end: int) -> tuple[float, bool]:
    """Return the number of a word, exact to the last bit but one, and whether it is a number; NaN
    for every spelling of NaN and infinity by printf.
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
            if taken < 18:  # more digits than a float64 distinguishes
                mantissa = 10 * mantissa + (int(sign) - 48)
                if mantissa > 0:
                    taken += 1
                if point:
                    exponent -= 1
            elif not point:
                exponent += 1
        elif sign == 46 and not point:
            point = True
        elif sign == 35 and point:  # 1.#QNAN, on Windows
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
