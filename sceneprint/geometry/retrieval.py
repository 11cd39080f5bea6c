"""Sec. III-C, similarity and retrieval: stored signatures to a ranking; the oracle of every index.

query (n,), database (N, n) uint8  --distances-->  (N,)  --rank-->  Ranking: R of Sec. III-C

Distances are exact integers, so that equal ones are equal, and ties fall to the lower index.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.scanning import scan
from sceneprint.types import Bytes, Floats

Ints64 = NDArray[np.int64]

#: "l1": the paper's, sum |x - y|; "l2": squared Euclidean, sum (x - y)^2, an integer as well.
Metric = Literal["l1", "l2"]

#: A ranking takes this share of a map, and no fewer and no more than these.
RANKING_SHARE, SMALLEST_RANKING, LARGEST_RANKING = 0.4, 50, 200


@dataclass(frozen=True, eq=False)
class Ranking:
    """R of Sec. III-C, nearest first, ties by index.

    Parameters
    ----------
    indices : (r,) rows of the database
    distances : (r,) int64, rising
    similarities : (r,) in [0, 1], falling; see `similarity`
    """

    indices: NDArray[np.intp]
    distances: Ints64
    similarities: Floats

    def __len__(self) -> int:
        return len(self.indices)


def distances(query: Bytes, database: Bytes, metric: Metric, rows: Ints64 | None = None) -> Ints64:
    """Distances -s(X, Y) of one signature to many: Sec. III-C.

    Parameters
    ----------
    query : (n,) uint8
    database : (N, n) uint8
    metric : "l1", the paper's, or "l2", squared Euclidean
    rows : (r,) of the database that are compared, where they are; all of them if not given

    Returns
    -------
    (N,) or (r,) int64, in units of a byte ("l2": of a byte squared); exact

    Raises
    ------
    ValueError : the lengths differ, the arrays are not of bytes, there is no such metric, or no
        such row.
    """
    if query.ndim != 1:
        raise ValueError(f"signatures of {query.shape} and {database.shape[1:]} bytes")
    _check(query[None], database, metric)
    if rows is not None:
        if rows.ndim != 1 or rows.dtype.kind not in "iu":
            raise ValueError(f"{rows.dtype} {rows.shape}, not numbers of rows")
        if len(rows) and not 0 <= rows.min() <= rows.max() < len(database):
            raise ValueError(f"rows {rows.min()} to {rows.max()} of {len(database)} signatures")
    found: Ints64 = _distances(query[None], database, metric, rows)[0]
    return found


def cross_distances(queries: Bytes, database: Bytes, metric: Metric) -> Ints64:
    """Distances -s(X, Y) of many signatures to many: Sec. III-C.

    The database streams through the cache once for all queries that fit in it.

    Parameters
    ----------
    queries : (Q, n) uint8
    database : (N, n) uint8
    metric : see `distances`

    Returns
    -------
    (Q, N) int64, as of `distances`

    Raises
    ------
    ValueError : see `distances`.
    """
    _check(queries, database, metric)
    return _distances(queries, database, metric)


def pairwise_distances(signatures: Bytes, metric: Metric) -> Ints64:
    """Distances of signatures among each other, each pair computed once: Sec. III-C.

    Parameters
    ----------
    signatures : (R, n) uint8
    metric : see `distances`

    Returns
    -------
    (R, R) int64, symmetric, 0 on the diagonal

    Raises
    ------
    ValueError : see `distances`.
    """
    _check(signatures, signatures, metric)
    above = np.triu(_distances(signatures, signatures, metric, half=True), 1)
    return above + above.T


def _check(queries: Bytes, database: Bytes, metric: Metric) -> None:
    if queries.ndim != 2 or database.ndim != 2 or queries.shape[1] != database.shape[1]:
        raise ValueError(f"signatures of {queries.shape[1:]} and {database.shape[1:]} bytes")
    if queries.dtype != np.uint8 or database.dtype != np.uint8:
        raise ValueError(f"signatures of {queries.dtype} and {database.dtype}, not of bytes")
    if metric not in get_args(Metric):
        raise ValueError(f"metric {metric!r}, not one of {get_args(Metric)}")


def _distances(
    queries: Bytes,
    database: Bytes,
    metric: Metric,
    rows: Ints64 | None = None,
    half: bool = False,
) -> Ints64:
    rows = np.arange(len(database)) if rows is None else np.ascontiguousarray(rows, np.int64)
    queries, database = np.ascontiguousarray(queries), np.ascontiguousarray(database)
    return scan(queries, database, rows, squared=metric == "l2", half=half)


def similarity(distances: Ints64, unrelated_distance: float) -> Floats:
    """Distances on a scale that does not depend on the model: Sec. III-C.

    Parameters
    ----------
    distances : (...) of one metric
    unrelated_distance : d0, the model's median distance of unrelated frames, in that metric

    Returns
    -------
    (...) 1 - d / d0, at least 0: 1 for equal signatures, 0 for unrelated ones

    Raises
    ------
    ValueError : d0 is not a positive, finite number.
    """
    if not (unrelated_distance > 0 and math.isfinite(unrelated_distance)):
        raise ValueError(f"the distance of unrelated frames is {unrelated_distance}")
    shares: Floats = np.clip(1.0 - np.asarray(distances, np.float64) / unrelated_distance, 0.0, 1.0)
    return shares


def distance_share(distances: Ints64, unrelated_distance: float, metric: Metric) -> Floats:
    """How far frames are, as a share of how far unrelated ones are: of squared distances the root.

    Parameters
    ----------
    distances : (...) of a metric
    unrelated_distance : d0, see `similarity`
    metric : see `distances`

    Returns
    -------
    (...) 0 for equal signatures, about 1 for unrelated ones
    """
    shares: Floats = np.asarray(distances, np.float64) / unrelated_distance
    return shares if metric == "l1" else np.sqrt(shares)


def share_distance(share: float, unrelated_distance: float, metric: Metric) -> float:
    """The distance that is such a share: the inverse of `distance_share`."""
    return (share if metric == "l1" else share**2) * unrelated_distance


def rank(distances: Ints64, size: int, unrelated_distance: float) -> Ranking:
    """The nearest `size` of a database, ties by index: R of Sec. III-C.

    Parameters
    ----------
    distances : (N,) integers, to every row of the database
    size : of the ranking; all of the database where it has no more rows
    unrelated_distance : see `similarity`

    Raises
    ------
    ValueError : distances that are not (N,) integers, a negative size, or d0 as in `similarity`.
    """
    if distances.ndim != 1 or distances.dtype.kind not in "iu" or size < 0:
        raise ValueError(f"{size} of distances {distances.shape} of {distances.dtype}")
    size = min(size, len(distances))
    if size == 0:
        chosen = np.empty(0, np.intp)
    else:
        cut = np.partition(distances, size - 1)[size - 1]
        nearer, at_cut = np.flatnonzero(distances < cut), np.flatnonzero(distances == cut)
        chosen = np.concatenate([nearer, at_cut[: size - len(nearer)]])
        # rising indices, and a stable sort: equal distances keep the order of the database
        chosen = chosen[np.argsort(distances[chosen], kind="stable")]
    ranked = distances[chosen].astype(np.int64)
    return Ranking(chosen, ranked, similarity(ranked, unrelated_distance))


def ranking_size(n_map: int) -> int:
    """|R| for a map of that many frames: 0.4 of them, from 50 to 200.

    In a map twice as dense the same place fills twice the ranks, so that a fixed number holds
    nothing but near-duplicates, of which no selection can be diverse: among the nearest 50 of 300
    frames of one room diversification gained 10 % of seen volume, among 125 of them 27 % (Sec.
    III-D). A share of the map keeps the stretch of places in R. The lower bound leaves a small
    map whole; the upper bounds the pairwise distances, and a larger map has more places, not
    more views of this one.

    Raises
    ------
    ValueError : a negative number.
    """
    if n_map < 0:
        raise ValueError(f"a map of {n_map} frames")
    wanted = min(max(round(RANKING_SHARE * n_map), SMALLEST_RANKING), LARGEST_RANKING)
    return min(wanted, n_map)
