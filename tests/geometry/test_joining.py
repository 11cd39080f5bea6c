"""Tests of the consensus of associations: known transforms, outliers and rejection."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneprint.geometry.rigid import inverse, pose_difference
from sceneprint.geometry.session_join import JoiningParameters, association_votes, join_sessions
from tests.geometry.scenes import rigid


def seen(rng, T_a_b, right, wrong, metres=0.01, degrees=0.4):
    """Frames of run b, 20 m from its origin, found again in run a; some of them wrongly."""
    n = right + wrong
    away = rigid(rng, 20.0)
    b = np.array([away @ rigid(rng, 1.5, 50.0) for _ in range(n)])
    a = np.array([T_a_b @ pose @ rigid(rng, 0.2, 10.0) for pose in b])
    transforms = np.array(
        [inverse(a[i]) @ T_a_b @ b[i] @ rigid(rng, metres, degrees) for i in range(n)]
    )
    for i in range(right, n):
        transforms[i] = rigid(rng, 1.0)
    order = rng.permutation(n)
    source = np.arange(n)
    return association_votes(
        transforms[order], b[order], a[order], source, source, rng.choice([0.5, 1.0], n)
    )


def at_places(votes, T, true):
    """Most that two transforms differ by where the frames are."""
    put, want = (votes.places @ one[:3, :3].T + one[:3, 3] for one in (T, true))
    return float(np.linalg.norm(put - want, axis=1).max())


@pytest.mark.parametrize("seed", range(2))
def test_a_known_transform_among_as_many_outliers(seed):
    rng = np.random.default_rng(seed)
    true = rigid(rng, 10.0)
    votes = seen(rng, true, 30, 30)
    join = join_sessions(votes, seed)
    assert (join.support, join.strength) == (30, "strong")
    assert at_places(votes, join.T, true) < 0.02
    assert pose_difference(join.T, true)[1] < math.radians(0.4)
    left = [pose_difference(join.T @ place_of(p), T @ place_of(p))[0]
            for T, p in zip(votes.transforms, votes.places, strict=True)]  # fmt: skip
    inside = np.array(left)[join.agree]
    assert join.spread_m == pytest.approx(math.sqrt((inside**2).mean()))


def place_of(point):
    T = np.eye(4)
    T[:3, 3] = point
    return T


def test_two_answers_with_as_many_votes_are_none():
    rng = np.random.default_rng(2)
    b = np.array([rigid(rng, 1.0, 20.0) for _ in range(20)])
    first, second = rigid(rng, 3.0), rigid(rng, 3.0)
    a = np.array([(first if i % 2 else second) @ pose for i, pose in enumerate(b)])
    n, T = np.arange(20), np.tile(np.eye(4), (20, 1, 1))
    join = join_sessions(association_votes(T, b, a, n, n, np.ones(20)))
    assert (join.T, join.strength, join.support, join.rival) == (None, None, 10, 10)
    assert "another transform" in join.reason
    # of which one has half as much again, and a third of it: then it is believed
    weights = np.where(n % 2, 1.0, 0.45)
    assert join_sessions(association_votes(T, b, a, n, n, weights)).T is not None


def test_too_few_votes_or_too_few_frames_are_none():
    rng = np.random.default_rng(3)
    true = rigid(rng, 3.0)
    b = np.array([rigid(rng, 1.0, 20.0) for _ in range(12)])
    a, T, n = true @ b, np.tile(np.eye(4), (12, 1, 1)), np.arange(12)
    assert join_sessions(association_votes(T[:2], b[:2], a[:2], n[:2], n[:2], np.ones(2))).T is None
    assert (
        join_sessions(association_votes(T[:3], b[:3], a[:3], n[:3], n[:3], np.ones(3))).strength
        == "weak"
    )
    one = np.zeros(12, np.int64)
    assert join_sessions(association_votes(T, b, a, one, n, np.ones(12))).T is None
    assert join_sessions(association_votes(T, b, a, n, n, np.ones(12))).strength == "strong"
    with pytest.raises(ValueError, match="There are no votes"):
        join_sessions(association_votes(T[:0], b[:0], a[:0], n[:0], n[:0], np.ones(0)))


def test_many_frames_of_one_place_join_nothing():
    """A robot that stands still takes one view many times, and all are mistaken alike."""
    rng = np.random.default_rng(6)
    true, n = rigid(rng, 3.0), np.arange(30)
    still = np.array([rigid(rng, 5.0)] * 30)
    reaching = {"": still}
    for metres, said in ((0.09, "one viewpoint"), (0.11, "within 0.11 m"), (1.1, "agree")):
        reaching[said] = still.copy()
        reaching[said][:, 0, 3] += np.linspace(0.0, metres, 30)
    turning = [still[0] @ turned_by(degrees) for degrees in np.linspace(0.0, 7.0, 30)]
    reaching["within 0.00 m"] = np.array(turning)
    expected = {"": None, "one viewpoint": None, "within 0.11 m": "weak", "agree": "strong",
                "within 0.00 m": "weak"}  # fmt: skip
    for said, b in reaching.items():
        T = np.array([rigid(rng, 0.01, 0.4) for _ in range(30)])
        join = join_sessions(association_votes(T, b, true @ b, n, n, np.ones(30)))
        assert (join.support, join.strength) == (30, expected[said])
        assert said in join.reason
        assert (join.T is None) is (expected[said] is None)


def turned_by(degrees):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return T


def test_a_frame_that_was_found_often_counts_once():
    rng = np.random.default_rng(4)
    true, wrong = rigid(rng, 3.0), rigid(rng, 3.0)
    b = np.array([rigid(rng, 1.0, 20.0) for _ in range(20)])
    source = np.array([*range(8), *([8] * 6), *([9] * 6)])
    b = b[source]
    a = np.where((source < 8)[:, None, None], true @ b, wrong @ b)
    join = join_sessions(
        association_votes(np.tile(np.eye(4), (20, 1, 1)), b, a, source, np.arange(20), np.ones(20))
    )
    assert join.support == 8
    assert join.T is not None
    np.testing.assert_allclose(join.T, true, atol=1e-9)


def test_many_votes_are_tried_by_lot_and_the_same_lot_again():
    rng = np.random.default_rng(5)
    true = rigid(rng, 5.0)
    votes = seen(rng, true, 400, 400)
    p = JoiningParameters(hypotheses=20)
    join = join_sessions(votes, 7, p)
    assert join.T is not None
    assert join.support >= 395
    np.testing.assert_array_equal(join.T, join_sessions(votes, 7, p).T)
