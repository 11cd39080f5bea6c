"""Ranking of stored signatures by distance, and diverse selection (Sec. III-C and III-D).

    query (n,), database (N, n) uint8  --distances-->  (N,)  --rank-->  Ranking: R of Sec. III-C
    distances to the query (R,), among R (R, R)  --diversify-->  Selection (k of R)

Tests compare all search indexes with these functions. Distances are exact integers; if two are
equal, the lower index comes first.

The kernel of Sec. III-D is L_XY = rho_X rho_Y exp(s(X, Y) / sigma) with rho_X = exp(s(X, Q) / (2
omega)) and s = -distance. The most probable set C of k members maximises det L_C; the greedy
algorithm repeatedly selects the candidate that increases the determinant by the largest factor.
This factor is rho_X^2 times the conditional variance of X given the selection under exp(-D /
sigma), so logarithms of quality and diversity neither overflow nor underflow.
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

#: Number of rows per tile of columns; maximum size of the tiles of all queries, in bytes, which
#: must fit into a core's cache; and minimum length of a tile, because short tiles need more calls.
GROUP, _CACHED, _SHORTEST = 16, 262144, 4096

#: Number of bytes that are summed in 32 bits: the largest power of 2 at which sums of squares fit.
BLOCK = 32768


def scan(
    queries: Bytes, database: Bytes, rows: Ints64, *, squared: bool = False, half: bool = False
) -> Ints64:
    """Sum |x - y| or (x - y)^2 over the bytes of each query and row; return (Q, r) int64.

    Parameters
    ----------
    queries : (Q, n) uint8, in C order
    database : (N, n) uint8, in C order
    rows : (r,) row indices of the database, not checked for validity
    squared : whether to sum squares
    half : whether to compute only entries (q, i) with q < i; all other entries are undefined
    """
    result = np.zeros((len(queries), len(rows)), np.int64)
    tile = max(_CACHED // max(len(queries), 1), _SHORTEST)
    _sum_tiles(
        read_only(queries), read_only(database), read_only(rows), squared, half, tile, result
    )
    return result


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Return a read-only view, so that mapped files and other arrays use the same machine code."""
    view = array.view()
    view.flags.writeable = False
    return view


@kernel
def _sum_absolute(a: Bytes, b: Bytes) -> int:
    """Return the sum of |a - b| over at most BLOCK bytes."""
    total = np.int32(0)
    for i in range(len(a)):
        # compiles to one instruction only if a 32-bit magnitude is added to a 32-bit sum
        d = np.int32(np.int32(a[i]) - np.int32(b[i]))
        total = np.int32(total + abs(d))
    return int(total)


@kernel
def _sum_squares(a: Bytes, b: Bytes) -> int:
    """Return the sum of (a - b)^2 over at most BLOCK bytes."""
    total = np.int32(0)
    for i in range(len(a)):
        d = np.int32(np.int32(a[i]) - np.int32(b[i]))
        total = np.int32(total + np.int32(d * d))  # compiles to pmaddwd
    return int(total)


@kernel
def _sum_tiles(
    queries: Bytes,
    database: Bytes,
    rows: Ints64,
    squared: bool,
    half: bool,
    tile: int,
    result: Ints64,
) -> None:
    n = queries.shape[1]
    for group in range(0, len(rows), GROUP):
        for start in range(0, n, tile):
            for i in range(group, min(group + GROUP, len(rows))):
                stored = database[rows[i], start : start + tile]
                for q in range(min(i, len(queries)) if half else len(queries)):
                    query = queries[q, start : start + tile]
                    total = 0
                    for low in range(0, len(stored), BLOCK):
                        # slices, because a loop that starts at `low` is not vectorized
                        a, b = query[low : low + BLOCK], stored[low : low + BLOCK]
                        total += _sum_squares(a, b) if squared else _sum_absolute(a, b)
                    result[q, i] += total


#: "l1": sum of |x - y|, as in the paper; "l2": squared Euclidean distance, sum of (x - y)^2.
Metric = Literal["l1", "l2"]

#: Size of a ranking: share of the map's frames, and minimum and maximum number of frames.
RANKING_SHARE, SMALLEST_RANKING, LARGEST_RANKING = 0.4, 50, 200


def distances(query: Bytes, database: Bytes, metric: Metric, rows: Ints64 | None = None) -> Ints64:
    """Return the distances -s(X, Y) from a signature to others: Sec. III-C.

    Parameters
    ----------
    query : (n,) uint8
    database : (N, n) uint8
    metric : "l1", as in the paper, or "l2", squared Euclidean
    rows : (r,) indices of the compared rows; None selects all rows

    Returns
    -------
    (N,) or (r,) int64, exact, in steps of a byte, or in squared steps for "l2"

    Raises
    ------
    ValueError : If the lengths differ, the arrays are not uint8, or the metric or a row does not
        exist
    """
    if query.ndim != 1:
        raise ValueError(f"The query has shape {query.shape}. Pass the bytes of one signature.")
    _require_signatures(query[None], database, metric)
    if rows is not None:
        if rows.ndim != 1 or rows.dtype.kind not in "iu":
            raise ValueError(
                f"The rows have type {rows.dtype}, shape {rows.shape}. Pass integer indices (r,)."
            )
        if len(rows) and not 0 <= rows.min() <= rows.max() < len(database):
            raise ValueError(
                f"Rows {rows.min()} to {rows.max()} do not all exist: the database has "
                f"{len(database)} rows."
            )
    result: Ints64 = _distances(query[None], database, metric, rows)[0]
    return result


@dataclass(frozen=True, eq=False)
class Ranking:
    """The ranking R of Sec. III-C: nearest first, ties by index.

    Parameters
    ----------
    indices : (r,) rows of the database
    distances : (r,) int64, ascending
    similarities : (r,) in [0, 1], descending; see `similarity`
    """

    indices: NDArray[np.intp]
    distances: Ints64
    similarities: Floats

    def __len__(self) -> int:
        return len(self.indices)


def cross_distances(queries: Bytes, database: Bytes, metric: Metric) -> Ints64:
    """Return the distances -s(X, Y) between two sets of signatures, (Q, N) int64: Sec. III-C.

    The database is read once for all queries that fit into the cache.

    Parameters
    ----------
    queries : (Q, n) uint8
    database : (N, n) uint8
    metric : see `distances`

    Raises
    ------
    ValueError : See `distances`
    """
    _require_signatures(queries, database, metric)
    return _distances(queries, database, metric)


def pairwise_distances(signatures: Bytes, metric: Metric) -> Ints64:
    """Return the distances between all signatures of a set: Sec. III-C.

    Parameters
    ----------
    signatures : (R, n) uint8
    metric : see `distances`

    Returns
    -------
    (R, R) int64, symmetric, 0 on the diagonal

    Raises
    ------
    ValueError : See `distances`
    """
    _require_signatures(signatures, signatures, metric)
    above = np.triu(_distances(signatures, signatures, metric, half=True), 1)
    return above + above.T


def _require_signatures(queries: Bytes, database: Bytes, metric: Metric) -> None:
    if queries.ndim != 2 or database.ndim != 2 or queries.shape[1] != database.shape[1]:
        raise ValueError(
            f"The signatures have {queries.shape[1:]} and {database.shape[1:]} bytes. "
            "Compare signatures of one model only."
        )
    if queries.dtype != np.uint8 or database.dtype != np.uint8:
        raise ValueError(
            f"The signatures have the types {queries.dtype} and {database.dtype}. "
            "Pass uint8 arrays."
        )
    if metric not in get_args(Metric):
        raise ValueError(f"The metric {metric!r} does not exist. Pass one of {get_args(Metric)}.")


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
    """Return 1 - d / d0, at least 0: 1 for equal and 0 for unrelated signatures (Sec. III-C).

    Parameters
    ----------
    distances : (...) distances in one metric
    unrelated_distance : d0, the model's median distance of unrelated frames, in the same metric

    Raises
    ------
    ValueError : If d0 is not positive and finite
    """
    if not (unrelated_distance > 0 and math.isfinite(unrelated_distance)):
        raise ValueError(
            f"The distance of unrelated frames is {unrelated_distance}. Pass a positive number."
        )
    shares: Floats = np.clip(1.0 - np.asarray(distances, np.float64) / unrelated_distance, 0.0, 1.0)
    return shares


def distance_share(distances: Ints64, unrelated_distance: float, metric: Metric) -> Floats:
    """Return distances as shares of d0; for squared distances, the square roots of these shares.

    Parameters
    ----------
    distances : (...) distances in `metric`
    unrelated_distance : d0; see `similarity`
    metric : see `distances`

    Returns
    -------
    (...) 0 for equal signatures, about 1 for unrelated signatures
    """
    shares: Floats = np.asarray(distances, np.float64) / unrelated_distance
    return shares if metric == "l1" else np.sqrt(shares)


def rank(distances: Ints64, size: int, unrelated_distance: float) -> Ranking:
    """Rank the `size` nearest rows of a database, ties by index: R of Sec. III-C.

    Parameters
    ----------
    distances : (N,) integer distances to all rows of the database
    size : maximum size of the ranking
    unrelated_distance : see `similarity`

    Raises
    ------
    ValueError : If the distances are not (N,) integers, the size is negative, or d0 is invalid
    """
    if distances.ndim != 1 or distances.dtype.kind not in "iu" or size < 0:
        raise ValueError(
            f"Cannot rank {size} of the {distances.shape} distances of type {distances.dtype}. "
            "Pass integers (N,) and a non-negative size."
        )
    size = min(size, len(distances))
    if size == 0:
        chosen = np.empty(0, np.intp)
    else:
        cut = np.partition(distances, size - 1)[size - 1]
        nearer, at_cut = np.flatnonzero(distances < cut), np.flatnonzero(distances == cut)
        chosen = np.concatenate([nearer, at_cut[: size - len(nearer)]])
        # a stable sort of ascending indices resolves ties by index
        chosen = chosen[np.argsort(distances[chosen], kind="stable")]
    ranked = distances[chosen].astype(np.int64)
    return Ranking(chosen, ranked, similarity(ranked, unrelated_distance))


def ranking_size(n_map: int) -> int:
    """Return |R| for a map of `n_map` frames: 40 % of them, but at least 50 and at most 200.

    In a dense map, a fixed number of ranks would contain only near-duplicates and allow no diverse
    selection: among the nearest 50 of 300 frames of a room, diversification increased the observed
    volume by 10 %, and among the nearest 125 by 27 % (Sec. III-D). The upper limit bounds the cost
    of pairwise distances; larger maps have more places, not more views of each place.

    Raises
    ------
    ValueError : If the number is negative
    """
    if n_map < 0:
        raise ValueError(f"A map cannot have {n_map} frames. Pass 0 or more.")
    size = min(max(round(RANKING_SHARE * n_map), SMALLEST_RANKING), LARGEST_RANKING)
    return min(size, n_map)


#: Distances: exact, as this module computes them, or in floating point.
Distances = Floats | NDArray[np.int64]

#: A candidate with a smaller conditional variance is a duplicate of a selected member.
DUPLICATE = 1e-9


@dataclass(frozen=True)
class DiversityParameters:
    """The scales of Eq. (3), relative to the ranking."""

    sigma: float = 1.0  #: multiple of the median distance within the ranking
    omega: float = 4.0  #: multiple of the range of distances to the query in the ranking


@dataclass(frozen=True, eq=False)
class Selection:
    """The selection C of Sec. III-D, in the order of the ranking.

    Parameters
    ----------
    indices : (k,) ascending positions in the ranking, always including 0
    gains : (k,) diversity added by each member: its variance given the previously selected members,
        in (0, 1]
    """

    indices: NDArray[np.intp]
    gains: Floats


def kernel_matrix(to_query: Distances, among: Distances, sigma: float, omega: float) -> Floats:
    """Return the kernel L of the determinantal point process: Eq. (3), Sec. III-D.

    Parameters
    ----------
    to_query : (R,) distances to the query
    among : (R, R) distances within the ranking
    sigma, omega : positive scales, in units of distance

    Returns
    -------
    L : (R, R) symmetric, positive semi-definite

    Notes
    -----
    Reading R6 (docs/paper.md): kappa scales all determinants of size k equally; it is 1 here.
    """
    rho = np.exp(-0.5 * to_query / omega)
    kernel: Floats = rho[:, None] * rho[None, :] * np.exp(-among / sigma)  # Eq. (3)
    return kernel


def diversify(
    to_query: Distances, among: Distances, k: int, p: DiversityParameters | None = None
) -> Selection:
    """Select up to `k` members of a ranking by greedily maximising det L_C (Sec. III-D).

    Parameters
    ----------
    to_query : (R,) distances to the query, in the ascending order of the ranking
    among : (R, R) distances within the ranking
    k : maximum size of the selection

    Returns
    -------
    selection : selected members; fewer than `k` if all remaining members are duplicates

    Raises
    ------
    ValueError : If the shapes disagree, the distances are not ascending or not finite, or k is
        below 1
    """
    p = p or DiversityParameters()
    n = len(to_query)
    to_query, among = np.asarray(to_query, np.float64), np.asarray(among, np.float64)
    finite = np.isfinite(to_query).all() and np.isfinite(among).all()
    shapes = to_query.shape == (n,) and among.shape == (n, n)
    if not (shapes and finite and k >= 1) or (np.diff(to_query) < 0).any():
        raise ValueError(
            f"Cannot select {k} members by distances of shapes {to_query.shape} and {among.shape}. "
            "Pass finite distances, (R,) in ascending order and (R, R), and k of at least 1."
        )
    if n == 0:
        return Selection(np.empty(0, np.intp), np.empty(0))
    sigma = _scale_of(among, p)
    omega = p.omega * float(to_query[-1] - to_query[0])
    quality = _log_quality(to_query, omega)
    chosen, gains = select_greedily(quality, similarity_kernel(among, sigma).__getitem__, min(k, n))
    order = np.argsort(chosen)
    return Selection(chosen[order], gains[order])


def remaining_gains(
    among: Distances, selected: NDArray[np.intp], p: DiversityParameters | None = None
) -> Floats:
    """Return the diversity that each member of a ranking would add to a selection.

    Parameters
    ----------
    among : (R, R) distances within the ranking
    selected : (k,) positions of the selection
    p : parameters of the selection

    Returns
    -------
    gains : (R,) conditional variance given the selection, in [0, 1]; 0 for selected members
    """
    among = np.asarray(among, np.float64)
    similarity = similarity_kernel(among, _scale_of(among, p or DiversityParameters()))
    rows = similarity[selected]
    explained = np.einsum("kr,kr->r", rows, np.linalg.solve(rows[:, selected], rows))
    gains: Floats = np.clip(1.0 - explained, 0.0, 1.0)
    gains[selected] = 0.0
    return gains


def _scale_of(among: Floats, p: DiversityParameters) -> float:
    upper = among[np.triu_indices(len(among), 1)]
    return p.sigma * float(np.median(upper)) if upper.size else 0.0


def _log_quality(to_query: Floats, omega: float) -> Floats:
    """Return log rho^2 up to a constant; the constant does not affect the selection."""
    if omega <= 0:  # with equal distances, or if quality is disabled, only diversity decides
        return np.zeros(len(to_query))
    quality: Floats = (to_query[0] - to_query) / omega
    return quality


def similarity_kernel(distances: Floats, sigma: float) -> Floats:
    """Return the kernel of Eq. (3) without the quality factors: exp(-d / sigma).

    If half of all pairs are duplicates, sigma is 0, and other pairs have the similarity 0.
    """
    likeness: Floats = np.exp(-distances / sigma) if sigma > 0 else (distances <= 0).astype(float)
    return likeness


def select_greedily(
    log_quality: Floats, similarity_of: Callable[[int], Floats], k: int
) -> tuple[NDArray[np.intp], Floats]:
    """Maximise det L_C greedily: Sec. III-D.

    The Cholesky factor of the similarities grows by one row per selected item, so only the rows of
    selected items are computed.

    Parameters
    ----------
    log_quality : (n,) log rho^2, up to a constant
    similarity_of : function that maps an item's index to its similarities (n,) to all items
    k : number of items to select, at most n

    Returns
    -------
    chosen : (m,) indices in the order of selection, ties by index; m is below k if all remaining
        items are duplicates
    gains : (m,) gains in the order of selection; see Selection
    """
    n = len(log_quality)
    factor = np.zeros((k, n))
    variance = np.ones(n)
    chosen: list[int] = []
    gains: list[float] = []
    open_ = np.ones(n, np.bool_)
    while len(chosen) < k:
        value = np.where(
            open_ & (variance > DUPLICATE),
            log_quality + np.log(np.maximum(variance, 1e-300)),
            -np.inf,
        )
        best = int(np.argmax(value))
        if not np.isfinite(value[best]):
            break
        rows = factor[: len(chosen)]
        row = (similarity_of(best) - rows[:, best] @ rows) / np.sqrt(variance[best])
        gains.append(float(variance[best]))
        factor[len(chosen)] = row
        variance = variance - row**2
        open_[best] = False
        chosen.append(best)
    return np.array(chosen, np.intp), np.array(gains)
