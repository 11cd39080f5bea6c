import numpy as np
import pytest

from sceneprint_lab.synth import make_room, trajectory
from sceneprint_lab.synth.rooms import inside
from sceneprint_lab.synth.trajectories import HEIGHTS, clear


def assert_good(room, poses):
    for T in poses:
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
        np.testing.assert_array_equal(T[3], (0, 0, 0, 1))
        assert inside(room.outline, T[:2, 3])
        assert HEIGHTS[0] - 0.1 < T[2, 3] < HEIGHTS[1] + 0.1


def test_a_path_is_smooth_free_and_comes_back():
    rng = np.random.default_rng(0)
    room = make_room(rng)
    poses = trajectory(room, 300, rng)
    assert len(poses) == 300
    assert_good(room, poses[::30])
    P = np.array(poses)
    assert np.linalg.norm(np.diff(P[:, :3, 3], axis=0), axis=1).max() < 0.10
    turned = np.einsum("kij,kij->k", P[1:, :3, :3], P[:-1, :3, :3])
    assert np.degrees(np.arccos(np.clip((turned - 1) / 2, -1, 1))).max() < 5
    assert clear(room, P[:, :3, 3], 0.25).all()
    # seen before: near a place of 60 frames ago or more, looking the same way
    again = np.zeros(300, bool)
    for k in range(60, 300):
        near = np.linalg.norm(P[: k - 60, :3, 3] - P[k, :3, 3], axis=1) < 0.5
        again[k] = (near & (P[: k - 60, :3, 2] @ P[k, :3, 2] > np.cos(0.5))).any()
    assert again.mean() > 0.15
