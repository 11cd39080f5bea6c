import numpy as np
import pytest

from sceneprint_lab.synth import make_room, trajectory
from sceneprint_lab.synth.rooms import inside
from sceneprint_lab.synth.trajectories import HEIGHTS, clear

SEEDS = (0,)


def winding(mesh, point):
    """How often the mesh encloses a point: its solid angle over 4 pi."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    numerator = (a * np.cross(b, c)).sum(axis=1)
    dot = [(x * y).sum(axis=1) for x, y in ((a, b), (b, c), (c, a))]
    denominator = la * lb * lc + dot[0] * lc + dot[1] * la + dot[2] * lb
    return float(2 * np.arctan2(numerator, denominator).sum() / (4 * np.pi))


def assert_good(room, poses):
    for T in poses:
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
        np.testing.assert_array_equal(T[3], (0, 0, 0, 1))
        assert inside(room.outline, T[:2, 3])
        assert HEIGHTS[0] - 0.1 < T[2, 3] < HEIGHTS[1] + 0.1
        assert winding(room.mesh, T[:3, 3]) == pytest.approx(-1, abs=0.05)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_path_is_smooth_free_and_comes_back(seed):
    rng = np.random.default_rng(seed)
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
