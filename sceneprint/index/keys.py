"""Where keys stand in a list of keys."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Keys = NDArray[np.int64]


class Places:
    """The places of keys in a list, found by bisection.

    Parameters
    ----------
    keys : (n,) in their order

    Raises
    ------
    ValueError : a key is there twice.
    """

    def __init__(self, keys: Keys) -> None:
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
        return np.where(self._rising[at] == keys, self._order[at], -1)
