"""Tests of queries, localization and comparison: pose, and equality with the library."""

import shutil
from dataclasses import asdict
from itertools import pairwise

import numpy as np
import pytest

from sceneprint.engine.search.query import check_localizes, localization_of
from sceneprint.engine.search.response import uncertainty_record
from sceneprint.errors import InvalidRequest, UnknownFrame
from sceneprint.geometry.registration.icp import PAIR_METHOD
from sceneprint.localization import localize, views_of_rows
from sceneprint.models import read_model
from sceneprint.pipeline import associate, distance, diversify, retrieve, validate
from sceneprint.places import QueryFrame
from sceneprint_client.api import Comparison, NamedFrame, NewMap, Query


def same(a, b):
    free = {"query_id": "", "milliseconds": {}}
    return a.model_copy(update=free) == b.model_copy(update=free)


def test_an_upload_is_found_where_it_was_taken(full, uploads):
    numbers = {frame_id: i for i, frame_id in enumerate(full.ids())}
    full.delete_frame("hall", full.ids()[8])
    upload = uploads[8]  # of the second room
    answer = full.ask(upload)
    assert answer.status == "found"
    accepted = [m for m in answer.matches if m.validation.status == "accepted"]
    assert len(accepted) == 5 == answer.counts.accepted
    assert answer.matches[:5] == accepted
    for match in accepted:
        there = uploads[numbers[match.frame_id]]
        assert there.room == upload.room
        T = np.linalg.inv(there.pose) @ upload.pose
        actual = np.array(match.transform.matrix)
        assert np.linalg.norm(actual[:3, 3] - T[:3, 3]) < 0.05
        assert np.trace(actual[:3, :3].T @ T[:3, :3]) > 1 + 2 * np.cos(np.radians(2))
        np.testing.assert_allclose(
            match.pose_in_map.matrix, there.pose @ actual, rtol=0, atol=1e-14
        )
        assert match.transform.parent_frame == f"{match.frame_id}.optical"
        assert match.transform.child_frame == match.pose_in_map.child_frame == "query.optical"
        assert match.pose_in_map.parent_frame == upload.room
    assert (answer.location.support, answer.location.votes) == (5, 5)
    assert answer.location.pose.parent_frame == upload.room
    place = np.array(answer.location.pose.matrix)
    assert np.linalg.norm(place[:3, 3] - upload.pose[:3, 3]) < 0.03
    assert np.trace(place[:3, :3].T @ upload.pose[:3, :3]) > 1 + 2 * np.cos(np.radians(1))


@pytest.mark.parametrize(("number", "k", "seed"), [(8, 2, 7), (3, 11, 1)])
def test_an_answer_has_the_numbers_of_the_library(full, prepared, signer, uploads, number, k, seed):
    names = full.ids()
    others = [i for i in range(len(prepared)) if i != number]
    signatures = [prepared[i][0] for i in others]
    geometries = [prepared[i][1] for i in others]
    query, seen = prepared[number]
    ranking = retrieve(query, signatures, signer.model)
    ten = diversify(ranking, signatures, 10).indices.tolist()
    deciding = associate(seen, ranking, ten, geometries.__getitem__, 5, seed)
    poses = [np.array(full.get_frame("hall", names[i]).pose.matrix) for i in others]
    rooms = [uploads[i].room for i in others]
    views_of = views_of_rows(deciding, poses, geometries.__getitem__, rooms)
    place = localize([QueryFrame(seen, deciding)], poses, rooms, views_of)
    chosen = diversify(ranking, signatures, max(10, k))
    among = [*ten, *(i for i in chosen.indices.tolist() if i not in ten)]
    tried = associate(seen, ranking, among, geometries.__getitem__, max(5, k), seed)
    accepted = [m.index for m in tried if m.validation.status == "accepted"]
    matches = [m for m in tried if m.index not in accepted[k:]]
    answer = full.query_frame("hall", names[number], Query(k=k, seed=seed))
    first = answer.matches[: len(matches)]
    assert [m.frame_id for m in first] == [names[others[m.index]] for m in matches]
    assert (answer.counts.validated, answer.counts.accepted) == (len(tried), len(accepted))
    for result, match in zip(first, matches, strict=True):
        v = match.validation
        assert result.distance == match.distance
        assert result.similarity == match.similarity
        assert (result.validation.status, result.validation.strength) == (v.status, v.strength)
        assert (result.validation.overlap, result.validation.inliers) == (v.overlap, v.inliers)
        assert result.validation.ambiguity == v.ambiguity
        assert result.validation.free_space_violations == v.violations
        if v.T_match_query is None:
            assert result.transform is None
        else:
            assert np.array(result.transform.matrix).tobytes() == v.T_match_query.tobytes()
    assert np.array(answer.location.pose.matrix).tobytes() == place.average.T.tobytes()
    assert answer.location.spread_m == place.average.spread_m
    assert answer.location.confidence == place.confidence
    evidence = asdict(place.alternatives[0].evidence)
    assert answer.location.evidence.model_dump() == pytest.approx(evidence, abs=5e-4)
    ranks = {m.frame_id: (m.rank, m.diversity_gain) for m in answer.matches}
    assert ranks == {
        names[others[ranking.indices[i]]]: (i + 1, gain)
        for i, gain in zip(chosen.indices.tolist(), chosen.gains.tolist(), strict=True)
        if ranking.indices[i] not in accepted[k:]
    }
    rest = [m.rank for m in answer.matches[len(matches) :]]
    assert rest == sorted(rest)
    assert {m.validation.reason for m in answer.matches[len(matches) :]} <= {
        "enough matches were accepted before it"
    }


def test_the_pose_does_not_depend_on_how_many_matches_are_listed(full):
    frame_id = full.ids()[8]
    usual = full.query_frame("hall", frame_id, Query())
    assert usual.status == "found"
    for k in (1, 2, 4, 7, 11):
        answer = full.query_frame("hall", frame_id, Query(k=k))
        assert (answer.status, answer.reason) == (usual.status, usual.reason)
        assert answer.location == usual.location
        listed = [m for m in answer.matches if m.validation.status == "accepted"]
        assert len(listed) == min(k, answer.counts.accepted)
        if k < 5:
            assert listed == usual.matches[:k]
            assert answer.counts == usual.counts
    second = usual.matches[1].frame_id
    result = full.query_frame("hall", frame_id, Query(k=1, explain_frame=second)).explained_frame
    assert result.lost_at == "turn"
    assert result.reason.startswith("more than `k` matches are accepted")


def test_stages_are_done_as_asked(full, uploads):
    for stages, k, matches, selected, validated in (
        (("retrieve",), 3, 3, 0, 0),
        (("retrieve",), 50, 12, 0, 0),
        (("retrieve", "diversify"), 3, 3, 3, 0),
        (("retrieve", "validate"), 1, 6, 0, 5),
        (("retrieve", "validate"), 11, 11, 0, 11),
        (("retrieve", "diversify", "validate"), 1, 7, 10, 10),
    ):
        answer = full.ask(uploads[0], Query(k=k, stages=stages))
        assert len(answer.matches) == matches
        counts = answer.counts
        assert (counts.map, counts.compared, counts.ranked) == (12, 12, 12)
        assert (counts.selected, counts.validated) == (selected, validated)
        chosen = {(m.selected, m.diversity_gain is None) for m in answer.matches}
        assert chosen == ({(True, False)} if "diversify" in stages else {(None, True)})
        if "validate" in stages:
            assert answer.status == "found"
            accepted = sum(m.validation.status == "accepted" for m in answer.matches)
            assert accepted == min(k, counts.accepted)
            assert answer.location is not None
        else:
            assert answer.status == "unvalidated"
            assert (counts.accepted, answer.location) == (0, None)
            assert {m.validation.reason for m in answer.matches} == {"not requested"}
            assert {m.validation.status for m in answer.matches} == {"skipped"}
            assert all(
                a.rank < b.rank and a.distance <= b.distance for a, b in pairwise(answer.matches)
            )
        assert answer.matches[0].distance == 0
        assert answer.matches[0].similarity == 1.0
        located = {"locate"} if "validate" in stages else set()
        done = {"prepare", "retrieve", "diversify", "validate", "total"}
        assert set(answer.milliseconds) == done | located


def test_a_frame_of_the_map_finds_what_its_upload_finds_but_not_itself(full, uploads):
    frame_id = full.ids()[2]
    stored = full.query_frame("hall", frame_id, Query(k=50))
    assert len(stored.matches) == 11 == stored.counts.map == stored.counts.compared
    assert frame_id not in [m.frame_id for m in stored.matches]
    assert stored.matches[0].transform.child_frame == f"{frame_id}.optical"
    full.delete_frame("hall", frame_id)
    sent = full.ask(uploads[2], Query(k=50))
    assert [m.frame_id for m in sent.matches] == [m.frame_id for m in stored.matches]
    assert [m.transform and m.transform.matrix for m in sent.matches] == [
        m.transform and m.transform.matrix for m in stored.matches
    ]
    assert sent.location.pose.matrix == stored.location.pose.matrix


@pytest.mark.parametrize("stages", [("retrieve",), ("retrieve", "diversify", "validate")])
def test_an_empty_map_finds_nothing(empty, uploads, stages):
    answer = empty.ask(uploads[0], Query(stages=stages))
    assert answer.status == ("unvalidated" if len(stages) == 1 else "not_found")
    assert (answer.matches, answer.location) == ([], None)
    assert set(answer.counts.model_dump().values()) == {0}


def test_answers_are_the_same_on_one_core_and_on_two(signed_folder, make_engine, uploads, tmp_path):
    result = []
    for cores in (1, 2):
        folder = tmp_path / str(cores)
        shutil.copytree(signed_folder, folder)
        engine = make_engine(folder, query_cores=cores)
        meta = uploads[8].meta.model_copy(update={"pose": None})
        answer = engine.ask(uploads[8], Query(k=5, seed=3), meta=meta)
        assert answer.status == "found"
        result.append(answer)
    assert same(*result)


def test_what_is_found_without_a_pose_has_the_transform_to_its_match(empty, uploads):
    bare = uploads[0].meta.model_copy(update={"pose": None})
    empty.add_frame("hall", uploads[0].data, bare)
    empty.work_off()
    there = localization_of(empty.ask(uploads[1], Query(), meta=bare))
    assert (there.status, there.pose, there.spread_m, there.votes) == ("found", None, None, 0)
    assert "none has a pose" in there.reason
    T = np.linalg.inv(uploads[0].pose) @ uploads[1].pose
    assert np.linalg.norm(np.array(there.best.transform.matrix)[:3, 3] - T[:3, 3]) < 0.05


def test_what_is_not_found_says_why(full, empty, uploads):
    def ask(**how):
        query = Query.model_validate({"keep": False, **how})
        return localization_of(full.query_frame("hall", full.ids()[0], query))

    tight = ask(validation={"residual_m": 1e-9})
    assert (tight.status, tight.best, tight.matches, tight.strength) == (
        "not_found",
        None,
        [],
        None,
    )
    assert tight.reason.startswith("none of 10 candidates is accepted (the nearest: the two ")
    none = ask(filter={"robot": "nobody"})
    assert (none.cause, tight.cause) == ("no_frames", "nothing_alike")
    late = ask(deadline_ms=1)
    assert (late.status, late.deadline_reached, late.cause) == ("not_found", True, "deadline")
    unsure = ask(validation={"ambiguous": 0.0})
    assert (unsure.status, unsure.pose) == ("ambiguous", None)
    with pytest.raises(InvalidRequest, match="requires validated matches"):
        check_localizes(Query(stages=("retrieve", "diversify")))


def timeless(one):
    return one.model_copy(update={"milliseconds": {}, "a": None, "b": None, "transform": None})


def test_two_frames_are_compared_as_the_library_does(full, uploads, prepared):
    names = full.ids()

    def side(i, stored):
        if stored:
            return NamedFrame(map="hall", frame_id=names[i])
        return uploads[i].data, uploads[i].meta

    how = Comparison(seed=3)
    for a, b in ((0, 1), (0, 7), (4, 4)):
        v = validate(prepared[b][1], prepared[a][1], 3)
        actual = []
        for kinds in ((True, True), (True, False), (False, True)):
            one = full.queries.compare(side(a, kinds[0]), side(b, kinds[1]), how)
            actual.append(timeless(one))
            assert one.distance == distance(prepared[a][0], prepared[b][0])
            assert (one.validation.status, one.validation.inliers) == (v.status, v.inliers)
            assert [one.a is not None, one.b is not None] == [*kinds]
            if v.T_match_query is None:
                assert one.transform is None
                continue
            assert one.transform.matrix == v.T_match_query.tolist()
            sides = zip((a, b), kinds, "ab", strict=True)
            words = [names[i] if stored else word for i, stored, word in sides]
            if words[0] == words[1]:
                words = ["a", "b"]
            ends = [one.transform.parent_frame, one.transform.child_frame]
            assert ends == [f"{word}.optical" for word in words]
        assert actual[0] == actual[1] == actual[2]
    near = full.queries.compare(side(0, True), side(1, True), how)
    sent = full.queries.compare(side(0, False), side(1, False), Comparison(model="depth"))
    assert (sent.distance, sent.model) == (near.distance, full.get_map("hall").model)
    bare = full.queries.compare(side(0, True), side(1, True), Comparison(validate=False))
    assert (bare.validation, bare.transform, bare.distance) == (None, None, near.distance)
    strict = Comparison.model_validate({"seed": 3, "validation": {"residual_m": 1e-9}})
    rejected = full.queries.compare(side(0, True), side(1, True), strict)
    assert rejected.validation.status == "rejected"


def test_frames_that_cannot_be_compared(full, uploads):
    full.create_map(NewMap(name="big", model="paper"))
    big, _ = full.add(uploads[0], "big")
    other = NamedFrame(map="big", frame_id=big.frame_id)
    stored = NamedFrame(map="hall", frame_id=full.ids()[0])
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
