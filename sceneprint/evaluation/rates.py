"""How sure a counted rate is, and how well one number tells right from wrong.

counts  --upper_bound-->  rate        scores, labels  --roc-->  Roc
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.types import Floats

#: Of the bound on a rate.
CONFIDENCE = 0.95
#: Points of a curve that are kept.
CURVE = 200


def upper_bound(seen: int, of: int, confidence: float = CONFIDENCE) -> float | None:
    """The rate above which so few would be seen with less than 1 - `confidence`.

    One-sided Clopper-Pearson. Of none seen it is 1 - (1 - confidence)^(1 / of), which for 95 % is
    about 3 / of: the rule of three. It holds for independent tries; pairs that share frames are
    not, and say less.

    Parameters
    ----------
    seen, of : 0 <= seen <= of
    confidence : between 0 and 1

    Returns
    -------
    rate : None where nothing was tried
    """
    if not 0 <= seen <= of or not 0 < confidence < 1:
        raise ValueError(f"{seen} of {of} at {confidence} is no rate")
    if of == 0:
        return None
    low, high = seen / of, 1.0
    while (middle := (low + high) / 2) not in (low, high):  # until no number lies between
        low, high = (middle, high) if _at_most(seen, of, middle) > 1 - confidence else (low, middle)
    return high


def _at_most(seen: int, of: int, rate: float) -> float:
    """Chance of at most `seen` hits in `of` independent tries."""
    if rate in (0.0, 1.0):
        return float(rate == 0 or seen == of)
    hit, miss = math.log(rate), math.log1p(-rate)
    ways = math.lgamma(of + 1)
    return math.fsum(
        math.exp(ways - math.lgamma(k + 1) - math.lgamma(of - k + 1) + k * hit + (of - k) * miss)
        for k in range(seen + 1)
    )


@dataclass(frozen=True, eq=False)
class Roc:
    """Right and wrong ones that pass, as the least score that is asked for falls.

    Parameters
    ----------
    area : under the curve: the chance that a right one scores higher than a wrong one, ties half
    false, true : (n,) share of the wrong and of the right ones that pass, from 0 to 1
    thresholds : (n,) least score; infinite at first
    """

    area: float
    false: Floats
    true: Floats
    thresholds: Floats

    def true_at(self, false: float) -> float:
        """The most right ones that pass while no more than this share of the wrong ones does."""
        return float(self.true[self.false <= false].max())

    def thinned(self, most: int = CURVE) -> list[list[float]]:
        """At most so many points (false, true, threshold), the ends among them."""
        n = len(self.true)
        kept = np.arange(n)
        if n > most:
            kept = self._kept(most)
        columns = zip(self.false[kept], self.true[kept], self.thresholds[kept], strict=True)
        return [[float(one) for one in row] for row in columns]

    def _kept(self, most: int) -> NDArray[np.intp]:
        n = len(self.true)
        # evenly along both shares, so that neither end of the curve is lost
        at = np.linspace(0, 2, most - 1)
        return np.unique(np.append(np.searchsorted(self.false + self.true, at).clip(0, n - 1), 0))


def roc(scores: Floats, right: NDArray[np.bool_]) -> Roc | None:
    """The curve of one number that should be high for right ones.

    Parameters
    ----------
    scores : (n,), -infinity where there is nothing to be said for it
    right : (n,)

    Returns
    -------
    curve : None where all are right, or none
    """
    n_right, n_wrong = int(right.sum()), int((~right).sum())
    if not n_right or not n_wrong:
        return None
    values, place = np.unique(-scores, return_inverse=True)  # highest first, equal ones together
    good = np.bincount(place[right], minlength=len(values)).cumsum()
    bad = np.bincount(place[~right], minlength=len(values)).cumsum()
    true = np.concatenate([[0], good]) / n_right
    false = np.concatenate([[0], bad]) / n_wrong
    area = float(((true[1:] + true[:-1]) / 2 * np.diff(false)).sum())
    return Roc(area, false, true, np.concatenate([[np.inf], -values]))
