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


@pytest.mark.parametrize("shape", [(0, 4, 4), (4, 4), (2, 3, 4), (1, 4, 4, 1), (0,)])
def test_what_is_no_pose(shape):
    with pytest.raises(ValueError, match="poses has shape"):
        average_poses(np.zeros(shape))
