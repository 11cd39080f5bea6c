"""Tests of the robust average of poses, and of its invariances."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneprint.geometry import rigid as module
from sceneprint.geometry.rigid import AveragingParameters, average_poses


def poses(rng, n, metres, degrees):
    """Votes about one pose, which is the first row; then n of them."""
    truth = np.eye(4)
    truth[:3, :3], truth[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(0, 3, 3)
    votes = np.tile(truth, (n + 1, 1, 1))
    turns = Rotation.from_rotvec(rng.normal(0, math.radians(degrees), (n, 3))).as_matrix()
    votes[1:, :3, :3] = turns @ truth[:3, :3]
    votes[1:, :3, 3] += rng.normal(0, metres, (n, 3))
    return votes


def test_by_hand(validation_goldens):
    validation_goldens.check_averaging(module)


def test_outliers_are_left_out():
    rng = np.random.default_rng(1)
    for _ in range(30):
        truth, *votes = poses(rng, 6, 0.02, 1.0)
        wrong = poses(rng, 3, 3.0, 60.0)[1:]
        mixed = np.array([wrong[0], *votes[:3], wrong[1], *votes[3:], wrong[2]])
        found = average_poses(mixed)
        assert (found.support, found.votes) == (6, 9)
        gap = found.T[:3, :3] @ truth[:3, :3].T
        assert np.linalg.norm(found.T[:3, 3] - truth[:3, 3]) < 0.04
        assert np.degrees(Rotation.from_matrix(gap).magnitude()) < 2.0
        np.testing.assert_allclose(found.T[:3, 3], np.mean(votes, axis=0)[:3, 3], atol=1e-12)
        left = [np.linalg.norm(v[:3, 3] - found.T[:3, 3]) for v in votes]
        assert found.spread_m == pytest.approx(np.sqrt(np.mean(np.square(left))))


def test_rotations_average_to_scipys_mean():
    rng = np.random.default_rng(2)
    votes = poses(rng, 5, 0.0, 2.0)[1:]
    found = average_poses(votes, AveragingParameters(1.0, 1.0))
    expected = Rotation.from_matrix(votes[:, :3, :3]).mean()
    turned = Rotation.from_matrix(found.T[:3, :3])
    assert (turned * expected.inv()).magnitude() < 1e-9
    spread = [(Rotation.from_matrix(v[:3, :3]) * turned.inv()).magnitude() for v in votes]
    assert found.spread_rad == pytest.approx(np.sqrt(np.mean(np.square(spread))))
    np.testing.assert_allclose(found.T[:3, :3] @ found.T[:3, :3].T, np.eye(3), atol=1e-12)


def test_ties_fall_to_the_earlier():
    rng = np.random.default_rng(3)
    for _ in range(100):
        # votes of which no two agree: the first, whatever rounding says of their agreement
        apart = np.array([poses(rng, 0, 0, 0)[0] for _ in range(5)])
        apart[:, 0, 3] += 100.0 * np.arange(5)
        np.testing.assert_allclose(average_poses(apart).T, apart[0], atol=1e-12)
        # twice two equal votes, and their copies: the pair that comes first
        a, b = apart[:2]
        for order in ([a, b, a, b], [b, a, a, b], [a, b, b, a]):
            np.testing.assert_allclose(average_poses(np.array(order)).T, order[0], atol=1e-12)


def test_moving_the_map_moves_the_average():
    rng = np.random.default_rng(4)
    votes = np.concatenate([poses(rng, 5, 0.03, 2.0), poses(rng, 2, 0.03, 2.0)])
    G = poses(rng, 0, 0, 0)[0]
    one, other = average_poses(votes), average_poses(G @ votes)
    np.testing.assert_allclose(other.T, G @ one.T, atol=1e-12)
    assert (other.support, other.votes) == (one.support, one.votes) == (6, 9)
    assert other.spread_m == pytest.approx(one.spread_m, abs=1e-12)
    assert other.spread_rad == pytest.approx(one.spread_rad, abs=1e-9)


@pytest.mark.parametrize("shape", [(0, 4, 4), (4, 4), (2, 3, 4), (1, 4, 4, 1), (0,)])
def test_what_is_no_pose(shape):
    with pytest.raises(ValueError, match="poses has shape"):
        average_poses(np.zeros(shape))
