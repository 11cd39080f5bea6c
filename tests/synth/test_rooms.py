import numpy as np
import pytest

from sceneprint_lab.synth import make_room
from sceneprint_lab.synth.mesh import (
    Ceiling,
    Opening,
    Wall,
    area,
    face_normals,
    shell,
    volume,
    walls_of,
)

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
