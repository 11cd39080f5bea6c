import numpy as np
import pytest

from sceneprint.types import Floats
from sceneprint_lab.synth import make_room, scattered_poses, trajectory
from sceneprint_lab.synth.mesh import Ceiling, SyntheticMesh, box
from sceneprint_lab.synth.rooms import Room, inside
from sceneprint_lab.synth.trajectories import CLEARANCE, HEIGHTS, clear, pose

SEEDS = (0, 1, 2)


def winding(mesh: SyntheticMesh, point: Floats) -> float:
    """How often the mesh encloses a point: its solid angle over 4 pi."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    numerator = (a * np.cross(b, c)).sum(axis=1)
    dot = [(x * y).sum(axis=1) for x, y in ((a, b), (b, c), (c, a))]
    denominator = la * lb * lc + dot[0] * lc + dot[1] * la + dot[2] * lb
    return float(2 * np.arctan2(numerator, denominator).sum() / (4 * np.pi))


def test_pose_by_hand():
    T = pose(np.array([1.0, 2.0, 1.5, 0.0, 0.0, 0.0]))
    # looks along +x: image right is -y, image down is -z
    np.testing.assert_allclose(T[:3, :3], [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-13)
    np.testing.assert_allclose(T[:, 3], (1, 2, 1.5, 1))
    down = pose(np.array([0, 0, 0, 0, np.radians(-30), 0.0]))
    np.testing.assert_allclose(down[:3, 2], (np.sqrt(3) / 2, 0, -0.5))
    rolled = pose(np.array([0, 0, 0, 0, 0, np.radians(90)]))
    np.testing.assert_allclose(rolled[:3, 0], (0, 0, -1), atol=1e-13)  # x where y was


def test_clear_knows_outside_inside_and_near():
    outline = np.array([(-3, -3), (3, -3), (3, 3), (-3, 3)], float)
    hall = box(6, 6, 3)
    hall = SyntheticMesh(hall.vertices, hall.faces[:, ::-1], hall.loss)
    solid = box(1, 1, 1)
    both = SyntheticMesh(
        np.concatenate([hall.vertices, solid.vertices]),
        np.concatenate([hall.faces, solid.faces + 8]).astype(np.int32),
        np.zeros(24, np.float32),
    )
    room = Room(both, outline, Ceiling(3.0, np.zeros(2)))
    points = np.array([(2, 2, 1.5), (0, 0, 0.5), (5, 0, 1.5), (0.7, 0, 0.5), (0, 0, 1.2)], float)
    assert clear(room, points).tolist() == [True, False, False, False, False]
    assert winding(both, points[0]) == pytest.approx(-1)
    assert winding(both, points[1]) == pytest.approx(0)


def assert_good(room: Room, poses: list[Floats]) -> None:
    for T in poses:
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
        np.testing.assert_array_equal(T[3], (0, 0, 0, 1))
        assert inside(room.outline, T[:2, 3])
        assert HEIGHTS[0] - 0.1 < T[2, 3] < HEIGHTS[1] + 0.1
        assert winding(room.mesh, T[:3, 3]) == pytest.approx(-1, abs=0.05)


@pytest.mark.parametrize("seed", SEEDS)
def test_scattered_views_are_free_rigid_and_differ(seed):
    rng = np.random.default_rng(seed)
    room = make_room(rng)
    poses = scattered_poses(room, 12, rng)
    assert len(poses) == 12
    assert_good(room, poses)
    places = np.array([T[:3, 3] for T in poses])
    assert clear(room, places, CLEARANCE).all()
    assert places.std(axis=0).min() > 0.05


def test_hands_look_slightly_down():
    forward = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        forward += [T[:3, 2] for T in scattered_poses(make_room(rng), 12, rng)]
    pitch = np.degrees(np.arcsin(np.array(forward)[:, 2]))
    assert -30 < pitch.mean() < -5
    assert 8 < pitch.std() < 25


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
