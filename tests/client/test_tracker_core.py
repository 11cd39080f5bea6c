"""Tests of the tracker's arithmetic: first fix, gate, kidnapping, ambiguity and drift."""

import math

import numpy as np
import pytest

from sceneprint_client.errors import InvalidPose, InvalidRequest
from sceneprint_client.tracker_core import (
    Observation,
    PoseEvidence,
    TrackerCore,
    TrackerParameters,
    difference,
    inverse,
    rotation_matrix,
    rotation_vector,
    spaced_views,
)

#: Covariance of the answers of these tests: 4 cm and 0 about each axis; 3 cm and 1 deg are added.
COVARIANCE = np.diag([0.0016] * 3 + [0.0] * 3)


def at(x, y=0.0, z=0.0, yaw_deg=0.0):
    T = np.eye(4)
    T[:3, :3] = rotation_matrix(np.array([0, 0, math.radians(yaw_deg)]))
    T[:3, 3] = x, y, z
    return T


#: Where the odometry began, in the map.
T_MAP_ODOM = at(10, 20, 0, 90)


def pose(T, weight=1.0, parent="map"):
    return PoseEvidence(parent, T, weight, COVARIANCE)


def fix(T, *, strong=True, by_prior=False, parent="map"):
    return Observation("found", (pose(T, parent=parent),), strong, by_prior, "an answer")


def several(*poses, weights=None):
    evidence = tuple(map(pose, poses, weights or [1.0] * len(poses)))
    return Observation("ambiguous", evidence, reason="an answer")


NOTHING = Observation("not_found", reason="nothing alike")


def tracking(parameters=None):
    """One that was fixed at the origin of the odometry, at 0 s."""
    core = TrackerCore(parameters)
    assert core.update(0.0, at(0), fix(T_MAP_ODOM)).status == "tracking"
    return core


def step(core, stamp, x, observation):
    return core.update(stamp, at(x), observation)


def test_views_of_a_question_differ_and_lie_close_behind_the_last():
    assert spaced_views([at(0)], 3) == [0]
    assert spaced_views([at(0), at(1), at(2), at(2.9)], 3) == [1, 2, 3]
    assert spaced_views([at(0), at(1), at(1.95), at(2)], 3) == [0, 1, 3]
    assert spaced_views([at(0), at(1.95), at(2)], 1) == [2]
    # it turns: 5 degrees are too few, and 7 are enough; 121 degrees of way are too many
    turns = [at(0, yaw_deg=a) for a in (-114, -107, 0, 5, 7)]
    assert spaced_views(turns, 5) == [1, 2, 4]
    # 3.1 m of way, to and fro
    assert spaced_views([at(0), at(1.6), at(0.1)], 3) == [1, 2]
    # a jump of the odometry
    assert spaced_views([at(0), at(50), at(50.5), at(51)], 4) == [1, 2, 3]


def test_a_strong_answer_is_a_fix():
    core = TrackerCore()
    assert core.move(0.0, at(3)).status == "lost"
    state = core.update(1.0, at(3), fix(at(10, 23, 0, 90)))
    assert (state.status, state.parent_frame, state.age, state.stamp) == ("tracking", "map", 0, 1)
    # 3 m ahead in odometry is 3 m along y of the map, as the map is turned by 90 degrees
    np.testing.assert_allclose(state.T_map_odom, T_MAP_ODOM, atol=1e-12)
    np.testing.assert_allclose(state.T_map_sensor, at(10, 23, 0, 90), atol=1e-12)
    turned = math.radians(1) ** 2
    assert state.covariance is not None
    np.testing.assert_allclose(np.diag(state.covariance), [0.0025] * 3 + [turned] * 3)


def test_a_weak_answer_needs_another_from_another_place():
    core = TrackerCore()
    assert step(core, 0, 0, fix(T_MAP_ODOM, strong=False)).status == "lost"
    assert step(core, 1, 0.1, fix(at(10, 20.1, 0, 90), strong=False)).status == "lost"
    state = step(core, 2, 0.5, fix(at(10.05, 20.5, 0, 90), strong=False))
    assert state.status == "tracking"
    np.testing.assert_allclose(state.T_map_sensor, at(10.05, 20.5, 0, 90), atol=1e-12)


def test_answers_by_the_prior_are_no_fix_and_neither_are_alternatives():
    core = TrackerCore()
    for i in range(9):
        assert step(core, i, i, fix(at(10, 20 + i, 0, 90), by_prior=True)).status == "lost"
        assert step(core, i + 0.5, i, several(at(10, 20 + i, 0, 90))).status == "ambiguous"


def test_views_of_two_places_alike_are_ambiguous_until_one_is_found():
    core = TrackerCore()
    for i in range(5):
        here, there = at(10, 20 + i, 0, 90), at(50, 20 + i, 0, 90)
        state = step(core, i, i, several(here, there))
        assert (state.status, state.T_map_odom) == ("ambiguous", None)
    # what both have cancels out; the answer leads by 1.5
    assert step(core, 5, 5, fix(at(50, 25, 0, 90))).status == "tracking"


def test_two_answers_that_contradict_each_other_are_ambiguous():
    core = TrackerCore()
    assert step(core, 0, 0, fix(T_MAP_ODOM, strong=False)).status == "lost"
    assert step(core, 1, 1, fix(at(50, 21, 0, 90), strong=False)).status == "ambiguous"
    assert step(core, 2, 2, NOTHING).status == "ambiguous"
    assert step(core, 3, 3, fix(at(10, 23, 0, 90), strong=False)).status == "ambiguous"
    assert step(core, 4, 4, fix(at(10, 24, 0, 90), strong=False)).status == "tracking"


def test_parent_frames_are_places_apart():
    core = TrackerCore()
    assert step(core, 0, 0, fix(T_MAP_ODOM, strong=False)).status == "lost"
    other = fix(at(10, 21, 0, 90), strong=False, parent="attic")
    assert step(core, 1, 1, other).status == "ambiguous"


def test_one_answer_never_moves_it():
    core = tracking()
    wrong = fix(at(50, 21, 0, 90))
    state = step(core, 1, 1, wrong)
    assert state.status == "tracking"
    assert "pose is unchanged" in state.reason
    np.testing.assert_allclose(state.T_map_sensor, at(10, 21, 0, 90), atol=1e-12)
    assert state.age == 1
    # an answer that agrees makes it forgotten: the next wrong one is a first one again
    assert step(core, 2, 2, fix(at(10, 22, 0, 90))).age == 0
    assert step(core, 3, 3, fix(at(50, 23, 0, 90))).status == "tracking"


def test_kidnapped_it_is_lost_by_answers_from_places_apart_and_found_again():
    core = tracking()
    assert step(core, 1.0, 1.0, fix(at(50, 21, 0, 90))).status == "tracking"
    state = step(core, 1.5, 1.5, fix(at(50, 21.5, 0, 90)))
    assert (state.status, state.T_map_odom, state.covariance, state.age) == (
        "lost", None, None, None,
    )  # fmt: skip
    state = step(core, 2.0, 2.0, fix(at(50, 22, 0, 90)))
    assert state.status == "tracking"
    np.testing.assert_allclose(state.T_map_sensor, at(50, 22, 0, 90), atol=1e-12)


def test_contradicted_from_one_place_it_is_ambiguous_and_soon_lost():
    core = tracking()
    wrong = fix(at(50, 20, 0, 90))
    assert step(core, 1.0, 0, wrong).status == "tracking"
    assert step(core, 1.5, 0, wrong).status == "ambiguous"
    assert core.move(2.4, at(0)).status == "ambiguous"
    assert core.move(2.5, at(0)).status == "lost"  # 1.5 s after the first
    core = tracking()
    step(core, 1.0, 0, wrong)
    assert step(core, 1.5, 0, wrong).status == "ambiguous"
    assert step(core, 1.6, 0, fix(T_MAP_ODOM)).status == "tracking"


def test_ambiguous_answers_without_the_tracked_place_count_half():
    core = tracking()
    elsewhere = [at(50, 20, 0, 90), at(70, 20, 0, 90)]
    patient = [step(core, 0.1 * i, i, several(*elsewhere)).status for i in range(1, 5)]
    assert patient == ["tracking", "ambiguous", "ambiguous", "lost"]


def test_the_deviation_grows_by_a_hundredth_of_the_way():
    core = tracking(TrackerParameters(heading_drift_deg=0.0))
    state = core.move(10.0, at(6))
    assert state.covariance is not None
    # 5 cm at the fix, 6 cm of drift along the way; and 1 deg turns 6 m aside by 10.5 cm
    aside = 0.0025 + 0.0036 + (6 * math.radians(1)) ** 2
    # ahead is y of the map
    np.testing.assert_allclose(np.diag(state.covariance)[:3], [aside, 0.0061, aside], rtol=1e-9)
    # 26 cm of drift along 26 m, and 45 cm aside
    assert core.move(20.0, at(16)).status == "lost"


def test_an_answer_that_agrees_is_weighed_by_its_covariance():
    core = tracking(TrackerParameters(heading_drift_deg=0.0, drift=0.0))
    state = step(core, 1, 1, fix(at(10, 21.1, 0, 90)))
    # both deviate by 5 cm along y: halfway
    np.testing.assert_allclose(state.T_map_sensor[:3, 3], [10, 21.05, 0], atol=1e-9)
    assert state.covariance[1, 1] == pytest.approx(0.00125)
    # from the same place it says nothing new
    again = step(core, 2, 1.1, fix(at(10, 21.3, 0, 90)))
    np.testing.assert_allclose(again.T_map_sensor[:3, 3], [10, 21.15, 0], atol=1e-9)


def test_the_prior_is_left_out_every_fourth_time_and_after_a_contradiction():
    core = TrackerCore()
    assert core.prior(at(0)) is None
    step(core, 0, 0, fix(T_MAP_ODOM))
    priors = []
    for i in range(1, 9):
        prior = core.prior(at(i))
        priors.append(prior is not None)
        if prior is not None:
            np.testing.assert_allclose(prior.T_map_sensor, at(10, 20 + i, 0, 90), atol=1e-9)
            assert prior.parent_frame == "map"
        step(core, i, i, fix(at(10, 20 + i, 0, 90)))
    assert priors == [True, True, False, True, True, True, False, True]
    step(core, 9, 9, fix(at(50, 29, 0, 90)))
    assert core.prior(at(10)) is None


def test_the_prior_does_not_confirm_itself_for_ever():
    """A lift between equal floors: each is found by the prior, and neither without it."""
    core = tracking()
    statuses = []
    for i in range(1, 14):
        floors = [at(10, 20 + i, z, 90) for z in (0.0, 3.0)]
        answer = fix(floors[0], by_prior=True) if i % 4 else several(*floors)
        state = step(core, float(i), float(i), answer)
        statuses.append(state.status)
        assert state.age == i
    assert statuses == ["tracking"] * 11 + ["ambiguous"] * 2
    assert core.prior(at(15)) is None  # in doubt it asks without
    state = step(core, 14, 14, fix(at(10, 34, 0, 90)))
    assert (state.status, state.age) == ("tracking", 0)


def test_no_answer_is_neither_for_nor_against():
    core = tracking()
    state = step(core, 1, 1, Observation("unanswered", reason="no answer: away"))
    assert state.status == "tracking"
    lost = TrackerCore().update(0, at(0), Observation("unanswered", reason="no answer: away"))
    assert (lost.status, lost.reason) == ("lost", "no answer: away")


def test_a_late_answer_counts_where_its_frame_was_taken():
    core = TrackerCore()
    for i in range(5):
        core.move(i, at(i))
    state = core.update(2, at(2), fix(at(10, 22, 0, 90)))
    assert (state.stamp, state.age) == (4, 2)
    np.testing.assert_allclose(state.T_map_sensor, at(10, 24, 0, 90), atol=1e-12)


def test_stamps_that_do_not_rise_are_refused():
    core = tracking()
    core.move(1.0, at(1))
    core.move(1.0, at(1))  # the same once more
    for stamp, T in ((1.0, at(2)), (0.5, at(1)), (-1.0, at(0))):
        with pytest.raises(InvalidRequest, match=r"not after 1\.0"):
            core.update(stamp, T, NOTHING)
    with pytest.raises(InvalidPose):
        core.move(2.0, at(math.nan))
    assert core.reset("the clock jumped").stamp == 1.0
    assert core.update(0.5, at(7), fix(at(10, 27, 0, 90))).status == "tracking"


def test_a_long_run_forgets_votes():
    core = TrackerCore(TrackerParameters(most_votes=4))
    for i in range(20):
        step(core, i, i, several(at(10, 20 + i), at(40, 20 + i)))
    assert len(core._votes) <= 8
    state = step(core, 20, 20, fix(at(10, 40), strong=False))
    assert state.status in ("ambiguous", "lost")


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1.0, 3.0, math.pi - 1e-8, math.pi])
def test_rotations_and_their_vectors(angle):
    axis = np.array([1.0, -2.0, 2.0]) / 3
    R = rotation_matrix(axis * angle)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    vector = rotation_vector(R)
    assert min(np.abs(vector - axis * angle).max(), np.abs(vector + axis * angle).max()) < 1e-6
    T = at(1, 2, 3)
    T[:3, :3] = R
    np.testing.assert_allclose(inverse(T) @ T, np.eye(4), atol=1e-12)
    moved, turned = difference(np.eye(4), T)
    assert moved == pytest.approx(math.sqrt(14))
    assert turned == pytest.approx(angle, abs=1e-6)
