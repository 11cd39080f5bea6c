"""`python -m benchmarks.lookalikes`: the table by hand, and one small site asked for real."""

from __future__ import annotations

import pytest

from benchmarks.lookalikes import ask_site
from sceneprint.models import read_model
from sceneprint.pipeline import Signer, open_signer


@pytest.mark.thorough
def test_a_site_is_asked_and_every_answer_is_one_of_three(small_signer: Signer) -> None:
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
def test_a_prior_decides_between_places_that_look_alike() -> None:
    signer = open_signer(read_model("depth"))
    alone = ask_site(signer, ("object", 0, 2), seed=5)
    assert [one.answer.status for one in alone] == ["ambiguous", "ambiguous"]
    told_where = ask_site(signer, ("object", 0, 2), seed=5, prior=(0.0, 0.3))
    assert [one.answer.status for one in told_where] == ["found", "found"]
    assert max(one.answer.error.metres for one in told_where) < 0.1
