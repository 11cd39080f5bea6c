import math

import numpy as np
import pytest

from sceneprint_lab.synth.mesh import (
    SyntheticMesh,
    area,
    blob,
    box,
    cone,
    cylinder,
    ellipsoid,
    extrude,
    face_normals,
    join,
    revolve,
    ribbon,
    tapered_box,
    triangulate,
    tube,
    volume,
)

RNG = np.random.default_rng(0)
NGON = 64 / 2 * math.sin(2 * math.pi / 64)  # area of a 64-gon in the unit circle


def test_box_by_hand():
    m = box(2.0, 3.0, 4.0, at=(5.0, 6.0, 7.0), yaw=0.3)
    assert volume(m) == pytest.approx(24.0)
    assert area(m) == pytest.approx(2 * (6 + 8 + 12))
    np.testing.assert_allclose(m.vertices.mean(axis=0), (5.0, 6.0, 9.0))
    assert m.vertices[:, 2].min() == pytest.approx(7.0)


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


def test_ellipsoid_nears_the_sphere_and_the_box():
    sphere = ellipsoid((1, 1, 1), 1.0, 96)
    assert volume(sphere) == pytest.approx(4 / 3 * math.pi, rel=5e-3)
    np.testing.assert_allclose(np.linalg.norm(sphere.vertices - (0, 0, 1), axis=1), 1.0)
    assert volume(ellipsoid((1, 2, 3), 0.05, 96)) > 0.85 * 48


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


def test_triangles_fill_the_polygon():
    outline = np.array([(0, 0), (4, 0), (4, 3), (3, 3), (3, 1), (1, 1), (1, 3), (0, 3)], float)
    t = outline[triangulate(outline)]
    e, g = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    areas = (e[:, 0] * g[:, 1] - e[:, 1] * g[:, 0]) / 2
    assert (areas >= 0).all()
    assert areas.sum() == pytest.approx(12 - 2 * 2)


def test_join_adds_up_and_keeps_the_loss():
    a, b = box(1, 1, 1).with_loss(0.5), cylinder(1, 1)
    both = join([a, b])
    assert volume(both) == pytest.approx(volume(a) + volume(b))
    assert both.loss.tolist() == [0.5] * len(a.faces) + [0.0] * len(b.faces)
    assert len(join([]).faces) == 0
