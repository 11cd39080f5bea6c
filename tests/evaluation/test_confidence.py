"""Tests of the confidence fit: steps, calibration and known penalties."""

import math
from dataclasses import asdict, fields

import numpy as np
import pytest

from sceneprint.geometry.validation.confidence import (
    KNOTS,
    ConfidenceModel,
    ConfidenceParameters,
    Penalty,
    PlaceEvidence,
    compute_confidences,
)
from sceneprint_lab.confidence import JudgedQuery, fit
from sceneprint_lab.evaluation.measures import calibration

#: Only these kinds cost anything.
TRUTH = ConfidenceParameters(
    best=5.0,
    **{name: Penalty(0.0, 0.0, 0.0) for name in KNOTS}
    | {"planes": Penalty(4.0, 2.0, 1.0), "rival": Penalty(3.0, 1.5, 0.5)},
)


def drawn(rng):
    values = {name: float(rng.uniform(min(knots), max(knots))) for name, knots in KNOTS.items()}
    values |= {"frames": 5.0 + values["frames"], "accepted": 5.0 * values.pop("acceptance")}
    names = [field.name for field in fields(PlaceEvidence)]
    return PlaceEvidence(**{name: values.get(name, 0.0) for name in names})


def test_what_was_drawn_from_a_model_is_learnt_again():
    """Of 4,000 queries of two candidates: confidences within a few hundredths."""
    rng = np.random.default_rng(1)
    samples = []
    for number in range(4000):
        pair = (drawn(rng), drawn(rng))
        confidences = compute_confidences(pair, ConfidenceModel(TRUTH))
        which = int(rng.choice(3, p=[*confidences, 1.0 - sum(confidences)]))
        samples.append(
            JudgedQuery("site", "rooms", number, pair, tuple(k == which for k in range(2)))
        )
    learnt = fit(samples, {"rooms": 1.0})
    tried = [(drawn(rng), drawn(rng)) for _ in range(300)]
    off = [
        abs(a - b)
        for pair in tried
        for a, b in zip(
            *(compute_confidences(pair, ConfidenceModel(one)) for one in (learnt, TRUTH)),
            strict=True,
        )
    ]
    assert float(np.mean(off)) < 0.03
    # no penalty falls with worse evidence
    for name in KNOTS:
        p = asdict(getattr(learnt, name))
        assert p["worst"] >= p["poor"] >= p["fair"] >= 0.0


def test_a_calibration_by_hand():
    actual = calibration(
        [0.95, 0.95, 0.91, 0.15, 0.05, 0.05], [True, True, False, False, True, False]
    )
    high, low, least = 2.81 / 3, 0.15, 0.05
    assert actual.bins == (
        (2, pytest.approx(least), 0.5), (1, pytest.approx(low), 0.0),
        (3, pytest.approx(high), pytest.approx(2 / 3)),
    )  # fmt: skip
    error = (2 * abs(least - 0.5) + low + 3 * abs(high - 2 / 3)) / 6
    assert actual.error == pytest.approx(error)
    squares = 2 * 0.05**2 + 0.91**2 + 0.15**2 + 0.95**2 + 0.05**2
    assert actual.brier == pytest.approx(squares / 6)
    assert math.isclose(calibration([1.0], [True]).error, 0.0)
    with pytest.raises(ValueError, match="2 confidences for 1"):
        calibration([0.5, 0.5], [True])
