"""Tests of candidates whose transform follows from earlier matches and the map's poses."""

from dataclasses import replace

import numpy as np
import pytest

from sceneprint.geometry.retrieval.ranking import Ranking
from sceneprint.geometry.rigid import inverse, pose_difference
from sceneprint.geometry.validation.validation import ValidationParameters, validate_guided
from sceneprint.localization import localize
from sceneprint.pipeline import PairMatch, associate, open_signer, prepare, unguided_validations
from sceneprint.places import QueryFrame


@pytest.fixture(scope="module")
def walk(room_views):
    """Six frames along a path through a room, more than 10 cm apart; the third asks the others."""
    signer = open_signer("depth")
    frames = room_views(21, 0, 36, along_path=True, step=6).frames
    frames = (frames[2], *frames[:2], *frames[3:])
    poses = [frame.pose for frame in frames if frame.pose is not None]
    return [prepare(frame, signer)[1] for frame in frames], poses


def asked_of(walk, rows, poses):
    geometries, _ = walk
    n = len(rows)
    ranking = Ranking(np.array(rows, np.intp), np.zeros(n, np.int64), np.zeros(n))
    matches = associate(
        geometries[0], ranking, range(n), geometries.__getitem__, n,
        pose_of=lambda row: ("room", poses[row]) if row in poses else None,
    )  # fmt: skip
    return sorted(matches, key=lambda match: rows.index(match.index))


def kinds(matches):
    return [match.validation.search for match in matches]


def test_two_matches_guide_the_rest_to_the_truth(walk):
    geometries, poses = walk
    rows = [1, 2, 3, 4, 5]
    matches = asked_of(walk, rows, dict(enumerate(poses)))
    assert kinds(matches) == ["correspondences"] * 2 + ["guided"] * 3
    for match in matches:
        v = match.validation
        metres, radians = pose_difference(v.T_match_query, inverse(poses[match.index]) @ poses[0])
        assert metres < 0.03
        assert radians < np.radians(1.0)
        assert v.guided == (v.predicted is not None) == (match.index > 2)
        assert v.reason.startswith("the surfaces agree")
        assert ("at the pose that other matches predict" in v.reason) == v.guided
    # the same bits from what was predicted: an answer is shown again from it
    first = matches[2].validation
    assert first.predicted is not None
    again = validate_guided(geometries[0], geometries[3], first.predicted)
    assert again.T_match_query.tobytes() == first.T_match_query.tobytes()
    assert (again.overlap, again.inliers) == (first.overlap, first.inliers)


def test_guided_matches_make_the_pose_more_precise_and_are_no_votes(walk):
    geometries, poses = walk
    matches = asked_of(walk, [1, 2, 3, 4, 5], dict(enumerate(poses)))
    answer = localize([QueryFrame(geometries[0], matches)], poses)
    assert (answer.status, answer.votes, len(answer.members), answer.guided) == ("found", 5, 5, 3)
    assert answer.reason.endswith("including 3 guided by other matches")
    assert answer.average.votes == 5
    # three weak matches elsewhere weigh 1.2: two strong ones do not outweigh that, five would
    elsewhere = poses[0].copy()
    elsewhere[0, 3] += 2.0
    weak = replace(matches[0].validation, strength="weak")
    against = [
        PairMatch(i, 9, 0.1, replace(weak, T_match_query=inverse(poses[i]) @ elsewhere))
        for i in (1, 2, 3)
    ]
    unsure = localize([QueryFrame(geometries[0], [*matches, *against])], poses)
    assert unsure.status == "ambiguous"
    assert unsure.alternatives[0].support == 2


def test_copies_of_one_view_guide_nothing(walk):
    _, poses = walk
    walk[0].append(walk[0][1])
    try:
        matches = asked_of(walk, [1, 6, 3], {1: poses[1], 6: poses[1], 3: poses[3]})
    finally:
        walk[0].pop()
    assert kinds(matches) == ["correspondences"] * 3


@pytest.mark.parametrize("known", [{}, {1: 1, 2: 2}, {1: 1, 3: 3}])
def test_without_poses_everything_is_searched(walk, known):
    poses = {row: walk[1][i] for row, i in known.items()}
    assert kinds(asked_of(walk, [1, 2, 3], poses)) == ["correspondences"] * 3


def test_matches_that_disagree_guide_nothing(walk):
    poses = dict(enumerate(walk[1]))
    poses[2] = poses[2].copy()
    poses[2][0, 3] += 1.0  # the map is wrong about it, so its match votes for another place
    assert kinds(asked_of(walk, [1, 2, 3], poses)) == ["correspondences"] * 3


def test_a_prediction_that_the_frames_do_not_bear_out_is_searched_for(walk):
    geometries, poses = walk
    wrong = dict(enumerate(poses))
    wrong[3] = wrong[3].copy()
    wrong[3][1, 3] += 0.4
    matches = asked_of(walk, [1, 2, 3], wrong)
    assert kinds(matches) == ["correspondences"] * 3
    T = matches[2].validation.T_match_query
    assert pose_difference(T, inverse(poses[3]) @ poses[0])[0] < 0.03
    truth = inverse(poses[3]) @ poses[0]
    near = truth.copy()
    near[0, 3] += 0.1
    assert validate_guided(geometries[0], geometries[3], near) is not None
    strict = ValidationParameters(guided_m=0.05)
    assert validate_guided(geometries[0], geometries[3], near, p=strict) is None


def test_guided_matches_can_be_searched_for_after_all(walk):
    geometries, poses = walk
    rows = [1, 2, 3]
    matches = asked_of(walk, rows, dict(enumerate(poses)))
    earlier = unguided_validations(matches)
    assert sorted(earlier) == [1, 2]
    ranking = Ranking(np.array(rows, np.intp), np.zeros(3, np.int64), np.zeros(3))
    again = associate(
        geometries[0], ranking, range(3), geometries.__getitem__, 3, validations=earlier,
    )  # fmt: skip
    by_row = {match.index: match.validation for match in again}
    assert by_row[1] is earlier[1]
    assert by_row[2] is earlier[2]
    assert by_row[3].search == "correspondences"
    assert unguided_validations(again) is None
    alone = associate(geometries[0], ranking, range(3), geometries.__getitem__, 3)
    of_alone = {match.index: match.validation.T_match_query for match in alone}
    np.testing.assert_array_equal(by_row[3].T_match_query, of_alone[3])
