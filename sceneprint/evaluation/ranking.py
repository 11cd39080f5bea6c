"""R and C of every query, by stored signatures alone.

signatures, allowed  --rank-->  Ranked: R and C of each query
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.evaluation.workers import Watch, unwatched
from sceneprint.geometry.diversity import diversify
from sceneprint.geometry.retrieval import (
    Ints64,
    Metric,
    cross_distances,
    pairwise_distances,
    ranking_size,
)
from sceneprint.types import Bytes

#: Queries scanned at once.
BLOCK = 64
#: Queries whose distances within R are worked out anew, to time what a service would do.
TIMED = 3


@dataclass(frozen=True, eq=False)
class Ranked:
    """R and C of one query.

    Parameters
    ----------
    ranking : R, database indices, nearest first
    distances : (|R|,) of R, as of `cross_distances`
    selection : C, in the order of R
    milliseconds : of `rank` (scan and sort) and `diversify`, and of `compare_ranking` where it
        was timed
    """

    ranking: list[int]
    distances: Ints64
    selection: list[int]
    milliseconds: dict[str, float]


def rank(
    queries: Bytes,
    database: Bytes,
    allowed: NDArray[np.bool_],
    *,
    metric: Metric,
    candidates: int = 10,
    watch: Watch = unwatched,
) -> list[Ranked]:
    """Rank the database for each query and select from the ranking.

    Parameters
    ----------
    queries : (Q, n) uint8
    database : (N, n) uint8
    allowed : (Q, N), which frames a query may find
    metric : l1 or l2
    candidates : size of C
    watch : told of each query

    Returns
    -------
    ranked : Q; empty lists where nothing is allowed
    """
    size = max((ranking_size(int(n)) for n in allowed.sum(axis=1)), default=0)
    # every pair of the database once, or the pairs within each ranking anew: whichever is less
    whole = len(database) ** 2 <= len(queries) * size**2
    among = pairwise_distances(database, metric) if whole and len(queries) else None
    rows = _rows(queries, database, metric)
    found = []
    for i, (row, spent) in enumerate(watch(rows, "rank", len(queries))):
        start = time.perf_counter()
        index = np.flatnonzero(allowed[i])
        order = np.argsort(row[index], kind="stable")  # ties by index
        ranking = index[order[: ranking_size(len(index))]]
        ms = {"rank": spent + 1e3 * (time.perf_counter() - start)}
        start = time.perf_counter()
        if among is None or i < TIMED:
            within = pairwise_distances(database[ranking], metric)
            ms["compare_ranking"] = 1e3 * (time.perf_counter() - start)
        else:
            within = among[np.ix_(ranking, ranking)]
        start = time.perf_counter()
        selection = diversify(row[ranking], within, candidates)
        ms["diversify"] = 1e3 * (time.perf_counter() - start)
        chosen = ranking[selection.indices]
        found.append(Ranked(ranking.tolist(), row[ranking], chosen.tolist(), ms))
    return found


def _rows(queries: Bytes, database: Bytes, metric: Metric) -> Iterable[tuple[Ints64, float]]:
    """Distances of each query to the database, and the milliseconds they took."""
    for begin in range(0, len(queries), BLOCK):
        start = time.perf_counter()
        block = cross_distances(queries[begin : begin + BLOCK], database, metric)
        spent = 1e3 * (time.perf_counter() - start) / len(block)
        for row in block:
            yield row, spent
