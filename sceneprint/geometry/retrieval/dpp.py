"""Sec. III-D, diversity: a ranking to a selection whose members differ from each other.

distances to the query (R,), among R (R, R)  --diversify-->  Selection (k of R)

The kernel is L_XY = rho_X rho_Y exp(s(X, Y) / sigma) with rho_X = exp(s(X, Q) / (2 omega)),
and s = -distance. The most probable set of k maximises det L_C; the greedy procedure takes,
again and again, the candidate that multiplies the determinant most. That factor is
rho_X^2 times the variance of X given those already taken, under exp(-D / sigma) alone: quality
and diversity part, and their logarithms neither overflow nor underflow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.types import Floats

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
    p : see DiversityParameters

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
    return _greedy(_log_quality(to_query, omega), among, sigma, min(k, n))


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


def _greedy(log_quality: Floats, among: Floats, sigma: float, k: int) -> Selection:
    similarity = similar(among, sigma)
    taken, gains = greedy(log_quality, similarity.__getitem__, k)
    order = np.argsort(taken)
    return Selection(taken[order], gains[order])


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


# Sec. III-D for a whole map: which of its frames say most, and which repeat another.
#
#     distances of one to all  --summarise-->  Summary: the k-DPP's choice among all frames
#     distances to those kept, among new ones  --novel-->  which of the new ones to keep
#
# The kernel is that of Eq. (3) without the quality term, as there is no query.

Ints64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Summary:
    """Frames that stand for all.

    Parameters
    ----------
    kept : (k,) indices, rising
    gains : (k,) variance given those taken before it, in (0, 1]
    nearest : (n,) index of the nearest that is kept, the first taken of equal ones; itself where
        it is kept
    distances : (n,) to that one
    """

    kept: NDArray[np.intp]
    gains: Floats
    nearest: NDArray[np.intp]
    distances: Floats


def summarise(distances_of: Callable[[int], Distances], n: int, k: int, sigma: float) -> Summary:
    """Select up to `k` of `n` by greedy maximisation of det L_C: Sec. III-D.

    The first is the first of all, as each is as good as any other to begin with. What follows
    depends on distances alone, and on no order, but where two bring exactly the same.

    Parameters
    ----------
    distances_of : (n,) distances of one to all, of its index; asked once for each that is kept
    n, k : how many there are, and how many to select
    sigma : scale of the kernel, in units of distance; 0 where only duplicates are alike

    Returns
    -------
    summary : fewer than `k` are kept where the rest are duplicates

    Raises
    ------
    ValueError : no items, k below 1, or a sigma that is negative or not finite.
    """
    if n < 1 or k < 1 or not 0 <= sigma < np.inf:
        raise ValueError(f"{k} of {n} with sigma {sigma}")
    nearest = np.zeros(n, np.intp)
    to_nearest = np.full(n, np.inf)

    def similarity_of(index: int) -> Floats:
        to_all = np.asarray(distances_of(index), np.float64)
        nearer = to_all < to_nearest
        nearest[nearer], to_nearest[nearer] = index, to_all[nearer]
        return similar(to_all, sigma)

    taken, gains = greedy(np.zeros(n), similarity_of, min(k, n))
    order = np.argsort(taken)
    return Summary(taken[order], gains[order], nearest, to_nearest)


def novel(to_kept: Ints64, among: Ints64, limit: float) -> tuple[NDArray[np.bool_], Ints64]:
    """Go through frames in their order, and keep what is farther than `limit` from all kept.

    Parameters
    ----------
    to_kept : (n,) distances to the nearest of those kept before these came
    among : (n, n) distances of these among each other
    limit : a distance; equal ones are not kept

    Returns
    -------
    kept : (n,) which to keep
    nearest : (n,) index among these of the nearest that was kept before each came, -1 where one
        kept earlier is as near
    """
    n = len(to_kept)
    kept = np.zeros(n, np.bool_)
    nearest, to_nearest = np.full(n, -1, np.int64), to_kept.copy()
    for i in range(n):
        if to_nearest[i] > limit:
            kept[i] = True
            nearer = among[i] < to_nearest
            nearer[: i + 1] = False  # those before it had their turn
            nearest[nearer], to_nearest[nearer] = i, among[i][nearer]
    return kept, nearest
