"""Tests of the effect and the explanation of each option of a query."""

import math
import time
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from sqlalchemy import update

from sceneprint.engine.search import local_index, retrieval
from sceneprint.engine.search.retrieval import FIRST_S, Deadline
from sceneprint.engine.search.verification import thresholds
from sceneprint.errors import UnknownFrame
from sceneprint.geometry.retrieval.ranking import (
    DiversityParameters,
    distances,
    diversify,
    pairwise_distances,
)
from sceneprint.geometry.validation.validation import ValidationParameters
from sceneprint.pipeline import retrieve, validate
from sceneprint.store.tables import frames
from sceneprint_client.api import Query
from sceneprint_client.api.query import ValidationOptions

VR = ("retrieve", "validate")


def ask(engine, frame_id, **how):
    return engine.query_frame("hall", frame_id, Query.model_validate({"keep": False, **how}))


def fields(answer, *without):
    return answer.model_dump_json(exclude={"query_id", "milliseconds", *without})


def test_so_many_candidates_are_selected_and_tried(full):
    names = full.ids()
    for candidates, stages in product((1, 7), (VR, ("retrieve", "diversify", "validate"))):
        answer = ask(full, names[0], candidates=candidates, k=50, stages=stages)
        assert len(answer.matches) == answer.counts.validated == candidates
        if stages == VR:
            assert sorted(match.rank for match in answer.matches) == [*range(1, candidates + 1)]
        else:
            assert answer.counts.selected == candidates
    assert len(ask(full, names[0], candidates=7, k=2, stages=["retrieve"]).matches) == 2


def test_the_scales_of_diversity_are_those_of_the_library(full, prepared):
    names, chosen = full.ids(), {}
    vectors = np.stack([one.vector for one, _ in prepared[1:]])
    d = distances(prepared[0][0].vector, vectors, "l2")
    order = np.argsort(d, kind="stable")
    for omega in (0.01, 4.0, 1000.0):
        p = DiversityParameters(0.7, omega)
        selection = diversify(d[order], pairwise_distances(vectors[order], "l2"), 4, p)
        pairs = zip(selection.indices, selection.gains, strict=True)
        wanted = {names[1 + order[i]]: gain for i, gain in pairs}
        stages = ["retrieve", "diversify"]
        answer = ask(full, names[0], k=4, stages=stages, diversity={"sigma": 0.7, "omega": omega})
        assert {match.frame_id: match.diversity_gain for match in answer.matches} == wanted
        chosen[omega] = set(wanted)
    assert chosen[0.01] == {names[1 + i] for i in order[:4]}  # quality decides
    assert chosen[1000.0] != chosen[0.01]


def test_thresholds_decide_what_is_accepted(full):
    name = full.ids()[0]
    before = {match.frame_id: match.validation for match in ask(full, name, k=50).matches}
    accepted = {one for one, v in before.items() if v.status == "accepted"}
    least = sorted(before[match].overlap for match in accepted)[1]
    after = ask(full, name, k=50, validation={"evidence": least, "violation_weight": 0.0})
    still = {match.frame_id for match in after.matches if match.validation.status == "accepted"}
    assert still == {match for match in accepted if before[match].overlap >= least} != accepted
    sure = ask(full, name, k=50, validation={"strong": 1.0})
    assert {match.validation.strength for match in sure.matches[: len(accepted)]} == {"weak"}
    assert {match.frame_id for match in sure.matches[: len(accepted)]} == accepted
    tight = ask(full, name, k=50, validation={"residual_m": 1e-9})
    assert tight.status == "not_found"
    assert all("disagree" in match.validation.reason for match in tight.matches if match.transform)
    paper = ask(full, name, k=50, validation={"mode": "paper"})
    for match in paper.matches:
        small = match.validation.residual is not None and (
            match.validation.residual.translation_m <= 0.08
            and match.validation.residual.rotation_deg <= 5.0
        )
        assert (match.validation.status == "accepted") is small


def test_a_limit_of_the_caller_holds_however_little_the_frames_share():
    p = ValidationParameters()
    limits = ValidationOptions(evidence=0.4, plane_overlap=0.3, residual_m=0.05, residual_deg=3.0)
    a = thresholds(limits, p)[0].acceptance
    assert (a.evidence, a.sparse_evidence, a.blind_evidence) == (0.4, 0.4, 0.4)
    assert (a.plane_overlap, a.sparse_plane_overlap, a.apart_plane_overlap) == (0.3, 0.3, 0.3)
    assert (a.residual_m, a.apart_m) == (0.05, 0.05)
    assert (a.residual_rad, a.apart_rad) == (math.radians(3.0), math.radians(3.0))
    assert thresholds(ValidationOptions(weak=0.1), p)[0].acceptance == replace(
        p.acceptance, weak=0.1
    )


def test_a_deadline_stops_validation_and_says_so(full, monkeypatch):
    name = full.ids()[0]
    whole = ask(full, name, k=50, deadline_ms=600_000)
    assert whole.deadline_reached is False
    assert fields(whole, "deadline_reached") == fields(ask(full, name, k=50), "deadline_reached")
    none = ask(full, name, deadline_ms=1)
    assert (none.deadline_reached, none.status, none.location) == (True, "unvalidated", None)
    assert none.counts.selected == len(none.matches) == 10
    assert {match.validation.reason for match in none.matches} == {
        "the deadline passed before it was validated"
    }
    allows, calls = Deadline.allows, []

    def thrice(self):
        calls.append(allows(self))
        self.reached = len(calls) > 3
        return not self.reached

    monkeypatch.setattr(Deadline, "allows", thrice)
    some = ask(full, name, k=50, stages=VR, deadline_ms=600_000)
    assert (some.counts.validated, some.deadline_reached) == (3, True)
    full_told = {match.frame_id: match for match in whole.matches}
    assert [match.rank for match in some.matches[3:]] == [*range(4, 12)]
    assert some.status == "found"
    for match in some.matches[:3]:
        assert match.validation == full_told[match.frame_id].validation


def test_no_candidate_is_begun_that_would_likely_end_too_late(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    deadline = Deadline(1000, since=99.5)  # ends at 100.5
    steps = [0.1, 0.2, 0.05]  # what candidates take: after 0.35 s the longest no longer fits
    seen = []
    for step in [0.0, *steps]:
        now[0] += step
        seen.append(deadline.allows())
    assert seen == [True, True, True, False]
    assert deadline.reached is True
    now[0] = 200.0
    late = Deadline(100, since=200.1 - 0.1 - FIRST_S + 0.001)
    assert late.allows() is True
    assert Deadline(100, since=200.1 - 0.1 - 0.1 + FIRST_S / 2).allows() is False
    assert (Deadline(None).allows(), Deadline(None).reached) == (True, None)


def test_every_frame_of_the_ranking_is_explained(full, prepared):
    names = full.ids()
    vectors = {name: one.vector for name, (one, _) in zip(names, prepared, strict=True)}

    def apart(a, b):
        return distances(vectors[a], vectors[b][None], "l2")[0]

    ranked = [match.frame_id for match in ask(full, names[0], k=50, stages=["retrieve"]).matches]
    outcomes = set()
    for candidates in (5, 11):  # some of the ranking, and all of it
        how = {"k": 2, "candidates": candidates}
        plain, answer = ask(full, names[0], **how), ask(full, names[0], **how, explain=True)
        assert fields(answer, "explanations") == fields(plain, "explanations")
        actual = answer.explanations
        assert [(item.rank, item.frame_id) for item in actual] == list(enumerate(ranked, 1))
        matches = {match.frame_id: match for match in answer.matches}
        # accepted ones beyond `k` are not listed
        chosen = {*matches, *(item.frame_id for item in actual if item.outcome == "accepted")}
        assert len(chosen) == candidates
        for one in actual:
            outcomes.add(one.outcome)
            assert one.distance == apart(names[0], one.frame_id)
            if one.frame_id not in chosen:
                assert (one.stage, one.outcome) == ("retrieve", "not_selected")
                near = min((apart(one.frame_id, name), ranked.index(name), name) for name in chosen)
                output = f"most similar to the selected frame {near[2]} (distance {near[0]})"
                assert one.reason.startswith(output)
            elif one.frame_id in matches:
                match = matches[one.frame_id]
                assert (one.rank, one.similarity) == (match.rank, match.similarity)
                if match.validation.status == "skipped":
                    assert (one.stage, one.outcome) == ("diversify", "skipped")
                else:
                    assert (one.stage, one.outcome) == ("validate", match.validation.status)
                    assert one.reason.startswith(f"{one.outcome}: {match.validation.reason}")
    assert outcomes == {"not_selected", "skipped", "accepted", "rejected"}
    plain = ask(full, names[0], k=3, stages=["retrieve"], explain=True).explanations
    assert [one.outcome for one in plain] == ["ranked"] * 3 + ["not_selected"] * 8
    assert plain[3].reason == "not a candidate: these were the first 3 frames of the ranking"


def test_a_frame_is_explained_where_it_was_lost(full, prepared, signer, monkeypatch):
    names = full.ids()
    index = {name: i for i, name in enumerate(names)}
    own = retrieve(prepared[0][0], [one for one, _ in prepared[1:]], signer.model)
    rank = {names[1 + i]: place + 1 for place, i in enumerate(own.indices.tolist())}

    def explained(frame_id, **how):
        answer = ask(full, names[0], explain_frame=frame_id, **how)
        plain = ask(full, names[0], **how)
        assert fields(answer, "explained_frame") == fields(plain, "explained_frame")
        one = answer.explained_frame
        assert (one.frame_id, one.map, one.state) == (frame_id, "hall", "indexed")
        return one

    def right(one):
        """Its figures are those of the library, whatever the query did."""
        i = index[one.frame_id]
        d = distances(prepared[0][0].vector, prepared[i][0].vector[None], "l2")[0]
        v = validate(prepared[0][1], prepared[i][1])
        assert (one.distance, one.rank, one.of) == (d, rank[one.frame_id], 11)
        assert (one.validation.status, one.validation.overlap) == (v.status, v.overlap)
        if v.T_match_query is not None:
            assert one.transform.matrix == v.T_match_query.tolist()
            assert one.transform.child_frame == f"{names[0]}.optical"

    near = [name for name, place in sorted(rank.items(), key=lambda one: one[1])]
    match = explained(near[0])
    right(match)
    assert match.lost_at is None
    assert (match.ranked, match.selected, match.shortlisted) == (True, True, True)
    assert match.reason.startswith("it is a match, accepted: ")
    far = explained(near[-1], k=50, stages=VR)
    right(far)
    assert (far.lost_at, far.selected, far.validation.status) == ("validation", True, "rejected")
    assert far.reason.startswith(f"rejected: {far.validation.reason}")
    turn = explained(near[5], k=1, stages=VR)
    right(turn)
    assert (turn.lost_at, turn.selected) == ("turn", True)
    output = "enough matches were accepted before it; validated only for this explanation"
    assert turn.reason.startswith(output)
    missed = explained(near[4], candidates=2, stages=VR)
    right(missed)
    assert (missed.lost_at, missed.ranked, missed.selected) == ("selection", True, False)
    barred = explained(near[2], filter={"exclude_frames": [near[2], near[8]]})
    assert (barred.lost_at, barred.passes_filter, barred.ranked) == ("filter", False, False)
    assert (barred.rank, barred.of) == (3, 9)
    assert barred.validation.status == "accepted"
    monkeypatch.setattr(retrieval, "ranking_size", lambda n: min(n, 4))
    unranked = explained(near[6], stages=VR)
    right(unranked)
    assert (unranked.lost_at, unranked.ranked, unranked.shortlisted) == ("ranking", False, True)
    bare = explained(near[6], stages=["retrieve"], k=1)
    assert (bare.validation, bare.transform, bare.lost_at) == (None, None, "ranking")


def test_a_frame_that_is_not_searched_is_explained(full):
    names = full.ids()
    itself = ask(full, names[0], explain_frame=names[0]).explained_frame
    assert (itself.lost_at, itself.rank, itself.passes_filter) == ("query", None, None)
    full.delete_frame("hall", names[4])
    gone = ask(full, names[0], explain_frame=names[4]).explained_frame
    assert (gone.lost_at, gone.state, gone.validation) == ("state", "deleted", None)
    full.write(update(frames).where(frames.c.id == names[5]).values(state="rejected"))
    bad = ask(full, names[0], explain_frame=names[5]).explained_frame
    assert (bad.lost_at, bad.state) == ("state", "rejected")
    with pytest.raises(UnknownFrame, match="'nobody' in map 'hall'"):
        ask(full, names[0], explain_frame="nobody")


def test_what_an_approximate_index_missed_is_said(full, monkeypatch):
    names = full.ids()
    near = [match.frame_id for match in ask(full, names[0], stages=["retrieve"], k=11).matches]
    real, lost = local_index.search, near[1]
    number = names.index(lost) + 1

    def search(*args, dead, exact, **more):
        if exact:
            return real(*args, dead=dead, exact=True, **more)
        return replace(real(*args, dead=dead | {number}, exact=False, **more), exact=False)

    monkeypatch.setattr(local_index, "search", search)
    monkeypatch.setattr(retrieval, "ranking_size", lambda n: min(n, 3))
    for rank, name in enumerate(near[:5], 1):
        answer = ask(full, names[0], explain_frame=name, stages=["retrieve"], k=3)
        assert (answer.exact, answer.counts.compared) == (False, 10)
        one = answer.explained_frame
        assert (one.rank, one.shortlisted) == (rank, name != lost)
        lost_at = "shortlist" if name == lost else (None if rank <= 4 else "ranking")
        assert (one.lost_at, one.ranked) == (lost_at, lost_at is None)  # one place is free


def test_a_frame_that_there_is_no_time_to_explain_changes_no_answer(full, monkeypatch):
    name, calls = full.ids()[0], []
    last = ask(full, name, k=50, stages=["retrieve"]).matches[-1].frame_id

    def so_often(self):
        calls.append(self)
        self.reached = len(calls) > 3
        return not self.reached

    monkeypatch.setattr(Deadline, "allows", so_often)
    how = {"candidates": 3, "stages": VR, "deadline_ms": 600_000, "validation": {"evidence": 1.0}}
    answer = ask(full, name, **how, explain_frame=last)
    one = answer.explained_frame
    assert (len(calls), one.lost_at) == (4, "selection")
    assert one.validation.reason == "the deadline passed before it was validated"
    assert (answer.counts.validated, answer.counts.accepted) == (3, 0)
    assert (answer.status, answer.deadline_reached) == ("not_found", False)  # all were tried
