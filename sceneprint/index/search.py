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
from sceneprint.index.keys import Keys
from sceneprint.index.segments import blocks_of, gather
from sceneprint.index.tails import Tail, check_lengths
from sceneprint.types import Bytes

#: Frames that the codes propose.
SHORTLIST = 1000
#: Bytes gathered at once: few calls, and little memory for each of many threads.
_GATHERED = 4 << 20


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
    exact : compare every frame
    shortlist : frames that the codes propose, raised to `size`; a generation that has no more is
        compared whole

    Raises
    ------
    ValueError : no signature of that length, a negative size, or a shortlist below 1.
    """
    if query.ndim != 1 or query.dtype != np.uint8 or size < 0 or shortlist < 1:
        raise ValueError(f"{size} of {shortlist} for a query {query.dtype} {query.shape}")
    check_lengths(len(query), generation, tail)
    query = np.array(query)  # writable and whole: one compiled kernel serves all queries
    gone = np.fromiter(dead, np.int64, len(dead))
    alive = np.flatnonzero(~np.isin(tail.keys, gone))
    keys, found, whole = tail.keys[alive], distances(query, tail.signatures)[alive], True
    if generation is not None and len(generation):
        excluded = generation.places.of(np.concatenate([gone, tail.keys]))
        excluded = np.unique(excluded[excluded >= 0])
        proposed = max(shortlist, size)
        whole = exact or len(generation) - len(excluded) <= proposed
        if whole:
            positions = np.delete(np.arange(len(generation)), excluded)
            own = _scan(query, generation)[positions]
        else:
            code = generation.code.encode(query[None])[0]
            positions = np.sort(generation.coarse.nearest(code, proposed, excluded))
            own = _compare(query, generation, positions)
        keys = np.concatenate([keys, generation.keys[positions]])
        found = np.concatenate([found, own])
    nearest = _nearest(keys, found, size)
    return Hits(keys[nearest], found[nearest], whole, len(keys))


def _scan(query: Bytes, generation: Generation) -> NDArray[np.int64]:
    """Distances (N,) to all frames; rows of frames that are gone are read in passing."""
    scanned = [distances(query, segment.signatures) for segment in generation.segments]
    result: NDArray[np.int64] = np.concatenate(scanned)[generation.rows]
    return result


def _compare(
    query: Bytes, generation: Generation, positions: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Distances (r,) to frames at rising positions."""
    rows = generation.rows[positions]
    return np.concatenate(
        [
            distances(query, gather(generation.segments, some))
            for some in blocks_of(rows, len(query), _GATHERED)
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
