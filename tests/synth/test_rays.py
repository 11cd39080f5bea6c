import sys

import numpy as np
import pytest

from sceneprint.errors import MissingDependency
from sceneprint.types import Intrinsics
from sceneprint_lab.synth import Caster, cast_depth, make_room
from sceneprint_lab.synth.mesh import ellipsoid, face_normals, mesh_of
from sceneprint_lab.synth.sensors import cast_faces, pixel_rays
from sceneprint_lab.synth.trajectories import pose

SMALL = Intrinsics(24, 18, 20.0, 21.0, 11.3, 8.9)


def oracle(mesh, T, camera):
    """Depth and cosine by Moeller and Trumbore against every triangle."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normals = face_normals(mesh)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    e, g, s = b - a, c - a, T[:3, 3] - a
    depth, cosine = np.zeros((2, camera.height, camera.width))
    for v in range(camera.height):
        for u in range(camera.width):
            ray = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
            d = T[:3, :3] @ ray
            h = np.cross(d, g)
            with np.errstate(divide="ignore", invalid="ignore"):
                f = 1 / (e * h).sum(axis=1)
                q = np.cross(s, e)
                x, y, t = f * (s * h).sum(axis=1), f * (q @ d), f * (q * g).sum(axis=1)
                hit = (x >= 0) & (y >= 0) & (x + y <= 1) & (t > 1e-6)
            if hit.any():
                k = np.where(hit, t, np.inf).argmin()
                depth[v, u], cosine[v, u] = t[k], abs(normals[k] @ d) / np.linalg.norm(d)
    return depth, cosine


def test_embree_agrees_with_the_oracle():
    room = make_room(np.random.default_rng(5))
    middle = room.outline[:3].mean(axis=0)
    T = pose(np.array([*middle, 1.5, 0.7, -0.3, 0.2]))
    expected_depth, expected_cosine = oracle(room.mesh, T, SMALL)
    depth, cosine = cast_depth(room.caster, T, SMALL)
    assert (expected_depth > 0).all()
    same = np.abs(depth - expected_depth) < 1e-4
    assert same.mean() > 0.995  # a ray through an edge may fall on either side
    np.testing.assert_allclose(cosine[same], expected_cosine[same], atol=2e-3)


def test_a_plane_has_its_analytic_depth_and_incidence():
    plane = mesh_of(
        [(-50, -50, 0), (50, -50, 0), (50, 50, 0), (-50, 50, 0)], [(0, 1, 2), (0, 2, 3)]
    )
    pitch = np.radians(-60)
    T = pose(np.array([0.3, -0.2, 1.5, 0.4, pitch, 0.0]))
    depth, cosine = cast_depth(Caster(plane), T, SMALL)
    y = (np.arange(18) - SMALL.cy)[:, None] / SMALL.fy
    x = (np.arange(24) - SMALL.cx) / SMALL.fx
    fall = np.sin(-pitch) + y * np.cos(pitch) + 0 * x  # metres lower a metre of depth
    np.testing.assert_allclose(depth, 1.5 / fall, rtol=1e-5)
    np.testing.assert_allclose(cosine, fall / np.sqrt(1 + x**2 + y**2), rtol=1e-4)


def test_a_sphere_has_its_analytic_depth_and_misses_beside_it():
    sphere = ellipsoid((0.5, 0.5, 0.5), 1.0, 200).moved((2, 0, -0.5))
    camera = Intrinsics(41, 31, 40.0, 40.0, 20.0, 15.0)
    depth, _, face = cast_faces(Caster(sphere), pose(np.zeros(6)), camera)
    rays = pixel_rays(camera).reshape(31, 41, 3).astype(float)
    length = np.linalg.norm(rays, axis=2)
    cos = 1 / length  # between ray and axis
    root = 0.25 - 4 * (1 - cos**2)
    expected = np.where(root > 0, (2 * cos - np.sqrt(np.maximum(root, 0))) / length, 0)
    clearly = np.abs(root) > 0.02
    np.testing.assert_allclose(depth[clearly], expected[clearly], atol=2e-3)
    np.testing.assert_array_equal(depth == 0, face == -1)
    assert (depth[0, 0], depth[15, 20]) == (0, pytest.approx(1.5, abs=1e-3))


def test_a_missing_embree_says_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)
    with pytest.raises(MissingDependency, match="pip install 'embreex"):
        Caster(ellipsoid((1, 1, 1)))
