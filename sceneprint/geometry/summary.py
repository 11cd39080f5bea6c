"""Sec. III-D for a whole map: which of its frames say most, and which repeat another.

    distances of one to all  --summarise-->  Summary: the k-DPP's choice among all frames
    distances to those kept, among new ones  --novel-->  which of the new ones to keep

The kernel is that of Eq. (3) without the quality term, as there is no query.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.diversity import Distances, greedy, similar
from sceneprint.types import Floats

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
