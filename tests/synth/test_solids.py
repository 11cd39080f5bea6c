import math

import numpy as np
import pytest

from sceneprint_lab.synth.mesh import (
    SyntheticMesh,
    blob,
    box,
    cone,
    cylinder,
    ellipsoid,
    extrude,
    face_normals,
    revolve,
    ribbon,
    tapered_box,
    tube,
    volume,
)

RNG = np.random.default_rng(0)
NGON = 64 / 2 * math.sin(2 * math.pi / 64)  # area of a 64-gon in the unit circle


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (cylinder(0.5, 2.0, 64), NGON * 0.25 * 2.0),
        (cone(1.0, 0.0, 3.0, 64), NGON * 3.0 / 3),
        (cone(1.0, 0.5, 3.0, 64), NGON * 3.0 / 3 * (1 + 0.5 + 0.25)),
        (revolve([(1, 0), (1, 1), (0.5, 1), (0.5, 0.5)], 64), NGON * (1 - 0.25 * 0.5)),
        (tapered_box((1, 1), (2, 2), 3.0), (1 + 2 + 4) / 3 * 3.0),
        (extrude([(0, 0), (3, 0), (3, 1), (1, 1), (1, 2), (0, 2)], 0.5), 4.0 * 0.5),
        (ribbon([(0, 0), (1, 0), (2, 0)], 0.1, 3.0), 2 * 0.1 * 3.0),
        (tube([(0, 0, 0), (0, 0, 1), (0, 0, 2)], 1.0, 64), NGON * 2.0),
    ],
)
def test_volume_by_the_divergence_theorem(mesh: SyntheticMesh, expected: float):
    assert volume(mesh) == pytest.approx(expected)


def test_solids_are_closed_and_face_outward():
    for m in (
        box(1, 2, 3),
        cylinder(1, 2),
        ellipsoid((1, 2, 3), 0.4),
        blob(RNG, (0.3, 0.2, 0.1)),
        ribbon([(0, 0), (1, 0.2), (2, 0)], 0.1, 1),
        tube([(0, 0, 0), (1, 0, 0), (1, 1, 0), (1, 1, 1)], 0.1),
    ):
        np.testing.assert_allclose(face_normals(m).sum(axis=0), 0, atol=1e-12)
        assert volume(m) > 0
        assert volume(m.moved((5, -3, 2), 1.0)) == pytest.approx(volume(m))
