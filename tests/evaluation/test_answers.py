"""Tests of the comparison of answers with true poses."""

import math

import numpy as np
import pytest

from sceneprint_client.api import Answer, Quaternion, Transform, Vector
from sceneprint_lab.evaluation.report import FramePlace, answer_rows, judge_answers


def at(x, y=0.0):
    pose = np.eye(4)
    pose[:2, 3] = x, y
    return pose


def told(T, parent="match"):
    x, y, z = T[:3, 3].tolist()
    return Transform(
        parent_frame=parent, child_frame="query", translation=Vector(x=x, y=y, z=z),
        rotation=Quaternion(x=0, y=0, z=0, w=1), matrix=T.tolist(),
    )  # fmt: skip


def match(frame_id, rank, status, T):
    return {
        "frame_id": frame_id, "map": "m", "robot": None, "session": None, "rank": rank,
        "distance": rank, "similarity": 0.5, "selected": None, "diversity_gain": None,
        "validation": {"status": status, "reason": "x"},
        "transform": None if T is None else told(T), "pose_in_map": None,
    }  # fmt: skip


def answer(matches, pose=None):
    names = ("map", "passed", "compared", "ranked", "selected", "validated", "accepted")
    counts = dict.fromkeys(names, 0)
    location = pose and {"pose": pose, "support": 1, "votes": 1, "spread_m": 0, "spread_deg": 0}
    return Answer.model_validate(
        {"query_id": "q", "status": "found", "matches": matches, "location": location, "seed": 0,
         "model": "m", "index_version": 0, "exact": True, "counts": counts, "milliseconds": {}}
    )  # fmt: skip


KNOWN = {
    "a": FramePlace("hall", at(1)),
    "b": FramePlace("hall", at(3)),
    "c": FramePlace("cellar", at(0)),
}
TRUTH = FramePlace("hall", at(0))


def test_rows_take_the_nearest_the_first_accepted_and_the_average():
    # accepted ones come first; b is accepted and 0.5 m off, a ranks first and is 0.1 m off
    ranked = answer([match("b", 2, "accepted", at(-2.5)), match("a", 1, "rejected", at(-0.9))])
    diverse = answer(
        [match("a", 1, "accepted", at(-1.02)), match("b", 3, "rejected", None)],
        told(at(0.03, 0.04), "hall"),
    )
    judged = judge_answers(TRUTH, ranked, diverse, KNOWN)
    off = {row: error.metres for row, error in judged.first.items()}
    wanted = {"R": 0.1, "VR": 0.5, "DR": 0.02, "VDR": 0.02, "pose_average": 0.05}
    assert off == pytest.approx(wanted)
    assert judged.spread == {"R": (2.0, 1.0), "VR": None, "DR": (2.0, 1.0), "VDR": None}
    rows = answer_rows([judged, judged])
    assert (rows["R"]["spread_mean_m"], rows["R"]["spread_std_m"]) == (2.0, 1.0)
    assert rows["VR"]["spread_mean_m"] is None
    assert [rows[row]["within_5cm_5deg"] for row in rows] == [0.0, 0.0, 1.0, 1.0, 1.0]


def test_another_place_and_no_answer_are_infinitely_far_off():
    elsewhere = answer([match("c", 1, "accepted", at(0))], told(at(0), "cellar"))
    nothing = answer([])
    for one in (elsewhere, nothing):
        judged = judge_answers(TRUTH, one, one, KNOWN)
        assert {error.metres for error in judged.first.values()} == {math.inf}
        assert set(judged.spread.values()) == {None}
