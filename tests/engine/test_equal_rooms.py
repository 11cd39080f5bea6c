"""Tests of two equal rooms, of which C may contain only one."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sceneprint.localization import rival_rows
from sceneprint.settings import Settings
from sceneprint_client.api import Query
from tests.whole_engine import Engine

#: What looks for frames of another place.
RIVAL_ROWS = "sceneprint.localization.rival_rows"
#: From one room to its twin, metres.
APART = 30.0


@dataclass
class Twins:
    """A map of two equal rooms, with the ids of the frames of each."""

    engine: Engine
    asked: Any
    first: list[str]
    second: list[str]

    def ask(self, **how):
        """Where the asked frame was taken, of which the map holds the twin alone."""
        query = Query.model_validate({"keep": False, **how})
        meta = self.asked.meta.model_copy(update={"pose": None})
        return self.engine.queries.upload(["hall"], self.asked.data, meta, query)


def equal(frame, rng):
    """The same view in another room: a millimetre of noise, the pose shifted."""
    depth = frame.depth + (frame.depth > 0) * rng.normal(0.0, 1e-3, frame.depth.shape)
    T = np.array(frame.pose)
    T[0, 3] += APART
    return replace(frame, depth=depth.astype(np.float32), pose=T)


@pytest.fixture(scope="module")
def twin_folder(signed_folder, uploads, make_upload, work_off, tmp_path_factory):
    """A data folder whose map `hall` has the second room twice, 30 m apart."""
    rng = np.random.default_rng(5)
    folder = Path(shutil.copytree(signed_folder, tmp_path_factory.mktemp("twins") / "data"))
    with Engine(Settings(data_dir=folder)) as engine:
        for one in uploads[6:]:
            copy = make_upload(equal(replace(one.frame, pose=one.pose), rng), one.room)
            engine.add_frame("hall", copy.data, copy.meta)
        work_off(engine)
    return folder


@pytest.fixture
def twins(twin_folder, make_engine, uploads, ids, tmp_path):
    engine = make_engine(shutil.copytree(twin_folder, tmp_path / "twins"))
    every = ids(engine)
    engine.delete_frame("hall", every[8])
    return Twins(engine, uploads[8], every[6:12], every[12:])


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
    told = {one.frame_id: (one.stage, one.outcome) for one in answer.explanations or ()}
    assert {told[m.frame_id] for m in beyond} == {("validate", "accepted")}
    assert answer.counts.selected == FEW
    assert answer.counts.validated == FEW + len(beyond)
    places = [one.pose.matrix[0][3] - twins.asked.pose[0, 3] for one in answer.alternatives[:2]]
    assert sorted(places) == pytest.approx([0.0, APART], abs=0.05)
    # without them the selection alone would be believed: 30 m off
    monkeypatch.setattr(RIVAL_ROWS, blind_to_rivals)
    believed = twins.ask(candidates=FEW)
    assert believed.status == "found"
    off = believed.location.pose.matrix[0][3] - twins.asked.pose[0, 3]
    assert off == pytest.approx(APART, abs=0.05)


def test_a_prior_tells_equal_rooms_apart(twins):
    pose = {"matrix": twins.asked.pose.tolist(), "parent_frame": twins.asked.room}
    answer = twins.ask(candidates=FEW, prior={"pose": pose})
    assert (answer.status, answer.location.verified_by) == ("found", "prior")
    assert answer.location.pose.matrix[0][3] == pytest.approx(twins.asked.pose[0, 3], abs=0.05)


def test_what_the_deadline_leaves_uncompared_is_not_found(twins, monkeypatch):
    """The selection is validated in time, the frames elsewhere are not."""
    passed, look, clock = [0.0], rival_rows, time.perf_counter

    def late(*given):
        passed[0] = 3600.0
        return look(*given)

    monkeypatch.setattr(RIVAL_ROWS, late)
    monkeypatch.setattr(
        "sceneprint.engine.search.retrieval.time.perf_counter", lambda: clock() + passed[0]
    )
    answer = twins.ask(candidates=FEW, deadline_ms=60_000)
    assert (answer.status, answer.deadline_reached) == ("ambiguous", True)
    assert "the deadline passed before similar frames of other places" in answer.reason
    [pose] = answer.alternatives
    assert pose.pose.matrix[0][3] - twins.asked.pose[0, 3] == pytest.approx(APART, abs=0.05)
