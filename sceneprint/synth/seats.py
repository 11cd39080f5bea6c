"""Things to sit and lie on.

rng  --chair, swivel_chair, stool, sofa, bed-->  Piece, its back towards +y
"""

from __future__ import annotations

import math

import numpy as np

from sceneprint.synth.mesh import Mesh, join, rotation_x
from sceneprint.synth.piece import Piece, Surface
from sceneprint.synth.solids import blob, box, cylinder, ellipsoid, ribbon, tube


def chair(rng: np.random.Generator) -> Piece:
    """A four-legged chair: a slatted, solid or bent back, sometimes arms."""
    w, d, h = rng.uniform(0.38, 0.5), rng.uniform(0.38, 0.48), rng.uniform(0.42, 0.48)
    t, rise = rng.uniform(0.02, 0.045), rng.uniform(0.35, 0.55)
    round_legs = rng.random() < 0.5
    x, y, lean = w / 2 - t, d / 2 - t, rng.uniform(0.0, 0.12)
    parts = [box(w, d, rng.uniform(0.015, 0.06), (0, 0, h - 0.03))]
    for a in (-x, x):
        if round_legs:
            parts.append(tube([(a * 1.1, -y * 1.1, 0), (a, -y, h - 0.02)], t / 2))
            parts.append(tube([(a, y, 0), (a, y, h), (a, y + lean, h + rise)], t / 2))
        else:
            parts += [box(t, t, h, (a, -y, 0)), box(t, t, h, (a, y, 0))]
            parts.append(_leaning(box(t, t, rise), lean / rise, (a, y, h)))
    parts.append(_leaning(_chair_back(rng, w, rise), lean / rise, (0, y, h)))
    if rng.random() < 0.25:
        for a in (-w / 2, w / 2):
            arm = [(a, -y, h), (a, -y, h + 0.2), (a, y, h + 0.22)]
            parts.append(tube(arm, 0.015))
    return Piece(join(parts), w, d + lean)


def swivel_chair(rng: np.random.Generator) -> Piece:
    """An office chair: star foot with castors, column, padded seat and back."""
    h, r = rng.uniform(0.42, 0.52), rng.uniform(0.27, 0.34)
    turn, rise = rng.uniform(0, 2), rng.uniform(0.45, 0.75)
    parts = [cylinder(0.03, h, 10), cylinder(0.05, 0.12, 10).moved((0, 0, 0.06))]
    for k in range(5):
        c, s = math.cos(turn + k * 2 * math.pi / 5), math.sin(turn + k * 2 * math.pi / 5)
        parts.append(tube([(0, 0, 0.12), (r * c, r * s, 0.07)], 0.02, 6))
        parts.append(ellipsoid((0.03, 0.03, 0.03), segments=8).moved((r * c, r * s, 0)))
    w, d = rng.uniform(0.42, 0.52), rng.uniform(0.42, 0.5)
    parts.append(ellipsoid((w / 2, d / 2, 0.045), 0.45).moved((0, 0, h)))
    bend = rng.uniform(0.0, 0.1)
    xs = np.linspace(-w / 2, w / 2, 9)
    back = ribbon(np.c_[-xs, bend * (1 - (2 * xs / w) ** 2)], rng.uniform(0.02, 0.07), rise)
    parts.append(_leaning(back, rng.uniform(0, 0.25), (0, d / 2, h + rng.uniform(0.05, 0.15))))
    parts.append(tube([(0, 0, h), (0, d / 2 + 0.05, h + 0.02), (0, d / 2 + 0.06, h + 0.3)], 0.025))
    if rng.random() < 0.6:
        for a in (-w / 2 - 0.02, w / 2 + 0.02):
            parts.append(tube([(a, 0.05, h), (a, 0.05, h + 0.2)], 0.018, 6))
            parts.append(box(0.06, 0.25, 0.03, (a, 0, h + 0.2)))
    return Piece(join(parts), 2 * r, 2 * r)


def stool(rng: np.random.Generator) -> Piece:
    """A stool, pouf or side table."""
    r, h = rng.uniform(0.15, 0.28), rng.uniform(0.35, 0.7)
    if rng.random() < 0.3:
        return Piece(ellipsoid((r, r, h * 0.35), 0.4), 2 * r, 2 * r)
    legs = []
    for a in np.arange(4) * math.pi / 2 + 0.4:
        c, s = r * math.cos(a), r * math.sin(a)
        legs.append(tube([(c, s, 0), (0.6 * c, 0.6 * s, h)], 0.015))
    top = cylinder(r, 0.04, 20).moved((0, 0, h))
    return Piece(join([top, *legs]), 2 * r, 2 * r, (Surface(0, 0, r, r, h + 0.04, 0.5, 10),))


def sofa(rng: np.random.Generator) -> Piece:
    """A sofa or armchair: base, back, arms, seat cushions, loose cushions."""
    places = int(rng.integers(1, 4))
    arm, seat = rng.uniform(0.08, 0.25), rng.uniform(0.5, 0.75)
    w, d = places * seat + 2 * arm, rng.uniform(0.75, 1.0)
    h, rise = rng.uniform(0.36, 0.46), rng.uniform(0.3, 0.5)
    soft = rng.uniform(0.2, 0.5)
    parts = [box(w, d, h - 0.13, (0, 0, rng.uniform(0, 0.1)))]
    back = box(w, 0.2, h + rise) if rng.random() < 0.5 else _pillow(w, 0.24, h + rise, soft)
    parts.append(_leaning(back, rng.uniform(0, 0.15), (0, d / 2 - 0.16, 0)))
    for a in (-1, 1):
        body = box if rng.random() < 0.5 else _pillow
        high = h + rng.uniform(0.1, 0.25)
        side = box(arm, d, high) if body is box else _pillow(arm, d, high, soft)
        parts.append(side.moved((a * (w - arm) / 2, 0, 0)))
    for k in range(places):
        x = (k - (places - 1) / 2) * seat
        parts.append(_pillow(seat, d - 0.2, 0.18, soft).moved((x, -0.1, h - 0.14)))
        parts.append(_leaning(_pillow(seat, 0.2, rise, soft), 0.2, (x, d / 2 - 0.33, h)))
    for _ in range(rng.integers(0, 4)):
        x, y = rng.uniform(-w / 2 + 0.3, w / 2 - 0.3), rng.uniform(-0.1, 0.15)
        parts.append(blob(rng, (0.22, 0.12, 0.18), 0.06).moved((x, y, h), rng.normal(0, 0.7)))
    return Piece(join(parts), w, d, (Surface(0, -0.1, w - 2 * arm, d * 0.5, h + 0.04, 0.4, 1.5),))


def bed(rng: np.random.Generator) -> Piece:
    """A bed with mattress, quilt and pillows, its head at the back."""
    w, d, h = rng.choice((0.9, 1.4, 1.7)) + rng.uniform(0, 0.1), 2.05, rng.uniform(0.3, 0.5)
    parts = [box(w, d, h - 0.18, (0, 0, 0.08)), _pillow(w, d, 0.25, 0.15).moved((0, 0, h - 0.2))]
    if rng.random() < 0.7:
        parts.append(box(w, 0.06, rng.uniform(0.6, 1.1), (0, d / 2, 0)))
    quilt = blob(rng, (w * 0.52, d * 0.36, 0.12), 0.1)
    parts.append(quilt.moved((0, -d * 0.1, h - 0.05), rng.normal(0, 0.1)))
    for k in range(2 if w > 1.2 else 1):
        x = (k - 0.5) * w / 2 if w > 1.2 else 0.0
        parts.append(blob(rng, (0.35, 0.22, 0.1), 0.05).moved((x, d / 2 - 0.3, h)))
    return Piece(join(parts), w, d, (Surface(0, 0, w, d, h + 0.03, 0.5, 0.7),))


def _chair_back(rng: np.random.Generator, w: float, rise: float) -> Mesh:
    kind = rng.choice(4, p=(0.3, 0.3, 0.2, 0.2))
    if kind == 0:  # a board
        return box(w, 0.025, rise * 0.6, (0, 0, rise * 0.4))
    if kind == 1:  # slats across
        n = int(rng.integers(2, 6))
        slat = rise * 0.75 / n * rng.uniform(0.35, 0.75)
        return join(box(w, 0.02, slat, (0, 0, rise * (0.25 + 0.75 * k / n))) for k in range(n))
    if kind == 2:  # bars upright
        n = int(rng.integers(3, 7))
        bars = [box(0.02, 0.02, rise, (w * (k + 0.5) / n - w / 2, 0, 0)) for k in range(n)]
        return join([*bars, box(w, 0.03, 0.06, (0, 0, rise - 0.06))])
    xs = np.linspace(-w / 2, w / 2, 9)
    bent = np.c_[-xs, 0.06 * (1 - (2 * xs / w) ** 2)]
    return ribbon(bent, 0.02, rise * 0.5).moved((0, 0, rise * 0.45))


def _pillow(w: float, d: float, h: float, soft: float) -> Mesh:
    return ellipsoid((w / 2, d / 2, h / 2), soft, 20)


def _leaning(mesh: Mesh, slope: float, at: tuple[float, float, float]) -> Mesh:
    """Leant backwards (+y) by slope radians about its foot, then put at a point."""
    return mesh.turned(rotation_x(-slope), at)
