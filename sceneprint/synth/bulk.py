"""Large things, of halls and of streets: what a laser sees from tens of metres away.

rng  --machine, rack, vehicle, tree, ...-->  Piece
"""

from __future__ import annotations

import math

import numpy as np

from sceneprint.synth.mesh import join, rotation_x
from sceneprint.synth.piece import Piece
from sceneprint.synth.solids import (
    blob,
    box,
    cone,
    cylinder,
    ellipsoid,
    ribbon,
    tapered_box,
    tube,
)

#: lays the z axis along x
_LYING = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def machine(rng: np.random.Generator) -> Piece:
    """A base that carries cabinets, drums, hoods and pipes."""
    w, d = rng.uniform((1.2, 0.8), (6.0, 2.6))
    h = rng.uniform(0.3, 1.3)
    parts = [box(w, d, h)]
    for _ in range(int(rng.integers(1, 6))):
        a, b, c = rng.uniform((0.3, 0.3, 0.3), (0.5 * w, 0.9 * d, 2.2))
        x, y = rng.uniform(-0.5, 0.5) * (w - a), rng.uniform(-0.5, 0.5) * (d - b)
        kind = int(rng.integers(0, 4))
        if kind == 0:
            parts.append(box(a, b, c, (x, y, h)))
        elif kind == 1:
            parts.append(cylinder(min(a, b) / 2, c).moved((x, y, h)))
        elif kind == 2:
            parts.append(tapered_box((a, b), (a * 0.5, b * 0.6), c).moved((x, y, h)))
        else:
            drum = cylinder(min(b, c) / 2, a).turned(_LYING, (x - a / 2, y, h + min(b, c) / 2))
            parts.append(drum)
    if rng.random() < 0.5:
        x, y, r = w * rng.uniform(-0.4, 0.4), d * rng.uniform(-0.4, 0.4), rng.uniform(0.05, 0.2)
        z = h + rng.uniform(1.0, 3.0)
        parts.append(tube([(x, y, h), (x, y, z), (x + rng.uniform(-1, 1), y, z)], r))
    return Piece(join(parts), w, d)


def rack(rng: np.random.Generator) -> Piece:
    """Shelving for pallets or boxes, one or more bays wide, partly filled."""
    bays, bay = int(rng.integers(1, 6)), rng.uniform(1.2, 2.8)
    d, levels, rise = rng.uniform(0.5, 1.2), int(rng.integers(2, 6)), rng.uniform(0.5, 1.4)
    w, h = bays * bay, levels * rise
    parts = [
        box(0.08, 0.08, h, (k * bay - w / 2, s * (d / 2 - 0.04), 0.0))
        for k in range(bays + 1)
        for s in (-1, 1)
    ]
    full = rng.uniform(0.2, 0.95)
    for level in range(levels):
        z = level * rise + (0.1 if level == 0 else 0.0)
        parts.append(box(w, d, 0.06, (0, 0, z)))
        for k in range(bays):
            if rng.random() < full:
                a, b, c = rng.uniform((0.4, 0.6, 0.3), (0.95, 1.0, 0.9)) * (bay, d, rise)
                x = (k + 0.5) * bay - w / 2 + rng.uniform(-0.5, 0.5) * (bay - a - 0.1)
                parts.append(box(a, b, c, (x, rng.normal(0, 0.03), z + 0.06)))
    return Piece(join(parts), w, d)


def pile(rng: np.random.Generator) -> Piece:
    """Crates or pallets in a heap."""
    a, b, c = rng.uniform((0.6, 0.5, 0.15), (1.6, 1.2, 1.0))
    parts, z = [], 0.0
    for _ in range(int(rng.integers(1, 5))):
        yaw = float(rng.normal(0, 0.08))
        parts.append(box(a, b, c, (rng.normal(0, 0.05), rng.normal(0, 0.05), z), yaw))
        z += c + 0.005
    return Piece(join(parts), a, b)


def tank(rng: np.random.Generator) -> Piece:
    """A standing or lying tank, a silo, a reel."""
    r, h = rng.uniform(0.3, 1.5), rng.uniform(1.0, 4.0)
    if rng.random() < 0.6:
        mesh = join([cylinder(r, h, 20), cone(r, 0.2 * r, 0.4 * r, 20).moved((0, 0, h))])
        return Piece(mesh, 2 * r, 2 * r)
    feet = [box(0.3, 1.6 * r, 0.4 + 0.4 * r, (x * h * 0.3, 0, 0)) for x in (-1, 1)]
    drum = cylinder(r, h, 20).turned(_LYING, (-h / 2, 0, 0.4 + r))
    return Piece(join([drum, *feet]), h, 2 * r)


def cabin(rng: np.random.Generator) -> Piece:
    """A room within the room: an office, a booth, a container."""
    w, d, h = rng.uniform((2.0, 2.0, 2.2), (8.0, 4.0, 3.2))
    x = rng.uniform(-0.3, 0.3) * w
    door = box(0.95, 0.06, 2.05, (x, -d / 2 - 0.03, 0))
    sill = box(w * 0.5, 0.1, 0.08, (-x, -d / 2 - 0.05, 1.1))
    return Piece(join([box(w, d, h), box(w + 0.2, d + 0.2, 0.12, (0, 0, h)), door, sill]), w, d)


def screen(rng: np.random.Generator) -> Piece:
    """A free-standing wall, straight or bent, or a fence of posts and rails."""
    w, h = rng.uniform(1.5, 8.0), rng.uniform(0.9, 3.0)
    if rng.random() < 0.6:
        x = np.linspace(-w / 2, w / 2, 4)
        bend = np.column_stack([x, rng.normal(0, 0.15, 4)])
        return Piece(ribbon(bend, rng.uniform(0.04, 0.2), h), w, 0.5)
    n = max(2, round(w / 1.2))
    posts = [box(0.07, 0.07, h, (k / (n - 1) * w - w / 2, 0, 0)) for k in range(n)]
    rails = [box(w, 0.05, 0.1, (0, 0, z)) for z in np.linspace(0.2, h - 0.1, int(h / 0.4) + 1)]
    return Piece(join([*posts, *rails]), w, 0.3)


def vehicle(rng: np.random.Generator) -> Piece:
    """A car, a van, a lorry, a fork lift: body, cab, wheels."""
    kind = int(rng.choice(4, p=(0.55, 0.2, 0.1, 0.15)))
    low = np.array([(3.8, 1.65, 0.6), (4.8, 1.9, 1.4), (6.5, 2.3, 1.0), (1.8, 1.0, 0.9)][kind])
    w, d, h = low * rng.uniform(0.95, 1.15, 3)
    cab = np.array([(0.55, 0.9, 0.62), (0.7, 0.98, 0.55), (0.72, 1.0, 2.0), (0.5, 0.9, 1.1)][kind])
    a, b, c = cab * (w, d, 1.0)
    back = rng.uniform(-0.12, 0.05) * w
    body = tapered_box((w, d), (w * 0.96, d * 0.94), h).moved((0, 0, 0.22))
    house = tapered_box((a, b), (a * 0.75, b * 0.88), c).moved((back, 0, 0.22 + h))
    r = 0.17 * d + 0.04
    wheels = [
        cylinder(r, 0.2, 10).turned(rotation_x(math.pi / 2), (x * w * 0.32, y * d / 2 + 0.1, r))
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    return Piece(join([body, house.with_loss(0.2), *wheels]), w, d)


def tree(rng: np.random.Generator) -> Piece:
    """A trunk that carries one to four crowns."""
    h, r = rng.uniform(1.2, 4.0), rng.uniform(0.07, 0.3)
    parts = [cone(r * 1.3, r * 0.8, h + 0.5, 9)]
    for _ in range(int(rng.integers(1, 5))):
        size = rng.uniform((0.7, 0.7, 0.8), (2.2, 2.2, 2.6))
        at = (*rng.normal(0, 0.7, 2), h + rng.uniform(-0.3, 1.5))
        parts.append(blob(rng, size, 0.25).moved(at))
    return Piece(join(parts), 3 * r, 3 * r)


def bush(rng: np.random.Generator) -> Piece:
    """A bush, a flower bed's hedge, a boulder."""
    w, d, h = rng.uniform((0.6, 0.5, 0.4), (3.5, 1.4, 1.8))
    return Piece(blob(rng, (w / 2, d / 2, h / 2), 0.2), w, d)


def pole(rng: np.random.Generator) -> Piece:
    """A lamp post, a sign, a bollard."""
    h, r = rng.uniform(0.7, 6.0), rng.uniform(0.03, 0.14)
    parts = [cylinder(r, h, 10)]
    if h > 2.0 and rng.random() < 0.6:
        parts.append(box(rng.uniform(0.4, 1.2), 0.08, rng.uniform(0.2, 0.9), (0, 0, h * 0.8)))
    return Piece(join(parts), max(0.3, 2 * r), max(0.3, 2 * r))


def person(rng: np.random.Generator) -> Piece:
    """Somebody who stands: legs, trunk, head."""
    h = rng.uniform(1.55, 1.9)
    trunk = ellipsoid((0.24, 0.15, 0.3 * h / 1.7), 0.8, 12).moved((0, 0, 0.46 * h))
    legs = [cylinder(0.08, 0.5 * h, 8).moved((s * 0.1, 0.05 * s, 0)) for s in (-1, 1)]
    return Piece(
        join([*legs, trunk, ellipsoid((0.09, 0.1, 0.12), 1, 10).moved((0, 0, 0.86 * h))]), 0.55, 0.4
    )
