"""Tests of the confidence of a pose: values, monotonicity and reasons."""

import math
from dataclasses import replace

import pytest

from sceneprint.geometry.validation.confidence import (
    KNOTS,
    ConfidenceModel,
    ConfidenceParameters,
    Penalty,
    PlaceEvidence,
    compute_confidences,
    compute_penalties,
    weakest_evidence,
)

BEST = PlaceEvidence(0.9, 0.95, 40.0, 12, 12, 0.0, 5.0, 5, 5, 8, 0.9, 0.0, 0.0, 3.0)
P = ConfidenceParameters(best=6.0, **{name: Penalty(3.0, 2.0, 1.0) for name in KNOTS})
#: Rendered views cost one kind of evidence more, and another nothing.
VIEWS = replace(P, excess=Penalty(0.0, 0.0, 0.0), rival=Penalty(9.0, 6.0, 3.0))
JUDGEMENT = ConfidenceModel(P, VIEWS)


def test_the_best_evidence_costs_nothing():
    assert set(compute_penalties(BEST, P).values()) == {0.0}
    assert compute_confidences([BEST], JUDGEMENT) == pytest.approx([1 / (1 + math.exp(-6.0))])


def test_a_penalty_is_linear_between_its_knots():
    """Planes: 3 at 3 planes, 2 at 6, 1 at 12, 0 from 24 on."""
    for planes, penalty in ((1.0, 3.0), (3.0, 3.0), (4.5, 2.5), (12.0, 1.0), (18.0, 0.5)):
        assert compute_penalties(replace(BEST, planes=planes), P)["planes"] == pytest.approx(
            penalty
        )
    for rival, penalty in ((1.5, 3.0), (0.9, 2.5), (0.5, 1.0), (0.35, 0.5), (0.2, 0.0)):
        assert compute_penalties(replace(BEST, rival=rival), P)["rival"] == pytest.approx(penalty)
    two = replace(BEST, planes=12.0, rival=0.8)
    assert compute_confidences([two], JUDGEMENT) == pytest.approx([1 / (1 + math.exp(-3.0))])


def test_accepted_matches_count_by_the_frames_that_see_the_place():
    for frames, accepted, acceptance in ((12, 1, 0.2), (3, 1, 1 / 3), (2, 2, 1.0), (1, 0, 0.0)):
        e = replace(BEST, frames=frames, accepted=accepted)
        assert e.acceptance == pytest.approx(acceptance)


def test_candidates_share_what_one_of_them_has():
    """Odds of e^6 and e^5 against 1 that none is right."""
    whole = 1 + math.exp(6.0) + math.exp(5.0)
    result = compute_confidences([BEST, replace(BEST, planes=12.0)], JUDGEMENT)
    assert result == pytest.approx([math.exp(6.0) / whole, math.exp(5.0) / whole])
    assert compute_confidences([], JUDGEMENT) == []


@pytest.mark.parametrize("name", KNOTS)
def test_better_evidence_never_lowers_a_confidence(name):
    worst, *_, best = KNOTS[name]
    steps = [worst + (best - worst) * k / 20 for k in range(-3, 24)]
    # five frames or more see the place, and each accepted match is a fifth
    field, times = ("accepted", 5.0) if name == "acceptance" else (name, 1.0)
    tried = [replace(BEST, **{field: times * x}) for x in steps]
    result = [compute_confidences([e], ConfidenceModel())[0] for e in tried]
    assert result == sorted(result)


def test_rendered_views_have_numbers_of_their_own():
    """5 % excess costs 1 beside frames and nothing beside views; a rival of .8 costs 2, or 6."""
    at_once = replace(BEST, excess=0.05), replace(BEST, rival=0.8, rendered=True)
    whole = 1 + math.exp(5.0) + math.exp(0.0)
    assert compute_confidences(at_once, JUDGEMENT) == pytest.approx(
        [math.exp(5.0) / whole, math.exp(0.0) / whole]
    )
    weak = replace(BEST, excess=0.1, rival=0.4)
    assert "10%" in weakest_evidence(weak, JUDGEMENT)
    assert "another pose" in weakest_evidence(replace(weak, rendered=True), JUDGEMENT)


def test_the_reason_names_what_costs_most():
    assert "only 5 distinct planes" in weakest_evidence(replace(BEST, planes=5.0), JUDGEMENT)
    assert "another pose" in weakest_evidence(replace(BEST, planes=12.0, rival=0.9), JUDGEMENT)
    assert "14%" in weakest_evidence(replace(BEST, excess=0.14), JUDGEMENT)
