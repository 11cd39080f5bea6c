"""Search: the nearest frames of a map by exact L1 distance of signatures, Sec. III-C.

A small map is compared whole. In a large one the compact codes propose a shortlist, and only the
shortlist and the tail are compared; what the shortlist misses is missed, which is why it is many
times longer than any ranking.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.retrieval import distances
from sceneprint.index.generations import Generation
from sceneprint.index.keys import Keys, Places
from sceneprint.index.tails import Tail, check_lengths
from sceneprint.types import Bytes

#: Frames that the codes propose.
SHORTLIST = 500


@dataclass(frozen=True, eq=False)
class Hits:
    """The nearest frames that a search found.

    Parameters
    ----------
    keys : (r,) int64 of the frames
    distances : (r,) int64, exact L1, rising; equal ones by key
    exact : every frame of the map was compared, so that these are the nearest
    compared : frames whose exact distance was computed
    """

    keys: Keys
    distances: NDArray[np.int64]
    exact: bool
    compared: int

    def __len__(self) -> int:
        return len(self.keys)


def search(
    query: Bytes,
    generation: Generation | None,
    tail: Tail,
    size: int,
    *,
    dead: frozenset[int] = frozenset(),
    among: Keys | None = None,
    exact: bool = False,
    shortlist: int = SHORTLIST,
) -> Hits:
    """Find the nearest frames of a map. Any number of threads may search one generation.

    Parameters
    ----------
    query : (D,) uint8, a signature of the model of the map
    generation : or None where there is none
    tail : frames newer than that; where a frame is in both, this one counts
    size : of the answer; all frames where there are fewer
    dead : keys of frames that were deleted since
    among : keys of the frames that may be found, where not all may; others are no matter
    exact : compare every frame, of those that may be found
    shortlist : frames that the codes propose, raised to `size`; where no more may be found in the
        generation, they are all compared

    Raises
    ------
    ValueError : no signature of that length, a negative size, or a shortlist below 1.
    """
    if query.ndim != 1 or query.dtype != np.uint8 or size < 0 or shortlist < 1:
        raise ValueError(f"{size} of {shortlist} for a query {query.dtype} {query.shape}")
    check_lengths(len(query), generation, tail)
    gone = np.fromiter(dead, np.int64, len(dead))
    alive = np.flatnonzero(_free(tail, gone, among))
    keys, found, whole = tail.keys[alive], distances(query, tail.signatures, rows=alive), True
    if generation is not None and len(generation):
        free = _free(generation, np.concatenate([gone, tail.keys]), among)
        positions, whole = _proposed(query, generation, free, max(shortlist, size), exact)
        keys = np.concatenate([keys, generation.keys[positions]])
        found = np.concatenate([found, _compare(query, generation, positions)])
    first = _nearest(keys, found, size)
    return Hits(keys[first], found[first], whole, len(keys))


def is_compared(
    query: Bytes,
    generation: Generation | None,
    tail: Tail,
    size: int,
    key: int,
    *,
    dead: frozenset[int] = frozenset(),
    among: Keys | None = None,
    exact: bool = False,
    shortlist: int = SHORTLIST,
) -> bool:
    """Whether `search` computes the exact distance of one frame, or its shortlist misses it.

    Parameters
    ----------
    key : of the frame
    query, generation, tail, size, dead, among, exact, shortlist : as of `search`
    """
    gone, wanted = np.fromiter(dead, np.int64, len(dead)), np.array([key], np.int64)
    at = _known(tail.places, wanted)
    if len(at):
        return bool(_free(tail, gone, among)[at[0]])
    if generation is None or not len(at := _known(generation.places, wanted)):
        return False
    free = _free(generation, np.concatenate([gone, tail.keys]), among)
    positions, _ = _proposed(query, generation, free, max(shortlist, size), exact)
    return bool(free[at[0]]) and at[0] in positions


def _proposed(
    query: Bytes, generation: Generation, free: NDArray[np.bool_], most: int, exact: bool
) -> tuple[NDArray[np.int64], bool]:
    """Positions in a generation that are compared, rising, and whether these are all."""
    positions = np.flatnonzero(free)
    if exact or len(positions) <= most:
        return positions, True
    code = generation.code.encode(query[None])[0]
    return np.sort(generation.coarse.nearest(code, most, np.flatnonzero(~free))), False


def _free(part: Generation | Tail, gone: Keys, among: Keys | None) -> NDArray[np.bool_]:
    """Which frames of a part may be found: those among the given ones that are not gone."""
    free = np.full(len(part), among is None)
    if among is not None:
        free[_known(part.places, among)] = True
    free[_known(part.places, gone)] = False
    return free


def _known(places: Places, keys: Keys) -> NDArray[np.int64]:
    at = places.of(keys)
    return at[at >= 0]


def _compare(
    query: Bytes, generation: Generation, positions: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Distances (r,) to frames at rising positions, where they are mapped: no copies."""
    rows = generation.rows[positions]
    starts = np.cumsum([0, *map(len, generation.segments)])
    edges = np.searchsorted(rows, starts)
    return np.concatenate(
        [
            distances(query, segment.signatures, rows=rows[edges[i] : edges[i + 1]] - starts[i])
            for i, segment in enumerate(generation.segments)
        ]
    )


def _nearest(keys: Keys, found: NDArray[np.int64], size: int) -> NDArray[np.intp]:
    """Places of the smallest `size`, rising, ties by key."""
    size = min(size, len(keys))
    if size == 0:
        return np.empty(0, np.intp)
    candidates = np.flatnonzero(found <= np.partition(found, size - 1)[size - 1])
    order = np.lexsort((keys[candidates], found[candidates]))
    chosen: NDArray[np.intp] = candidates[order[:size]]
    return chosen
