"""Tests of poses of queries: priors, sequences, causes, and reads from the store."""

import math
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from sceneprint.engine.maps.map_lifecycle import edit_frame
from sceneprint.engine.search.answer import answer_status
from sceneprint.engine.search.query import localization_of
from sceneprint.engine.search.verification import Validated, numbers_of
from sceneprint.errors import InvalidPose, InvalidRequest
from sceneprint.geometry.rigid import inverse
from sceneprint.geometry.validation.validation import PairValidation, ValidationParameters
from sceneprint.localization import AlternativePose, PoseEstimate, localize, views_of_rows
from sceneprint.models import read_model
from sceneprint.pipeline import PairMatch, associate, diversify, retrieve
from sceneprint.places import QueryFrame, model_parameters
from sceneprint.store.maps import placed_frames
from sceneprint.types import Patches
from sceneprint_client.api import Counts, Prior, Query


def localized(engine, upload, **how):
    query = Query.model_validate({"keep": False, **how})
    meta = upload.meta.model_copy(update={"pose": None})
    return localization_of(engine.ask(upload, query, meta=meta))


def judged(there):
    if there.pose is not None:
        return [(there.pose.matrix, there.confidence, there.evidence)]
    return [(a.pose.matrix, a.confidence, a.evidence) for a in there.alternatives]


def prior_at(upload, shift=0.0, **more):
    T = np.array(upload.pose)
    T[0, 3] += shift
    return {"pose": {"matrix": T.tolist(), "parent_frame": upload.room}, **more}


def listed(covariance):
    return covariance.ravel().tolist()


def test_frames_are_found_by_where_they_were_taken(full, uploads):
    poses = [np.array(upload.pose)[:3, 3] for upload in uploads]
    with full.store.database.read() as connection:
        row, _, _ = full.view("hall")

        def near(centre, within, most=99, room=uploads[0].room):
            return placed_frames(
                connection, row.number, room, row.model_id, centre.tolist(), within, most
            )

        for within in (0.01, 0.05, 5.0):
            by_hand = sorted(
                (float(((at - poses[2]) ** 2).sum()), i)
                for i, at in enumerate(poses[:6])
                if np.abs(at - poses[2]).max() <= within
            )
            actual = near(poses[2], within)
            assert [item.number for item in actual] == [i + 1 for _, i in by_hand]
            for item in actual:
                np.testing.assert_allclose(item.pose, uploads[item.number - 1].pose, atol=1e-12)
        assert [one.number for one in near(poses[2], 5.0, most=2)] == [3, by_hand[1][1] + 1]
        assert near(poses[2] + 50.0, 5.0) == []
        assert near(poses[2], 5.0, room="nowhere") == []
    full.delete_frame("hall", full.ids()[2])
    with full.store.database.read() as connection:
        left = placed_frames(
            connection, row.number, uploads[0].room, row.model_id, poses[2].tolist(), 5.0, 99
        )
    assert 3 not in {one.number for one in left}


@pytest.mark.parametrize(
    ("number", "candidates", "without"),
    [(8, 10, ()), (8, 1, ()), (8, 10, (1, 2, 3, 7)), (2, 1, (3, 9))],
)
def test_poses_are_scored_on_the_frames_that_pass_alone(
    full, prepared, signer, uploads, number, candidates, without
):
    names = full.ids()
    others = [i for i in range(len(prepared)) if i != number and i not in without]
    signatures = [prepared[i][0] for i in others]
    geometries = [prepared[i][1] for i in others]
    query, seen = prepared[number]
    p = signer.model.parameters.validation
    p = replace(p, acceptance=replace(p.acceptance, ambiguous=0.0))  # no match is accepted
    ranking = retrieve(query, signatures, signer.model)
    chosen = diversify(ranking, signatures, candidates).indices.tolist()
    matches = associate(seen, ranking, chosen, geometries.__getitem__, 5, 0, p)
    poses, rooms = [uploads[i].pose for i in others], [uploads[i].room for i in others]
    views_of = views_of_rows(matches, poses, geometries.__getitem__, rooms)
    frames = [QueryFrame(seen, matches)]
    own_p = replace(model_parameters(frames), voted_only=True)
    by_library = localize(frames, poses, rooms, views_of, p=own_p)
    assert by_library.verified_by in (None, "map")
    how = {"candidates": candidates, "validation": {"ambiguous": 0.0}}
    if without:
        how["filter"] = {"exclude_frames": [names[i] for i in without]}
    answer = full.query_frame("hall", names[number], Query.model_validate(how))
    assert answer.status == by_library.status != "not_found"
    result = judged(localization_of(answer))
    for (matrix, confidence, evidence), alternative in zip(
        result, by_library.alternatives, strict=True
    ):
        np.testing.assert_allclose(matrix, alternative.T, atol=1e-9)
        assert confidence == pytest.approx(alternative.confidence)
        assert evidence.score == pytest.approx(alternative.evidence.score, abs=1e-3)


#: A query of which no match is accepted, so that the map judges the poses that it suggests.
UNSURE = {"validation": {"ambiguous": 0.0}}


def test_frames_of_other_parent_frames_tell_nothing_of_a_pose(full, uploads):
    before = localized(full, uploads[8], **UNSURE)
    assert judged(before)
    for frame_id, own, there in zip(full.ids(), uploads[:6], uploads[6:], strict=False):
        pose = {"matrix": there.pose.tolist(), "parent_frame": own.room}
        edit_frame(full.store, "hall", frame_id, {"pose": pose})
    after = localized(full, uploads[8], **UNSURE)
    assert judged(after) == judged(before)


def test_frames_about_each_pose_are_asked(full, uploads):
    alone = localized(full, uploads[8], candidates=1, **UNSURE)
    prior = prior_at(uploads[8], 50.0)
    there = localized(full, uploads[8], candidates=1, prior=prior, **UNSURE)
    assert judged(there) == judged(alone)
    assert judged(alone)


def test_the_paper_s_test_asks_no_other_frames(full, uploads):
    for mode, answer in (("full", True), ("paper", False)):
        there = localized(full, uploads[8], validation={"mode": mode})
        assert (there.status, there.verified_by) == ("found", "matches")
        assert (there.confidence is not None) is answer
        assert (there.evidence is not None) is answer


def test_a_query_says_how_sure_a_pose_must_be(full, uploads):
    sure = localized(full, uploads[8], confidence=0.5)
    assert sure.status == "found"
    answer = full.ask(uploads[8], Query(confidence=0.5, keep=False))
    assert answer.location.confidence == sure.confidence
    model = read_model("depth")
    for wanted in (0.5, 0.99, 0.999):
        assert numbers_of(model, Query(confidence=wanted)).confidence == wanted
    assert numbers_of(model, Query()).confidence == 0.99
    for wrong in (0.49, 1.0):
        with pytest.raises(ValidationError, match="confidence"):
            Query(confidence=wrong)


def test_candidates_near_a_prior_are_tried_first(full, uploads):
    rooms = dict(zip(full.ids(), (upload.room for upload in uploads), strict=True))

    def tried(prior):
        query = Query.model_validate({"keep": False, "prior": prior})
        meta = uploads[8].meta.model_copy(update={"pose": None})
        answer = full.ask(uploads[8], query, meta=meta)
        assert len(answer.matches) == 10
        elsewhere = [match for match in answer.matches if rooms[match.frame_id] == uploads[0].room]
        assert len(elsewhere) > 1
        return [one.validation.status for one in elsewhere]

    assert set(tried(None)) == {"skipped"}  # the nearest of all is a match
    assert set(tried(prior_at(uploads[0]))) == {"rejected"}
    assert set(tried(prior_at(uploads[8]))) == {"skipped"}
    # of coordinates alone, either room is as near
    here = prior_at(uploads[0])
    here["pose"]["parent_frame"] = uploads[8].room
    assert set(tried(here)) == {"skipped"}


@pytest.mark.parametrize(
    "how",
    [
        {"deviation_m": 1e-6, "deviation_deg": 1e-4},
        {"covariance": np.diag([1e-12] * 6)},
        {"covariance": np.diag([1e6] * 6)},
        {"covariance": np.diag([1e6, 1e-12] * 3)},
        {"covariance": np.eye(6) * 1e-4 + np.full((6, 6), 1.0)},  # mostly of all axes at once
    ],
)
def test_priors_of_any_deviation_in_range_are_used(full, uploads, how):
    answer = {name: listed(one) if name == "covariance" else one for name, one in how.items()}
    for away in (0.3, 9e8):
        there = localized(full, uploads[8], prior=prior_at(uploads[8], away, **answer))
        assert (there.status, there.verified_by) == ("found", "matches")


def test_a_prior_that_cannot_be_used_says_why(full, uploads):
    flat, asymmetric, hostile = np.eye(6), np.eye(6), np.eye(6)
    flat[0, 0], asymmetric[0, 1] = 0.0, 0.5
    hostile[0, 1], hostile[1, 0] = 1e308, -1e308
    equal = np.ones((6, 6)) * 0.04  # one error that all axes share
    skew, elsewhere = prior_at(uploads[8]), prior_at(uploads[8])
    skew["pose"]["matrix"][0][0] += 0.5
    elsewhere["pose"]["parent_frame"] = "elsewhere"
    for prior, error, message in (
        *(
            (prior_at(uploads[8], covariance=listed(matrix)), InvalidRequest, "is not valid")
            for matrix in (flat, asymmetric, equal, hostile, -np.eye(6))
        ),
        *(
            (prior_at(uploads[8], covariance=listed(np.diag(variances))), InvalidRequest, limits)
            for variances, limits in (
                ([1e-320, 1, 1, 1, 1, 1], "between 1e-160 and 1, but"),
                ([0.9e-12, 1, 1, 1, 1, 1], "between 9.49e-07 and 1, but"),
                ([1, 1, 1e308, 1, 1, 1], r"between 1 and 1e\+154, but"),
                ([1e-4, 1, 1.1e6, 1, 1, 1], r"between 0.01 and 1.05e\+03"),
            )
        ),
        *((prior_at(uploads[8], x), InvalidRequest, "from the origin") for x in (1.1e9, -1.7e308)),
        (skew, InvalidPose, "The prior"),
        (elsewhere, InvalidRequest, "No frame of map 'hall' has a pose in the parent"),
    ):
        with pytest.raises(error, match=message):
            localized(full, uploads[8], prior=prior)
    for deviation in ({"deviation_m": 1e-200}, {"deviation_deg": 1e-320}):
        with pytest.raises(ValueError, match="greater than or equal to"):
            Prior.model_validate(prior_at(uploads[8], **deviation))
    with pytest.raises(InvalidRequest, match="A prior requires validated matches"):
        full.ask(
            uploads[8], Query.model_validate({"stages": "retrieve", "prior": prior_at(uploads[8])})
        )


def test_a_sequence_places_its_last_frame(full, uploads):
    start = np.eye(4)
    start[:3, 3] = 40.0, -7.0, 1.0
    sent = []
    for upload in uploads[6:9]:
        T = start @ inverse(np.array(uploads[6].pose)) @ np.array(upload.pose)
        pose = {"matrix": T.tolist(), "parent_frame": "odom"}
        meta = upload.meta.model_validate(upload.meta.model_dump() | {"pose": pose})
        sent.append((upload.data, meta))
    answer = full.queries.sequence("hall", sent, Query(keep=False))
    assert (answer.status, answer.frames) == ("found", 3)
    assert answer.location.votes == 15  # five of each frame
    there = np.array(answer.location.pose.matrix)
    assert np.linalg.norm(there[:3, 3] - np.array(uploads[8].pose)[:3, 3]) < 0.02
    turn = there[:3, :3].T @ np.array(uploads[8].pose)[:3, :3]
    assert math.degrees(math.acos(min(1.0, (np.trace(turn) - 1) / 2))) < 1.0
    assert "earlier" in answer.milliseconds


def test_a_sequence_needs_frames_and_odometry(full, uploads):
    bare = uploads[0].meta.model_copy(update={"pose": None})
    one, other = (uploads[0].data, uploads[0].meta), (uploads[0].data, bare)
    for frames, why in (
        ([one], "The sequence has 1 frames"), ([one] * 11, "The sequence has 11 frames"),
        ([one, other], "frame 1 has no pose"),
        ([one, (uploads[6].data, uploads[6].meta)], "the parent frames differ"),
    ):  # fmt: skip
        with pytest.raises(InvalidRequest, match=why):
            full.queries.sequence("hall", frames, Query())


@pytest.mark.parametrize(
    ("change", "cause", "reason"),
    [
        ("scale", "scale", "times as far away as those in the map. Check `depth_scale`"),
        ("wall", "one_plane", "towards furniture"),
    ],
)
def test_what_is_not_found_names_its_likeliest_cause(
    full, uploads, make_upload, change, cause, reason
):
    frame = uploads[0].frame
    if change == "scale":
        upload = uploads[0]
        meta = upload.meta.model_copy(update={"depth_scale": 5000.0, "pose": None})
        answer = full.ask(upload, Query(keep=False), meta=meta)
    else:
        # a slanted wall, which fills the view
        slant = 1.5 + np.linspace(0.0, 1.0, frame.depth.shape[1])[None, :]
        depth = np.broadcast_to(slant, frame.depth.shape).astype(np.float32)
        wall = make_upload(replace(frame, depth=depth, pose=np.eye(4)), "wall")
        answer = full.ask(wall, Query(keep=False))
    assert (answer.status, answer.cause, answer.location) == ("not_found", cause, None)
    assert reason in answer.reason
    assert [m.pose_in_map for m in answer.matches if m.validation.status == "rejected"] == [
        None for m in answer.matches if m.validation.status == "rejected"
    ]


def came_of(geometry, *statuses, estimate=None, late=False, others=()):
    matches = []
    for i, status in enumerate(statuses):
        validation = PairValidation(
            status, "strong" if status == "accepted" else None, f"as given {i}",
            np.eye(4), 0.01, 0.01, 0.5, 0.4, 0.0, 100, 0.0, None, 0,
        )  # fmt: skip
        matches.append(PairMatch(i, 10, 0.5, validation))
    n = len(matches)
    tried = Validated(range(n + late), matches, {}, "", late, dict(enumerate(others)))
    counts = Counts(
        map=9, passed=9, compared=9, ranked=9, selected=n + late, validated=n,
        accepted=statuses.count("accepted"),
    )  # fmt: skip
    p = ValidationParameters()
    return answer_status(Query(), estimate, tried, matches, counts, geometry, p, posed=True)


def supported(*confidences):
    answer = tuple(AlternativePose(np.eye(4), 0, confidence, None) for confidence in confidences)
    status = "ambiguous" if answer else "not_found"
    return PoseEstimate(status, "the map's say", "hall", None, None, None, None, answer)


def test_poses_of_the_map_are_told_where_no_match_is_accepted(prepared):
    seen = prepared[0][1]
    answer = came_of(seen, "rejected", estimate=supported(0.5, 0.4), others=[seen])
    assert (answer.status, answer.reason, answer.cause) == ("ambiguous", "the map's say", None)
    none = came_of(seen, "rejected", estimate=supported(), others=[seen])
    assert (none.status, none.cause) == ("not_found", "nothing_alike")
    assert "(the nearest: as given 0)" in none.reason
    # what is wrong with the match itself says more than that the map bears nothing out
    unsure = came_of(seen, "rejected", "ambiguous", estimate=supported(), others=[seen])
    assert (unsure.status, unsure.reason) == (
        "ambiguous", "the best fit is not unique: as given 1",
    )  # fmt: skip
    late = came_of(seen, "rejected", estimate=supported(), late=True, others=[seen])
    assert (late.status, late.cause) == ("unvalidated", "deadline")
    assert "1 of 2 candidates were validated" in late.reason


def test_what_in_view_is_no_help_is_the_cause(prepared):
    seen, other = prepared[0][1], prepared[1][1]
    few = Patches(*(value[:9] for value in vars(seen.patches).values()))
    answer = came_of(replace(seen, patches=few), "rejected", others=[other])
    assert (answer.status, answer.cause) == ("not_found", "too_little_in_view")
    assert "the frame has 9 surface patches, but 10 are needed" in answer.reason
    cloud = replace(other, surface=replace(other.surface, camera=None))
    for others, cause in (
        ([cloud], "other_sensor"), ([cloud, cloud], "other_sensor"), ([], "nothing_alike"),
        ([cloud, other], "nothing_alike"), ([other], "nothing_alike"),
    ):  # fmt: skip
        assert came_of(seen, "rejected", others=others).cause == cause
