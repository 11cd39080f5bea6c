"""Tests that an evaluation and a service give the same status, confidence and pose."""

from dataclasses import replace

import numpy as np
import pytest

from sceneprint.formats.artifact import read_geometry, write_geometry
from sceneprint.geometry.rigid import pose_difference
from sceneprint_client.api import Query
from sceneprint_lab.evaluation.judgement import Candidate, Judge, QueryTask, answer_of, rank
from sceneprint_lab.evaluation.sites import signed


@pytest.fixture
def both(empty, work_off, signer):
    """Ask a service and an evaluation of the same frames."""

    def ask(in_map, queries, candidates=10):
        for one in in_map:
            empty.add_frame("hall", one.data, one.meta)
        work_off(empty)
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
            np.stack([one.signature for one in members]),
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
            served = empty.queries.upload(["hall"], one.data, meta, how)
            pairs.append((served, answer_of(judge, task)))
            see_same(*pairs[-1], one.pose)
        return pairs

    return ask


def see_same(served, evaluated, truth):
    """See that a service and an evaluation answer alike."""
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
    assert {one.validation.search for one in served.matches} == {"correspondences"}
    first = served.alternatives[0]
    assert first.support > 2  # that many had guided the others, which vote now as well
    assert pose_difference(np.array(first.pose.matrix), np.array(path[4].pose))[0] < 0.02
    assert first.evidence.rival_weight >= 0.8  # the two frames that are off vote elsewhere
