"""Whether a place is among the first k of a ranking, by any way to rank.

Prepared, Overlaps  --relevant-->  (Q, N)        rankings  --recall-->  figures
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sceneprint.evaluation.records import Member
from sceneprint.types import Floats

#: The k of recall@k.
FIRST = (1, 5, 10)
#: Overlap, by the definition of retrieval, from which a frame shows the query's place.
OVERLAP = 0.5


def metres_apart(queries: Sequence[Member], database: Sequence[Member]) -> Floats:
    """(Q, N) distance of the sensors by the true poses; infinite between scenes."""
    there = np.array([m.pose[:3, 3] for m in queries])
    here = np.array([m.pose[:3, 3] for m in database])
    same = np.array([m.scene for m in queries])[:, None] == np.array([m.scene for m in database])
    apart = np.linalg.norm(there[:, None] - here, axis=2)
    return np.where(same, apart, np.inf)


def recall(
    relevant: NDArray[np.bool_], allowed: NDArray[np.bool_], rankings: Sequence[Sequence[int]]
) -> dict[str, float | int | None]:
    """Share of queries that have a relevant frame among the first k, of those that have one.

    Parameters
    ----------
    relevant : (Q, N), whether a database frame shows the query's place
    allowed : (Q, N), whether the query may find it
    rankings : of each query database indices, nearest first, all of them allowed

    Returns
    -------
    figures : `queries` that may find a relevant frame, and the share of each k of FIRST; null
        where there is no such query
    """
    able = np.flatnonzero((relevant & allowed).any(axis=1)).tolist()
    found: dict[str, float | int | None] = {"queries": len(able)}
    for k in FIRST:
        hits = [any(relevant[i, j] for j in rankings[i][:k]) for i in able]
        found[f"at_{k}"] = sum(hits) / len(hits) if hits else None
    return found
