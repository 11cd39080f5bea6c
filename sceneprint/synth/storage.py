"""Things that hold things: cupboards, shelves, kitchen rows, and what stands on a floor.

rng  --cupboard, shelf, kitchen_row, ...-->  Piece, its back towards +y
"""

from __future__ import annotations

import numpy as np

from sceneprint.synth.clutter import plant, stack
from sceneprint.synth.mesh import Mesh, join
from sceneprint.synth.piece import Piece, Surface
from sceneprint.synth.solids import box, cone, cylinder, tube


def cupboard(rng: np.random.Generator) -> Piece:
    """A chest of drawers, sideboard or wardrobe with fronts, gaps and handles."""
    h = rng.choice((rng.uniform(0.45, 1.2), rng.uniform(1.6, 2.25)))
    w, d = rng.uniform(0.45, 1.6), rng.uniform(0.3, 0.65)
    mesh = join([box(w, d, h), _fronts(rng, w, h - 0.05, 0.05).moved((0, -d / 2, 0))])
    return Piece(mesh, w, d, (Surface(0, 0, w, d, h, 0.7, 6),))


def shelf(rng: np.random.Generator) -> Piece:
    """An open shelf: sides, boards, a back or none, rows of books and boxes."""
    w, d, h = rng.uniform(0.5, 1.8), rng.uniform(0.22, 0.4), rng.uniform(0.8, 2.2)
    n = max(2, round(h / rng.uniform(0.28, 0.45)))
    t, gap = rng.uniform(0.015, 0.03), h / n
    parts = [box(t, d, h, (x, 0, 0)) for x in (-w / 2, w / 2)]
    parts += [box(w, d, t, (0, 0, k * gap)) for k in range(n)] + [box(w, d, t, (0, 0, h - t))]
    if rng.random() < 0.6:
        parts.append(box(w, 0.01, h, (0, d / 2, 0)))
    free = []
    for k in range(n):
        z = k * gap + t
        if rng.random() < 0.6:
            parts.append(books(rng, w - 2 * t, d, gap - t).moved((0, 0, z)))
        else:
            free.append(Surface(0, 0, w - 2 * t, d, z, gap - t - 0.02, 14))
    free.append(Surface(0, 0, w, d, h, 0.5, 6))
    return Piece(join(parts), w, d, tuple(free))


def books(rng: np.random.Generator, width: float, depth: float, headroom: float) -> Mesh:
    """A row of books or binders, with gaps; some lean."""
    parts: list[Mesh] = []
    x, end = -width / 2, width / 2
    size = rng.uniform(0.5, 0.95) * headroom
    while True:
        t = rng.uniform(0.012, 0.07)
        if x + t > end:
            return join(parts)
        if rng.random() < 0.08:
            x += rng.uniform(0.03, 0.3)
            continue
        h = min(size * rng.uniform(0.75, 1.1), headroom - 0.01)
        d = depth * rng.uniform(0.5, 0.9)
        parts.append(box(t * 0.97, d, h, (x + t / 2, (depth - d) / 2 - 0.02, 0)))
        x += t


def kitchen_row(rng: np.random.Generator) -> Piece:
    """Base units under a worktop with a sink or hob, wall units above, perhaps a fridge."""
    unit = rng.uniform(0.45, 0.65)
    n = int(rng.integers(2, 6))
    w, d, h, t = n * unit, 0.6, rng.uniform(0.85, 0.94), rng.uniform(0.025, 0.05)
    parts = [box(w, d - 0.06, 0.1, (0, 0.03, 0)), box(w, d - 0.03, h - t - 0.1, (0, 0.015, 0.1))]
    for k in range(n):
        x = (k + 0.5) * unit - w / 2
        parts.append(_fronts(rng, unit - 0.006, h - t - 0.12, 0.11).moved((x, -d / 2 + 0.015, 0)))
    sink = int(rng.integers(0, n))
    xs = [-w / 2, sink * unit - w / 2 + 0.06, (sink + 1) * unit - w / 2 - 0.06, w / 2]
    parts += [_slab(xs[0], xs[1], d, h - t, t), _slab(xs[2], xs[3], d, h - t, t)]
    parts += _sink(rng, xs[1], xs[2], d, h, t)
    surfaces = [Surface(0, -0.02, w, d - 0.1, h, 0.45, 7)]
    if rng.random() < 0.7:  # wall units leave a gap over the worktop
        z, high, deep = h + rng.uniform(0.45, 0.6), rng.uniform(0.4, 0.85), rng.uniform(0.3, 0.38)
        m = int(rng.integers(1, n + 1))
        for k in range(m):
            x = (k + 0.5) * unit - w / 2
            parts.append(box(unit - 0.004, deep, high, (x, (d - deep) / 2, z)))
            front = _fronts(rng, unit - 0.008, high - 0.02, 0.01)
            parts.append(front.moved((x, d / 2 - deep, z)))
        surfaces.append(Surface((m - n) * unit / 2, 0.13, m * unit, deep, z + high, 0.3, 5))
    elif rng.random() < 0.6:  # or a board with things on it
        z = h + rng.uniform(0.35, 0.6)
        parts.append(box(w, 0.22, 0.025, (0, d / 2 - 0.11, z)))
        surfaces.append(Surface(0, d / 2 - 0.11, w, 0.22, z + 0.025, 0.4, 14))
    return Piece(join(parts), w, d, tuple(surfaces))


def fridge(rng: np.random.Generator) -> Piece:
    """A fridge, oven tower or locker."""
    w, d, h = rng.uniform((0.5, 0.55, 0.85), (0.75, 0.72, 2.1))
    split = h * rng.uniform(0.3, 0.7)
    doors = [
        box(w, 0.05, split - 0.02, (0, -d / 2, 0.02)),
        box(w, 0.05, h - split, (0, -d / 2, split + 0.008)),
    ]
    grips = (split * 0.35, split + 0.1)
    grip = [box(0.025, 0.05, 0.3, (w * 0.4, -d / 2 - 0.04, z)) for z in grips]
    return Piece(join([box(w, d, h), *doors, *grip]), w, d, (Surface(0, 0, w, d, h, 0.5, 5),))


def counter(rng: np.random.Generator) -> Piece:
    """A bar or island: a body with an overhanging top, often free-standing."""
    w, d, h = rng.uniform((1.0, 0.4, 0.85), (2.4, 0.9, 1.15))
    body = box(w - 0.1, d * rng.uniform(0.6, 0.95), h - 0.04)
    return Piece(
        join([body, box(w, d, 0.04, (0, 0, h - 0.04))]), w, d, (Surface(0, 0, w, d, h, 0.7, 8),), -2
    )


def floor_thing(rng: np.random.Generator) -> Piece:
    """What stands on floors: bins, boxes in a pile, plants, lamps, bags, fans, buckets."""
    kind = rng.choice(5, p=(0.2, 0.35, 0.2, 0.15, 0.1))
    if kind == 0:
        r = rng.uniform(0.12, 0.22)
        mesh = cone(r * rng.uniform(0.7, 1), r, rng.uniform(0.28, 0.65))
    elif kind == 1:
        mesh = stack(rng)
        mesh = mesh.turned(np.diag(rng.uniform((1.0, 1.0, 1.5), (2.0, 2.0, 4.0))))
    elif kind == 2:
        mesh = plant(rng)
        mesh = mesh.turned(np.eye(3) * rng.uniform(1.2, 2.8))
    elif kind == 3:
        h, r = rng.uniform(1.3, 1.8), rng.uniform(0.14, 0.25)
        shade = cone(r, r * 0.7, 0.3).moved((0, 0, h))
        mesh = join([cylinder(0.15, 0.03), tube([(0, 0, 0.02), (0, 0, h)], 0.014), shade])
    else:
        w, d, h = rng.uniform((0.3, 0.2, 0.4), (0.6, 0.4, 0.75))
        handle = tube([(-0.1, 0, h), (-0.1, 0, h + 0.3), (0.1, 0, h + 0.3), (0.1, 0, h)], 0.012)
        mesh = join([box(w, d, h), handle])
    reach = np.ptp(mesh.vertices, axis=0)
    return Piece(mesh, float(reach[0]), float(reach[1]))


def stairs(rng: np.random.Generator) -> Piece:
    """A straight flight of steps that rises towards the back."""
    n, rise, tread = int(rng.integers(3, 11)), rng.uniform(0.16, 0.19), rng.uniform(0.24, 0.3)
    w, d = rng.uniform(0.8, 1.2), n * tread
    steps = [box(w, d - k * tread, rise, (0, k * tread / 2, k * rise)) for k in range(n)]
    rail = [(w / 2, -d / 2, 0.9), (w / 2, d / 2, 0.9 + n * rise)]
    return Piece(join([*steps, tube(rail, 0.025)]), w, d)


def _fronts(rng: np.random.Generator, w: float, h: float, z: float) -> Mesh:
    """Doors or drawers of a body, in the plane y = 0, from height z on."""
    columns = max(1, round(w / rng.uniform(0.4, 0.7)))
    rows = int(rng.choice((1, 1, 2, 3, 4)))
    a, b, gap = w / columns, h / rows, 0.006
    parts = []
    for i in range(columns):
        for k in range(rows):
            x, low = (i + 0.5) * a - w / 2, z + k * b
            parts.append(box(a - gap, 0.02, b - gap, (x, -0.01, low)))
            parts.append(box(a * 0.3, 0.03, 0.015, (x, -0.035, low + b * 0.8)))
    return join(parts)


def _slab(x0: float, x1: float, d: float, z: float, t: float) -> Mesh:
    return box(x1 - x0, d + 0.02, t, ((x0 + x1) / 2, -0.01, z))


def _sink(
    rng: np.random.Generator, x0: float, x1: float, d: float, h: float, t: float
) -> list[Mesh]:
    """The worktop around a basin set between x0 and x1, with a tap."""
    x, w, wide = (x0 + x1) / 2, x1 - x0, rng.uniform(0.09, 0.14)
    rims = [box(w, wide, t, (x, s * (d / 2 - wide / 2 + 0.01) - 0.01, h - t)) for s in (-1, 1)]
    back = d / 2 - 0.06
    tap = [(x, back, h), (x, back, h + 0.25), (x, 0.06, h + 0.24), (x, 0.05, h + 0.17)]
    return [*rims, tube(tap, 0.014)]
