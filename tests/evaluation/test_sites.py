"""Tests of answers at a small ambiguous site."""

import math

import pytest

from sceneprint.models import read_model
from sceneprint.pipeline import open_signer
from sceneprint_lab.evaluation import sites
from sceneprint_lab.evaluation.protocol import Error, JudgedAnswer
from sceneprint_lab.evaluation.sites import ask_site, kinds_of
from sceneprint_lab.synth.lookalike_surveys import SURVEYED_KINDS
from sceneprint_lab.synth.lookalikes import KINDS, ORDINARY

#: A scan may be off by so much and still be right.
SCAN = (0.5, 10.0)


@pytest.mark.thorough
def test_a_site_is_asked_and_every_answer_is_one_of_three(small_signer):
    answers = ask_site(small_signer, ("object", 0, 2), seed=5)
    assert [(one.site, one.query, one.answerable) for one in answers] == [
        ("object-000", 0, True),
        ("object-000", 1, True),
    ]
    for one in answers:
        assert one.answer.status in ("found", "ambiguous", "not_found")
        assert (one.answer.strength is None) == (one.answer.status != "found")
        assert one.answer.milliseconds > 0
    again = ask_site(small_signer, ("object", 0, 2), seed=5)
    assert [(a.answer.status, a.answer.error) for a in again] == [
        (a.answer.status, a.answer.error) for a in answers
    ]


@pytest.mark.thorough
def test_a_prior_decides_between_places_that_look_alike():
    signer = open_signer(read_model("depth"))
    alone = ask_site(signer, ("object", 0, 2), seed=5)
    assert [one.answer.status for one in alone] == ["ambiguous", "ambiguous"]
    told_where = ask_site(signer, ("object", 0, 2), seed=5, prior=(0.0, 0.3))
    assert [one.answer.status for one in told_where] == ["found", "found"]
    assert max(one.answer.error.metres for one in told_where) < 0.1


def test_a_model_is_asked_at_places_of_its_sensor():
    assert kinds_of(read_model("depth")) == KINDS + ORDINARY
    assert kinds_of(read_model("lidar")) == SURVEYED_KINDS


def test_the_answer_of_a_scanner_may_be_five_times_as_far_off():
    for metres, right, gross in ((0.45, True, False), (0.55, False, False), (2.6, False, True)):
        scanned, seen = (
            JudgedAnswer("found", "strong", Error(share * metres, 0.1), limits=limits)
            for share, limits in ((1.0, SCAN), (0.2, (0.10, 10.0)))
        )
        assert (scanned.right, scanned.grossly_wrong) == (right, gross)
        assert (seen.right, seen.grossly_wrong) == (right, gross)
    turned = JudgedAnswer("found", "weak", Error(0.0, math.radians(16)), limits=SCAN)
    assert (turned.right, turned.grossly_wrong) == (False, True)


def test_a_site_whose_map_is_one_surface_is_asked_of_views(small_signer, monkeypatch):
    monkeypatch.setattr(sites, "VIEWS", 12)
    answers = ask_site(small_signer, ("object", 0, 1), seed=5, as_surface=True)
    places = [place for one in answers for place in one.answer.places]
    assert places
    assert all(place.evidence.rendered for place in places)


@pytest.mark.thorough
def test_a_scanned_site_is_asked():
    signer = open_signer(read_model("lidar"))
    (answer,) = ask_site(signer, ("bays", 0, 1), seed=1)
    assert (answer.site, answer.answerable) == ("bays-000", True)
    assert answer.answer.limits == pytest.approx(SCAN)
    assert answer.answer.status == "not_found" or answer.answer.error.metres < 100.0
