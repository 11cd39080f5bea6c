"""`python -m benchmarks.lookalikes`: the table by hand, and one small site asked for real."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.lookalikes import Told, ask_site, prior_about, table
from sceneprint.geometry.rigid import difference
from sceneprint.lab.evaluation.measures import upper_bound
from sceneprint.lab.evaluation.protocol import Error, JudgedAnswer
from sceneprint.models import read_model
from sceneprint.pipeline import Signer, open_signer


def told(kind: str, number: int, answer: JudgedAnswer) -> Told:
    return Told(f"{kind}-000", kind, number, kind == "object", answer)


def test_the_table_by_hand() -> None:
    right = JudgedAnswer("found", "strong", Error(0.03, 0.02), 100.0)
    flipped = JudgedAnswer("found", "strong", Error(2.5, 3.1), 300.0)
    lines = table(
        [
            told("object", 0, right),
            told("object", 1, flipped),
            told("absent", 0, JudgedAnswer("not_found", milliseconds=40.0)),
            told("absent", 1, JudgedAnswer("ambiguous", milliseconds=60.0)),
        ]
    )
    rows = {line.split("|")[1].strip(): line for line in lines[2:]}
    assert list(rows) == ["object", "absent", "all"]
    bounds = [upper_bound(1, 2), upper_bound(0, 2), upper_bound(1, 4)]
    a, b, c = (f"{bound:.3f}" for bound in bounds)
    assert rows["object"] == (
        f"| object | 2 | 2 | 0.500 | 0.500 | 0.500 | {a} | 0.500 | 0.000 | 0.000 | 200 |"
    )
    assert rows["absent"] == (
        f"| absent | 2 | 0 | 0.000 | 0.000 | 0.000 | {b} | 0.000 | 0.500 | 0.500 | 50 |"
    )
    assert rows["all"] == (
        f"| all | 4 | 2 | 0.250 | 0.250 | 0.250 | {c} | 0.250 | 0.250 | 0.250 | 80 |"
    )


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


def test_a_prior_is_off_by_as_much_as_asked_for() -> None:
    rng = np.random.default_rng(3)
    pose = np.eye(4)
    pose[:3, 3] = (4.0, -2.0, 1.0)
    priors = [prior_about(pose, "object-000", 1.5, 4.0, rng) for _ in range(200)]
    shifts, turns = zip(*(difference(pose, one.T) for one in priors), strict=True)
    assert min(shifts) >= 1.5
    assert max(shifts) <= 4.0
    assert min(shifts) < 1.7
    assert max(shifts) > 3.8
    assert np.rad2deg(max(turns)) <= 10.0 + 1e-9
    assert np.rad2deg(max(turns)) > 9.0
    assert {one.parent for one in priors} == {"object-000"}
    np.testing.assert_allclose(np.sqrt(np.diag(priors[0].covariance)), [0.3] * 3 + [np.pi / 18] * 3)


@pytest.mark.thorough
def test_a_prior_decides_between_places_that_look_alike() -> None:
    signer = open_signer(read_model("depth"))
    alone = ask_site(signer, ("object", 0, 2), seed=5)
    assert [one.answer.status for one in alone] == ["ambiguous", "ambiguous"]
    told_where = ask_site(signer, ("object", 0, 2), seed=5, prior=(0.0, 0.3))
    assert [one.answer.status for one in told_where] == ["found", "found"]
    assert max(one.answer.error.metres for one in told_where) < 0.1
