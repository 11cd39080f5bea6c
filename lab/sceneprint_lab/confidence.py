"""The numbers that a confidence is computed with, learnt on synthetic sites.

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
    """A query with its candidate poses.

    Parameters
    ----------
    site, kind, query : where it was taken
    evidence : for each pose
    right : which poses are right
    """

    site: str
    kind: str
    query: int
    evidence: tuple[PlaceEvidence, ...]
    right: tuple[bool, ...]


def judged_queries(answers: Iterable[SiteAnswer]) -> list[JudgedQuery]:
    """Return the candidate poses of every answer that has any.

    Parameters
    ----------
    answers : of `ask_site`
    """
    return [
        JudgedQuery(
            one.site, one.kind, one.query,
            tuple(place.evidence for place in one.answer.places),
            tuple(place.right for place in one.answer.places),
        )
        for one in answers
        if one.answer.places
    ]  # fmt: skip


def steps_of(evidence: Sequence[PlaceEvidence]) -> Floats:
    """Return how far each evidence falls between its knots: (n, 3 kinds), from 0 to 1.

    The penalty of a kind is the sum of its three steps, each times how far the evidence fell
    within it; so a penalty rises wherever its steps are not negative.
    """
    columns = []
    for name, (worst, poor, fair, best) in KNOTS.items():
        x = np.array([getattr(one, name) for one in evidence], float)
        for upper, lower in ((best, fair), (fair, poor), (poor, worst)):
            columns.append(np.clip((upper - x) / (upper - lower), 0.0, 1.0))
    return np.stack(columns, axis=1)


#: Step of a penalty that the samples leave open: evidence that no site happens to test counts too.
USUAL_STEP = 0.3


def fit(
    samples: Sequence[JudgedQuery], shares: Mapping[str, float], ridge: float = 1e-5,
    lone: float = 0.0,
) -> ConfidenceParameters:  # fmt: skip
    """Fit a conditional logistic model whose penalties never fall with worse evidence.

    Parameters
    ----------
    samples : queries with their candidate poses
    shares : how often robots are at a place of each kind: a confidence is a probability among
        queries that are mixed so, whatever the numbers of samples
    ridge : weight of the squares by which steps differ from `USUAL_STEP`
    lone : least step of the penalty of a pose that one view alone suggests

    Returns
    -------
    parameters : of the least mean logarithmic loss
    """
    X = steps_of([e for one in samples for e in one.evidence])
    right = np.array([y for one in samples for y in one.right], bool)
    counts = np.array([len(one.evidence) for one in samples])
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    none = ~np.logical_or.reduceat(right, first)
    kinds = Counter(one.kind for one in samples)
    w = np.array([shares[one.kind] / kinds[one.kind] for one in samples])
    w /= w.sum()

    def loss(theta: Floats) -> tuple[float, Floats]:
        off = theta[1:] - USUAL_STEP
        odds = np.exp(np.clip(theta[0] - X @ theta[1:], -50.0, 50.0))
        whole = 1.0 + np.add.reduceat(odds, first)
        good = np.where(none, 1.0, np.add.reduceat(np.where(right, odds, 0.0), first))
        value = w @ np.log(whole / good) + ridge * (off @ off)
        # by each logit: what the pose has of all odds, less what it has of the right ones
        residuals = odds / np.repeat(whole, counts)
        residuals -= np.where(right, odds / np.repeat(good, counts), 0.0)
        residuals *= np.repeat(w, counts)
        slope = np.concatenate([[residuals.sum()], -X.T @ residuals + 2.0 * ridge * off])
        return float(value), slope

    bounds = [(None, None), *[(0.0, None)] * X.shape[1]]
    bounds[1 + 3 * list(KNOTS).index("suggested") + 1] = (lone, None)  # from two views to one
    result = minimize(
        loss, np.full(1 + X.shape[1], max(0.5, lone)), jac=True, bounds=bounds, method="L-BFGS-B",
        options={"maxiter": 2000},
    )  # fmt: skip
    curves = {
        name: Penalty(*(round(float(x), 3) for x in np.cumsum(three)[::-1]))
        for name, three in zip(KNOTS, result.x[1:].reshape(-1, 3), strict=True)
    }
    return ConfidenceParameters(best=round(float(result.x[0]), 3), **curves)
