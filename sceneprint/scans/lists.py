"""Binary rows that hold lists, as PLY has them: each has a length of its own.

bytes, start, count, kinds  --skip_rows-->  place behind them
                            --list_blocks-->  three of their values (n, 3)
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import UnreadableCloud
from sceneprint.geometry.kernel import kernel
from sceneprint.scans.raw import steps
from sceneprint.types import Bytes, Floats

Places = NDArray[np.int64]

#: Type of each value, of numpy, and of a list's length before it.
Kinds = Sequence[tuple[str, str | None]]


def skip_rows(view: Bytes, start: int, count: int, kinds: Kinds, order: str) -> int:
    """Where so many rows end.

    Raises
    ------
    UnreadableCloud : the bytes end before.
    """
    end = start
    for _, behind in _walked(view, start, count, kinds, (0, 0, 0), order):
        end = behind
    return end


def list_blocks(
    view: Bytes, start: int, count: int, kinds: Kinds, picked: tuple[int, int, int], order: str
) -> Iterator[Floats]:
    """Yield three of the values of each row, (n, 3) each; raises as `skip_rows`."""
    for places, _ in _walked(view, start, count, kinds, picked, order):
        block = np.empty((len(places), 3))
        for k, value in enumerate(picked):
            kind = np.dtype(order + kinds[value][0])
            gathered = view[places[:, k, None] + np.arange(kind.itemsize)]
            block[:, k] = np.ascontiguousarray(gathered).view(kind)[:, 0]
        yield block


def _walked(
    view: Bytes, start: int, count: int, kinds: Kinds, picked: tuple[int, int, int], order: str
) -> Iterator[tuple[Places, int]]:
    """Yield where the picked values of each row are, and where its block ends."""
    sizes = np.array([np.dtype(kind).itemsize for kind, _ in kinds])
    lengths = np.array([np.dtype(length).itemsize if length else 0 for _, length in kinds])
    signed = np.array([length is not None and length[0] == "i" for _, length in kinds])
    wanted = np.array(picked)
    for first, n in steps(count):
        places = np.zeros((n, 3), np.int64)
        start, rows = _walk(view, start, places, sizes, lengths, signed, wanted, order == "<")
        if rows < n:
            raise UnreadableCloud(
                f"The file ends in row {first + rows + 1} of {count}, whose lists have more in "
                "them than is left. Copy or write the file again."
            )
        yield places, start


@kernel
def _walk(
    view: Bytes, start: int, places: Places, sizes: Places, lengths: Places,
    signed: NDArray[np.bool_], wanted: Places, little: bool,
) -> tuple[int, int]:  # fmt: skip
    """Fill the places; return the one behind the last whole row, and how many there were."""
    at, end = start, len(view)
    for row in range(len(places)):
        for p in range(len(sizes)):
            for k in range(3):
                if wanted[k] == p:
                    places[row, k] = at
            repeats = 1
            if lengths[p] > 0:
                if lengths[p] > end - at:
                    return at, row
                repeats = 0
                for b in range(lengths[p]):
                    byte = int(view[at + (lengths[p] - 1 - b if little else b)])
                    if b == 0 and signed[p] and byte > 127:  # fewer than none
                        return at, row
                    repeats = 256 * repeats + byte
                at += lengths[p]
            if sizes[p] * repeats > end - at:
                return at, row
            at += sizes[p] * repeats
    return at, len(places)
