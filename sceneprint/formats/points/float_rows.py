"""What every parser of points hands to the door, and what it may not exceed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import UnreadableCloud
from sceneprint.types import Floats
from sceneprint_client.sidecars import Position

#: Most points of a file that is read; more is refused by its header.
MAXIMUM_POINTS = 20_000_000

#: Most bytes that a compressed file is inflated to at once: 20 million points of x, y, z and one
#: more, and what several uploads at a time may hold together.
MAXIMUM_INFLATED = 400 << 20

#: Points that are parsed at a time: what they take beside the file stays in the cache.
BLOCK = 1 << 16


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


def check_count(count: int) -> None:
    """Refuse a header that announces more points than are read."""
    if count > MAXIMUM_POINTS:
        raise UnreadableCloud(
            f"The file announces {count} points, and at most {MAXIMUM_POINTS} are read. "
            "Thin the cloud out, to a voxel grid of a few centimetres, or send it in parts."
        )


def steps(count: int) -> Iterator[tuple[int, int]]:
    """First index and length of each block of so many rows."""
    return ((first, min(BLOCK, count - first)) for first in range(0, count, BLOCK))


def columns(table: NDArray[np.void], names: tuple[str, str, str]) -> Iterator[Floats]:
    """The three columns of a table of records, a block at a time."""
    for first, n in steps(len(table)):
        rows, block = table[first : first + n], np.empty((n, 3))
        for k, name in enumerate(names):
            block[:, k] = rows[name]
        yield block
