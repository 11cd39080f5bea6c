"""What the first match of an answer is worth, beside R's nearest: VR of `benchmarks.lidar`.

A query of the service is not answered with the nearest signature, but with the first candidate
that validation accepts, strong before weak; with the nearest where it accepts none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from sceneprint.geometry.validation import ValidationParameters
from sceneprint.pipeline import validate
from sceneprint.types import Floats, Geometry

CANDIDATES = 10  #: of a query, as the service has by default
_ORDER = {"strong": 0, "weak": 1}


@dataclass(frozen=True)
class Answered:
    """Queries that have a right answer, by what the first match of theirs is."""

    queries: int
    right: int  #: the first match is within reach, believed or not
    found: int  #: queries of which a match is accepted
    found_right: int  #: of these, those whose first match is within reach


def first_answers(
    geometries: Sequence[Geometry],
    rows: Floats,
    near: NDArray[np.bool_],
    allowed: NDArray[np.bool_],
    p: ValidationParameters,
) -> Answered:
    """Answer every query that has a right answer.

    Parameters
    ----------
    geometries : n scans
    rows : (n, n) distances of signatures
    near : (n, n) whether the second would be a right answer to the first
    allowed : (n, n) whether the second is in the database of the first
    p : of the model
    """
    asked = np.flatnonzero((near & allowed).any(axis=1))
    right, found = np.zeros(len(asked), bool), np.zeros(len(asked), bool)
    for row, i in enumerate(tqdm(asked, desc="answer", unit="query", disable=None)):
        ranked = np.argsort(np.where(allowed[i], rows[i], np.inf), kind="stable")[:CANDIDATES]
        tried = [int(j) for j in ranked if allowed[i, j]]
        said = [validate(geometries[i], geometries[j], p=p) for j in tried]
        order = [_ORDER[str(v.strength)] if v.status == "accepted" else len(_ORDER) for v in said]
        first = int(np.argmin(order))  # of equals the nearest
        found[row] = order[first] < len(_ORDER)
        right[row] = near[i, tried[first]]
    return Answered(len(asked), int(right.sum()), int(found.sum()), int((right & found).sum()))
