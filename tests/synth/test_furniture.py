import numpy as np
import pytest

from sceneprint_lab.synth import furniture
from sceneprint_lab.synth.mesh import SyntheticMesh, face_normals, volume

PIECES = [
    furniture.table, furniture.round_table, furniture.desk, furniture.chair,
furniture.swivel_chair, furniture.stool,
    furniture.sofa, furniture.bed, furniture.cupboard, furniture.shelf, furniture.kitchen_row,
furniture.fridge,
    furniture.counter, furniture.floor_thing, furniture.stairs,
]  # fmt: skip
THINGS = [builder for builder, _ in furniture.SMALL]


def assert_solid(mesh: SyntheticMesh) -> None:
    assert np.isfinite(mesh.vertices).all()
    np.testing.assert_allclose(face_normals(mesh).sum(axis=0), 0, atol=1e-9)
    assert volume(mesh) > 0


@pytest.mark.parametrize("maker", PIECES)
def test_a_piece_is_solid_and_stands_on_its_footprint(maker):
    for seed in range(25):
        piece = maker(np.random.default_rng(seed))
        assert_solid(piece.mesh)
        low, high = piece.mesh.vertices.min(axis=0), piece.mesh.vertices.max(axis=0)
        assert -0.02 < low[2] < 0.12
        assert high[2] < 2.8
        assert (high - low)[0] < piece.width + 0.3
        assert (high - low)[1] < piece.depth + 0.45
        for s in piece.surfaces:
            assert 0 < s.z <= high[2] + 0.1


@pytest.mark.parametrize("builder", THINGS)
def test_a_thing_is_solid_and_small(builder):
    for seed in range(25):
        mesh = builder(np.random.default_rng(seed))
        assert_solid(mesh)
        assert abs(mesh.vertices[:, 2].min()) < 0.15
        assert np.ptp(mesh.vertices, axis=0).max() < 1.2
