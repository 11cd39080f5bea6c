"""The empty room: floor plan, walls with openings, ceiling. Its normals face inward.

rng  --floor_plan-->  outline (n, 2)  --shell-->  Shell(mesh, outline, walls)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sceneprint.lab.synth.mesh import SyntheticMesh, join, mesh_of, triangulate
from sceneprint.types import Floats


@dataclass(frozen=True)
class Opening:
    """A recess in a wall: a door, a window or a niche.

    Parameters
    ----------
    start, end : along the wall, metres from its first corner
    low, high : heights, metres
    deep : metres behind the wall's plane
    loss : share of samples lost on its back plane (glass), [0, 1]
    """

    start: float
    end: float
    low: float
    high: float
    deep: float
    loss: float = 0.0


@dataclass(frozen=True, eq=False)
class Wall:
    """One straight wall, seen from inside the room.

    Parameters
    ----------
    corner : (2,) where it starts, metres
    along : (2,) unit vector to its end; the room lies to the left
    length : metres
    openings : what is recessed in it
    """

    corner: Floats
    along: Floats
    length: float
    openings: tuple[Opening, ...] = ()

    @property
    def inward(self) -> Floats:
        """(2,) unit vector from the wall into the room."""
        return np.array([-self.along[1], self.along[0]])

    def at(self, distance: float, out: float = 0.0) -> Floats:
        """(2,) the floor point so far along the wall and so far out into the room."""
        return np.asarray(self.corner + distance * self.along + out * self.inward)


@dataclass(frozen=True, eq=False)
class Ceiling:
    """A plane z = height + slope . (x, y), metres."""

    height: float
    slope: Floats

    def at(self, points: Floats) -> Floats:
        """(...,) heights over floor points (..., 2)."""
        return np.asarray(self.height + points @ self.slope)


def floor_plan(rng: np.random.Generator) -> Floats:
    """(n, 2) outline, counter-clockwise from the origin: rectangle, L, alcove or cut corner."""
    w, d = rng.uniform(2.6, 8.0), rng.uniform(2.5, 6.5)
    kind = rng.choice(4, p=(0.4, 0.25, 0.2, 0.15))
    a, b = w * rng.uniform(0.4, 0.7), d * rng.uniform(0.4, 0.7)
    if kind == 1 and min(w, d) > 3.0:  # L
        plan = [(0, 0), (w, 0), (w, b), (a, b), (a, d), (0, d)]
    elif kind == 2:  # alcove in the far wall
        deep = rng.uniform(0.4, 1.6)
        left = w * rng.uniform(0.1, 0.3)
        plan = [(0, 0), (w, 0), (w, d), (a, d), (a, d + deep), (left, d + deep), (left, d), (0, d)]
    elif kind == 3:  # a corner cut off
        cut = rng.uniform(0.4, 1.4, 2)
        plan = [(0, 0), (w, 0), (w, d - cut[1]), (w - cut[0], d), (0, d)]
    else:
        plan = [(0, 0), (w, 0), (w, d), (0, d)]
    return np.array(plan, float)


def ceiling(rng: np.random.Generator, outline: Floats) -> Ceiling:
    """A flat ceiling, or one in four sloped along x or y."""
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
    """The walls over the edges of an outline, without openings."""
    walls = []
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        length = float(np.linalg.norm(b - a))
        walls.append(Wall(a, (b - a) / length, length))
    return walls


def shell(outline: Floats, walls: list[Wall], top: Ceiling) -> SyntheticMesh:
    """Floor, ceiling and walls as one closed surface whose normals face the room."""
    flat = triangulate(outline)
    floor = mesh_of(np.c_[outline, np.zeros(len(outline))], flat)
    roof = mesh_of(np.c_[outline, top.at(outline)], flat[:, ::-1])
    return join([floor, roof, *(wall_mesh(w, top) for w in walls)])


def wall_mesh(wall: Wall, top: Ceiling) -> SyntheticMesh:
    """One wall up to the ceiling, its openings cut out and lined."""
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
    """Sides and back of a recess, in the wall's frame (along, inward, up)."""
    front = np.array([(u, 0.0, v) for u, v in _ring(o)])
    back = front - (0.0, o.deep, 0.0)
    sides = [np.stack([front[k - 1], front[k], back[k], back[k - 1]]) for k in range(4)]
    return join([_quads(sides), _quads([back]).with_loss(o.loss)])


def _ring(o: Opening) -> list[tuple[float, float]]:
    return [(o.start, o.low), (o.end, o.low), (o.end, o.high), (o.start, o.high)]


def _quads(corners: list[Floats]) -> SyntheticMesh:
    """Quadrilaterals in the plane (along, up), given so that they face +inward."""
    v = np.concatenate(corners)
    first = np.arange(0, len(v), 4)[:, None]
    # (along, inward, up) is right-handed: along x up points to -inward, so turn them round
    return mesh_of(v, first + np.array([0, 2, 1, 0, 3, 2]))
