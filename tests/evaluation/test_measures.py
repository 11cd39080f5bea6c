"""Tests of the figures of an evaluation against manual results."""

import math

import numpy as np
import pytest

from sceneprint.types import DepthFrame, Intrinsics
from sceneprint_lab.evaluation import sites
from sceneprint_lab.evaluation.judgement import rank, views_to_average
from sceneprint_lab.evaluation.measures import (
    PLACES,
    absent,
    answers,
    bound,
    diversity,
    lost,
    metres_apart,
    place_of,
    recall,
    roc,
    rows,
    upper_bound,
    validation,
)
from sceneprint_lab.evaluation.protocol import Error, JudgedAnswer, SignedFrame, travelled
from sceneprint_lab.evaluation.sites import ask_site
from tests.evaluation.conftest import outcome, pair


def test_rows_of_three_queries(three):
    actual = rows(three)  # the third has no scene to be found in
    assert actual["R"] == {
        "within_5cm_5deg": 0.0,
        "within_10cm_10deg": 0.5,  # 7 cm, and a match of another scene
        "median_translation_m": None,
        "median_rotation_deg": None,
        "top1_overlap_50": 0.5,  # 0.6 and 0
        "top5_overlap_50": 1.0,  # 0.6, and 0.5 at rank 3
        "top1_overlap_30": 0.5,
        "mean_overlap": pytest.approx(0.3),
        "right_scene": 0.5,
    }
    assert actual["DR"]["top5_overlap_50"] == 1.0
    assert actual["DR"]["within_10cm_10deg"] == 0.5
    # strong goes before weak: 2 cm, not 7; and 15 cm
    assert actual["VR"]["within_5cm_5deg"] == 0.5
    assert actual["VR"]["median_translation_m"] == pytest.approx(0.085)
    # 4 cm and 6 degrees; nothing accepted
    assert actual["VDR"]["within_5cm_5deg"] == 0.0
    assert actual["VDR"]["within_10cm_10deg"] == 0.5
    assert actual["pose_average"]["within_5cm_5deg"] == 0.5
    assert actual["pose_average_vr"]["within_10cm_10deg"] == 0.5
    assert bound(three)["VDR"]["within_5cm_5deg"] == 0.5  # 3 cm; nothing accepted
    assert bound(three)["pose_average"]["within_5cm_5deg"] == 0.5


def test_acceptance_of_three_queries(three):
    actual = validation(three)
    assert (actual["pairs"], actual["accepted"], actual["accepted_strong"]) == (7, 5, 2)
    assert actual["precision"] == pytest.approx(3 / 5)  # 15 cm, and another scene
    assert actual["precision_strong"] == 1.0
    assert actual["recall"] == pytest.approx(3 / 4)  # the ambiguous one was right
    assert actual["recall_overlap_30"] == pytest.approx(2 / 3)  # one overlaps by 20 %
    assert (actual["right_but_rejected"], actual["right_but_ambiguous"]) == (0, 1)
    assert actual["pairs_of_other_scenes"] == 2
    assert actual["accepted_of_other_scenes"] == 1
    assert actual["accepted_strong_of_other_scenes"] == 0
    assert absent(three) == {
        "queries": 1,
        "accepted_strong": 0.0,
        "accepted_weak": 1.0,
        "pairs": 1,
        "pairs_accepted": 1,
    }


def test_whole_answers_by_hand():
    result = [
        JudgedAnswer("found", "strong", Error(0.02, 0.01)),
        JudgedAnswer("found", "weak", Error(0.10, math.radians(10))),
        JudgedAnswer("found", "weak", Error(0.30, 0.05)),
        JudgedAnswer("found", "strong", Error(0.05, math.radians(180))),
        JudgedAnswer("found", "weak"),
        JudgedAnswer("ambiguous"),
        JudgedAnswer("not_found"),
        JudgedAnswer("not_found"),
    ]
    actual = answers(result)
    assert actual == {
        "queries": 8,
        "found_right": 2 / 8,
        "found_wrong": 3 / 8,
        "ambiguous": 1 / 8,
        "not_found": 2 / 8,
        "grossly_wrong": 2 / 8,
        "grossly_wrong_at_most": upper_bound(2, 8),
        "found_strong_wrong": 1 / 8,
        "wrong_of_found": 3 / 5,
        "calibration_error": None,  # of answers whose places are not known
        "reliability": None,
    }
    nothing = answers([])
    assert nothing.pop("queries") == 0
    assert set(nothing.values()) == {None}


def test_where_three_queries_are_lost(three):
    counts = lost(three)
    assert list(counts) == list(PLACES)
    assert sum(counts.values()) == 3
    assert (counts["found"], counts["ambiguous"], counts["wrongly_accepted"]) == (1, 1, 1)


@pytest.mark.parametrize(
    ("place", "status", "off", "least", "ranking", "selection"),
    [
        ("found", "accepted", Error(0.09, 0.1), [0.4, 0.4], [0, 1], [0]),
        ("near", "accepted", Error(0.09, 0.2), [0.4, 0.4], [0, 1], [0]),
        ("near", "accepted", Error(0.19, 0.1), [0.0, 0.0], [0, 1], [0]),
        ("wrongly_accepted", "accepted", Error(0.21, 0.1), [0.4, 0.4], [0, 1], [0]),
        ("nothing_overlaps", "rejected", None, [0.29, 0.29], [0, 1], [0]),
        ("not_in_r", "rejected", None, [0.0, 0.3], [0], [0]),
        ("not_in_c", "rejected", None, [0.0, 0.3], [0, 1], [0]),
        ("rejected", "rejected", None, [0.3, 0.0], [0, 1], [0]),
        ("ambiguous", "ambiguous", None, [0.3, 0.0], [0, 1], [0]),
        ("not_in_c", "ambiguous", None, [0.2, 0.3], [0, 1], [0]),
    ],
)
def test_each_place(place, status, off, least, ranking, selection):
    pairs = [pair(0, status, off=off), pair(1, "rejected")]
    assert place_of(outcome(ranking, selection, pairs, least=least)) == place


def test_views_to_average():
    pairs = [pair(0, strength="weak"), pair(1, scene="there"), pair(2, "rejected"), pair(3)]
    assert [p.match for p in views_to_average(pairs)] == [3, 0]
    # as many views: the scene of the most believed one
    assert [p.match for p in views_to_average(pairs[:2])] == [1]
    assert len(views_to_average([pair(i) for i in range(9)])) == 5
    assert views_to_average([pairs[2]]) == []


CAMERA = Intrinsics(40, 4, 100.0, 100.0, 0.0, 0.0)


def dots(*columns, shift=0.0, depth=1.01):
    image = np.zeros((4, 40), np.float32)
    image[0, list(columns)] = depth
    pose = np.eye(4)
    pose[0, 3] = shift
    return DepthFrame(image, CAMERA, "dots", pose)


def test_diversity_by_hand():
    database = [dots(0), dots(0), dots(0, 10), dots(0, 10, 20), dots(30)]
    poses = [np.eye(4) for _ in database]
    for pose, x in zip(poses, (1.0, 2.0, 4.0, 8.0, 16.0), strict=True):
        pose[0, 3] = x
    one = outcome(
        [0, 1, 2, 3, 4], [0, 3, 4], [pair(i) for i in range(4)] + [pair(4, scene="there")]
    )
    actual = diversity([one], poses, database.__getitem__)
    # R has three candidates at 1, 2, 4 m; C 1 and 8 m, and one of another scene
    spread = math.sqrt(((1 - 7 / 3) ** 2 + (2 - 7 / 3) ** 2 + (4 - 7 / 3) ** 2) / 3)
    assert actual["translation"]["R"] == {
        "mean_m": pytest.approx(7 / 3),
        "std_m": pytest.approx(spread),
    }
    assert actual["translation"]["DR"] == {"mean_m": 4.5, "std_m": 3.5}
    # as many views of either: 1, 2 m and 1, 8 m
    assert actual["translation"]["VR"] == {"mean_m": 1.5, "std_m": 0.5}
    assert actual["translation"]["VDR"] == {"mean_m": 4.5, "std_m": 3.5}
    assert actual["coverage"] == {"VR": 1.0, "VDR": 3.0, "ratio_of_means": 3.0, "mean_ratio": 3.0}
    assert (actual["queries"], actual["queries_validated"]) == (1, 1)


def test_a_site_whose_map_is_one_surface_is_asked_of_views(small_signer, monkeypatch):
    monkeypatch.setattr(sites, "VIEWS", 12)
    answers = ask_site(small_signer, ("object", 0, 1), seed=5, as_surface=True)
    places = [place for answer in answers for place in answer.answer.places]
    assert places
    assert all(place.evidence.rendered for place in places)


def member(name, x, y=0.0, scene="hall"):
    pose = np.eye(4)
    pose[:2, 3] = x, y
    return SignedFrame(0, name, scene, pose, np.zeros(4, np.uint8))


def test_recall_by_hand():
    relevant = np.array([[1, 0, 1], [0, 0, 1], [0, 1, 0], [0, 0, 0]], bool)
    allowed = np.array([[1, 1, 0], [1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)
    # the first finds at once; the second at the third place; of the third what is relevant may
    # not be found, and the fourth has nothing: neither counts
    rankings = [[0, 1], [0, 1, 2], [0, 2], [0, 1, 2]]
    actual = recall(relevant, allowed, rankings)
    assert actual == {"queries": 2, "at_1": 0.5, "at_5": 1.0, "at_10": 1.0}
    nothing = recall(np.zeros((1, 3), bool), np.ones((1, 3), bool), [[0]])
    assert nothing == {"queries": 0, "at_1": None, "at_5": None, "at_10": None}


def test_poses_of_two_scenes_are_not_compared():
    actual = metres_apart([member("a/1", 0)], [member("a/2", 3, 4), member("b/1", 0, 0, "shed")])
    np.testing.assert_array_equal(actual, [[5.0, np.inf]])


def test_travel_leads_through_all_frames_of_a_run():
    # out to 3 m and back: frame 10 comes after frame 9, at the place of frame 1
    run = [member("hall/1", 0), member("hall/9", 3), member("hall/10", 0)]
    other = member("hall/b/1", 0)
    actual = travelled([run[2], run[0], other], [run[0], run[1], run[2], other])
    np.testing.assert_array_equal(
        actual, [[6, 3, 0, np.inf], [0, -3, -6, np.inf], [np.inf, np.inf, np.inf, 0]]
    )


@pytest.mark.parametrize(("seen", "of"), [(0, 2000), (3, 40), (9, 10)])
def test_the_bound_is_that_of_clopper_and_pearson(seen, of):
    from scipy.stats import beta, binom  # slow to import

    bound = upper_bound(seen, of)
    assert bound == pytest.approx(beta.ppf(0.95, seen + 1, of - seen), rel=1e-9)
    # what it means: so few are seen with a chance of 5 % there, and with less above
    assert binom.cdf(seen, of, bound) == pytest.approx(0.05, rel=1e-6)


def test_a_curve_by_hand():
    right = np.array([True, True, False, True, False])
    curve = roc(np.array([5.0, 4.0, 3.0, 3.0, 1.0]), right)
    np.testing.assert_allclose(curve.true, [0, 1 / 3, 2 / 3, 1, 1])
    np.testing.assert_allclose(curve.false, [0, 0, 0, 1 / 2, 1])
    np.testing.assert_array_equal(curve.thresholds, [np.inf, 5, 4, 3, 1])
    assert curve.area == pytest.approx((2 + 2 + 1.5) / 6)  # of six couples one is a tie
    assert [curve.true_at(share) for share in (0.0, 0.49, 0.5)] == [2 / 3, 2 / 3, 1.0]
    assert curve.thinned() == [
        [0.0, 0.0, np.inf], [0.0, 1 / 3, 5.0], [0.0, 2 / 3, 4.0], [0.5, 1.0, 3.0], [1.0, 1.0, 1.0]
    ]  # fmt: skip


def test_a_ranking_by_hand():
    queries = np.array([[10, 10]], np.uint8)
    database = np.array([[10, 16], [10, 11], [12, 12], [14, 13], [10, 11]], np.uint8)
    allowed = np.array([[True, True, True, True, False]])
    (actual,) = rank(queries, database, allowed, metric="l1", candidates=2)
    assert actual.ranking == [1, 2, 0, 3]
    assert actual.distances.tolist() == [1, 4, 6, 7]
    assert actual.selection[0] == 1
    assert len(actual.selection) == 2
    (actual,) = rank(queries, database, allowed, metric="l2", candidates=2)
    assert actual.ranking == [1, 2, 3, 0]
    assert actual.distances.tolist() == [1, 8, 25, 36]
    assert set(actual.milliseconds) == {"rank", "compare_ranking", "diversify"}
