"""Fitting of the confidence parameters to answers at synthetic sites.

answers at sites  --judged_queries-->  JudgedQuery, ...  --fit-->  ConfidenceParameters
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from sceneprint.geometry.validation.confidence import (
    KNOTS,
    ConfidenceParameters,
    Penalty,
    PlaceEvidence,
)
from sceneprint.types import Floats
from sceneprint_lab.evaluation.sites import SiteAnswer


@dataclass(frozen=True)
class JudgedQuery:
    """A query, with its candidate poses.

    Parameters
    ----------
    site, kind, query : name and kind of the site, and index of the query
    right : whether each pose is right
    """

    site: str
    kind: str
    query: int
    evidence: tuple[PlaceEvidence, ...]
    right: tuple[bool, ...]


def judged_queries(answers: Iterable[SiteAnswer]) -> list[JudgedQuery]:
    """Return the candidate poses of answers from `ask_site`; skip answers without candidates."""
    return [
        JudgedQuery(
            query.site, query.kind, query.query,
            tuple(place.evidence for place in query.answer.places),
            tuple(place.right for place in query.answer.places),
        )
        for query in answers
        if query.answer.places
    ]  # fmt: skip


def steps_of(evidence: Sequence[PlaceEvidence]) -> Floats:
    """Return the positions (n, 3 kinds) of evidence in the intervals between each kind's knots.

    In each interval, the position increases from 0 to 1 as the evidence becomes worse. The penalty
    of a kind is the sum of step times position over its intervals, so it never decreases if no step
    is negative.
    """
    columns = []
    for name, (worst, poor, fair, best) in KNOTS.items():
        x = np.array([getattr(item, name) for item in evidence], float)
        for upper, lower in ((best, fair), (fair, poor), (poor, worst)):
            columns.append(np.clip((upper - x) / (upper - lower), 0.0, 1.0))
    return np.stack(columns, axis=1)


#: Step of a penalty over an interval that contains no samples.
USUAL_STEP = 0.3


def fit(
    samples: Sequence[JudgedQuery], shares: Mapping[str, float], ridge: float = 1e-5
) -> ConfidenceParameters:
    """Fit a conditional logistic model with penalties that never decrease with worse evidence.

    Parameters
    ----------
    samples : queries with their candidate poses
    shares : share of queries at each kind of place; confidences are probabilities for this mixture,
        however many samples there are of each kind
    ridge : weight of the squared differences between the steps and `USUAL_STEP`

    Returns
    -------
    parameters : parameters with the minimum weighted mean logarithmic loss
    """
    X = steps_of([e for sample in samples for e in sample.evidence])
    right = np.array([y for sample in samples for y in sample.right], bool)
    counts = np.array([len(sample.evidence) for sample in samples])
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    none = ~np.logical_or.reduceat(right, first)
    kinds = Counter(sample.kind for sample in samples)
    w = np.array([shares[sample.kind] / kinds[sample.kind] for sample in samples])
    w /= w.sum()

    def loss(theta: Floats) -> tuple[float, Floats]:
        off = theta[1:] - USUAL_STEP
        odds = np.exp(np.clip(theta[0] - X @ theta[1:], -50.0, 50.0))
        whole = 1.0 + np.add.reduceat(odds, first)
        good = np.where(none, 1.0, np.add.reduceat(np.where(right, odds, 0.0), first))
        value = w @ np.log(whole / good) + ridge * (off @ off)
        # derivative by each logit: its share of all odds, minus its share of the odds of right
        # poses
        residuals = odds / np.repeat(whole, counts)
        residuals -= np.where(right, odds / np.repeat(good, counts), 0.0)
        residuals *= np.repeat(w, counts)
        slope = np.concatenate([[residuals.sum()], -X.T @ residuals + 2.0 * ridge * off])
        return float(value), slope

    bounds = [(None, None), *[(0.0, None)] * X.shape[1]]
    result = minimize(
        loss, np.full(1 + X.shape[1], 0.5), jac=True, bounds=bounds, method="L-BFGS-B",
        options={"maxiter": 2000},
    )  # fmt: skip
    curves = {
        name: Penalty(*(round(float(x), 3) for x in np.cumsum(three)[::-1]))
        for name, three in zip(KNOTS, result.x[1:].reshape(-1, 3), strict=True)
    }
    return ConfidenceParameters(best=round(float(result.x[0]), 3), **curves)
