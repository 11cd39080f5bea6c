"""Keys of frames, and where they stand in a list of keys."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneprint.types import Bytes

Keys = NDArray[np.int64]
#: Keys (n,) int64 of frames, and their signatures (n, D) uint8.
Block = tuple[Keys, Bytes]


class Places:
    """The places of keys in a list, found by bisection.

    Parameters
    ----------
    keys : (n,) in their order; a rising list is not copied

    Raises
    ------
    ValueError : a key is there twice.
    """

    def __init__(self, keys: Keys) -> None:
        self._order: NDArray[np.intp] | None = None
        self._rising = keys
        if (keys[1:] <= keys[:-1]).any():
            self._order = np.argsort(keys)
            self._rising = keys[self._order]
            again = self._rising[1:] == self._rising[:-1]
            if again.any():
                raise ValueError(f"the keys {self._rising[1:][again][:5].tolist()} are there twice")

    def of(self, keys: Keys) -> NDArray[np.int64]:
        """Places (m,) of keys (m,); -1 for a key that is not there."""
        if len(self._rising) == 0:
            return np.full(len(keys), -1, np.int64)
        at = np.minimum(np.searchsorted(self._rising, keys), len(self._rising) - 1)
        places = at if self._order is None else self._order[at]
        return np.where(self._rising[at] == keys, places, -1)


def check_block(keys: Keys, signatures: Bytes, length: int) -> None:
    """See that these are keys and signatures of that many bytes.

    Raises
    ------
    ValueError : they are not.
    """
    if keys.dtype != np.int64 or signatures.dtype != np.uint8:
        raise ValueError(f"keys of {keys.dtype} and signatures of {signatures.dtype}")
    if keys.ndim != 1 or length < 1 or signatures.shape != (len(keys), length):
        raise ValueError(f"keys {keys.shape} and signatures {signatures.shape} of {length} bytes")


def draw(n: int, limit: int, seed: int) -> NDArray[np.int64]:
    """At most `limit` of n rows: one at random from each of as many equal stretches.

    Even, so that every place of a map counts alike; at random, so that nothing periodic in the
    order of the frames (two robots in turn) is missed.
    """
    if n <= limit:
        return np.arange(n)
    edges = np.arange(limit + 1) * n // limit
    return np.random.default_rng(seed).integers(edges[:-1], edges[1:])
