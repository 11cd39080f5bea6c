"""Sec. III-C, similarity: distances of stored signatures.

query (n,), database (N, n) uint8  --distances-->  (N,)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.types import Bytes


@kernel
def _scan(query: Bytes, database: Bytes, result: NDArray[np.int64]) -> None:
    for row in range(len(database)):
        stored = database[row]
        total = 0
        for i in range(len(query)):
            a, b = query[i], stored[i]
            # this form, and no other, becomes one psadbw instruction for every 32 bytes
            total += int(np.uint8(max(a, b) - min(a, b)))
        result[row] = total


def distances(query: Bytes, database: Bytes) -> NDArray[np.int64]:
    """L1 distances -s(X, Y) of one signature to many: Sec. III-C.

    Parameters
    ----------
    query : (n,) uint8
    database : (N, n) uint8

    Returns
    -------
    (N,) int64, in units of a byte; exact

    Raises
    ------
    ValueError : the lengths differ.
    """
    if query.ndim != 1 or database.shape[1:] != query.shape:
        raise ValueError(f"signatures of {query.shape} and {database.shape[1:]} bytes")
    result = np.empty(len(database), np.int64)
    _scan(np.ascontiguousarray(query), np.ascontiguousarray(database), result)
    return result
