"""Blocks: streets and yards of 50 to 110 m with buildings, walls, cars and trees.

rng  --make_block-->  Premises
"""

from __future__ import annotations

import math

import numpy as np

from sceneprint.synth.arrangement import Menu, Site, in_the_open
from sceneprint.synth.bulk import bush, pile, pole, screen, tree, vehicle
from sceneprint.synth.layout import Floor, Place
from sceneprint.synth.mesh import Mesh, join, mesh_of
from sceneprint.synth.premises import CELL, Premises
from sceneprint.synth.shell import Ceiling, Opening, Wall, wall_mesh, walls_of
from sceneprint.synth.solids import box, extrude
from sceneprint.types import Floats

#: what stands about outdoors, and how often
_MENUS: tuple[Menu, ...] = (
    {vehicle: 4, tree: 3, pole: 2, bush: 1, screen: 1},
    {tree: 5, bush: 3, pole: 1},
    {vehicle: 5, pole: 2, pile: 2, screen: 2, tree: 1},
)


def make_block(rng: np.random.Generator) -> Premises:
    """Buildings at right angles or not, on slightly uneven ground, and what stands between."""
    half = rng.uniform(25.0, 55.0, 2)
    outline = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half
    sky = Ceiling(40.0, np.zeros(2))
    site = Site([], sky, Floor(outline, CELL), rng)
    parts = [_ground(half, rng)]
    main = float(rng.uniform(-math.pi, math.pi))
    for _ in range(int(rng.integers(5, 16))):
        parts += _building(half, main, site)
    for _ in range(int(rng.integers(0, 6))):
        parts += _garden_wall(half, main, site)
    menu = _MENUS[int(rng.integers(0, len(_MENUS)))]
    parts += in_the_open(menu, site)
    return Premises("block", join(parts), site.floor)


def _ground(half: Floats, rng: np.random.Generator) -> Mesh:
    """Ground to 60 m beyond the block, sunken here and there by up to 30 cm."""
    n = 48
    x = np.linspace(-half[0] - 60, half[0] + 60, n)
    y = np.linspace(-half[1] - 60, half[1] + 60, n)
    gx, gy = np.meshgrid(x, y, indexing="ij")
    waves = rng.normal(0, 0.08, (4, 2))
    phases = gx[..., None] * waves[:, 0] + gy[..., None] * waves[:, 1]
    z = -rng.uniform(0.0, 0.3) * (1 + np.sin(phases + rng.uniform(0, 6, 4)).mean(axis=-1)) / 2
    i, j = np.meshgrid(np.arange(n - 1), np.arange(n - 1), indexing="ij")
    a = (i * n + j).ravel()
    faces = np.concatenate([np.stack([a, a + n, a + n + 1], 1), np.stack([a, a + n + 1, a + 1], 1)])
    return mesh_of(np.stack([gx, gy, z], axis=-1), faces)


def _building(half: Floats, main: float, site: Site) -> list[Mesh]:
    """One building with recessed windows and doors, or none where there is no room."""
    rng = site.rng
    w, d, h = rng.uniform((6.0, 5.0, 3.0), (32.0, 16.0, 15.0))
    yaw = main + int(rng.integers(0, 2)) * math.pi / 2 + float(rng.normal(0, 0.02))
    if rng.random() < 0.15:
        yaw = float(rng.uniform(-math.pi, math.pi))
    x, y = rng.uniform(-0.9, 0.9, 2) * half
    place = Place(x, y, yaw)
    if not site.floor.claim(place, w + 1.0, d + 1.0, 0.1):
        return []
    corners = np.array([(-w, -d), (-w, d), (w, d), (w, -d)]) / 2  # clockwise: walls face outward
    top = Ceiling(h, np.zeros(2))
    rise, deep = float(rng.uniform(2.7, 3.8)), float(rng.uniform(0.1, 0.4))
    walls = [wall_mesh(_facade(wall, h, rise, deep, rng), top) for wall in walls_of(corners)]
    parts = [*walls, _roof(w, d, h, rng)]
    for _ in range(int(rng.integers(0, 5))):  # porches, bays, boxes on the wall
        a, b, c = rng.uniform((0.8, 0.5, 0.8), (4.0, 2.0, 3.5))
        side = float(rng.choice((-1, 1)))
        x, y = rng.uniform(-0.5, 0.5) * (w - a), side * (d + b) / 2
        low = float(rng.choice((0.0, rng.uniform(0.0, max(0.1, h - c)))))
        parts.append(box(a, b, min(c, h), (x, y, low)))
        c0, s0 = math.cos(yaw), math.sin(yaw)
        if low < 2.5:
            at = Place(place.x + c0 * x - s0 * y, place.y + s0 * x + c0 * y, yaw)
            site.floor.take(at, float(a), float(b))
    return [join(parts).moved((place.x, place.y, -0.3), yaw)]


def _facade(wall: Wall, h: float, rise: float, deep: float, rng: np.random.Generator) -> Wall:
    """The wall with windows in rows, some missing, and doors below."""
    wide, gap = rng.uniform(0.8, 2.2), rng.uniform(0.6, 3.0)
    high, share = rng.uniform(1.0, 1.8), rng.uniform(0.3, 1.0)
    glass = float(rng.choice((0.3, 0.9)))
    openings, u = [], float(rng.uniform(0.5, 2.0))
    while u + wide < wall.length - 0.4:
        if rng.random() < 0.15:
            openings.append(Opening(u, u + wide, 0.35, 2.5, deep))
        else:
            rows = np.arange(0.9, h - high - 0.4, rise)
            openings += [
                Opening(u, u + wide, level, level + high, deep, glass)
                for level in rows[rng.random(len(rows)) < share]
            ]
        u += wide + gap
    return Wall(wall.corner, wall.along, wall.length, tuple(openings))


def _roof(w: float, d: float, h: float, rng: np.random.Generator) -> Mesh:
    """A flat roof with eaves, or a gable along x."""
    if rng.random() < 0.5:
        return box(w + 0.6, d + 0.6, 0.3, (0, 0, h))
    over, up = d / 2 + 0.4, d * rng.uniform(0.2, 0.5)
    gable = extrude([(-over, 0.0), (over, 0.0), (0.0, up)], w + 0.6)
    lying = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return gable.turned(lying, (-(w + 0.6) / 2, 0.0, h))


def _garden_wall(half: Floats, main: float, site: Site) -> list[Mesh]:
    rng = site.rng
    long, thick, h = rng.uniform((5.0, 0.15, 0.8), (30.0, 0.5, 2.6))
    yaw = main + int(rng.integers(0, 2)) * math.pi / 2
    x, y = rng.uniform(-0.9, 0.9, 2) * half
    place = Place(x, y, yaw)
    if not site.floor.claim(place, long, thick + 0.4, 0.1):
        return []
    return [box(long, thick, h + 0.3, (place.x, place.y, -0.3), yaw)]
