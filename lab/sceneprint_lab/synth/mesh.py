"""Meshes of closed solids, for furniture, and of empty rooms.

a few lengths (metres)  --box, cylinder, cone, revolve, ...-->  SyntheticMesh, outward normals
rng  --floor_plan-->  outline (n, 2)  --walls_of, shell-->  SyntheticMesh, inward normals

Every solid stands on z = 0 around the z axis. A shell has walls with openings and a ceiling; its
normals face inward.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sceneprint.types import Floats, Floats32, Ints32


@dataclass(frozen=True, eq=False)
class SyntheticMesh:
    """A triangle mesh with outward normals.

    Parameters
    ----------
    vertices : (V, 3) float64, metres, z up
    faces : (F, 3) int32, indices into vertices, counter-clockwise from outside
    loss : (F,) float32, share of samples that a depth camera loses on each face, [0, 1]; positive
        for dark, shiny or transparent surfaces
    """

    vertices: Floats
    faces: Ints32
    loss: Floats32

    def moved(self, offset: ArrayLike = (0.0, 0.0, 0.0), yaw: float = 0.0) -> SyntheticMesh:
        """Return the mesh rotated about z by `yaw` radians, then moved by `offset` (3,), metres."""
        return self.turned(rotation_z(yaw), offset) if yaw else self._shifted(offset)

    def turned(self, rotation: Floats, offset: ArrayLike = (0.0, 0.0, 0.0)) -> SyntheticMesh:
        """Return the mesh transformed by rotation (3, 3) @ x + offset (3,), metres."""
        return replace(self, vertices=self.vertices @ rotation.T + np.asarray(offset, float))

    def with_loss(self, share: float) -> SyntheticMesh:
        """Return the mesh with the loss `share` on all faces."""
        return replace(self, loss=np.full(len(self.faces), share, np.float32))

    def _shifted(self, offset: ArrayLike) -> SyntheticMesh:
        return replace(self, vertices=self.vertices + np.asarray(offset, float))


def mesh_of(vertices: ArrayLike, faces: ArrayLike) -> SyntheticMesh:
    """Return a mesh of these faces, except degenerate ones, without loss."""
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
    """Return all meshes as a single mesh, which is empty if there are none."""
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
    """Return the rotation (3, 3) about z by `yaw` radians."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_x(angle: float) -> Floats:
    """Return the rotation (3, 3) about x by `angle` radians."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def face_normals(mesh: SyntheticMesh) -> Floats:
    """Return the normals (F, 3) of the faces; the length of each is twice the face's area, m^2."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.asarray(np.cross(b - a, c - a))


def area(mesh: SyntheticMesh) -> float:
    """Return the total area of the faces, m^2."""
    return float(np.linalg.norm(face_normals(mesh), axis=1).sum() / 2)


def volume(mesh: SyntheticMesh) -> float:
    """Return the enclosed volume, m^3; it is negative if normals face inward."""
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
    """Return a cuboid with extents along x, y and z, metres; `at` is the centre of its base."""
    m = SyntheticMesh(_CORNERS * (width, depth, height), _BOX_FACES, np.zeros(12, np.float32))
    return m.moved(at, yaw)


def tapered_box(
    bottom: tuple[float, float], top: tuple[float, float], height: float
) -> SyntheticMesh:
    """Return a box whose `bottom` and `top` have different extents (width, depth)."""
    scale = np.where(_CORNERS[:, 2:] > 0.5, np.array(top), np.array(bottom))
    xy = _CORNERS[:, :2] * scale
    return mesh_of(np.column_stack([xy, _CORNERS[:, 2] * height]), _BOX_FACES)


def revolve(profile: ArrayLike, segments: int = 16) -> SyntheticMesh:
    """Return the solid of revolution of a profile about z.

    Parameters
    ----------
    profile : (n, 2) radius and height, metres, along the outside from the bottom to the top; discs
        close ends that are not on the axis
    segments : number of sides
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
    """Return an upright cylinder as a prism with `segments` sides."""
    return revolve([(radius, 0.0), (radius, height)], segments)


def cone(lower: float, upper: float, height: float, segments: int = 16) -> SyntheticMesh:
    """Return a truncated cone with the radii `lower` and `upper`; a radius of 0 makes a tip."""
    return revolve([(lower, 0.0), (upper, height)], segments)


def ellipsoid(radii: ArrayLike, power: float = 1.0, segments: int = 16) -> SyntheticMesh:
    """Return a superellipsoid on z = 0: with `power` 1 an ellipsoid, near 0 almost a box."""
    directions = _sphere(segments)
    shaped = np.sign(directions) * np.abs(directions) ** power
    # Scale each direction to the level set |x|^(2/power) + ... = 1.
    level = (np.abs(shaped) ** (2 / power)).sum(axis=-1, keepdims=True) ** (-power / 2)
    return _on_sphere(shaped * level * np.asarray(radii, float), segments)


def blob(rng: np.random.Generator, radii: ArrayLike, roughness: float = 0.12) -> SyntheticMesh:
    """Return a superellipsoid with random low-frequency waves, such as a bag or a cushion."""
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
    """Return a prism over a simple counter-clockwise polygon (n, 2), metres."""
    p = np.asarray(outline, float)
    n = len(p)
    cap = triangulate(p)
    i = np.arange(n)
    j = (i + 1) % n
    sides = np.concatenate([np.stack([i, j, j + n], 1), np.stack([i, j + n, i + n], 1)])
    v = np.concatenate([np.c_[p, np.zeros(n)], np.c_[p, np.full(n, height)]])
    return mesh_of(v, np.concatenate([cap[:, ::-1], cap + n, sides]))


def ribbon(path: ArrayLike, thickness: float, height: float) -> SyntheticMesh:
    """Return an upright sheet along an open path (n, 2), such as a curtain or a bent panel."""
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
    """Return a round rod along a path of n points (3,), such as a pipe or a handle."""
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
    """Return triangles (n - 2, 3) of a counter-clockwise polygon (n, 2), by ear clipping."""
    p = np.asarray(outline, float)
    remaining = list(range(len(p)))
    triangles = []
    while len(remaining) > 3:
        for k in range(len(remaining)):
            a, b, c = remaining[k - 1], remaining[k], remaining[(k + 1) % len(remaining)]
            others = [i for i in remaining if i not in (a, b, c)]
            if _turn(p[a], p[b], p[c]) > 1e-12 and not any(
                min(_turn(p[a], p[b], p[i]), _turn(p[b], p[c], p[i]), _turn(p[c], p[a], p[i])) >= 0
                for i in others
            ):
                break
        else:  # all remaining corners lie on straight edges
            k = 1
        triangles.append((remaining[k - 1], remaining[k], remaining[(k + 1) % len(remaining)]))
        del remaining[k]
    return np.array([*triangles, tuple(remaining)], np.int32)


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


# The empty room.


@dataclass(frozen=True)
class Opening:
    """A recess in a wall, such as a door, a window or a niche.

    Parameters
    ----------
    start, end : positions along the wall from its first corner, metres
    low, high : heights, metres
    deep : depth behind the wall's plane, metres
    loss : share of samples that a camera loses on the back plane (glass), [0, 1]
    """

    start: float
    end: float
    low: float
    high: float
    deep: float
    loss: float = 0.0


@dataclass(frozen=True, eq=False)
class Wall:
    """A straight wall, as seen from inside the room.

    Parameters
    ----------
    corner : (2,) start, metres
    along : (2,) unit vector to the end; the room lies on its left
    length : metres
    openings : recesses of the wall
    """

    corner: Floats
    along: Floats
    length: float
    openings: tuple[Opening, ...] = ()

    @property
    def inward(self) -> Floats:
        """Return the unit vector (2,) from the wall into the room."""
        return np.array([-self.along[1], self.along[0]])

    def at(self, distance: float, out: float = 0.0) -> Floats:
        """Return the floor point (2,) at `distance` along the wall and `out` into the room."""
        return np.asarray(self.corner + distance * self.along + out * self.inward)


@dataclass(frozen=True, eq=False)
class Ceiling:
    """A plane z = height + slope . (x, y), metres."""

    height: float
    slope: Floats

    def at(self, points: Floats) -> Floats:
        """Return the heights (...,) above floor points (..., 2)."""
        return np.asarray(self.height + points @ self.slope)


def floor_plan(rng: np.random.Generator) -> Floats:
    """Return a random outline (n, 2): a rectangle, an L, or one with an alcove or a cut corner."""
    w, d = rng.uniform(2.6, 8.0), rng.uniform(2.5, 6.5)
    kind = rng.choice(4, p=(0.4, 0.25, 0.2, 0.15))
    a, b = w * rng.uniform(0.4, 0.7), d * rng.uniform(0.4, 0.7)
    if kind == 1 and min(w, d) > 3.0:  # L shape
        plan = [(0, 0), (w, 0), (w, b), (a, b), (a, d), (0, d)]
    elif kind == 2:  # alcove in the far wall
        deep = rng.uniform(0.4, 1.6)
        left = w * rng.uniform(0.1, 0.3)
        plan = [(0, 0), (w, 0), (w, d), (a, d), (a, d + deep), (left, d + deep), (left, d), (0, d)]
    elif kind == 3:  # cut corner
        cut = rng.uniform(0.4, 1.4, 2)
        plan = [(0, 0), (w, 0), (w, d - cut[1]), (w - cut[0], d), (0, d)]
    else:
        plan = [(0, 0), (w, 0), (w, d), (0, d)]
    return np.array(plan, float)


def ceiling(rng: np.random.Generator, outline: Floats) -> Ceiling:
    """Return a random ceiling: flat in 75 % of rooms, otherwise sloping along x or y."""
    height = rng.uniform(2.3, 3.2)
    if rng.random() > 0.25:
        return Ceiling(height, np.zeros(2))
    axis = int(rng.integers(0, 2))
    span = float(np.ptp(outline[:, axis]))
    slope = np.zeros(2)
    slope[axis] = rng.choice((-1, 1)) * rng.uniform(0.1, min(0.5, 1.2 / span))
    lowest = float((outline @ slope).min())
    return Ceiling(rng.uniform(2.1, 2.5) - lowest, slope)


def walls_of(outline: Floats) -> list[Wall]:
    """Return the walls on the edges of an outline, without openings."""
    walls = []
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        length = float(np.linalg.norm(b - a))
        walls.append(Wall(a, (b - a) / length, length))
    return walls


def shell(outline: Floats, walls: list[Wall], top: Ceiling) -> SyntheticMesh:
    """Return the floor, ceiling and walls as a closed surface whose normals face the room."""
    flat = triangulate(outline)
    floor = mesh_of(np.c_[outline, np.zeros(len(outline))], flat)
    roof = mesh_of(np.c_[outline, top.at(outline)], flat[:, ::-1])
    return join([floor, roof, *(wall_mesh(w, top) for w in walls)])


def wall_mesh(wall: Wall, top: Ceiling) -> SyntheticMesh:
    """Return the mesh of a wall, up to the ceiling, with its openings as recesses."""
    us = sorted({0.0, wall.length, *(u for o in wall.openings for u in (o.start, o.end))})
    vs = sorted({0.0, *(v for o in wall.openings for v in (o.low, o.high))})
    grid = np.array([[(u, 0.0, v) for u in us] for v in [*vs, math.inf]])
    grid[-1, :, 2] = top.at(np.array([wall.at(u) for u in us]))
    quads = []
    for i in range(len(vs)):
        v = (vs[i] + vs[i + 1]) / 2 if i + 1 < len(vs) else math.inf
        for k in range(len(us) - 1):
            u = (us[k] + us[k + 1]) / 2
            if not any(o.start < u < o.end and o.low < v < o.high for o in wall.openings):
                corners = grid[[i, i, i + 1, i + 1], [k, k + 1, k + 1, k]]
                quads.append(corners)
    local = join([_quads(quads), *(_lining(o) for o in wall.openings)])
    frame = np.eye(3)
    frame[:2, 0], frame[:2, 1] = wall.along, wall.inward
    return local.turned(frame, (*wall.corner, 0.0))


def _lining(o: Opening) -> SyntheticMesh:
    """Return the sides and the back of a recess, in the frame (along, inward, up) of the wall."""
    ring = ((o.start, o.low), (o.end, o.low), (o.end, o.high), (o.start, o.high))
    front = np.array([(u, 0.0, v) for u, v in ring])
    back = front - (0.0, o.deep, 0.0)
    sides = [np.stack([front[k - 1], front[k], back[k], back[k - 1]]) for k in range(4)]
    return join([_quads(sides), _quads([back]).with_loss(o.loss)])


def _quads(corners: list[Floats]) -> SyntheticMesh:
    """Return quadrilaterals in the plane (along, up) that face inward."""
    v = np.concatenate(corners)
    first = np.arange(0, len(v), 4)[:, None]
    # (along, inward, up) is right-handed, so along x up = -inward; the order is reversed.
    return mesh_of(v, first + np.array([0, 2, 1, 0, 3, 2]))
