"""More signatures than anybody has signed, with the neighbourhoods of those that were.

Two ways in which a map grows, neither of them real, one on either side of what is:

* *places*: as many new places as wished. A new building is the map mirrored: along each of its
  principal axes a coin decides whether all frames change sides, and what the axes leave over
  changes its sign byte by byte. A mirror keeps the Euclidean distances within a building, and the
  spread along every axis that a code could use; two buildings are as unrelated as two rooms.
* *visits*: the same places more often. Between two frames that follow each other lie others: on
  the line between them, and off it by a share of the step of another pair of the same run, so
  that the squared distance grows evenly with time, as it does among real frames.

Neither draws from the test queries.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.index import fit_code
from sceneprint.types import Bytes, Floats32

#: Axes along which a mirror decides as a whole; the rest is decided byte by byte.
AXES = 512
#: Numbers that are worked on at once, as floats.
_NUMBERS = 8 << 20


@dataclass(frozen=True, eq=False)
class Mirror:
    """What of a map makes another building of it.

    Parameters
    ----------
    mean : (D,)
    axes : (d, D) orthonormal rows
    """

    mean: Floats32
    axes: Floats32

    def building(self, signatures: Bytes, number: int) -> Bytes:
        """The signatures (n, D) as seen in building `number`; number 0 is what was measured."""
        if number == 0:
            return signatures
        rng = np.random.default_rng((29, number))
        sides = rng.choice(np.array([-1, 1], np.float32), len(self.axes))
        signs = rng.choice(np.array([-1, 1], np.float32), len(self.mean))
        away = signatures.astype(np.float32) - self.mean
        along = away @ self.axes.T
        rest = away - along @ self.axes
        return _bytes(self.mean + (along * sides) @ self.axes + rest * signs)


def fit_mirror(signatures: Bytes) -> Mirror:
    """The mean and principal axes of a map (n, D)."""
    code = fit_code(signatures, seed=17, dimension=AXES)
    return Mirror(code.mean, code.matrix)


def places(signatures: Bytes, mirror: Mirror, total: int) -> Iterator[Bytes]:
    """The map, building after building until there are `total` frames; in blocks."""
    made, step = 0, _rows(signatures)
    for number in range(-(-total // len(signatures))):
        for start in range(0, len(signatures), step):
            block = signatures[start : start + step][: total - made]
            if len(block):
                yield mirror.building(block, number)
                made += len(block)


def visits(signatures: Bytes, runs: NDArray[np.int64], total: int) -> Iterator[Bytes]:
    """The map, and frames between its frames until there are `total`; in blocks.

    Parameters
    ----------
    signatures : (n, D) in the order in which they were taken
    runs : (n,) which frames follow each other: those of one number that are neighbours
    total : of frames
    """
    rng, step = np.random.default_rng(31), _rows(signatures)
    firsts = np.flatnonzero(runs[1:] == runs[:-1])
    for start in range(0, min(len(signatures), total), step):
        yield signatures[start : min(start + step, total)]
    rest = max(total - len(signatures), 0)
    if rest and len(firsts) == 0:
        raise ValueError("no frames follow each other, so that none lie between")
    for start in range(0, rest, step):
        count = min(step, rest - start)
        first = firsts[(start + np.arange(count)) % len(firsts)]
        yield _between(signatures, first, _others(first, runs, firsts, rng), rng)


def _others(
    first: NDArray[np.int64],
    runs: NDArray[np.int64],
    firsts: NDArray[np.int64],
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """For each pair another one of the same run."""
    at = (
        np.searchsorted(runs[firsts], runs[first]),
        np.searchsorted(runs[firsts], runs[first], side="right"),
    )
    chosen: NDArray[np.int64] = firsts[rng.integers(at[0], at[1])]
    return chosen


def _between(
    signatures: Bytes, first: NDArray[np.int64], other: NDArray[np.int64], rng: np.random.Generator
) -> Bytes:
    """One frame between each of `first` and its successor: a step of a random bridge."""
    share = rng.uniform(0, 1, (len(first), 1)).astype(np.float32)
    side = rng.choice(np.array([-1, 1], np.float32), (len(first), 1))
    a, b, c, d = (
        signatures[rows].astype(np.float32) for rows in (first, first + 1, other, other + 1)
    )
    return _bytes(a + share * (b - a) + side * np.sqrt(share * (1 - share)) * (d - c))


def _rows(signatures: Bytes) -> int:
    return max(_NUMBERS // int(signatures.shape[1]), 1)


def _bytes(values: Floats32) -> Bytes:
    result: Bytes = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return result
