"""What the first match of an answer is worth, beside R's nearest: VR of `benchmarks.lidar`.

A query of the service is not answered with the nearest signature, but with the first candidate
that validation accepts, strong before weak; with the nearest where it accepts none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from sceneprint.geometry.retrieval import Ranking
from sceneprint.geometry.validation import Validation, ValidationParameters
from sceneprint.matches import associate
from sceneprint.types import Floats, Geometry

#: As the service has by default: candidates of a query, and accepted ones after which it stops.
CANDIDATES, K = 10, 5


@dataclass(frozen=True)
class Answered:
    """Queries that have a right answer, by what the first match of theirs is."""

    queries: int
    right: int  #: the first match is within reach, believed or not
    found: int  #: queries of which a match is accepted
    found_right: int  #: of these, those whose first match is within reach
    placed: int  #: of these, those whose transform odometry confirms


def first_answers(
    geometries: Sequence[Geometry],
    rows: Floats,
    near: NDArray[np.bool_],
    allowed: NDArray[np.bool_],
    p: ValidationParameters,
    confirmed: Callable[[int, int, Validation], bool],
) -> Answered:
    """Answer every query that has a right answer.

    Parameters
    ----------
    geometries : n scans
    rows : (n, n) distances of signatures
    near : (n, n) whether the second would be a right answer to the first
    allowed : (n, n) whether the second is in the database of the first
    p : of the model
    confirmed : of query, match and what was said of them, whether the transform is right
    """
    asked = [int(i) for i in np.flatnonzero((near & allowed).any(axis=1))]
    right, found, placed = (np.zeros(len(asked), bool) for _ in range(3))
    for row, i in enumerate(tqdm(asked, desc="answer", unit="query", disable=None)):
        far = np.where(allowed[i], rows[i], np.inf)
        ranked = np.argsort(far, kind="stable")[: int(allowed[i].sum())]
        ranking = Ranking(ranked, far[ranked].astype(np.int64), np.zeros(len(ranked)))
        among = range(min(CANDIDATES, len(ranked)))
        first = associate(geometries[i], ranking, among, geometries.__getitem__, K, p=p)[0]
        found[row] = first.validation.status == "accepted"
        right[row] = near[i, first.index]
        placed[row] = found[row] and confirmed(i, first.index, first.validation)
    counts = (int(one.sum()) for one in (right, found, right & found, placed))
    return Answered(len(asked), *counts)
