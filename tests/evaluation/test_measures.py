"""Tests of rows, acceptance, lost queries and diversity against manual results."""

import json
import math

import numpy as np
import pytest

from sceneprint.types import DepthFrame, Intrinsics
from sceneprint_lab.evaluation.judgement import views_to_average
from sceneprint_lab.evaluation.measures import (
    PLACES,
    absent,
    answers,
    bound,
    diversity,
    lost,
    place_of,
    rows,
    upper_bound,
    validation,
)
from sceneprint_lab.evaluation.protocol import (
    Error,
    JudgedAnswer,
)
from sceneprint_lab.evaluation.report import (
    per_query,
    to_json,
    without_infinities,
)


def test_rows_of_three_queries(three):
    found = rows(three)  # the third has no scene to be found in
    assert found["R"] == {
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
    assert found["DR"]["top5_overlap_50"] == 1.0
    assert found["DR"]["within_10cm_10deg"] == 0.5
    # strong goes before weak: 2 cm, not 7; and 15 cm
    assert found["VR"]["within_5cm_5deg"] == 0.5
    assert found["VR"]["median_translation_m"] == pytest.approx(0.085)
    # 4 cm and 6 degrees; nothing accepted
    assert found["VDR"]["within_5cm_5deg"] == 0.0
    assert found["VDR"]["within_10cm_10deg"] == 0.5
    assert found["pose_average"]["within_5cm_5deg"] == 0.5
    assert found["pose_average_vr"]["within_10cm_10deg"] == 0.5
    assert bound(three)["VDR"]["within_5cm_5deg"] == 0.5  # 3 cm; nothing accepted
    assert bound(three)["pose_average"]["within_5cm_5deg"] == 0.5


def test_acceptance_of_three_queries(three):
    found = validation(three)
    assert (found["pairs"], found["accepted"], found["accepted_strong"]) == (7, 5, 2)
    assert found["precision"] == pytest.approx(3 / 5)  # 15 cm, and another scene
    assert found["precision_strong"] == 1.0
    assert found["recall"] == pytest.approx(3 / 4)  # the ambiguous one was right
    assert found["recall_overlap_30"] == pytest.approx(2 / 3)  # one overlaps by 20 %
    assert (found["right_but_rejected"], found["right_but_ambiguous"]) == (0, 1)
    assert found["pairs_of_other_scenes"] == 2
    assert found["accepted_of_other_scenes"] == 1
    assert found["accepted_strong_of_other_scenes"] == 0
    assert absent(three) == {
        "queries": 1,
        "accepted_strong": 0.0,
        "accepted_weak": 1.0,
        "pairs": 1,
        "pairs_accepted": 1,
    }


def test_whole_answers_by_hand():
    """Two are right, one is off a little, one faces elsewhere, one is in another room."""
    told = [
        JudgedAnswer("found", "strong", Error(0.02, 0.01)),
        JudgedAnswer("found", "weak", Error(0.10, math.radians(10))),
        JudgedAnswer("found", "weak", Error(0.30, 0.05)),
        JudgedAnswer("found", "strong", Error(0.05, math.radians(180))),
        JudgedAnswer("found", "weak"),
        JudgedAnswer("ambiguous"),
        JudgedAnswer("not_found"),
        JudgedAnswer("not_found"),
    ]
    found = answers(told)
    assert found == {
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
def test_each_place(place, status, off, least, ranking, selection, make_outcome, make_pair):
    pairs = [make_pair(0, status, off=off), make_pair(1, "rejected")]
    assert place_of(make_outcome(ranking, selection, pairs, least=least)) == place


def test_views_to_average(make_pair):
    pairs = [
        make_pair(0, strength="weak"),
        make_pair(1, scene="there"),
        make_pair(2, "rejected"),
        make_pair(3),
    ]
    assert [p.match for p in views_to_average(pairs)] == [3, 0]
    # as many views: the scene of the most believed one
    assert [p.match for p in views_to_average(pairs[:2])] == [1]
    assert len(views_to_average([make_pair(i) for i in range(9)])) == 5
    assert views_to_average([pairs[2]]) == []


CAMERA = Intrinsics(40, 4, 100.0, 100.0, 0.0, 0.0)


def dots(*columns, shift=0.0, depth=1.01):
    """Single samples in the first row: 10 columns are five voxels at 1 m."""
    image = np.zeros((4, 40), np.float32)
    image[0, list(columns)] = depth
    pose = np.eye(4)
    pose[0, 3] = shift
    return DepthFrame(image, CAMERA, "dots", pose)


def test_diversity_by_hand(make_outcome, make_pair):
    database = [dots(0), dots(0), dots(0, 10), dots(0, 10, 20), dots(30)]
    poses = [np.eye(4) for _ in database]
    for pose, x in zip(poses, (1.0, 2.0, 4.0, 8.0, 16.0), strict=True):
        pose[0, 3] = x
    one = make_outcome(
        [0, 1, 2, 3, 4],
        [0, 3, 4],
        [make_pair(i) for i in range(4)] + [make_pair(4, scene="there")],
    )
    found = diversity([one], poses, database.__getitem__)
    # R has three candidates at 1, 2, 4 m; C 1 and 8 m, and one of another scene
    spread = math.sqrt(((1 - 7 / 3) ** 2 + (2 - 7 / 3) ** 2 + (4 - 7 / 3) ** 2) / 3)
    assert found["translation"]["R"] == {
        "mean_m": pytest.approx(7 / 3),
        "std_m": pytest.approx(spread),
    }
    assert found["translation"]["DR"] == {"mean_m": 4.5, "std_m": 3.5}
    # as many views of either: 1, 2 m and 1, 8 m
    assert found["translation"]["VR"] == {"mean_m": 1.5, "std_m": 0.5}
    assert found["translation"]["VDR"] == {"mean_m": 4.5, "std_m": 3.5}
    assert found["coverage"] == {"VR": 1.0, "VDR": 3.0, "ratio_of_means": 3.0, "mean_ratio": 3.0}
    assert (found["queries"], found["queries_validated"]) == (1, 1)


def test_json_has_null_for_what_is_infinite(three):
    names = ["a", "b", "c", "d"]
    found = without_infinities({"per_query": [per_query(one, names) for one in three]})
    read = json.loads(to_json(found))
    assert read["per_query"][1]["R"]["translation_m"] is None
    assert read["per_query"][1]["VDR"] is None
    assert read["per_query"][0]["VDR"]["match"] == "c"
    assert read["per_query"][0]["pose_average"]["translation_m"] == pytest.approx(0.01)
    with pytest.raises(ValueError, match="not JSON compliant"):
        to_json({"x": math.nan})
