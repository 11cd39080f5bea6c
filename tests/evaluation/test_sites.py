"""Tests of answers at a small ambiguous site."""

import math

from sceneprint.models import read_model
from sceneprint_lab.evaluation import sites
from sceneprint_lab.evaluation.protocol import Error, JudgedAnswer
from sceneprint_lab.evaluation.sites import ask_site, kinds_of
from sceneprint_lab.synth.lookalike_surveys import SURVEYED_KINDS
from sceneprint_lab.synth.lookalikes import KINDS, ORDINARY

#: A scan may be off by so much and still be right.
SCAN = (0.5, 10.0)


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
