"""What belongs to walls: doors, windows and niches cut into them, and things mounted on them.

Wall, rng  --pierced-->  Wall with openings  --fittings-->  Mesh
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sceneprint.synth.mesh import Mesh, join
from sceneprint.synth.piece import Surface, scatter
from sceneprint.synth.shell import Ceiling, Opening, Wall
from sceneprint.synth.solids import box, ribbon, tube
from sceneprint.types import Floats

DOOR_TOP = 2.03  #: metres; every ceiling is higher


def pierced(wall: Wall, rng: np.random.Generator, deepest: float) -> Wall:
    """The wall with doors, windows and niches side by side; `deepest` bounds their depth."""
    openings: list[Opening] = []
    u = rng.uniform(0.1, 0.8)
    while u < wall.length - 0.6:
        kind = rng.choice(4, p=(0.15, 0.3, 0.1, 0.45))
        wide = rng.uniform(0.75, 1.0) if kind == 0 else rng.uniform(0.6, 1.8)
        end = min(u + wide, wall.length - 0.08)
        if kind == 0:
            deep = rng.uniform(0.04, 0.2) if rng.random() < 0.75 else rng.uniform(0.5, 2.0)
            openings.append(Opening(u, end, 0.0, DOOR_TOP, min(deep, deepest)))
        elif kind == 1:
            low = rng.choice((rng.uniform(0.75, 1.1), rng.uniform(0.05, 0.3)), p=(0.8, 0.2))
            glass = rng.choice((0.0, rng.uniform(0.6, 1.0)), p=(0.4, 0.6))
            deep = min(rng.uniform(0.08, 0.4), deepest)
            openings.append(Opening(u, end, low, rng.uniform(1.7, 2.1), deep, glass))
        elif kind == 2:
            low = rng.uniform(0.0, 1.2)
            high = low + rng.uniform(0.3, 0.85)
            openings.append(Opening(u, end, low, high, min(rng.uniform(0.1, 0.5), deepest)))
        u = end + rng.uniform(0.25, 1.5)
    return replace(wall, openings=tuple(openings))


def fittings(wall: Wall, top: Ceiling, rng: np.random.Generator) -> Mesh:
    """Frames, sills, radiators, curtains, skirting, pipes, pictures, boards on one wall."""
    parts = [m for o in wall.openings for m in _around(o, rng)]
    if rng.random() < 0.5:
        parts += _skirting(wall, rng.uniform(0.04, 0.12))
    for u, wide in _gaps(wall):
        draw = rng.random()
        if draw < 0.3:
            parts += _pictures(u, wide, rng)
        elif draw < 0.4:
            parts.append(_pipe(u + wide * rng.random(), top, wall, rng))
        elif draw < 0.6:
            parts.append(_mounted(u, wide, rng))
        elif draw < 0.7:
            parts.append(box(0.08, 0.012, 0.08, (u + wide / 2, 0.006, rng.choice((0.3, 1.1)))))
    if rng.random() < 0.15:
        z = rng.uniform(0.8, 1.1)  # a duct for cables
        parts.append(box(wall.length - 0.02, 0.07, 0.13, (wall.length / 2, 0.035, z)))
    frame = np.eye(3)
    frame[:2, 0], frame[:2, 1] = wall.along, wall.inward
    return join(parts).turned(frame, (*wall.corner, 0.0))


def overhead(outline: Floats, top: Ceiling, rng: np.random.Generator) -> Mesh:
    """Beams, lamps and pipes under a ceiling (outline (n, 2) of the room, metres)."""
    parts: list[Mesh] = []
    low, high = outline.min(axis=0), outline.max(axis=0)
    middle, span = (low + high) / 2, high - low
    z = float(top.at(outline).min())
    flat = not top.slope.any()
    if flat and rng.random() < 0.25:
        w, drop = rng.uniform(0.1, 0.3), rng.uniform(0.1, 0.35)
        xs = np.arange(low[0] + rng.uniform(0.5, 1.5), high[0], rng.uniform(0.8, 2.5))
        parts += [box(w, span[1], drop, (x, middle[1], z - drop)) for x in xs]
    if rng.random() < 0.6:
        for _ in range(rng.integers(1, 5)):
            x, y = rng.uniform(low + 0.5, high - 0.5)
            size = (1.2, 0.15, 0.06) if rng.random() < 0.5 else (0.35, 0.35, 0.2)
            drop = size[2] + rng.uniform(0.01, 0.3)
            parts.append(box(*size, (x, y, z - drop), rng.integers(0, 2) * math.pi / 2))
            parts.append(
                tube([(x, y, z - drop), (x, y, float(top.at(np.array([x, y]))))], 0.008, 6)
            )
    return join(parts)


def radiator(wide: float, high: float, rng: np.random.Generator) -> Mesh:
    """A ribbed or flat radiator; its back in the plane y = 0, its front towards +y."""
    if rng.random() < 0.4:
        return box(wide, 0.06, high, (0, 0.07, 0.12))
    ribs = np.arange(-wide / 2 + 0.03, wide / 2, 0.06)
    bars = [box(0.035, 0.1, high, (x, 0.08, 0.12)) for x in ribs]
    rails = [box(wide, 0.03, 0.03, (0, 0.08, z)) for z in (0.18, high)]
    return join([*bars, *rails])


def curtain(wide: float, high: float, rng: np.random.Generator) -> Mesh:
    """A wavy sheet along x, its lower edge on z = 0."""
    xs = np.linspace(-wide / 2, wide / 2, max(12, int(wide / 0.02)))
    pitch, swing = rng.uniform(0.09, 0.22), rng.uniform(0.02, 0.06)
    phase = 2 * math.pi * xs / pitch + 0.7 * np.sin(xs * rng.uniform(3, 9))
    return ribbon(np.c_[xs, swing * np.sin(phase)], 0.008, high)


def _around(o: Opening, rng: np.random.Generator) -> list[Mesh]:
    """Frame, sill, bars, radiator, curtains of one opening, in the wall's frame."""
    middle, wide = (o.start + o.end) / 2, o.end - o.start
    parts: list[Mesh] = []
    if o.low == 0.0 and o.deep < 0.3:
        posts = (o.start - 0.03, o.end + 0.03)
        parts += [box(0.07, 0.025, o.high, (u, 0.0125, 0)) for u in posts]
        parts.append(box(wide + 0.13, 0.025, 0.07, (middle, 0.0125, o.high)))
        parts.append(box(0.13, 0.05, 0.02, (o.end - 0.12, 0.03 - o.deep, 1.04)))
        return parts
    if o.high < 1.65 or o.low == 0.0:
        return parts
    bars = np.linspace(o.start + 0.03, o.end - 0.03, int(rng.integers(2, 5)))
    parts += [box(0.06, 0.05, o.high - o.low, (u, 0.03 - o.deep, o.low)) for u in bars]
    rails = (o.low, o.high - 0.06)
    parts += [box(wide, 0.05, 0.06, (middle, 0.03 - o.deep, z)) for z in rails]
    reach = rng.uniform(0.02, 0.2)
    sill = box(wide + 0.06, reach, 0.03, (middle, reach / 2, o.low - 0.03))
    parts += [sill] if rng.random() < 0.6 else []
    if o.low > 0.7 and rng.random() < 0.5:
        high = o.low - rng.uniform(0.2, 0.3)
        parts.append(radiator(wide * rng.uniform(0.6, 1.0), high, rng).moved((middle, 0, 0)))
    if rng.random() < 0.35:
        z = rng.uniform(0.02, 0.3) if rng.random() < 0.6 else max(o.low - 0.15, 0.02)
        for u in (o.start, o.end):
            cloth = curtain(wide * rng.uniform(0.15, 0.45), o.high + 0.08 - z, rng)
            parts.append(cloth.moved((u, rng.uniform(0.1, 0.2), z)))
    return parts


def _gaps(wall: Wall) -> list[tuple[float, float]]:
    """(start, width) of the stretches between openings that are wider than 0.5 m."""
    edges = [0.0, *(u for o in wall.openings for u in (o.start, o.end)), wall.length]
    spans = zip(edges[::2], edges[1::2], strict=True)
    return [(a + 0.1, b - a - 0.2) for a, b in spans if b - a > 0.5]


def _pictures(u: float, wide: float, rng: np.random.Generator) -> list[Mesh]:
    parts = []
    for _ in range(rng.integers(1, 4)):
        w = min(rng.uniform(0.2, 1.6), wide)
        h, t = w * rng.uniform(0.5, 1.2), rng.uniform(0.01, 0.06)
        h = min(h, 1.0)
        x = u + w / 2 + (wide - w) * rng.random()
        picture = box(w, t, h, (x, t / 2, rng.uniform(0.9, 1.95 - h)))
        parts.append(picture.with_loss(0.6 if rng.random() < 0.1 else 0.0))
    return parts


def _mounted(u: float, wide: float, rng: np.random.Generator) -> Mesh:
    """A board on brackets with things on it."""
    w, d, z = min(rng.uniform(0.4, 1.4), wide), rng.uniform(0.15, 0.32), rng.uniform(1.2, 1.8)
    x = u + w / 2 + (wide - w) * rng.random()
    ends = [box(0.02, d * 0.8, 0.15, (x + s * w * 0.4, d * 0.4, z - 0.15)) for s in (-1, 1)]
    load = scatter(Surface(x, d / 2, w, d, z + 0.025, 0.3, 16), rng)
    return join([box(w, d, 0.025, (x, d / 2, z)), *ends, load])


def _pipe(u: float, top: Ceiling, wall: Wall, rng: np.random.Generator) -> Mesh:
    r = rng.uniform(0.012, 0.06)
    height = float(top.at(wall.at(u)))
    return tube([(u, r + 0.02, 0.0), (u, r + 0.02, height)], r, 10)


def _skirting(wall: Wall, high: float) -> list[Mesh]:
    doors = [o for o in wall.openings if o.low < high]
    edges = [0.0, *(u for o in doors for u in (o.start, o.end)), wall.length]
    pairs = zip(edges[::2], edges[1::2], strict=True)
    return [box(b - a, 0.014, high, ((a + b) / 2, 0.007, 0)) for a, b in pairs if b - a > 0.05]


def wall_yaw(wall: Wall) -> float:
    """Yaw (radians) that turns a piece's back, +y, to the wall."""
    out = -wall.inward
    return math.atan2(out[1], out[0]) - math.pi / 2
