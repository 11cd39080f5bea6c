"""Times of many answers in a few numbers that can be added up: a histogram of fixed bounds.

Bin i holds what took from FIRST_S * STEP^i up to STEP times that. The bounds are the same in every
process, so that the histograms of several add to that of all, and a quantile of the sum is that
of all answers, but for the width of a bin: it is wrong by 9 % at most.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping

#: Lower bound of bin 0, seconds, and how much wider each bin reaches than the one before.
FIRST_S, STEP = 1e-4, 2.0**0.25
#: Bins: what takes longer than FIRST_S STEP^91, 12 minutes, is in the last one.
BINS = 92


def bin_of(seconds: float) -> int:
    """The bin of a time."""
    if seconds <= FIRST_S:
        return 0
    return min(int(math.log(seconds / FIRST_S, STEP)), BINS - 1)


def quantile(histogram: Mapping[int, int], share: float) -> float | None:
    """The time that this share of all answers did not take longer than.

    Parameters
    ----------
    histogram : number of answers in each bin that has any
    share : from 0 to 1

    Returns
    -------
    seconds, the geometric middle of the bin; None where there were no answers
    """
    total = sum(histogram.values())
    if total == 0:
        return None
    rank, seen = max(math.ceil(share * total), 1), 0
    for place in sorted(histogram):
        seen += histogram[place]
        if seen >= rank:
            return float(FIRST_S * STEP ** (place + 0.5))
    raise AssertionError("the ranks of all bins are their sum")


class Latencies:
    """A histogram that grows."""

    def __init__(self) -> None:
        self._bins: Counter[int] = Counter()

    def add(self, seconds: float) -> None:
        """Count an answer."""
        self._bins[bin_of(seconds)] += 1

    def as_json(self) -> dict[str, int]:
        """As it is stored."""
        return {str(place): number for place, number in sorted(self._bins.items())}


def merged(parts: list[Mapping[str, int]]) -> dict[int, int]:
    """Several stored histograms as one."""
    total: Counter[int] = Counter()
    for part in parts:
        for place, number in part.items():
            total[int(place)] += int(number)
    return dict(total)
