"""Closed solids of which furniture is made; every one rests on z = 0 around the z axis.

a few lengths (metres)  --box, cylinder, cone, revolve, ...-->  Mesh, outward normals
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sceneprint.types import Floats, Floats32, Ints32

# Triangle meshes: the one record that all builders of a synthetic scene pass on.
#
#     solids (n)  --join-->  one mesh (V, 3), (F, 3)
#
# Lengths are metres, z points up. The faces of a solid turn counter-clockwise when seen
# from outside, so that a ray which meets a back face has started inside a solid.


@dataclass(frozen=True, eq=False)
class SyntheticMesh:
    """Triangles with outward normals.

    Parameters
    ----------
    vertices : (V, 3) float64, metres, z up
    faces : (F, 3) int32, indices into vertices, counter-clockwise from outside
    loss : (F,) float32, share of samples on the face from which a depth camera gets no
        answer (dark, shiny or transparent surfaces), [0, 1]
    """

    vertices: Floats
    faces: Ints32
    loss: Floats32

    def moved(self, offset: ArrayLike = (0.0, 0.0, 0.0), yaw: float = 0.0) -> SyntheticMesh:
        """The mesh turned about z by yaw (radians), then shifted by offset (3, metres)."""
        return self.turned(rotation_z(yaw), offset) if yaw else self._shifted(offset)

    def turned(self, rotation: Floats, offset: ArrayLike = (0.0, 0.0, 0.0)) -> SyntheticMesh:
        """The mesh after x -> rotation x + offset; rotation (3, 3), offset (3,) metres."""
        return replace(self, vertices=self.vertices @ rotation.T + np.asarray(offset, float))

    def with_loss(self, share: float) -> SyntheticMesh:
        """The same mesh with one loss on all faces."""
        return replace(self, loss=np.full(len(self.faces), share, np.float32))

    def _shifted(self, offset: ArrayLike) -> SyntheticMesh:
        return replace(self, vertices=self.vertices + np.asarray(offset, float))


def mesh_of(vertices: ArrayLike, faces: ArrayLike) -> SyntheticMesh:
    """A mesh without loss, its faces of no area left out."""
    v = np.asarray(vertices, np.float64).reshape(-1, 3)
    f: NDArray[np.int32] = np.asarray(faces, np.int32).reshape(-1, 3)
    a, b, c = v[f[:, 0]], v[f[:, 1]], v[f[:, 2]]
    e, g = b - a, c - a
    normal = np.stack(
        [
            e[:, 1] * g[:, 2] - e[:, 2] * g[:, 1],
            e[:, 2] * g[:, 0] - e[:, 0] * g[:, 2],
            e[:, 0] * g[:, 1] - e[:, 1] * g[:, 0],
        ],
        axis=1,
    )
    f = f[(normal * normal).sum(axis=1) > 1e-20]
    return SyntheticMesh(v, f, np.zeros(len(f), np.float32))


def join(meshes: Iterable[SyntheticMesh]) -> SyntheticMesh:
    """All meshes as one; an empty iterable gives the empty mesh."""
    parts = list(meshes)
    if not parts:
        return SyntheticMesh(np.empty((0, 3)), np.empty((0, 3), np.int32), np.empty(0, np.float32))
    starts = np.cumsum([0] + [len(m.vertices) for m in parts[:-1]])
    return SyntheticMesh(
        np.concatenate([m.vertices for m in parts]),
        np.concatenate([m.faces + s for m, s in zip(parts, starts, strict=True)]).astype(np.int32),
        np.concatenate([m.loss for m in parts]),
    )


def rotation_z(yaw: float) -> Floats:
    """(3, 3) rotation about z by yaw radians."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_x(angle: float) -> Floats:
    """(3, 3) rotation about x by angle radians."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def face_normals(mesh: SyntheticMesh) -> Floats:
    """(F, 3) normals of the faces, each as long as twice the area of its face, m^2."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.asarray(np.cross(b - a, c - a))


def area(mesh: SyntheticMesh) -> float:
    """Area of all faces, m^2."""
    return float(np.linalg.norm(face_normals(mesh), axis=1).sum() / 2)


def volume(mesh: SyntheticMesh) -> float:
    """Enclosed volume, m^3, by the divergence theorem; negative where normals face inward."""
    return float((mesh.vertices[mesh.faces[:, 0]] * face_normals(mesh)).sum() / 6)


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
) -> SyntheticMesh:
    """A cuboid width x depth x height along x, y, z; `at` is the middle of its underside."""
    m = SyntheticMesh(_CORNERS * (width, depth, height), _BOX_FACES, np.zeros(12, np.float32))
    return m.moved(at, yaw)


def tapered_box(
    bottom: tuple[float, float], top: tuple[float, float], height: float
) -> SyntheticMesh:
    """A box whose underside (width, depth) differs from its upper side."""
    scale = np.where(_CORNERS[:, 2:] > 0.5, np.array(top), np.array(bottom))
    xy = _CORNERS[:, :2] * scale
    return mesh_of(np.column_stack([xy, _CORNERS[:, 2] * height]), _BOX_FACES)


def revolve(profile: ArrayLike, segments: int = 16) -> SyntheticMesh:
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


def cylinder(radius: float, height: float, segments: int = 16) -> SyntheticMesh:
    """An upright cylinder, as a prism of that many sides."""
    return revolve([(radius, 0.0), (radius, height)], segments)


def cone(lower: float, upper: float, height: float, segments: int = 16) -> SyntheticMesh:
    """A truncated cone from radius lower to radius upper; 0 makes a tip."""
    return revolve([(lower, 0.0), (upper, height)], segments)


def ellipsoid(radii: ArrayLike, power: float = 1.0, segments: int = 16) -> SyntheticMesh:
    """A superellipsoid resting on z = 0: power 1 is an ellipsoid, towards 0 a box."""
    directions = _sphere(segments)
    shaped = np.sign(directions) * np.abs(directions) ** power
    # points of the level set |x|^(2/power) + ... = 1 along each direction
    level = (np.abs(shaped) ** (2 / power)).sum(axis=-1, keepdims=True) ** (-power / 2)
    return _on_sphere(shaped * level * np.asarray(radii, float), segments)


def blob(rng: np.random.Generator, radii: ArrayLike, roughness: float = 0.12) -> SyntheticMesh:
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


def extrude(outline: ArrayLike, height: float) -> SyntheticMesh:
    """A prism over a simple polygon (n, 2), counter-clockwise, metres."""
    p = np.asarray(outline, float)
    n = len(p)
    cap = triangulate(p)
    i = np.arange(n)
    j = (i + 1) % n
    sides = np.concatenate([np.stack([i, j, j + n], 1), np.stack([i, j + n, i + n], 1)])
    v = np.concatenate([np.c_[p, np.zeros(n)], np.c_[p, np.full(n, height)]])
    return mesh_of(v, np.concatenate([cap[:, ::-1], cap + n, sides]))


def ribbon(path: ArrayLike, thickness: float, height: float) -> SyntheticMesh:
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


def tube(points: Sequence[ArrayLike], radius: float, segments: int = 8) -> SyntheticMesh:
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


def _on_sphere(points: Floats, segments: int) -> SyntheticMesh:
    v = points.reshape(-1, 3)
    return mesh_of(v - (0.0, 0.0, v[:, 2].min()), _ring_faces(len(points), segments))
