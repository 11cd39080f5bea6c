"""Small things that lie about: each builder returns one object resting on z = 0.

rng  --thing-->  Mesh, 5 to 60 cm, yaw left to the caller
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from sceneprint.synth.mesh import Mesh, join, mesh_of, rotation_x, rotation_z
from sceneprint.synth.solids import (
    blob,
    box,
    cone,
    cylinder,
    ellipsoid,
    revolve,
    tapered_box,
    tube,
)

Builder = Callable[[np.random.Generator], Mesh]


def packet(rng: np.random.Generator) -> Mesh:
    """A carton of any proportion: cereals, tissues, parcels."""
    return box(*rng.uniform((0.05, 0.04, 0.04), (0.3, 0.22, 0.3)))


def flat_thing(rng: np.random.Generator) -> Mesh:
    """A book, magazine, tablet or pile of paper."""
    return box(rng.uniform(0.12, 0.32), rng.uniform(0.1, 0.24), rng.uniform(0.004, 0.05))


def stack(rng: np.random.Generator) -> Mesh:
    """Books or boxes on top of each other, each turned a little."""
    parts, z = [], 0.0
    w, d = rng.uniform((0.15, 0.12), (0.4, 0.3))
    for _ in range(rng.integers(2, 7)):
        h = rng.uniform(0.015, 0.12)
        w, d = np.array([w, d]) * rng.uniform(0.75, 1.05, 2)
        parts.append(box(w, d, h, (0, 0, z), rng.normal(0, 0.25)))
        z += h
    return join(parts)


def mug(rng: np.random.Generator) -> Mesh:
    """A mug with a wall and a handle."""
    r, h, t = rng.uniform(0.03, 0.05), rng.uniform(0.07, 0.12), 0.005
    body = revolve([(r * 0.9, 0), (r, h), (r - t, h), (r * 0.9 - t, t)], 14)
    a = np.linspace(-1.3, 1.3, 6)
    ring = np.c_[r * 0.9 + 0.03 * np.cos(a), np.zeros(6), h / 2 + 0.03 * np.sin(a)]
    return join([body, tube(list(ring), 0.006, 6)])


def bottle(rng: np.random.Generator) -> Mesh:
    """A bottle, jug or vase: a smooth random profile."""
    r, h = rng.uniform(0.03, 0.06), rng.uniform(0.15, 0.35)
    neck = rng.uniform(0.2, 0.7)
    s = rng.uniform(0.5, 0.75)
    profile = [(r * 0.9, 0), (r, 0.02), (r, h * s), (r * neck, h * (s + 0.18)), (r * neck, h)]
    return revolve(profile, 14)


def bowl(rng: np.random.Generator) -> Mesh:
    """A bowl, sometimes with fruit."""
    r, h = rng.uniform(0.07, 0.17), rng.uniform(0.03, 0.1)
    s = np.linspace(0.25, 1, 6)
    outer = np.c_[r * s, h * (s - 0.25) ** 2 / 0.5625]
    dish = revolve(np.concatenate([outer, outer[::-1] * (0.94, 1) + (0, 0.008)]), 18)
    fruit = [
        ellipsoid(np.full(3, rng.uniform(0.03, 0.045)), segments=10).moved(
            (*rng.normal(0, r * 0.3, 2), h * 0.3)
        )
        for _ in range(rng.integers(0, 6))
    ]
    return join([dish, *fruit])


def jar(rng: np.random.Generator) -> Mesh:
    """A tin, jar, roll or candle."""
    return cylinder(rng.uniform(0.025, 0.08), rng.uniform(0.05, 0.25), 14)


def ball(rng: np.random.Generator) -> Mesh:
    """A ball or a rounded object."""
    r = rng.uniform(0.03, 0.13)
    return ellipsoid(r * rng.uniform(0.6, 1.2, 3), rng.uniform(0.5, 1.0))


def bag(rng: np.random.Generator) -> Mesh:
    """A bag, cushion or heap of cloth."""
    return blob(rng, rng.uniform((0.1, 0.07, 0.05), (0.28, 0.2, 0.22)), rng.uniform(0.05, 0.15))


def basket(rng: np.random.Generator) -> Mesh:
    """A tapered open tray or basket: a floor and four leaning walls."""
    w, d, h = rng.uniform((0.15, 0.12, 0.06), (0.45, 0.32, 0.25))
    t = 0.012
    walls = [box(w, t, h, (0, y, 0)) for y in (-d / 2, d / 2)]
    walls += [box(t, d, h, (x, 0, 0)) for x in (-w / 2, w / 2)]
    inside = [packet(rng).moved((0, 0, t), rng.uniform(0, 3))] if min(w, d) > 0.25 else []
    return join([box(w, d, t), *walls, *inside])


def lamp(rng: np.random.Generator) -> Mesh:
    """A table lamp: foot, stem, shade."""
    h = rng.uniform(0.3, 0.6)
    r = rng.uniform(0.08, 0.18)
    lean = rng.uniform(0, 0.2) if rng.random() < 0.5 else 0.0
    stem = tube([(0, 0, 0.01), (lean / 2, 0, h * 0.5), (lean, 0, h)], 0.01)
    shade = cone(r, r * rng.uniform(0.3, 0.9), r * 1.2).moved((lean, 0, h * 0.85))
    return join([cylinder(r * 0.7, 0.02), stem, shade])


def plant(rng: np.random.Generator) -> Mesh:
    """A pot with leaves, a ball of leaves, or a few branches."""
    r, h = rng.uniform(0.05, 0.16), rng.uniform(0.08, 0.26)
    size = rng.uniform(1.0, 2.5) * r + 0.08
    pot = cone(r * 0.75, r, h)
    if rng.random() < 0.3:
        return join([pot, blob(rng, size * rng.uniform(0.6, 1, 3), 0.2).moved((0, 0, h * 0.8))])
    leaves = [_leaf(rng, size) for _ in range(rng.integers(12, 45))]
    return join([pot, *(leaf.moved((0, 0, h)) for leaf in leaves)])


def _leaf(rng: np.random.Generator, size: float) -> Mesh:
    length, width = size * rng.uniform(0.5, 1.2), size * rng.uniform(0.1, 0.35)
    bend = rng.uniform(-0.6, 0.2) * length
    v = np.array([(0, 0, 0), (length / 2, width / 2, 0.1 * length), (length, 0, bend)])
    v = np.concatenate([v, v[1:2] * (1, -1, 1)])
    f = [(0, 2, 1), (0, 3, 2), (0, 1, 2), (0, 2, 3)]  # both sides
    tilt = rotation_z(rng.uniform(0, 2 * math.pi)) @ _pitch(rng.uniform(0.1, 1.4))
    return mesh_of(v, f).turned(tilt, (0, 0, rng.uniform(0, size * 0.6)))


def _pitch(angle: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    turn = rotation_z(math.pi / 2)
    return turn.T @ rotation_x(angle) @ turn


def tool(rng: np.random.Generator) -> Mesh:
    """A long thin thing that lies down: pen box, ruler, remote, rolled paper."""
    if rng.random() < 0.5:
        return box(rng.uniform(0.1, 0.45), rng.uniform(0.02, 0.06), rng.uniform(0.01, 0.04))
    half, r = rng.uniform(0.08, 0.3), rng.uniform(0.01, 0.04)
    return tube([(-half, 0, r), (half, 0, r)], r)


def appliance(rng: np.random.Generator) -> Mesh:
    """A microwave, printer, toaster or coffee machine: a body with parts set on or in."""
    w, d, h = rng.uniform((0.18, 0.15, 0.15), (0.52, 0.42, 0.38))
    face = box(w * 0.6, 0.02, h * 0.7, (-w * 0.12, -d / 2, h * 0.15))
    top = box(w * rng.uniform(0.4, 0.95), d * rng.uniform(0.4, 0.9), h * 0.2, (0, 0, h))
    knob = box(0.03, 0.04, h * 0.5, (w * 0.35, -d / 2, h * 0.25))
    return join([box(w, d, h), face, knob] + ([top] if rng.random() < 0.5 else []))


def kettle(rng: np.random.Generator) -> Mesh:
    """A kettle, teapot or watering can."""
    r, h = rng.uniform(0.06, 0.1), rng.uniform(0.12, 0.24)
    body = revolve([(r, 0), (r * 1.05, h * 0.4), (r * 0.6, h), (0.02, h + 0.02)], 14)
    grip = [(r * 0.6, 0, h * 0.9), (r * 1.7, 0, h * 0.85), (r * 1.6, 0, h * 0.3), (r, 0, h * 0.2)]
    spout = tube([(-r * 0.8, 0, h * 0.4), (-r * 1.7, 0, h * 0.85)], r * 0.18)
    return join([body, tube(grip, 0.011), spout])


def tray(rng: np.random.Generator) -> Mesh:
    """A tapered solid: a bread, a pan with a handle, a hard hat of a thing."""
    w, d, h = rng.uniform((0.1, 0.1, 0.03), (0.35, 0.25, 0.12))
    s = rng.uniform(0.5, 1.2)
    handle = tube([(w / 2, 0, h * 0.7), (w / 2 + 0.18, 0, h * 0.9)], 0.011)
    return join([tapered_box((w * s, d * s), (w, d), h)] + ([handle] if rng.random() < 0.4 else []))


#: what may stand on any surface, and how often
SMALL: tuple[tuple[Builder, float], ...] = (
    (packet, 4), (flat_thing, 4), (stack, 2), (mug, 3), (bottle, 2), (bowl, 1.5), (jar, 2),
    (ball, 1), (bag, 1), (basket, 1), (lamp, 0.5), (plant, 1), (tool, 2), (appliance, 0.7),
    (kettle, 0.6), (tray, 1),
)  # fmt: skip
_WEIGHTS = np.array([w for _, w in SMALL]) / sum(w for _, w in SMALL)


def small_thing(rng: np.random.Generator) -> Mesh:
    """Any small object; one in eight is dark or shiny and answers badly."""
    builder = SMALL[int(rng.choice(len(SMALL), p=_WEIGHTS))][0]
    thing = builder(rng)
    return thing.with_loss(rng.uniform(0.2, 0.95)) if rng.random() < 0.12 else thing
