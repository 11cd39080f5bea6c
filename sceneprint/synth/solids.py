"""Closed solids of which furniture is made; every one rests on z = 0 around the z axis.

a few lengths (metres)  --box, cylinder, cone, revolve, ...-->  Mesh, outward normals
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from sceneprint.synth.mesh import Mesh, mesh_of
from sceneprint.types import Floats, Ints32

_CORNERS = np.array([[x, y, z] for z in (0.0, 1.0) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
_BOX_FACES = np.array(
    [
        [0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4],
        [2, 6, 7], [2, 7, 3], [0, 4, 6], [0, 6, 2], [1, 3, 7], [1, 7, 5],
    ],
    np.int32,
)  # fmt: skip


def box(
    width: float, depth: float, height: float, at: ArrayLike = (0.0, 0.0, 0.0), yaw: float = 0.0
) -> Mesh:
    """A cuboid width x depth x height along x, y, z; `at` is the middle of its underside."""
    m = Mesh(_CORNERS * (width, depth, height), _BOX_FACES, np.zeros(12, np.float32))
    return m.moved(at, yaw)


def tapered_box(bottom: tuple[float, float], top: tuple[float, float], height: float) -> Mesh:
    """A box whose underside (width, depth) differs from its upper side."""
    scale = np.where(_CORNERS[:, 2:] > 0.5, np.array(top), np.array(bottom))
    xy = _CORNERS[:, :2] * scale
    return mesh_of(np.column_stack([xy, _CORNERS[:, 2] * height]), _BOX_FACES)


def revolve(profile: ArrayLike, segments: int = 16) -> Mesh:
    """The solid swept by a profile that turns about z.

    Parameters
    ----------
    profile : (n, 2) radius and height, metres, from the bottom along the outside to the
        top; ends away from the axis are closed by a disc
    segments : corners of the circle
    """
    p = np.asarray(profile, float)
    ends = ([[0.0, p[0, 1]]] if p[0, 0] > 0 else [], [[0.0, p[-1, 1]]] if p[-1, 0] > 0 else [])
    p = np.concatenate([np.reshape(ends[0], (-1, 2)), p, np.reshape(ends[1], (-1, 2))])
    angle = np.arange(segments) * (2 * math.pi / segments)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    rings = np.empty((len(p), segments, 3))
    rings[..., :2] = p[:, None, :1] * circle
    rings[..., 2] = p[:, 1:]
    return mesh_of(rings.reshape(-1, 3), _ring_faces(len(p), segments))


def cylinder(radius: float, height: float, segments: int = 16) -> Mesh:
    """An upright cylinder, as a prism of that many sides."""
    return revolve([(radius, 0.0), (radius, height)], segments)


def cone(lower: float, upper: float, height: float, segments: int = 16) -> Mesh:
    """A truncated cone from radius lower to radius upper; 0 makes a tip."""
    return revolve([(lower, 0.0), (upper, height)], segments)


def ellipsoid(radii: ArrayLike, power: float = 1.0, segments: int = 16) -> Mesh:
    """A superellipsoid resting on z = 0: power 1 is an ellipsoid, towards 0 a box."""
    directions = _sphere(segments)
    shaped = np.sign(directions) * np.abs(directions) ** power
    # points of the level set |x|^(2/power) + ... = 1 along each direction
    level = (np.abs(shaped) ** (2 / power)).sum(axis=-1, keepdims=True) ** (-power / 2)
    return _on_sphere(shaped * level * np.asarray(radii, float), segments)


def blob(rng: np.random.Generator, radii: ArrayLike, roughness: float = 0.12) -> Mesh:
    """A sphere bent by a few low-frequency waves: bags, cushions, crumpled cloth."""
    directions = _sphere(26)
    waves = rng.normal(size=(4, 3)) * 2.2
    swell = np.cos(directions @ waves.T + rng.uniform(0, 2 * math.pi, 4)) @ rng.normal(size=4)
    scale = np.maximum(1.0 + roughness * swell, 0.3)[..., None]
    power = rng.uniform(0.6, 1.0)
    shaped = np.sign(directions) * np.abs(directions) ** power
    shaped = shaped * scale
    shaped /= np.abs(shaped).max(axis=(0, 1))
    return _on_sphere(shaped * np.asarray(radii, float), 26)


def extrude(outline: ArrayLike, height: float) -> Mesh:
    """A prism over a simple polygon (n, 2), counter-clockwise, metres."""
    p = np.asarray(outline, float)
    n = len(p)
    cap = triangulate(p)
    i = np.arange(n)
    j = (i + 1) % n
    sides = np.concatenate([np.stack([i, j, j + n], 1), np.stack([i, j + n, i + n], 1)])
    v = np.concatenate([np.c_[p, np.zeros(n)], np.c_[p, np.full(n, height)]])
    return mesh_of(v, np.concatenate([cap[:, ::-1], cap + n, sides]))


def ribbon(path: ArrayLike, thickness: float, height: float) -> Mesh:
    """An upright sheet over an open path (n, 2): curtains, bent panels."""
    p = np.asarray(path, float)
    along = np.gradient(p, axis=0)
    side = np.column_stack([along[:, 1], -along[:, 0]])
    side *= thickness / 2 / np.linalg.norm(side, axis=1, keepdims=True)
    n = len(p)
    ring = np.stack([p + side, p - side], axis=1)  # right and left of the path
    v = np.concatenate([np.c_[ring[:, k], np.full(n, z)] for z in (0.0, height) for k in (0, 1)])
    corner = np.array([0, 1, 3, 2]) * n  # right-low, left-low, left-high, right-high
    faces = []
    for a, b in zip(corner, np.roll(corner, -1), strict=True):
        i = np.arange(n - 1)
        faces.append(np.stack([a + i, b + i, b + i + 1], 1))
        faces.append(np.stack([a + i, b + i + 1, a + i + 1], 1))
    start, end = corner, corner + n - 1
    faces.append(np.array([start[[0, 2, 1]], start[[0, 3, 2]], end[[0, 1, 2]], end[[0, 2, 3]]]))
    return mesh_of(v, np.concatenate(faces))


def tube(points: Sequence[ArrayLike], radius: float, segments: int = 8) -> Mesh:
    """A round rod along a path of points (n, 3): pipes, chair frames, cables, handles."""
    p = np.asarray(points, float)
    along = np.gradient(p, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    angle = np.arange(segments) * (2 * math.pi / segments)
    rings = []
    x = np.cross(along[0], np.eye(3)[int(np.argmin(np.abs(along[0])))])
    for t, centre in zip(along, p, strict=True):
        x = x - (x @ t) * t
        x /= np.linalg.norm(x)
        y = np.cross(t, x)
        rings.append(centre + radius * (np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * y))
    first, last = np.tile(p[0], (segments, 1)), np.tile(p[-1], (segments, 1))
    v = np.concatenate([first, *rings, last])
    return mesh_of(v, _ring_faces(len(p) + 2, segments))


def triangulate(outline: Floats) -> Ints32:
    """(n - 2, 3) triangles that fill a simple polygon (n, 2), counter-clockwise: ear clipping."""
    p = np.asarray(outline, float)
    left = list(range(len(p)))
    triangles = []
    while len(left) > 3:
        for k in range(len(left)):
            a, b, c = left[k - 1], left[k], left[(k + 1) % len(left)]
            others = [i for i in left if i not in (a, b, c)]
            if _turn(p[a], p[b], p[c]) > 1e-12 and not any(
                min(_turn(p[a], p[b], p[i]), _turn(p[b], p[c], p[i]), _turn(p[c], p[a], p[i])) >= 0
                for i in others
            ):
                break
        else:  # only corners on straight edges are left
            k = 1
        triangles.append((left[k - 1], left[k], left[(k + 1) % len(left)]))
        del left[k]
    return np.array([*triangles, tuple(left)], np.int32)


def _turn(a: Floats, b: Floats, c: Floats) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def _ring_faces(rings: int, segments: int) -> Ints32:
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(segments), indexing="ij")
    a, b = i * segments + j, i * segments + (j + 1) % segments
    c, d = b + segments, a + segments
    return np.concatenate(
        [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    ).astype(np.int32)


def _sphere(segments: int) -> Floats:
    latitude = np.linspace(-math.pi / 2, math.pi / 2, segments // 2 + 1)
    longitude = np.arange(segments) * (2 * math.pi / segments)
    c, s = np.cos(latitude), np.sin(latitude)
    c[[0, -1]] = 0.0
    return np.stack(
        [
            c[:, None] * np.cos(longitude),
            c[:, None] * np.sin(longitude),
            np.broadcast_to(s[:, None], (len(s), segments)),
        ],
        axis=-1,
    )


def _on_sphere(points: Floats, segments: int) -> Mesh:
    v = points.reshape(-1, 3)
    return mesh_of(v - (0.0, 0.0, v[:, 2].min()), _ring_faces(len(points), segments))
