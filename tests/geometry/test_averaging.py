"""Tests of the robust average of poses, and of its invariances."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

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


def test_by_hand():
    def at(x, y=0.0, degrees=0.0):
        T = np.eye(4)
        a = math.radians(degrees)
        T[0, 0] = T[1, 1] = math.cos(a)
        T[1, 0], T[0, 1] = math.sin(a), -math.sin(a)
        T[0, 3], T[1, 3] = x, y
        return T

    # four votes around a square of 8 cm and 4 degrees, and two far off
    votes = [
        at(9.0),
        at(0, 0, -2),
        at(0.08, 0, 2),
        at(0, 0.08, -2),
        at(0.08, 0.08, 2),
        at(0, 0, 40),
    ]
    average = average_poses(np.array(votes))
    np.testing.assert_allclose(average.T, at(0.04, 0.04), atol=1e-12)
    assert (average.support, average.votes) == (4, 6)
    # each of the four is 4 cm off in x and in y, and 2 degrees
    np.testing.assert_allclose(average.spread_m, 0.04 * math.sqrt(2), atol=1e-12)
    np.testing.assert_allclose(average.spread_rad, math.radians(2), atol=1e-12)
    # the default tolerances: 15 cm and 10 degrees, either is enough to disagree
    for other, support in (
        (at(0.149), 2), (at(0.151), 1), (at(0, 0, 9.9), 2), (at(0, 0, 10.1), 1),
        (at(0.14, 0, 9), 2),
    ):  # fmt: skip
        assert average_poses(np.array([at(0), other])).support == support
    # nobody agrees: the earlier
    average = average_poses(np.array([at(1), at(2), at(3)]))
    np.testing.assert_array_equal(average.T, at(1))
    assert (average.spread_m, average.support, average.votes) == (0.0, 1, 3)
    # two against two: the two that are nearer to each other, though they come later
    average = average_poses(np.array([at(1), at(1.1), at(2), at(2.04)]))
    np.testing.assert_allclose(average.T, at(2.02), atol=1e-12)
    # more against fewer, though these are nearer; the mean is not the medoid
    average = average_poses(np.array([at(5), at(5.01), at(0), at(0.12), at(0.06), at(0.06)]))
    np.testing.assert_allclose(average.T, at(0.06), atol=1e-12)
    np.testing.assert_allclose(average.spread_m, math.sqrt(0.0072 / 4), atol=1e-12)
    # the medoid has two beside it, which do not agree with each other
    average = average_poses(np.array([at(-0.1), at(0.0), at(0.13)]))
    np.testing.assert_allclose(average.T, at(0.01), atol=1e-12)
    assert average.support == 3


def test_rotations_average_to_scipys_mean():
    rng = np.random.default_rng(2)
    votes = poses(rng, 5, 0.0, 2.0)[1:]
    average = average_poses(votes, AveragingParameters(1.0, 1.0))
    expected = Rotation.from_matrix(votes[:, :3, :3]).mean()
    turned = Rotation.from_matrix(average.T[:3, :3])
    assert (turned * expected.inv()).magnitude() < 1e-9
    spread = [(Rotation.from_matrix(v[:3, :3]) * turned.inv()).magnitude() for v in votes]
    assert average.spread_rad == pytest.approx(np.sqrt(np.mean(np.square(spread))))
    np.testing.assert_allclose(average.T[:3, :3] @ average.T[:3, :3].T, np.eye(3), atol=1e-12)
