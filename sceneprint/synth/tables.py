"""Tables and desks, with what usually stands on a desk.

rng  --table, round_table, desk-->  Piece
"""

from __future__ import annotations

import numpy as np

from sceneprint.synth.mesh import Mesh, join, rotation_x
from sceneprint.synth.piece import Piece, Surface
from sceneprint.synth.solids import box, cone, cylinder, tube


def table(rng: np.random.Generator) -> Piece:
    """A rectangular table for eating or meeting; low and small ones are coffee tables."""
    low = rng.random() < 0.25
    w, d = rng.uniform((0.8, 0.6), (2.0, 1.0))
    h = rng.uniform(0.38, 0.5) if low else rng.uniform(0.7, 0.77)
    if low:
        w, d = w * 0.65, d * 0.75
    mesh = join([_top(rng, w, d, h), *_legs(rng, w, d, h)])
    return Piece(mesh, w, d, (Surface(0, 0, w, d, h, 0.7, 8),), 0 if low else -int(rng.integers(5)))


def round_table(rng: np.random.Generator) -> Piece:
    """A round table on a column or on four legs."""
    r, h = rng.uniform(0.35, 0.75), rng.uniform(0.5, 0.76)
    top = cylinder(r, rng.uniform(0.02, 0.05), 32).moved((0, 0, h - 0.03))
    if rng.random() < 0.6:
        base = [cylinder(rng.uniform(0.03, 0.08), h - 0.03), cone(r * 0.6, 0.05, 0.06)]
    else:
        base = _legs(rng, 1.3 * r, 1.3 * r, h)
    side = 1.4 * r
    return Piece(join([top, *base]), 2 * r, 2 * r, (Surface(0, 0, side, side, h, 0.7, 8),), -3)


def desk(rng: np.random.Generator) -> Piece:
    """A work desk: monitors at the back, keyboard, drawers below, sometimes a screen wall."""
    w, d, h = rng.uniform(1.0, 2.0), rng.uniform(0.6, 0.9), rng.uniform(0.68, 0.78)
    parts = [_top(rng, w, d, h), *_legs(rng, w, d, h)]
    if rng.random() < 0.6:
        x = rng.choice((-1, 1)) * (w / 2 - 0.28)
        parts.append(_drawers(rng, 0.42, d * 0.85, h - 0.08).moved((x, 0.02, 0)))
    if rng.random() < 0.3:
        parts.append(box(w, 0.03, rng.uniform(0.9, 1.4), (0, d / 2, 0)))
    if rng.random() < 0.35:
        parts.append(pc_tower(rng).moved((rng.uniform(-0.4, 0.4) * w, 0.1, 0), rng.normal(0, 0.1)))
    count = min(int(rng.choice(4, p=(0.2, 0.4, 0.3, 0.1))), int(w / 0.65))
    for k in range(count):
        x = (k - (count - 1) / 2) * 0.6 + rng.normal(0, 0.05)
        parts.append(
            monitor(rng).moved((x, rng.uniform(0.05, d / 2 - 0.15), h), rng.normal(-0.2 * x, 0.2))
        )
    if rng.random() < 0.7:
        parts.append(
            box(0.43, 0.15, 0.025, (rng.normal(0, 0.1), -d / 2 + 0.2, h), rng.normal(0, 0.1))
        )
    if rng.random() < 0.4:
        at = (rng.uniform(-0.35, 0.35) * w, -0.05, h)
        parts.append(laptop(rng).moved(at, rng.normal(0, 0.5)))
    return Piece(join(parts), w, d, (Surface(0, 0, w, d, h, 0.7, 8),), 1)


def monitor(rng: np.random.Generator) -> Mesh:
    """A flat screen on a foot, facing -y; its glass often answers badly."""
    w = rng.uniform(0.4, 0.72)
    h = w * rng.uniform(0.56, 0.75)
    rise = rng.uniform(0.08, 0.2)
    screen = box(w, rng.uniform(0.02, 0.06), h)
    screen = screen.turned(rotation_x(rng.normal(-0.08, 0.08)), (0, 0, rise))
    hump = box(w * 0.5, 0.05, h * 0.5, (0, 0.04, rise + h * 0.25))
    foot = box(0.25, 0.2, 0.015) if rng.random() < 0.5 else cylinder(0.12, 0.015)
    neck = box(0.06, 0.03, rise + h * 0.4, (0, 0.03, 0))
    dark = rng.uniform(0.3, 0.9) if rng.random() < 0.3 else 0.0
    return join([screen.with_loss(dark), hump, foot, neck])


def laptop(rng: np.random.Generator) -> Mesh:
    """An open laptop."""
    w, d = rng.uniform((0.28, 0.2), (0.4, 0.27))
    lid = box(w, 0.012, d).turned(rotation_x(-rng.uniform(0.05, 0.6)), (0, d / 2, 0.01))
    return join([box(w, d, 0.02), lid])


def pc_tower(rng: np.random.Generator) -> Mesh:
    """A computer case with a ledge at its front."""
    w, d, h = rng.uniform((0.15, 0.35, 0.33), (0.23, 0.5, 0.5))
    return join([box(w, d, h), box(w * 0.9, 0.02, h * 0.3, (0, -d / 2, h * 0.6))])


def _drawers(rng: np.random.Generator, w: float, d: float, h: float) -> Mesh:
    n = int(rng.integers(2, 5))
    fronts = [
        box(w - 0.02, 0.02, h / n - 0.015, (0, -d / 2 - 0.01 * (rng.random() < 0.8), k * h / n))
        for k in range(n)
    ]
    grips = [box(0.12, 0.02, 0.015, (0, -d / 2 - 0.03, (k + 0.7) * h / n)) for k in range(n)]
    return join([box(w, d, h), *fronts, *grips])


def _top(rng: np.random.Generator, w: float, d: float, h: float) -> Mesh:
    t = rng.uniform(0.018, 0.06)
    apron = box(w * 0.9, d * 0.85, rng.uniform(0.03, 0.1), (0, 0, h - t - 0.08))
    return join([box(w, d, t, (0, 0, h - t))] + ([apron] if rng.random() < 0.5 else []))


def _legs(rng: np.random.Generator, w: float, d: float, h: float) -> list[Mesh]:
    inset = rng.uniform(0.02, 0.12)
    x, y, t = w / 2 - inset, d / 2 - inset, rng.uniform(0.03, 0.09)
    corners = [(a * x, b * y) for a in (-1, 1) for b in (-1, 1)]
    style = rng.choice(4, p=(0.4, 0.25, 0.2, 0.15))
    if style == 0:
        return [box(t, t, h - 0.02, (a, b, 0)) for a, b in corners]
    if style == 1:
        s = rng.uniform(0.8, 1.0)  # legs that lean outward
        return [tube([(a, b, 0), (a * s, b * s, h - 0.02)], t / 2) for a, b in corners]
    if style == 2:  # two side panels
        return [box(0.03, d * 0.95, h - 0.02, (a, 0, 0)) for a in (-x, x)]
    feet = [box(t, d * 0.9, 0.04, (a, 0, 0)) for a in (-x, x)]
    return [*feet, *(box(t, t * 1.5, h - 0.02, (a, 0, 0)) for a in (-x, x))]
