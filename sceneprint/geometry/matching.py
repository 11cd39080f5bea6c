"""Sec. III-E, matching: patches of two frames whose surroundings are alike.

    descriptors (S, d), (P, d)  --correspondences-->  pairs (M, 2)

Reading R10 (docs/paper.md): of the paper's patch matching only the idea is public. A random few
of the source's patches are compared with all of the target's, and each keeps its nearest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneprint.geometry.kernel import kernel
from sceneprint.types import Bytes, Ints32


@dataclass(frozen=True)
class MatchingParameters:
    """The numbers of matching."""

    n_sources: int = 100  #: patches drawn from the source
    n_nearest: int = 3  #: correspondences each keeps


@kernel
def _nearest(source: Bytes, target: Bytes, drawn: Ints32, n_nearest: int, pairs: Ints32) -> None:
    """The targets nearest to each source drawn, by squared distance, ties by index."""
    count, length = target.shape
    squares = np.empty(count, np.int32)
    for row in range(len(drawn)):
        query = source[drawn[row]]
        for j in range(count):
            other = target[j]
            total = np.int32(0)
            for k in range(length):
                gap = np.int32(query[k]) - np.int32(other[k])
                total += gap * gap
            squares[j] = total
        for k in range(n_nearest):
            best = 0
            for j in range(1, count):
                if squares[j] < squares[best]:
                    best = j
            pairs[row * n_nearest + k, 0] = drawn[row]
            pairs[row * n_nearest + k, 1] = best
            squares[best] = np.int32(2147483647)


def correspondences(
    source: Bytes, target: Bytes, rng: np.random.Generator, p: MatchingParameters
) -> Ints32:
    """Correspondences of a random few of the source's patches: Sec. III-E.

    Parameters
    ----------
    source : (P, d) uint8 descriptors
    target : (P', d) uint8
    rng : which patches are drawn depends on it alone
    p : see MatchingParameters

    Returns
    -------
    (M, 2) int32, index in source and in target; each drawn patch with its nearest, nearest first

    Raises
    ------
    ValueError : the descriptors have different lengths.
    """
    if source.shape[1] != target.shape[1]:
        raise ValueError(f"descriptors of {source.shape[1]} and {target.shape[1]} bytes")
    drawn = np.sort(rng.choice(len(source), min(p.n_sources, len(source)), replace=False))
    n_nearest = min(p.n_nearest, len(target))
    pairs = np.empty((len(drawn) * n_nearest, 2), np.int32)
    _nearest(source, target, drawn.astype(np.int32), n_nearest, pairs)
    return pairs
