"""Pieces of furniture: meshes, footprints, and surfaces on which small objects stand.

    Shelf, rng  --scatter-->  small objects on that surface

A piece stands on z = 0, and its footprint is centred on the origin. Its back, which faces a wall,
is at +y, and its front is at -y.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sceneprint.types import Floats
from sceneprint_lab.synth.mesh import (
    Ceiling,
    Opening,
    SyntheticMesh,
    Wall,
    blob,
    box,
    cone,
    cylinder,
    ellipsoid,
    join,
    mesh_of,
    revolve,
    ribbon,
    rotation_x,
    rotation_z,
    tapered_box,
    tube,
)

# Small objects on z = 0.
#
# rng  --small_thing-->  SyntheticMesh, 5 to 60 cm

Builder = Callable[[np.random.Generator], SyntheticMesh]


def packet(rng: np.random.Generator) -> SyntheticMesh:
    """Return a carton of random proportions, such as a cereal packet or a parcel."""
    return box(*rng.uniform((0.05, 0.04, 0.04), (0.3, 0.22, 0.3)))


def flat_thing(rng: np.random.Generator) -> SyntheticMesh:
    """Return a book, magazine, tablet or stack of paper."""
    return box(rng.uniform(0.12, 0.32), rng.uniform(0.1, 0.24), rng.uniform(0.004, 0.05))


def stack(rng: np.random.Generator) -> SyntheticMesh:
    """Return a stack of slightly rotated books or boxes."""
    parts, z = [], 0.0
    w, d = rng.uniform((0.15, 0.12), (0.4, 0.3))
    for _ in range(rng.integers(2, 7)):
        h = rng.uniform(0.015, 0.12)
        w, d = np.array([w, d]) * rng.uniform(0.75, 1.05, 2)
        parts.append(box(w, d, h, (0, 0, z), rng.normal(0, 0.25)))
        z += h
    return join(parts)


def mug(rng: np.random.Generator) -> SyntheticMesh:
    """Return a mug with a wall and a handle."""
    r, h, t = rng.uniform(0.03, 0.05), rng.uniform(0.07, 0.12), 0.005
    body = revolve([(r * 0.9, 0), (r, h), (r - t, h), (r * 0.9 - t, t)], 14)
    a = np.linspace(-1.3, 1.3, 6)
    ring = np.c_[r * 0.9 + 0.03 * np.cos(a), np.zeros(6), h / 2 + 0.03 * np.sin(a)]
    return join([body, tube(list(ring), 0.006, 6)])


def bottle(rng: np.random.Generator) -> SyntheticMesh:
    """Return a bottle, jug or vase with a smooth random profile."""
    r, h = rng.uniform(0.03, 0.06), rng.uniform(0.15, 0.35)
    neck = rng.uniform(0.2, 0.7)
    s = rng.uniform(0.5, 0.75)
    profile = [(r * 0.9, 0), (r, 0.02), (r, h * s), (r * neck, h * (s + 0.18)), (r * neck, h)]
    return revolve(profile, 14)


def bowl(rng: np.random.Generator) -> SyntheticMesh:
    """Return a bowl, sometimes with fruit."""
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


def jar(rng: np.random.Generator) -> SyntheticMesh:
    """Return a tin, jar, roll or candle."""
    return cylinder(rng.uniform(0.025, 0.08), rng.uniform(0.05, 0.25), 14)


def ball(rng: np.random.Generator) -> SyntheticMesh:
    """Return a ball or a rounded object."""
    r = rng.uniform(0.03, 0.13)
    return ellipsoid(r * rng.uniform(0.6, 1.2, 3), rng.uniform(0.5, 1.0))


def bag(rng: np.random.Generator) -> SyntheticMesh:
    """Return a bag, cushion or heap of cloth."""
    return blob(rng, rng.uniform((0.1, 0.07, 0.05), (0.28, 0.2, 0.22)), rng.uniform(0.05, 0.15))


def basket(rng: np.random.Generator) -> SyntheticMesh:
    """Return a tapered open tray or basket with a floor and four leaning walls."""
    w, d, h = rng.uniform((0.15, 0.12, 0.06), (0.45, 0.32, 0.25))
    t = 0.012
    walls = [box(w, t, h, (0, y, 0)) for y in (-d / 2, d / 2)]
    walls += [box(t, d, h, (x, 0, 0)) for x in (-w / 2, w / 2)]
    inside = [packet(rng).moved((0, 0, t), rng.uniform(0, 3))] if min(w, d) > 0.25 else []
    return join([box(w, d, t), *walls, *inside])


def lamp(rng: np.random.Generator) -> SyntheticMesh:
    """Return a table lamp with a foot, a stem and a shade."""
    h = rng.uniform(0.3, 0.6)
    r = rng.uniform(0.08, 0.18)
    lean = rng.uniform(0, 0.2) if rng.random() < 0.5 else 0.0
    stem = tube([(0, 0, 0.01), (lean / 2, 0, h * 0.5), (lean, 0, h)], 0.01)
    shade = cone(r, r * rng.uniform(0.3, 0.9), r * 1.2).moved((lean, 0, h * 0.85))
    return join([cylinder(r * 0.7, 0.02), stem, shade])


def plant(rng: np.random.Generator) -> SyntheticMesh:
    """Return a pot with leaves, a ball of leaves or a few branches."""
    r, h = rng.uniform(0.05, 0.16), rng.uniform(0.08, 0.26)
    size = rng.uniform(1.0, 2.5) * r + 0.08
    pot = cone(r * 0.75, r, h)
    if rng.random() < 0.3:
        return join([pot, blob(rng, size * rng.uniform(0.6, 1, 3), 0.2).moved((0, 0, h * 0.8))])
    leaves = [_leaf(rng, size) for _ in range(rng.integers(12, 45))]
    return join([pot, *(leaf.moved((0, 0, h)) for leaf in leaves)])


def _leaf(rng: np.random.Generator, size: float) -> SyntheticMesh:
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


def tool(rng: np.random.Generator) -> SyntheticMesh:
    """Return a long thin object that lies flat, such as a ruler or a remote control."""
    if rng.random() < 0.5:
        return box(rng.uniform(0.1, 0.45), rng.uniform(0.02, 0.06), rng.uniform(0.01, 0.04))
    half, r = rng.uniform(0.08, 0.3), rng.uniform(0.01, 0.04)
    return tube([(-half, 0, r), (half, 0, r)], r)


def appliance(rng: np.random.Generator) -> SyntheticMesh:
    """Return a microwave, printer, toaster or coffee machine: a body with attached parts."""
    w, d, h = rng.uniform((0.18, 0.15, 0.15), (0.52, 0.42, 0.38))
    face = box(w * 0.6, 0.02, h * 0.7, (-w * 0.12, -d / 2, h * 0.15))
    top = box(w * rng.uniform(0.4, 0.95), d * rng.uniform(0.4, 0.9), h * 0.2, (0, 0, h))
    knob = box(0.03, 0.04, h * 0.5, (w * 0.35, -d / 2, h * 0.25))
    return join([box(w, d, h), face, knob] + ([top] if rng.random() < 0.5 else []))


def kettle(rng: np.random.Generator) -> SyntheticMesh:
    """Return a kettle, teapot or watering can."""
    r, h = rng.uniform(0.06, 0.1), rng.uniform(0.12, 0.24)
    body = revolve([(r, 0), (r * 1.05, h * 0.4), (r * 0.6, h), (0.02, h + 0.02)], 14)
    grip = [(r * 0.6, 0, h * 0.9), (r * 1.7, 0, h * 0.85), (r * 1.6, 0, h * 0.3), (r, 0, h * 0.2)]
    spout = tube([(-r * 0.8, 0, h * 0.4), (-r * 1.7, 0, h * 0.85)], r * 0.18)
    return join([body, tube(grip, 0.011), spout])


def tray(rng: np.random.Generator) -> SyntheticMesh:
    """Return a tapered solid, such as a loaf, a pan with a handle or a hard hat."""
    w, d, h = rng.uniform((0.1, 0.1, 0.03), (0.35, 0.25, 0.12))
    s = rng.uniform(0.5, 1.2)
    handle = tube([(w / 2, 0, h * 0.7), (w / 2 + 0.18, 0, h * 0.9)], 0.011)
    return join([tapered_box((w * s, d * s), (w, d), h)] + ([handle] if rng.random() < 0.4 else []))


#: Small objects for any surface, and their weights.
SMALL: tuple[tuple[Builder, float], ...] = (
    (packet, 4), (flat_thing, 4), (stack, 2), (mug, 3), (bottle, 2), (bowl, 1.5), (jar, 2),
    (ball, 1), (bag, 1), (basket, 1), (lamp, 0.5), (plant, 1), (tool, 2), (appliance, 0.7),
    (kettle, 0.6), (tray, 1),
)  # fmt: skip
_WEIGHTS = np.array([w for _, w in SMALL]) / sum(w for _, w in SMALL)


def small_thing(rng: np.random.Generator) -> SyntheticMesh:
    """Return a random small object; 12 % are dark or shiny and lose samples."""
    builder = SMALL[int(rng.choice(len(SMALL), p=_WEIGHTS))][0]
    thing = builder(rng)
    return thing.with_loss(rng.uniform(0.2, 0.95)) if rng.random() < 0.12 else thing


@dataclass(frozen=True)
class Shelf:
    """A horizontal rectangle on which objects stand.

    Parameters
    ----------
    x, y : centre in the piece's frame, metres
    width, depth : extent along x and y, metres
    z : height, metres
    headroom : free height above it, metres
    density : objects per square metre
    """

    x: float
    y: float
    width: float
    depth: float
    z: float
    headroom: float = 0.6
    density: float = 9.0


@dataclass(frozen=True, eq=False)
class Piece:
    """A piece of furniture.

    Parameters
    ----------
    mesh : mesh on z = 0, with its back towards +y
    width, depth : footprint along x and y, metres
    surfaces : surfaces on which objects stand
    seats : 1 for a chair at the front, -n for n chairs at random sides, 0 for no chairs
    """

    mesh: SyntheticMesh
    width: float
    depth: float
    surfaces: tuple[Shelf, ...] = ()
    seats: int = 0


def scatter(surface: Shelf, rng: np.random.Generator) -> SyntheticMesh:
    """Return small objects on a surface, without overlaps; half of them are aligned with it."""
    count = rng.poisson(surface.density * surface.width * surface.depth)
    placed: list[tuple[float, float, float]] = []
    parts: list[SyntheticMesh] = []
    for _ in range(min(count, 40)):
        thing = small_thing(rng)
        low, high = thing.vertices.min(axis=0), thing.vertices.max(axis=0)
        reach = float(np.abs(np.concatenate([low[:2], high[:2]])).max())
        room_x, room_y = surface.width / 2 - 0.7 * reach, surface.depth / 2 - 0.7 * reach
        if min(room_x, room_y) <= 0 or high[2] > surface.headroom:
            continue
        x = surface.x + rng.uniform(-room_x, room_x)
        y = surface.y + rng.uniform(-room_y, room_y)
        if any(math.hypot(x - a, y - b) < 0.75 * (reach + r) for a, b, r in placed):
            continue
        yaw = rng.uniform(-math.pi, math.pi)
        if rng.random() < 0.5:
            yaw = rng.integers(0, 4) * math.pi / 2 + rng.normal(0, 0.08)
        placed.append((x, y, reach))
        parts.append(thing.moved((x, y, surface.z), yaw))
    return join(parts)


def with_objects(piece: Piece, rng: np.random.Generator) -> SyntheticMesh:
    """Return a piece with a random density of objects on its surfaces."""
    fullness = float(np.clip(rng.lognormal(0.1, 0.7), 0.1, 3.0))
    loads = [
        scatter(Shelf(**{**vars(s), "density": s.density * fullness}), rng) for s in piece.surfaces
    ]
    return join([piece.mesh, *loads])


# Furniture for sitting and lying.
#
# rng  --chair, swivel_chair, stool, sofa, bed-->  Piece, its back towards +y


def chair(rng: np.random.Generator) -> Piece:
    """Return a four-legged chair with a slatted, solid or bent back, sometimes with arms."""
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
    """Return an office chair with a star foot on castors, a column, a padded seat and a back."""
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
    """Return a stool, pouf or side table."""
    r, h = rng.uniform(0.15, 0.28), rng.uniform(0.35, 0.7)
    if rng.random() < 0.3:
        return Piece(ellipsoid((r, r, h * 0.35), 0.4), 2 * r, 2 * r)
    legs = []
    for a in np.arange(4) * math.pi / 2 + 0.4:
        c, s = r * math.cos(a), r * math.sin(a)
        legs.append(tube([(c, s, 0), (0.6 * c, 0.6 * s, h)], 0.015))
    top = cylinder(r, 0.04, 20).moved((0, 0, h))
    return Piece(join([top, *legs]), 2 * r, 2 * r, (Shelf(0, 0, r, r, h + 0.04, 0.5, 10),))


def sofa(rng: np.random.Generator) -> Piece:
    """Return a sofa or armchair with a base, a back, arms and cushions."""
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
    return Piece(join(parts), w, d, (Shelf(0, -0.1, w - 2 * arm, d * 0.5, h + 0.04, 0.4, 1.5),))


def bed(rng: np.random.Generator) -> Piece:
    """Return a bed with a mattress, a quilt and pillows, its head at the back."""
    w, d, h = rng.choice((0.9, 1.4, 1.7)) + rng.uniform(0, 0.1), 2.05, rng.uniform(0.3, 0.5)
    parts = [box(w, d, h - 0.18, (0, 0, 0.08)), _pillow(w, d, 0.25, 0.15).moved((0, 0, h - 0.2))]
    if rng.random() < 0.7:
        parts.append(box(w, 0.06, rng.uniform(0.6, 1.1), (0, d / 2, 0)))
    quilt = blob(rng, (w * 0.52, d * 0.36, 0.12), 0.1)
    parts.append(quilt.moved((0, -d * 0.1, h - 0.05), rng.normal(0, 0.1)))
    for k in range(2 if w > 1.2 else 1):
        x = (k - 0.5) * w / 2 if w > 1.2 else 0.0
        parts.append(blob(rng, (0.35, 0.22, 0.1), 0.05).moved((x, d / 2 - 0.3, h)))
    return Piece(join(parts), w, d, (Shelf(0, 0, w, d, h + 0.03, 0.5, 0.7),))


def _chair_back(rng: np.random.Generator, w: float, rise: float) -> SyntheticMesh:
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


def _pillow(w: float, d: float, h: float, soft: float) -> SyntheticMesh:
    return ellipsoid((w / 2, d / 2, h / 2), soft, 20)


def _leaning(mesh: SyntheticMesh, slope: float, at: tuple[float, float, float]) -> SyntheticMesh:
    """Return a mesh tilted backwards (+y) by `slope` radians about z = 0, then moved by `at`."""
    return mesh.turned(rotation_x(-slope), at)


# Tables, and desks with their usual equipment.
#
# rng  --table, round_table, desk-->  Piece


def table(rng: np.random.Generator) -> Piece:
    """Return a rectangular dining, meeting or coffee table."""
    low = rng.random() < 0.25
    w, d = rng.uniform((0.8, 0.6), (2.0, 1.0))
    h = rng.uniform(0.38, 0.5) if low else rng.uniform(0.7, 0.77)
    if low:
        w, d = w * 0.65, d * 0.75
    mesh = join([_top(rng, w, d, h), *_legs(rng, w, d, h)])
    return Piece(mesh, w, d, (Shelf(0, 0, w, d, h, 0.7, 8),), 0 if low else -int(rng.integers(5)))


def round_table(rng: np.random.Generator) -> Piece:
    """Return a round table on a column or on four legs."""
    r, h = rng.uniform(0.35, 0.75), rng.uniform(0.5, 0.76)
    top = cylinder(r, rng.uniform(0.02, 0.05), 32).moved((0, 0, h - 0.03))
    if rng.random() < 0.6:
        base = [cylinder(rng.uniform(0.03, 0.08), h - 0.03), cone(r * 0.6, 0.05, 0.06)]
    else:
        base = _legs(rng, 1.3 * r, 1.3 * r, h)
    side = 1.4 * r
    return Piece(join([top, *base]), 2 * r, 2 * r, (Shelf(0, 0, side, side, h, 0.7, 8),), -3)


def desk(rng: np.random.Generator) -> Piece:
    """Return a desk with monitors, a keyboard, drawers and sometimes a partition."""
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
        across = (k - (count - 1) / 2) * 0.6 + rng.normal(0, 0.05)
        screen = monitor(rng)
        place = (across, rng.uniform(0.05, d / 2 - 0.15), h)
        parts.append(screen.moved(place, rng.normal(-0.2 * across, 0.2)))
    if rng.random() < 0.7:
        parts.append(
            box(0.43, 0.15, 0.025, (rng.normal(0, 0.1), -d / 2 + 0.2, h), rng.normal(0, 0.1))
        )
    if rng.random() < 0.4:
        at = (rng.uniform(-0.35, 0.35) * w, -0.05, h)
        parts.append(laptop(rng).moved(at, rng.normal(0, 0.5)))
    return Piece(join(parts), w, d, (Shelf(0, 0, w, d, h, 0.7, 8),), 1)


def monitor(rng: np.random.Generator) -> SyntheticMesh:
    """Return a flat screen on a foot, facing -y; 30 % of the screens lose samples."""
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


def laptop(rng: np.random.Generator) -> SyntheticMesh:
    """Return an open laptop."""
    w, d = rng.uniform((0.28, 0.2), (0.4, 0.27))
    lid = box(w, 0.012, d).turned(rotation_x(-rng.uniform(0.05, 0.6)), (0, d / 2, 0.01))
    return join([box(w, d, 0.02), lid])


def pc_tower(rng: np.random.Generator) -> SyntheticMesh:
    """Return a computer case with a ledge on its front."""
    w, d, h = rng.uniform((0.15, 0.35, 0.33), (0.23, 0.5, 0.5))
    return join([box(w, d, h), box(w * 0.9, 0.02, h * 0.3, (0, -d / 2, h * 0.6))])


def _drawers(rng: np.random.Generator, w: float, d: float, h: float) -> SyntheticMesh:
    n = int(rng.integers(2, 5))
    fronts = [
        box(w - 0.02, 0.02, h / n - 0.015, (0, -d / 2 - 0.01 * (rng.random() < 0.8), k * h / n))
        for k in range(n)
    ]
    grips = [box(0.12, 0.02, 0.015, (0, -d / 2 - 0.03, (k + 0.7) * h / n)) for k in range(n)]
    return join([box(w, d, h), *fronts, *grips])


def _top(rng: np.random.Generator, w: float, d: float, h: float) -> SyntheticMesh:
    t = rng.uniform(0.018, 0.06)
    apron = box(w * 0.9, d * 0.85, rng.uniform(0.03, 0.1), (0, 0, h - t - 0.08))
    return join([box(w, d, t, (0, 0, h - t))] + ([apron] if rng.random() < 0.5 else []))


def _legs(rng: np.random.Generator, w: float, d: float, h: float) -> list[SyntheticMesh]:
    inset = rng.uniform(0.02, 0.12)
    x, y, t = w / 2 - inset, d / 2 - inset, rng.uniform(0.03, 0.09)
    corners = [(a * x, b * y) for a in (-1, 1) for b in (-1, 1)]
    style = rng.choice(4, p=(0.4, 0.25, 0.2, 0.15))
    if style == 0:
        return [box(t, t, h - 0.02, (a, b, 0)) for a, b in corners]
    if style == 1:
        s = rng.uniform(0.8, 1.0)  # splayed legs
        return [tube([(a, b, 0), (a * s, b * s, h - 0.02)], t / 2) for a, b in corners]
    if style == 2:  # two side panels
        return [box(0.03, d * 0.95, h - 0.02, (a, 0, 0)) for a in (-x, x)]
    feet = [box(t, d * 0.9, 0.04, (a, 0, 0)) for a in (-x, x)]
    return [*feet, *(box(t, t * 1.5, h - 0.02, (a, 0, 0)) for a in (-x, x))]


# Storage furniture, kitchen units and free-standing objects.
#
# rng  --cupboard, shelf, kitchen_row, ...-->  Piece, its back towards +y


def cupboard(rng: np.random.Generator) -> Piece:
    """Return a chest of drawers, a sideboard or a wardrobe with fronts, gaps and handles."""
    h = rng.choice((rng.uniform(0.45, 1.2), rng.uniform(1.6, 2.25)))
    w, d = rng.uniform(0.45, 1.6), rng.uniform(0.3, 0.65)
    mesh = join([box(w, d, h), _fronts(rng, w, h - 0.05, 0.05).moved((0, -d / 2, 0))])
    return Piece(mesh, w, d, (Shelf(0, 0, w, d, h, 0.7, 6),))


def shelf(rng: np.random.Generator) -> Piece:
    """Return an open shelf with boards, an optional back, and rows of books and boxes."""
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
            free.append(Shelf(0, 0, w - 2 * t, d, z, gap - t - 0.02, 14))
    free.append(Shelf(0, 0, w, d, h, 0.5, 6))
    return Piece(join(parts), w, d, tuple(free))


def books(rng: np.random.Generator, width: float, depth: float, headroom: float) -> SyntheticMesh:
    """Return a row of books or binders with gaps."""
    parts: list[SyntheticMesh] = []
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
    """Return base units under a worktop with a sink or hob, wall units, and sometimes a fridge."""
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
    surfaces = [Shelf(0, -0.02, w, d - 0.1, h, 0.45, 7)]
    if rng.random() < 0.7:  # wall units above a gap
        z, high, deep = h + rng.uniform(0.45, 0.6), rng.uniform(0.4, 0.85), rng.uniform(0.3, 0.38)
        m = int(rng.integers(1, n + 1))
        for k in range(m):
            x = (k + 0.5) * unit - w / 2
            parts.append(box(unit - 0.004, deep, high, (x, (d - deep) / 2, z)))
            front = _fronts(rng, unit - 0.008, high - 0.02, 0.01)
            parts.append(front.moved((x, d / 2 - deep, z)))
        surfaces.append(Shelf((m - n) * unit / 2, 0.13, m * unit, deep, z + high, 0.3, 5))
    elif rng.random() < 0.6:  # a board with objects
        z = h + rng.uniform(0.35, 0.6)
        parts.append(box(w, 0.22, 0.025, (0, d / 2 - 0.11, z)))
        surfaces.append(Shelf(0, d / 2 - 0.11, w, 0.22, z + 0.025, 0.4, 14))
    return Piece(join(parts), w, d, tuple(surfaces))


def fridge(rng: np.random.Generator) -> Piece:
    """Return a fridge, an oven tower or a locker."""
    w, d, h = rng.uniform((0.5, 0.55, 0.85), (0.75, 0.72, 2.1))
    split = h * rng.uniform(0.3, 0.7)
    doors = [
        box(w, 0.05, split - 0.02, (0, -d / 2, 0.02)),
        box(w, 0.05, h - split, (0, -d / 2, split + 0.008)),
    ]
    grips = (split * 0.35, split + 0.1)
    grip = [box(0.025, 0.05, 0.3, (w * 0.4, -d / 2 - 0.04, z)) for z in grips]
    return Piece(join([box(w, d, h), *doors, *grip]), w, d, (Shelf(0, 0, w, d, h, 0.5, 5),))


def counter(rng: np.random.Generator) -> Piece:
    """Return a bar or kitchen island, often free-standing, with an overhanging top."""
    w, d, h = rng.uniform((1.0, 0.4, 0.85), (2.4, 0.9, 1.15))
    body = box(w - 0.1, d * rng.uniform(0.6, 0.95), h - 0.04)
    return Piece(
        join([body, box(w, d, 0.04, (0, 0, h - 0.04))]), w, d, (Shelf(0, 0, w, d, h, 0.7, 8),), -2
    )


def floor_thing(rng: np.random.Generator) -> Piece:
    """Return an object that stands on the floor, such as a bin, a plant, a lamp or a bucket."""
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
    """Return a straight flight of stairs that rises towards the back."""
    n, rise, tread = int(rng.integers(3, 11)), rng.uniform(0.16, 0.19), rng.uniform(0.24, 0.3)
    w, d = rng.uniform(0.8, 1.2), n * tread
    steps = [box(w, d - k * tread, rise, (0, k * tread / 2, k * rise)) for k in range(n)]
    rail = [(w / 2, -d / 2, 0.9), (w / 2, d / 2, 0.9 + n * rise)]
    return Piece(join([*steps, tube(rail, 0.025)]), w, d)


def _fronts(rng: np.random.Generator, w: float, h: float, z: float) -> SyntheticMesh:
    """Return doors or drawers, with handles, in the plane y = 0 from the height `z` upwards."""
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


def _slab(x0: float, x1: float, d: float, z: float, t: float) -> SyntheticMesh:
    return box(x1 - x0, d + 0.02, t, ((x0 + x1) / 2, -0.01, z))


def _sink(
    rng: np.random.Generator, x0: float, x1: float, d: float, h: float, t: float
) -> list[SyntheticMesh]:
    """Return the rims of a worktop around a basin between x0 and x1, and a tap."""
    x, w, wide = (x0 + x1) / 2, x1 - x0, rng.uniform(0.09, 0.14)
    rims = [box(w, wide, t, (x, s * (d / 2 - wide / 2 + 0.01) - 0.01, h - t)) for s in (-1, 1)]
    back = d / 2 - 0.06
    tap = [(x, back, h), (x, back, h + 0.25), (x, 0.06, h + 0.24), (x, 0.05, h + 0.17)]
    return [*rims, tube(tap, 0.014)]


# Walls: doors, windows and niches, and objects mounted on walls.
#
# Wall, rng  --with_openings-->  Wall with openings  --fittings-->  Mesh

DOOR_TOP = 2.03  #: height of door openings, metres


def with_openings(wall: Wall, rng: np.random.Generator, deepest: float) -> Wall:
    """Return a wall with random doors, windows and niches, at most `deepest` metres deep."""
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


def fittings(wall: Wall, top: Ceiling, rng: np.random.Generator) -> SyntheticMesh:
    """Return the frames, radiators, curtains, pipes, pictures and boards of a wall."""
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
        z = rng.uniform(0.8, 1.1)  # a cable duct
        parts.append(box(wall.length - 0.02, 0.07, 0.13, (wall.length / 2, 0.035, z)))
    frame = np.eye(3)
    frame[:2, 0], frame[:2, 1] = wall.along, wall.inward
    return join(parts).turned(frame, (*wall.corner, 0.0))


def overhead(outline: Floats, top: Ceiling, rng: np.random.Generator) -> SyntheticMesh:
    """Return beams and lamps below the ceiling of a room that has the outline (n, 2), metres."""
    parts: list[SyntheticMesh] = []
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


def radiator(wide: float, high: float, rng: np.random.Generator) -> SyntheticMesh:
    """Return a ribbed or flat radiator with its back in the plane y = 0 and its front at +y."""
    if rng.random() < 0.4:
        return box(wide, 0.06, high, (0, 0.07, 0.12))
    ribs = np.arange(-wide / 2 + 0.03, wide / 2, 0.06)
    bars = [box(0.035, 0.1, high, (x, 0.08, 0.12)) for x in ribs]
    rails = [box(wide, 0.03, 0.03, (0, 0.08, z)) for z in (0.18, high)]
    return join([*bars, *rails])


def curtain(wide: float, high: float, rng: np.random.Generator) -> SyntheticMesh:
    """Return a wavy sheet along x with its lower edge at z = 0."""
    xs = np.linspace(-wide / 2, wide / 2, max(12, int(wide / 0.02)))
    pitch, swing = rng.uniform(0.09, 0.22), rng.uniform(0.02, 0.06)
    phase = 2 * math.pi * xs / pitch + 0.7 * np.sin(xs * rng.uniform(3, 9))
    return ribbon(np.c_[xs, swing * np.sin(phase)], 0.008, high)


def _around(o: Opening, rng: np.random.Generator) -> list[SyntheticMesh]:
    """Return the frame, sill, bars, radiator and curtains of an opening, in the wall's frame."""
    middle, wide = (o.start + o.end) / 2, o.end - o.start
    parts: list[SyntheticMesh] = []
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
    """Return (start, width) of each stretch of more than 0.5 m between openings, with margins."""
    edges = [0.0, *(u for o in wall.openings for u in (o.start, o.end)), wall.length]
    spans = zip(edges[::2], edges[1::2], strict=True)
    return [(a + 0.1, b - a - 0.2) for a, b in spans if b - a > 0.5]


def _pictures(u: float, wide: float, rng: np.random.Generator) -> list[SyntheticMesh]:
    parts = []
    for _ in range(rng.integers(1, 4)):
        w = min(rng.uniform(0.2, 1.6), wide)
        h, t = w * rng.uniform(0.5, 1.2), rng.uniform(0.01, 0.06)
        h = min(h, 1.0)
        x = u + w / 2 + (wide - w) * rng.random()
        picture = box(w, t, h, (x, t / 2, rng.uniform(0.9, 1.95 - h)))
        parts.append(picture.with_loss(0.6 if rng.random() < 0.1 else 0.0))
    return parts


def _mounted(u: float, wide: float, rng: np.random.Generator) -> SyntheticMesh:
    """Return a board on brackets with objects on it."""
    w, d, z = min(rng.uniform(0.4, 1.4), wide), rng.uniform(0.15, 0.32), rng.uniform(1.2, 1.8)
    x = u + w / 2 + (wide - w) * rng.random()
    ends = [box(0.02, d * 0.8, 0.15, (x + s * w * 0.4, d * 0.4, z - 0.15)) for s in (-1, 1)]
    load = scatter(Shelf(x, d / 2, w, d, z + 0.025, 0.3, 16), rng)
    return join([box(w, d, 0.025, (x, d / 2, z)), *ends, load])


def _pipe(u: float, top: Ceiling, wall: Wall, rng: np.random.Generator) -> SyntheticMesh:
    r = rng.uniform(0.012, 0.06)
    height = float(top.at(wall.at(u)))
    return tube([(u, r + 0.02, 0.0), (u, r + 0.02, height)], r, 10)


def _skirting(wall: Wall, high: float) -> list[SyntheticMesh]:
    doors = [o for o in wall.openings if o.low < high]
    edges = [0.0, *(u for o in doors for u in (o.start, o.end)), wall.length]
    pairs = zip(edges[::2], edges[1::2], strict=True)
    return [box(b - a, 0.014, high, ((a + b) / 2, 0.007, 0)) for a, b in pairs if b - a > 0.05]


def wall_yaw(wall: Wall) -> float:
    """Return the yaw, radians, that turns the back of a piece (+y) towards a wall."""
    out = -wall.inward
    return math.atan2(out[1], out[0]) - math.pi / 2


# Large objects in halls and streets, which a laser sees from tens of metres away.
#
# rng  --machine, rack, vehicle, tree, ...-->  Piece

#: Rotation that lays the z axis along x.
_LYING = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def machine(rng: np.random.Generator) -> Piece:
    """Return a base with cabinets, drums, hoods and pipes."""
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
    """Return a partly filled rack for pallets or boxes with one or more bays."""
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
    """Return a pile of crates or pallets."""
    a, b, c = rng.uniform((0.6, 0.5, 0.15), (1.6, 1.2, 1.0))
    parts, z = [], 0.0
    for _ in range(int(rng.integers(1, 5))):
        yaw = float(rng.normal(0, 0.08))
        parts.append(box(a, b, c, (rng.normal(0, 0.05), rng.normal(0, 0.05), z), yaw))
        z += c + 0.005
    return Piece(join(parts), a, b)


def tank(rng: np.random.Generator) -> Piece:
    """Return an upright or horizontal tank, a silo or a reel."""
    r, h = rng.uniform(0.3, 1.5), rng.uniform(1.0, 4.0)
    if rng.random() < 0.6:
        mesh = join([cylinder(r, h, 20), cone(r, 0.2 * r, 0.4 * r, 20).moved((0, 0, h))])
        return Piece(mesh, 2 * r, 2 * r)
    feet = [box(0.3, 1.6 * r, 0.4 + 0.4 * r, (x * h * 0.3, 0, 0)) for x in (-1, 1)]
    drum = cylinder(r, h, 20).turned(_LYING, (-h / 2, 0, 0.4 + r))
    return Piece(join([drum, *feet]), h, 2 * r)


def cabin(rng: np.random.Generator) -> Piece:
    """Return a room within a room: an office, a booth or a container."""
    w, d, h = rng.uniform((2.0, 2.0, 2.2), (8.0, 4.0, 3.2))
    x = rng.uniform(-0.3, 0.3) * w
    door = box(0.95, 0.06, 2.05, (x, -d / 2 - 0.03, 0))
    sill = box(w * 0.5, 0.1, 0.08, (-x, -d / 2 - 0.05, 1.1))
    return Piece(join([box(w, d, h), box(w + 0.2, d + 0.2, 0.12, (0, 0, h)), door, sill]), w, d)


def screen(rng: np.random.Generator) -> Piece:
    """Return a free-standing wall, straight or bent, or a fence with posts and rails."""
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
    """Return a car, van, lorry or forklift with a body, a cab and wheels."""
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
    """Return a trunk with one to four crowns."""
    h, r = rng.uniform(1.2, 4.0), rng.uniform(0.07, 0.3)
    parts = [cone(r * 1.3, r * 0.8, h + 0.5, 9)]
    for _ in range(int(rng.integers(1, 5))):
        size = rng.uniform((0.7, 0.7, 0.8), (2.2, 2.2, 2.6))
        at = (*rng.normal(0, 0.7, 2), h + rng.uniform(-0.3, 1.5))
        parts.append(blob(rng, size, 0.25).moved(at))
    return Piece(join(parts), 3 * r, 3 * r)


def bush(rng: np.random.Generator) -> Piece:
    """Return a bush, a hedge or a boulder."""
    w, d, h = rng.uniform((0.6, 0.5, 0.4), (3.5, 1.4, 1.8))
    return Piece(blob(rng, (w / 2, d / 2, h / 2), 0.2), w, d)


def pole(rng: np.random.Generator) -> Piece:
    """Return a lamp post, a sign or a bollard."""
    h, r = rng.uniform(0.7, 6.0), rng.uniform(0.03, 0.14)
    parts = [cylinder(r, h, 10)]
    if h > 2.0 and rng.random() < 0.6:
        parts.append(box(rng.uniform(0.4, 1.2), 0.08, rng.uniform(0.2, 0.9), (0, 0, h * 0.8)))
    return Piece(join(parts), max(0.3, 2 * r), max(0.3, 2 * r))


def person(rng: np.random.Generator) -> Piece:
    """Return a standing person with legs, trunk and head."""
    h = rng.uniform(1.55, 1.9)
    trunk = ellipsoid((0.24, 0.15, 0.3 * h / 1.7), 0.8, 12).moved((0, 0, 0.46 * h))
    legs = [cylinder(0.08, 0.5 * h, 8).moved((s * 0.1, 0.05 * s, 0)) for s in (-1, 1)]
    return Piece(
        join([*legs, trunk, ellipsoid((0.09, 0.1, 0.12), 1, 10).moved((0, 0, 0.86 * h))]), 0.55, 0.4
    )
