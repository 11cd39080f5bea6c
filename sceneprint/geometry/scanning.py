"""Sec. III-C, the sums behind a similarity: the loops of `retrieval`, as fast as memory allows.

    queries (Q, n), database (N, n) uint8, rows (r,)  --scan-->  (Q, r) sums of integers

On x86 sums of |x - y| are those of `psadbw`. Elsewhere, and for squares, the loop in plain words
serves. All give the same integers.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.psadbw import GROUP, SCANNERS, TILE, Ints64, widths
from sceneprint.types import Bytes

#: Bytes summed in 32 bits before they move to 64: the last power of 2 of which 255^2 each fit.
BLOCK = 32768

#: The same of the loop in plain words, whose calls cost more than sums in shorter tiles.
_CACHED, _SHORTEST = 262144, 4096


def scan(
    queries: Bytes,
    database: Bytes,
    rows: Ints64,
    *,
    squared: bool = False,
    half: bool = False,
    width: int | None = None,
) -> Ints64:
    """Sums of |x - y|, or of (x - y)^2, over the bytes of every query and row.

    Parameters
    ----------
    queries : (Q, n) uint8, in C order
    database : (N, n) uint8, in C order
    rows : (r,) of the database, each from 0 to N - 1: not checked here
    squared : sum squares
    half : only entries (q, i) with q < i mean something; the others may be anything
    width : bytes at a time, of `widths`; the widest where it is not given

    Returns
    -------
    (Q, r) int64
    """
    result = np.zeros((len(queries), len(rows)), np.int64)
    width = widths()[0] if width is None else width
    if squared or width == 0:
        tile = max(_CACHED // max(len(queries), 1), _SHORTEST)
        _plain(frozen(queries), frozen(database), frozen(rows), squared, half, tile, result)
    else:
        # one query stays in the cache whole, and a row is read without a break
        tile = TILE if len(queries) > 1 else max(queries.shape[1], TILE)
        scanner = SCANNERS[width]
        scanner(frozen(queries), frozen(database), frozen(rows), half, tile, result)
    return result


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """A read-only view: code compiled for it serves mapped files and arrays in memory alike."""
    view = array.view()
    view.flags.writeable = False
    return view


@kernel
def _absolute(a: Bytes, b: Bytes) -> int:
    """Sum of |a - b| over at most BLOCK bytes."""
    total = np.int32(0)
    for i in range(len(a)):
        # the magnitude of 32 bits added to 32 bits, and no other form, becomes one instruction
        d = np.int32(np.int32(a[i]) - np.int32(b[i]))
        total = np.int32(total + abs(d))
    return int(total)


@kernel
def _squares(a: Bytes, b: Bytes) -> int:
    """Sum of (a - b)^2 over at most BLOCK bytes."""
    total = np.int32(0)
    for i in range(len(a)):
        d = np.int32(np.int32(a[i]) - np.int32(b[i]))
        total = np.int32(total + np.int32(d * d))  # becomes pmaddwd
    return int(total)


@kernel
def _plain(
    queries: Bytes,
    database: Bytes,
    rows: Ints64,
    squared: bool,
    half: bool,
    tile: int,
    result: Ints64,
) -> None:
    """Add to result (Q, r), on any processor."""
    n = queries.shape[1]
    for group in range(0, len(rows), GROUP):
        for start in range(0, n, tile):
            for i in range(group, min(group + GROUP, len(rows))):
                stored = database[rows[i], start : start + tile]
                for q in range(min(i, len(queries)) if half else len(queries)):
                    asked = queries[q, start : start + tile]
                    total = 0
                    for low in range(0, len(stored), BLOCK):
                        # slices start at 0: a loop from `low` would not be vectorised
                        a, b = asked[low : low + BLOCK], stored[low : low + BLOCK]
                        total += _squares(a, b) if squared else _absolute(a, b)
                    result[q, i] += total
