"""Tests of localization, and of the comparison of two frames."""

import numpy as np
import pytest

from sceneprint.engine.search.query import check_localizes, localization_of
from sceneprint.engine.search.response import uncertainty_record
from sceneprint.errors import InvalidRequest, UnknownFrame
from sceneprint.geometry.registration.icp import PAIR_METHOD
from sceneprint.models import read_model
from sceneprint.pipeline import distance, validate
from sceneprint_client.api import Comparison, NamedFrame, NewMap, Query


def test_a_localization_is_the_answer_in_short(full, ids):
    answer = full.query_frame("hall", ids(full)[8], Query())
    there = localization_of(answer)
    assert (there.status, there.map, there.strength) == ("found", "hall", "strong")
    assert (there.pose, there.support, there.votes) == (
        answer.location.pose, answer.location.support, answer.location.votes,
    )  # fmt: skip
    assert (there.spread_m, there.spread_deg) == (
        answer.location.spread_m, answer.location.spread_deg,
    )  # fmt: skip
    accepted = [one for one in answer.matches if one.validation.status == "accepted"]
    assert there.matches == [one.frame_id for one in accepted]
    assert there.best == accepted[0]
    assert there.reason.startswith(f"{there.support} of {there.votes} matches agree on the pose")
    for field in ("query_id", "seed", "model", "milliseconds"):
        assert getattr(there, field) == getattr(answer, field)


def test_what_is_found_without_a_pose_has_the_transform_to_its_match(empty, uploads, work_off):
    bare = uploads[0].meta.model_copy(update={"pose": None})
    empty.add_frame("hall", uploads[0].data, bare)
    work_off(empty)
    there = localization_of(empty.queries.upload(["hall"], uploads[1].data, bare, Query()))
    assert (there.status, there.pose, there.spread_m, there.votes) == ("found", None, None, 0)
    assert "none has a pose" in there.reason
    T = np.linalg.inv(uploads[0].pose) @ uploads[1].pose
    assert np.linalg.norm(np.array(there.best.transform.matrix)[:3, 3] - T[:3, 3]) < 0.05


def test_what_is_not_found_says_why(full, empty, uploads, ids):
    def ask(**how):
        query = Query.model_validate({"keep": False, **how})
        return localization_of(full.query_frame("hall", ids(full)[0], query))

    tight = ask(validation={"residual_m": 1e-9})
    assert (tight.status, tight.best, tight.matches, tight.strength) == (
        "not_found",
        None,
        [],
        None,
    )
    assert tight.reason.startswith("none of 10 candidates is accepted (the nearest: the two ")
    none = ask(filter={"robot": "nobody"})
    assert none.reason == "no frame of the map passes the filter. Widen the filter"
    assert (none.cause, tight.cause) == ("no_frames", "nothing_alike")
    late = ask(deadline_ms=1)
    assert (late.status, late.deadline_reached, late.cause) == ("not_found", True, "deadline")
    assert late.reason.startswith("the deadline passed before a match was accepted: 0 of 10")
    unsure = ask(validation={"ambiguous": 0.0})
    assert (unsure.status, unsure.pose) == ("ambiguous", None)
    assert "another transform explains the frames equally well" in unsure.reason
    with pytest.raises(InvalidRequest, match="requires validated matches"):
        check_localizes(Query(stages=("retrieve", "diversify")))


def timeless(one):
    return one.model_copy(update={"milliseconds": {}, "a": None, "b": None, "transform": None})


def test_two_frames_are_compared_as_the_library_does(full, uploads, prepared, ids):
    names = ids(full)

    def side(i, stored):
        if stored:
            return NamedFrame(map="hall", frame_id=names[i])
        return uploads[i].data, uploads[i].meta

    how = Comparison(seed=3)
    for a, b in ((0, 1), (0, 7), (4, 4)):
        v = validate(prepared[b][1], prepared[a][1], 3)
        found = []
        for kinds in ((True, True), (True, False), (False, True)):
            one = full.queries.compare(side(a, kinds[0]), side(b, kinds[1]), how)
            found.append(timeless(one))
            assert one.distance == distance(prepared[a][0], prepared[b][0])
            assert (one.validation.status, one.validation.inliers) == (v.status, v.inliers)
            assert [one.a is not None, one.b is not None] == [*kinds]
            if v.T_match_query is None:
                assert one.transform is None
                continue
            assert one.transform.matrix == v.T_match_query.tolist()
            wanted = [
                f"{names[i] if stored else word}.optical"
                for i, stored, word in zip((a, b), kinds, ("a", "b"), strict=True)
            ]
            if wanted[0] == wanted[1]:
                wanted = ["a.optical", "b.optical"]
            assert [one.transform.parent_frame, one.transform.child_frame] == wanted
        assert found[0] == found[1] == found[2]
    near = full.queries.compare(side(0, True), side(1, True), how)
    T = np.linalg.inv(uploads[0].pose) @ uploads[1].pose
    assert np.linalg.norm(np.array(near.transform.matrix)[:3, 3] - T[:3, 3]) < 0.05
    sent = full.queries.compare(side(0, False), side(1, False), Comparison(model="depth"))
    assert (sent.distance, sent.model) == (near.distance, full.get_map("hall").model)
    bare = full.queries.compare(side(0, True), side(1, True), Comparison(validate=False))
    assert (bare.validation, bare.transform, bare.distance) == (None, None, near.distance)
    strict = Comparison.model_validate({"seed": 3, "validation": {"residual_m": 1e-9}})
    assert (
        full.queries.compare(side(0, True), side(1, True), strict).validation.status == "rejected"
    )


def test_frames_that_cannot_be_compared(full, uploads, work_off, ids):
    full.create_map(NewMap(name="big", model="paper"))
    big, _ = full.add_frame("big", uploads[0].data, uploads[0].meta)
    other = NamedFrame(map="big", frame_id=big.frame_id)
    stored = NamedFrame(map="hall", frame_id=ids(full)[0])
    sent = (uploads[1].data, uploads[1].meta)
    with pytest.raises(InvalidRequest, match=r"map hall has depth-.* and map big has paper-"):
        full.queries.compare(stored, other, Comparison())
    with pytest.raises(InvalidRequest, match="not signed with the model 'paper'"):
        full.queries.compare(stored, sent, Comparison(model="paper"))
    with pytest.raises(InvalidRequest, match="is received"):
        full.queries.compare(other, sent, Comparison())
    with pytest.raises(UnknownFrame):
        full.queries.compare(NamedFrame(map="hall", frame_id="x"), sent, Comparison())


def test_what_is_free_is_told_by_the_numbers_of_the_model():
    """A radian counts five metres in a hall, and one in a room."""
    S = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 300.0]) * 1e-6
    room, hall = (read_model(one).parameters.validation.covariance for one in ("paper", "lidar"))
    held = uncertainty_record(S, PAIR_METHOD, room)
    free = uncertainty_record(S, PAIR_METHOD, hall)
    assert (held.degenerate, held.covariance) == ([], free.covariance)
    [one] = free.degenerate
    assert (one.rotation.z, one.translation.z) == (1.0, 0.0)
