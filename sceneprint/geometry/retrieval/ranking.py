"""Sec. III-C and III-D: stored signatures to a ranking, the oracle of every index, and a ranking
to a selection whose members differ from each other.

query (n,), database (N, n) uint8  --distances-->  (N,)  --rank-->  Ranking: R of Sec. III-C
distances to the query (R,), among R (R, R)  --diversify-->  Selection (k of R)

Distances are exact integers, so that equal ones are equal, and ties fall to the lower index.

The kernel of Sec. III-D is L_XY = rho_X rho_Y exp(s(X, Y) / sigma) with
rho_X = exp(s(X, Q) / (2 omega)), and s = -distance. The most probable set of k maximises det L_C;
the greedy procedure takes, again and again, the candidate that multiplies the determinant most.
That factor is rho_X^2 times the variance of X given those already taken, under exp(-D / sigma)
alone: quality and diversity part, and their logarithms neither overflow nor underflow.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.types import Bytes, Floats

Ints64 = NDArray[np.int64]

# Sec. III-C, the sums behind a similarity.
#
#     queries (Q, n), database (N, n) uint8, rows (r,)  --scan-->  (Q, r) sums of integers

#: Rows that take turns at one tile of columns, and bytes of the tiles of all queries together:
#: these stay in a core's cache while the rows pass. Shorter tiles cost more in calls.
GROUP, _CACHED, _SHORTEST = 16, 262144, 4096

#: Bytes summed in 32 bits before they move to 64: the last power of 2 of which 255^2 each fit.
BLOCK = 32768


def scan(
    queries: Bytes, database: Bytes, rows: Ints64, *, squared: bool = False, half: bool = False
) -> Ints64:
    """Sum |x - y|, or (x - y)^2, over the bytes of every query and row.

    Parameters
    ----------
    queries : (Q, n) uint8, in C order
    database : (N, n) uint8, in C order
    rows : (r,) of the database, each from 0 to N - 1: not checked here
    squared : sum squares
    half : only entries (q, i) with q < i mean something; the others may be anything

    Returns
    -------
    (Q, r) int64
    """
    result = np.zeros((len(queries), len(rows)), np.int64)
    tile = max(_CACHED // max(len(queries), 1), _SHORTEST)
    _sums(frozen(queries), frozen(database), frozen(rows), squared, half, tile, result)
    return result


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """A read-only view: code compiled for it serves mapped files and arrays in memory alike."""
    view = array.view()
    view.flags.writeable = False
    return view


@kernel
def _absolute(a: Bytes, b: Bytes) -> int:
    """Sum of |a - b| over at most BLOCK bytes."""
    total = np.int32(0)
    for i in range(len(a)):
        # the magnitude of 32 bits added to 32 bits, and no other form, becomes one instruction
        d = np.int32(np.int32(a[i]) - np.int32(b[i]))
        total = np.int32(total + abs(d))
    return int(total)


@kernel
def _squares(a: Bytes, b: Bytes) -> int:
    """Sum of (a - b)^2 over at most BLOCK bytes."""
    total = np.int32(0)
    for i in range(len(a)):
        d = np.int32(np.int32(a[i]) - np.int32(b[i]))
        total = np.int32(total + np.int32(d * d))  # becomes pmaddwd
    return int(total)


@kernel
def _sums(
    queries: Bytes,
    database: Bytes,
    rows: Ints64,
    squared: bool,
    half: bool,
    tile: int,
    result: Ints64,
) -> None:
    """Add to result (Q, r)."""
    n = queries.shape[1]
    for group in range(0, len(rows), GROUP):
        for start in range(0, n, tile):
            for i in range(group, min(group + GROUP, len(rows))):
                stored = database[rows[i], start : start + tile]
                for q in range(min(i, len(queries)) if half else len(queries)):
                    asked = queries[q, start : start + tile]
                    total = 0
                    for low in range(0, len(stored), BLOCK):
                        # slices start at 0: a loop from `low` would not be vectorised
                        a, b = asked[low : low + BLOCK], stored[low : low + BLOCK]
                        total += _squares(a, b) if squared else _absolute(a, b)
                    result[q, i] += total


#: "l1": the paper's, sum |x - y|; "l2": squared Euclidean, sum (x - y)^2, an integer as well.
Metric = Literal["l1", "l2"]

#: A ranking takes this share of a map, and no fewer and no more than these.
RANKING_SHARE, SMALLEST_RANKING, LARGEST_RANKING = 0.4, 50, 200


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


#: As `geometry.retrieval` gives them, or any others.
Distances = Floats | NDArray[np.int64]

#: Variance given the selection below which a candidate is a duplicate of one that is in it.
DUPLICATE = 1e-9


@dataclass(frozen=True)
class DiversityParameters:
    """The scales of Eq. (3), as multiples of what the ranking itself spans."""

    sigma: float = 1.0  #: of the median distance within the ranking
    omega: float = 4.0  #: of the span from its nearest to its farthest


@dataclass(frozen=True, eq=False)
class Selection:
    """C of Sec. III-D, in the order of the ranking.

    Parameters
    ----------
    indices : (k,) positions in the ranking, rising; the first is always 0
    gains : (k,) variance given those taken before it, in (0, 1]: 1 for the first, near 0 for one
        much like another; what diversity each brought
    """

    indices: NDArray[np.intp]
    gains: Floats


def kernel_matrix(to_query: Distances, among: Distances, sigma: float, omega: float) -> Floats:
    """The kernel L of the determinantal point process: Eq. (3), Sec. III-D.

    Parameters
    ----------
    to_query : (R,) distances to the query
    among : (R, R) distances within the ranking
    sigma, omega : positive, in units of distance

    Returns
    -------
    L : (R, R) symmetric, positive semi-definite

    Notes
    -----
    Reading R6 (docs/paper.md): kappa scales every determinant of size k alike; it is 1.
    """
    rho = np.exp(-0.5 * to_query / omega)
    kernel: Floats = rho[:, None] * rho[None, :] * np.exp(-among / sigma)  # Eq. (3)
    return kernel


def diversify(
    to_query: Distances, among: Distances, k: int, p: DiversityParameters | None = None
) -> Selection:
    """Select up to `k` of a ranking by greedy maximisation of det L_C: Sec. III-D.

    Parameters
    ----------
    to_query : (R,) distances to the query, rising: the ranking
    among : (R, R) distances within the ranking
    k : how many to select

    Returns
    -------
    selection : the top-ranked first, then in the order of the ranking; fewer than `k` where the
        rest are duplicates

    Raises
    ------
    ValueError : the shapes disagree, the ranking is not rising, a distance is not finite, or k is
        below 1.
    """
    p = p or DiversityParameters()
    n = len(to_query)
    to_query, among = np.asarray(to_query, np.float64), np.asarray(among, np.float64)
    finite = np.isfinite(to_query).all() and np.isfinite(among).all()
    shapes = to_query.shape == (n,) and among.shape == (n, n)
    if not (shapes and finite and k >= 1) or (np.diff(to_query) < 0).any():
        raise ValueError(f"k = {k}, distances {to_query.shape} (rising) and {among.shape}")
    if n == 0:
        return Selection(np.empty(0, np.intp), np.empty(0))
    sigma = _sigma(among, p)
    omega = p.omega * float(to_query[-1] - to_query[0])
    quality = _log_quality(to_query, omega)
    taken, gains = greedy(quality, similar(among, sigma).__getitem__, min(k, n))
    order = np.argsort(taken)
    return Selection(taken[order], gains[order])


def remaining(
    among: Distances, taken: NDArray[np.intp], p: DiversityParameters | None = None
) -> Floats:
    """What diversity each of a ranking would still bring to a selection of it.

    Parameters
    ----------
    among : (R, R) distances within the ranking
    taken : (k,) positions of the selection
    p : that it was selected with

    Returns
    -------
    gains : (R,) variance given all that were taken, in [0, 1]; 0 for those themselves
    """
    among = np.asarray(among, np.float64)
    similarity = similar(among, _sigma(among, p or DiversityParameters()))
    known = similarity[taken]
    explained = np.einsum("kr,kr->r", known, np.linalg.solve(known[:, taken], known))
    gains: Floats = np.clip(1.0 - explained, 0.0, 1.0)
    gains[taken] = 0.0
    return gains


def _sigma(among: Floats, p: DiversityParameters) -> float:
    upper = among[np.triu_indices(len(among), 1)]
    return p.sigma * float(np.median(upper)) if upper.size else 0.0


def _log_quality(to_query: Floats, omega: float) -> Floats:
    """log rho^2 up to a constant, which no choice depends on."""
    if omega <= 0:  # all equally near, or quality left out: only diversity decides
        return np.zeros(len(to_query))
    quality: Floats = (to_query[0] - to_query) / omega
    return quality


def similar(distances: Floats, sigma: float) -> Floats:
    """The kernel of Eq. (3) without its quality: exp(-d / sigma).

    Where half of all pairs are duplicates sigma is 0: what is not a duplicate is then unlike.
    """
    likeness: Floats = np.exp(-distances / sigma) if sigma > 0 else (distances <= 0).astype(float)
    return likeness


def greedy(
    log_quality: Floats, similarity_of: Callable[[int], Floats], k: int
) -> tuple[NDArray[np.intp], Floats]:
    """Greedy maximisation of det L_C: Sec. III-D.

    The Cholesky factor of the similarities grows by one row for each one taken, so that only
    their similarities are ever asked for.

    Parameters
    ----------
    log_quality : (n,) log rho^2, up to a constant
    similarity_of : (n,) similarities of one to all, of its index
    k : how many to take, at most n

    Returns
    -------
    taken : (up to k,) indices in the order in which they were taken, ties by index; fewer where
        the rest are duplicates
    gains : see Selection; in the same order
    """
    n = len(log_quality)
    factor = np.zeros((k, n))
    variance = np.ones(n)
    taken: list[int] = []
    gains: list[float] = []
    open_ = np.ones(n, np.bool_)
    while len(taken) < k:
        value = np.where(
            open_ & (variance > DUPLICATE),
            log_quality + np.log(np.maximum(variance, 1e-300)),
            -np.inf,
        )
        best = int(np.argmax(value))
        if not np.isfinite(value[best]):
            break
        known = factor[: len(taken)]
        row = (similarity_of(best) - known[:, best] @ known) / np.sqrt(variance[best])
        gains.append(float(variance[best]))
        factor[len(taken)] = row
        variance = variance - row**2
        open_[best] = False
        taken.append(best)
    return np.array(taken, np.intp), np.array(gains)
