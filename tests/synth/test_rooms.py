import numpy as np
import pytest

from sceneprint_lab.synth import make_room
from sceneprint_lab.synth.mesh import (
    Ceiling,
    Opening,
    Wall,
    area,
    ceiling,
    face_normals,
    floor_plan,
    shell,
    volume,
    walls_of,
)
from sceneprint_lab.synth.rooms import CELL, Floor, PiecePose

L_PLAN = np.array([(0, 0), (4, 0), (4, 2), (2, 2), (2, 3), (0, 3)], float)


def test_shell_encloses_the_room_and_its_recesses():
    walls = walls_of(L_PLAN)
    w = walls[0]
    walls[0] = Wall(
        w.corner, w.along, w.length, (Opening(1, 2, 0, 2, 0.2), Opening(2.5, 3, 0.5, 1, 0.4, 0.9))
    )
    mesh = shell(L_PLAN, walls, Ceiling(2.5, np.zeros(2)))
    # normals face the room, so the volume is negative
    assert volume(mesh) == pytest.approx(-(10 * 2.5 + 1 * 2 * 0.2 + 0.5 * 0.5 * 0.4))
    np.testing.assert_allclose(face_normals(mesh).sum(axis=0), 0, atol=1e-12)
    lost = mesh.loss > 0
    assert np.linalg.norm(face_normals(mesh)[lost], axis=1).sum() / 2 == pytest.approx(0.5 * 0.5)


def test_plans_and_ceilings_keep_to_their_bounds():
    rng = np.random.default_rng(0)
    for _ in range(200):
        outline = floor_plan(rng)
        x, y = outline.T
        assert np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)) > 0  # counter-clockwise
        assert 2.5 <= np.ptp(x) <= 8.0
        assert 2.5 <= np.ptp(y) <= 8.2
        assert 2.09 < ceiling(rng, outline).at(outline).min() < 3.2


def test_floor_is_claimed_once_and_only_inside():
    floor = Floor(L_PLAN)
    assert np.count_nonzero(floor.inside) * CELL**2 == pytest.approx(10.0)
    assert floor.claim(PiecePose(1, 1, 0.5), 0.8, 0.6)
    assert np.count_nonzero(floor.claimed & floor.inside) * CELL**2 == pytest.approx(0.48, abs=0.05)
    before = floor.claimed.copy()
    assert not floor.claim(PiecePose(1.3, 1, 0), 0.8, 0.6)
    assert not floor.claim(PiecePose(3.5, 2.5, 0), 0.4, 0.4)
    np.testing.assert_array_equal(floor.claimed, before)
    assert floor.claim(PiecePose(1.5, 1, 0), 0.6, 0.6, overlap=0.6)


def test_rooms_are_furnished():
    for seed in range(8):
        room = make_room(np.random.default_rng(seed))
        assert room.vertices.dtype == np.float32
        assert room.faces.dtype == np.int32
        assert room.faces.max() < len(room.vertices)
        assert len(room.mesh.loss) == len(room.faces) > 2000
        bare = area(shell(room.outline, walls_of(room.outline), room.ceiling))
        assert area(room.mesh) > 1.3 * bare
        top = room.ceiling.at(room.mesh.vertices[:, :2])
        assert (room.mesh.vertices[:, 2] < top + 0.01).all()
