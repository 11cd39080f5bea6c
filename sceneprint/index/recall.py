"""What the shortlist of a generation misses, measured against the exact scan."""

from __future__ import annotations

import numpy as np

from sceneprint.index.codes import draw
from sceneprint.index.generations import Generation
from sceneprint.index.manifests import Recall
from sceneprint.index.search import SHORTLIST, search
from sceneprint.index.tails import Tail, signatures_of
from sceneprint.types import Bytes

#: Neighbours that are looked for.
NEAR = 10
#: Frames looked up: at most, at least, and so many that they are compared with no more bytes.
MOST, LEAST, COMPARED_BYTES = 50, 10, 1 << 33
#: Bytes of signatures that all of them are compared with while they are in memory.
BLOCK_BYTES = 1 << 26
#: Share by which a generation's frames may be more or fewer before it is measured anew.
DRIFT = 0.1


def measure_recall(generation: Generation, seed: int = 0) -> Recall:
    """Look up some frames of a generation by its shortlist, and by the exact scan.

    Parameters
    ----------
    generation : open
    seed : of the choice of frames
    """
    n = len(generation)
    if n - 1 <= SHORTLIST:
        return Recall(1.0, NEAR, 0, SHORTLIST, n)
    size = min(max(COMPARED_BYTES // (n * generation.dimension), LEAST), MOST)
    chosen = generation.keys[draw(n, size, seed)]
    tail, found = Tail.empty(generation.dimension), 0
    queries = signatures_of(chosen, generation, tail)
    tenths = _farthest_wanted(queries, chosen.tolist(), generation)
    for query, key, tenth in zip(queries, chosen.tolist(), tenths, strict=True):
        itself = frozenset({key})
        listed = search(query, generation, tail, NEAR, dead=itself, shortlist=SHORTLIST)
        # an equal distance is as good: which of two equal frames is meant is nobody's concern
        found += int((listed.distances <= tenth).sum())
    return Recall(found / (NEAR * len(chosen)), NEAR, len(chosen), SHORTLIST, n)


def still_holds(recall: Recall, frames: int) -> bool:
    """Whether what was measured of a generation stands for one that follows it by the same code.

    A large map is appended to often, and each time to read all of it would cost more than the
    appending.
    """
    return recall.sample > 0 and abs(frames - recall.frames) <= DRIFT * recall.frames


def _farthest_wanted(queries: Bytes, keys: list[int], generation: Generation) -> list[int]:
    """Distance of each query's NEAR-th nearest other frame. All is read once, for all of them."""
    step = max(BLOCK_BYTES // generation.dimension, 1)
    tail = Tail.empty(generation.dimension)
    near = [np.empty(0, np.int64) for _ in keys]
    for first in range(0, len(generation), step):
        among = generation.keys[first : first + step]
        for i, (query, key) in enumerate(zip(queries, keys, strict=True)):
            itself = frozenset({key})
            hits = search(query, generation, tail, NEAR, dead=itself, among=among, exact=True)
            near[i] = np.sort(np.concatenate([near[i], hits.distances]))[:NEAR]
    return [int(one[-1]) for one in near]
