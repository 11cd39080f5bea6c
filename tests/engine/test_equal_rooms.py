"""Tests of equal rooms and other rivals of an answer, for a service and an evaluation."""

from __future__ import annotations

import shutil
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sceneprint.formats.artifact import read_geometry, write_geometry
from sceneprint.geometry.rigid import pose_difference
from sceneprint.localization import rival_rows
from sceneprint.settings import Settings
from sceneprint_client.api import Query
from sceneprint_lab.evaluation.judgement import Candidate, Judge, QueryTask, answer_of, rank
from sceneprint_lab.evaluation.sites import signed
from tests.whole_engine import Engine

#: What looks for frames of another place.
RIVAL_ROWS = "sceneprint.localization.rival_rows"
#: From one room to its twin, metres.
APART = 30.0


def equal(frame, rng):
    depth = frame.depth + (frame.depth > 0) * rng.normal(0.0, 1e-3, frame.depth.shape)
    T = np.array(frame.pose)
    T[0, 3] += APART
    return replace(frame, depth=depth.astype(np.float32), pose=T)


@pytest.fixture(scope="module")
def twin_folder(signed_folder, uploads, make_upload, tmp_path_factory):
    """A data folder whose map `hall` has the second room twice, 30 m apart."""
    rng = np.random.default_rng(5)
    folder = Path(shutil.copytree(signed_folder, tmp_path_factory.mktemp("twins") / "data"))
    with Engine(Settings(data_dir=folder)) as engine:
        for upload in uploads[6:]:
            copy = make_upload(equal(replace(upload.frame, pose=upload.pose), rng), upload.room)
            engine.add(copy)
        engine.work_off()
    return folder


@pytest.fixture
def twins(twin_folder, make_engine, uploads, tmp_path):
    """A function that asks where a frame was taken, of which the map holds the twin alone; with
    that frame, and the ids of the frames of each room.
    """
    engine, request = make_engine(shutil.copytree(twin_folder, tmp_path / "twins")), uploads[8]
    every = engine.ids()
    engine.delete_frame("hall", every[8])
    meta = request.meta.model_copy(update={"pose": None})

    def ask(**how):
        query = Query.model_validate({"keep": False, **how})
        return engine.ask(request, query, meta=meta)

    return SimpleNamespace(ask=ask, query=request, first=every[6:12], second=every[12:])


#: So many candidates are all but one of the twin room.
FEW = 3


def accepted(answer):
    return [m.frame_id for m in answer.matches if m.validation.status == "accepted"]


def blind_to_rivals(*_):
    return []


def test_an_equal_room_that_fills_the_selection_makes_the_answer_ambiguous(twins, monkeypatch):
    answer = twins.ask(candidates=FEW, explain=True)
    chosen = [m for m in answer.matches if m.selected]
    assert {m.frame_id for m in chosen if m.validation.status == "accepted"} <= set(twins.second)
    assert (answer.status, answer.location) == ("ambiguous", None)
    # beyond the selection, the own room's frames that look most like the query
    beyond = [m for m in answer.matches if not m.selected]
    assert [(m.rank, m.diversity_gain, m.frame_id in twins.first) for m in beyond] == [
        (4, None, True), (3, None, True)
    ]  # fmt: skip
    assert set(accepted(answer)) & set(twins.first) == {m.frame_id for m in beyond}
    result = {one.frame_id: (one.stage, one.outcome) for one in answer.explanations or ()}
    assert {result[m.frame_id] for m in beyond} == {("validate", "accepted")}
    assert answer.counts.selected == FEW
    assert answer.counts.validated == FEW + len(beyond)
    places = [a.pose.matrix[0][3] - twins.query.pose[0, 3] for a in answer.alternatives[:2]]
    assert sorted(places) == pytest.approx([0.0, APART], abs=0.05)
    # without them the selection alone would be believed: 30 m off
    monkeypatch.setattr(RIVAL_ROWS, blind_to_rivals)
    believed = twins.ask(candidates=FEW)
    assert believed.status == "found"
    off = believed.location.pose.matrix[0][3] - twins.query.pose[0, 3]
    assert off == pytest.approx(APART, abs=0.05)


def test_a_prior_tells_equal_rooms_apart(twins):
    pose = {"matrix": twins.query.pose.tolist(), "parent_frame": twins.query.room}
    answer = twins.ask(candidates=FEW, prior={"pose": pose})
    assert (answer.status, answer.location.verified_by) == ("found", "prior")
    assert answer.location.pose.matrix[0][3] == pytest.approx(twins.query.pose[0, 3], abs=0.05)


def test_what_the_deadline_leaves_uncompared_is_not_found(twins, monkeypatch):
    passed, look, clock = [0.0], rival_rows, time.perf_counter

    def late(*args):
        passed[0] = 3600.0
        return look(*args)

    monkeypatch.setattr(RIVAL_ROWS, late)
    monkeypatch.setattr(
        "sceneprint.engine.search.retrieval.time.perf_counter", lambda: clock() + passed[0]
    )
    answer = twins.ask(candidates=FEW, deadline_ms=60_000)
    assert (answer.status, answer.deadline_reached) == ("ambiguous", True)
    assert "the deadline passed before similar frames of other places" in answer.reason
    [pose] = answer.alternatives
    assert pose.pose.matrix[0][3] - twins.query.pose[0, 3] == pytest.approx(APART, abs=0.05)


@pytest.fixture
def both(empty, signer):
    def ask(in_map, queries, candidates=10):
        for one in in_map:
            empty.add(one)
        empty.work_off()
        shown, sent = ([replace(one.frame, pose=one.pose) for one in some]
                       for some in (in_map, queries))  # fmt: skip
        _, database, of_map = signed(shown, "room", signer, 0)
        _, members, of_queries = signed(sent, "room", signer, len(database))
        geometries = [read_geometry(write_geometry(one)) for one in (*of_map, *of_queries)]
        model, n = signer.model, len(database)
        judge = Judge(
            geometries.__getitem__, "full", 0, model.parameters.validation, database=database,
            answer=model.answer, unrelated_distance=model.unrelated_distance,
        )  # fmt: skip
        ranked = rank(
            np.stack([member.signature for member in members]),
            np.stack([one.signature for one in database]),
            np.ones((len(members), n), np.bool_), metric=model.metric, candidates=candidates,
        )  # fmt: skip
        pairs = []
        for one, query, r in zip(queries, members, ranked, strict=True):
            among = tuple(Candidate(j, j, "room", database[j].pose, 0.0, 0.0) for j in r.selection)
            task = QueryTask(
                query.number, "room", query.pose, [], r.selection, among, np.arange(n), r.retrieved
            )
            meta = one.meta.model_copy(update={"pose": None})
            how = Query(candidates=candidates, keep=False)
            served = empty.ask(one, how, meta=meta)
            pairs.append((served, answer_of(judge, task)))
            see_same(*pairs[-1], one.pose)
        return pairs

    return ask


def see_same(served, evaluated, truth):
    assert served.status == evaluated.status
    poses = list(served.alternatives)
    if served.location is not None:
        poses = [served.location]
        assert served.location.strength == evaluated.strength
        off = pose_difference(np.array(served.location.pose.matrix), truth)
        assert (evaluated.error.metres, evaluated.error.radians) == pytest.approx(off, abs=1e-6)
    for pose, place in zip(poses, evaluated.places, strict=False):
        assert pose.confidence == pytest.approx(place.confidence, abs=1e-6)
        # an answer has three decimals
        assert pose.evidence.model_dump() == pytest.approx(vars(place.evidence), abs=6e-4)


def test_guided_matches_that_are_searched_for_change_both_answers(both, make_upload, room_views):
    """Two frames whose poses are 3 m off vote elsewhere, after others have guided the rest."""
    path = room_views(21, 0, 48, along_path=True, step=3).frames
    in_map = []
    for i in (2, 6, 0, 10, 11):
        pose = np.array(path[i].pose)
        pose[0, 3] += 3.0 * (i >= 10)
        in_map.append(make_upload(replace(path[i], pose=pose), "room"))
    [(served, _)] = both(in_map, [make_upload(path[4], "room")])
    assert served.status == "ambiguous"
    assert {match.validation.search for match in served.matches} == {"correspondences"}
    first = served.alternatives[0]
    assert first.support > 2  # that many had guided the others, which vote now as well
    assert pose_difference(np.array(first.pose.matrix), np.array(path[4].pose))[0] < 0.02
    assert first.evidence.rival_weight >= 0.8  # the two frames that are off vote elsewhere
