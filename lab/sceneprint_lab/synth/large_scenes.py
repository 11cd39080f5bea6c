"""Large scenes for laser scans: halls, storeys and blocks of streets.

outline, rng  --Premises-->  surfaces, walkable floor, and ray casting
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sceneprint.types import Floats
from sceneprint_lab.synth.furniture import (
    bush,
    cabin,
    counter,
    cupboard,
    desk,
    fridge,
    machine,
    overhead,
    person,
    pile,
    pole,
    rack,
    round_table,
    screen,
    shelf,
    stairs,
    table,
    tank,
    tree,
    vehicle,
    wall_yaw,
)
from sceneprint_lab.synth.mesh import (
    Ceiling,
    Opening,
    SyntheticMesh,
    Wall,
    box,
    cylinder,
    extrude,
    floor_plan,
    join,
    mesh_of,
    shell,
    tube,
    wall_mesh,
    walls_of,
)
from sceneprint_lab.synth.rooms import (
    Floor,
    Menu,
    PiecePose,
    Room,
    Site,
    along_wall,
    in_the_open,
    keep_doors_free,
    on_the_floor,
)
from sceneprint_lab.synth.sensors import Caster

CELL = 0.2  #: edge length of a cell of the floor's grid, metres
CLEARANCE = 0.45  #: minimum distance of a scanner from objects, metres


@dataclass(frozen=True, eq=False)
class Premises:
    """A large scene through which a scanner can be carried.

    Parameters
    ----------
    kind : "hall", "storey" or "block"
    mesh : all surfaces
    floor : the ground, and its occupied cells
    """

    kind: str
    mesh: SyntheticMesh
    floor: Floor

    @cached_property
    def caster(self) -> Caster:
        """Return the ray caster of the mesh, which is built at the first use."""
        return Caster(self.mesh)

    @cached_property
    def walkable(self) -> NDArray[np.bool_]:
        """Return a mask (nx, ny) of the largest connected area of the floor that has CLEARANCE."""
        clear = ndimage.distance_transform_edt(np.pad(~self.floor.claimed, 1))[1:-1, 1:-1]
        parts, n = ndimage.label(clear * self.floor.cell >= CLEARANCE)
        if n == 0:
            return np.asarray(clear == clear.max())
        sizes = np.bincount(parts.ravel())[1:]
        return np.asarray(parts == 1 + int(sizes.argmax()))


# Halls: factories, stores, foyers and garages of 15 to 75 m.
#
# rng  --make_hall-->  Premises

#: Objects along the walls of a hall, and free-standing objects, with weights.
_KINDS: tuple[tuple[Menu, Menu], ...] = (
    ({machine: 3, rack: 2, pile: 2, tank: 1}, {machine: 5, tank: 1, pile: 2, cabin: 1, person: 1}),
    ({rack: 5, pile: 3, stairs: 1}, {rack: 5, pile: 3, vehicle: 1, person: 1}),
    ({screen: 1, stairs: 1, pile: 1, cabin: 1}, {screen: 2, cabin: 1, person: 3, pile: 1}),
    ({vehicle: 3, pile: 1, rack: 1}, {vehicle: 5, person: 1, screen: 1}),
    (
        dict.fromkeys((machine, rack, pile, tank, cabin, screen, stairs), 1),
        dict.fromkeys((machine, rack, pile, tank, cabin, screen, vehicle, person), 1),
    ),
)


def make_hall(rng: np.random.Generator) -> Premises:
    """Return a random hall with columns, girders, galleries, doors and objects."""
    outline = floor_plan(rng) * rng.uniform(4.5, 9.0)
    top = Ceiling(float(rng.uniform(3.5, 12.0)), np.zeros(2))
    walls = [hall_wall(wall, top, rng) for wall in walls_of(outline)]
    site = Site(walls, top, Floor(outline, CELL), rng)
    keep_doors_free(site)
    parts = [shell(outline, walls, top)]
    parts += [*_columns(site, outline), *_girders(site, outline)]
    for wall in walls:
        if top.height > 5.5 and rng.random() < 0.3:
            parts += _gallery(wall, site)
        parts += _pilasters(wall, site)
    at_walls, free = _KINDS[int(rng.integers(0, len(_KINDS)))]
    for wall in walls:
        parts += along_wall(wall, at_walls, site)
    for _ in range(int(rng.integers(0, 3))):
        parts += in_the_open(free, site)
    return Premises("hall", join(parts), site.floor)


def hall_wall(wall: Wall, top: Ceiling, rng: np.random.Generator) -> Wall:
    """Return a wall with random gates, doors and windows side by side."""
    openings, u = [], float(rng.uniform(0.5, 4.0))
    high = min(top.height - 0.5, rng.uniform(3.0, 4.5))
    sill = rng.uniform(0.9, max(1.0, top.height - 2.2))
    glass, deep = float(rng.choice((0.2, 0.9))), rng.uniform(0.1, 0.6)
    windows = rng.random() < 0.6
    while u < wall.length - 1.0:
        kind = rng.random()
        if kind < 0.2:
            wide, low, up, loss = rng.uniform(2.5, 5.0), 0.0, high, 0.0
        elif kind < 0.45:
            wide, low, up, loss = rng.uniform(0.9, 2.0), 0.0, 2.1, 0.0
        elif windows:
            wide, low, up, loss = rng.uniform(1.0, 3.5), sill, min(sill + 1.8, high), glass
        else:
            u += rng.uniform(2.0, 6.0)
            continue
        if u + wide > wall.length - 0.4 or up <= low + 0.3:
            break
        back = rng.uniform(0.1, 0.8) if low == 0.0 else deep
        openings.append(Opening(u, u + wide, low, up, float(back), loss))
        u += wide + rng.uniform(0.4, 5.0)
    return Wall(wall.corner, wall.along, wall.length, tuple(openings))


def _columns(site: Site, outline: Floats) -> list[SyntheticMesh]:
    """Return columns on a grid with gaps, and mark their floor area as occupied."""
    rng = site.rng
    if rng.random() < 0.2:
        return []
    low, high = outline.min(axis=0), outline.max(axis=0)
    pitch, size = rng.uniform(4.0, 10.0, 2), float(rng.uniform(0.25, 0.9))
    start, share, is_round = rng.uniform(1.0, 5.0, 2), rng.uniform(0.7, 1.0), rng.random() < 0.4
    parts = []
    for x in np.arange(low[0] + start[0], high[0], pitch[0]):
        for y in np.arange(low[1] + start[1], high[1], pitch[1]):
            place = PiecePose(float(x), float(y), 0.0)
            if rng.random() > share or not site.floor.claim(place, size, size):
                continue
            height = float(site.top.at(np.array([x, y])))
            mesh = cylinder(size / 2, height) if is_round else box(size, size, height)
            parts.append(mesh.moved((x, y, 0.0)))
    return parts


def _girders(site: Site, outline: Floats) -> list[SyntheticMesh]:
    """Return girders under the ceiling, and ducts and lamps below them."""
    rng, height = site.rng, site.top.height
    low, high = outline.min(axis=0), outline.max(axis=0)
    size, middle = high - low, (low + high) / 2
    parts, axis = [], int(rng.integers(0, 2))
    wide, deep = rng.uniform(0.15, 0.6), rng.uniform(0.2, 1.0)
    if rng.random() < 0.75:
        for at in np.arange(low[axis] + 1.0, high[axis], rng.uniform(2.5, 8.0)):
            where = np.where(np.arange(2) == axis, at, middle)
            extent = np.where(np.arange(2) == axis, wide, size)
            parts.append(box(extent[0], extent[1], deep, (*where, height - deep)))
    for _ in range(int(rng.integers(0, 4))):
        z, r = height - deep - rng.uniform(0.3, 1.0), float(rng.uniform(0.08, 0.4))
        at = float(rng.uniform(low[1 - axis] + 1, high[1 - axis] - 1))
        ends = [np.where(np.arange(2) == axis, e, at) for e in (low[axis], high[axis])]
        parts.append(tube([(*ends[0], z), (*ends[1], z)], r))
    return parts


def _gallery(wall: Wall, site: Site) -> list[SyntheticMesh]:
    """Return a gallery along part of a wall, on posts and with a railing."""
    rng = site.rng
    start = rng.uniform(0.0, 0.4) * wall.length
    long = rng.uniform(0.4, 0.9) * (wall.length - start)
    deep, z = rng.uniform(1.5, 5.0), rng.uniform(2.6, site.top.height - 2.2)
    yaw, parts = wall_yaw(wall), []
    x, y = wall.at(start + long / 2, deep / 2)
    parts.append(box(long, deep, 0.25, (x, y, z), yaw))
    for u in np.arange(start + 0.3, start + long, rng.uniform(3.0, 6.0)):
        x, y = wall.at(float(u), deep - 0.3)
        if site.floor.claim(PiecePose(x, y, yaw), 0.25, 0.25):
            parts.append(box(0.25, 0.25, z, (x, y, 0.0), yaw))
    posts = [wall.at(float(u), deep - 0.1) for u in np.arange(start + 0.1, start + long, 1.6)]
    parts += [box(0.06, 0.06, 1.1, (*at, z + 0.25), yaw) for at in posts]
    x, y = wall.at(start + long / 2, deep - 0.1)
    parts += [box(long, 0.06, 0.08, (x, y, z + up), yaw) for up in (0.7, 1.3)]
    return parts


def _pilasters(wall: Wall, site: Site) -> list[SyntheticMesh]:
    """Return half columns along a wall, between its openings."""
    rng = site.rng
    if rng.random() < 0.5:
        return []
    parts, yaw = [], wall_yaw(wall)
    wide, deep = rng.uniform(0.2, 0.8), rng.uniform(0.1, 0.6)
    for u in np.arange(rng.uniform(1.0, 4.0), wall.length - 0.5, rng.uniform(3.0, 8.0)):
        if any(o.start - wide < u < o.end + wide for o in wall.openings):
            continue
        x, y = wall.at(float(u), deep / 2)
        site.floor.take(PiecePose(x, y, yaw), wide, deep)
        parts.append(box(wide, deep, site.top.height, (x, y, 0.0), yaw))
    return parts


# Storeys: corridors with rooms on both sides, 20 to 70 m long.
#
# rng  --make_storey-->  Premises

#: Objects along the walls of a room, with weights.
_ROOMS: tuple[Menu, ...] = (
    {desk: 3, shelf: 2, cupboard: 2}, {cupboard: 2, shelf: 2}, {rack: 3, pile: 2, machine: 1},
    {fridge: 2, cupboard: 3, counter: 1},
)  # fmt: skip
#: Free-standing objects of any room, with weights.
_OPEN: Menu = {
    desk: 2,
    table: 3,
    round_table: 1,
    rack: 1,
    pile: 1,
    screen: 1,
    counter: 1,
    person: 1,
}


def make_storey(rng: np.random.Generator) -> Premises:
    """Return a storey with a long corridor, sometimes a cross corridor, and adjoining rooms."""
    long, wide = float(rng.uniform(20.0, 70.0)), float(rng.uniform(9.0, 26.0))
    outline = _rectangle(0.0, long, 0.0, wide)
    top = Ceiling(float(rng.uniform(2.4, 4.2)), np.zeros(2))
    site = Site(walls_of(outline), top, Floor(outline, CELL), rng)
    parts = [shell(outline, site.walls, top), overhead(outline, top, rng)]
    hall = float(rng.uniform(1.9, 4.0))
    low = float(rng.uniform(0.25, 0.75)) * (wide - hall)
    cross = float(rng.uniform(0.2, 0.8)) * long if rng.random() < 0.6 else math.inf
    for y0, y1, side in ((0.0, low, low), (low + hall, wide, low + hall)):
        if y1 - y0 < 2.0:
            continue
        x = 0.0
        while x < long - 2.5:
            if x <= cross < x + 2.5:  # the cross corridor
                x = cross + float(rng.uniform(2.0, 3.5))
                continue
            end = min(x + float(rng.uniform(2.8, 11.0)), long, cross if x < cross else math.inf)
            parts += _room((x, end, y0, y1), side, site)
            x = end
    with _reserved(site.floor, PiecePose(long / 2, low + hall / 2, 0.0), long, hall):
        parts += in_the_open(_OPEN, site)
        parts += on_the_floor(site)
    return Premises("storey", join(parts), site.floor)


@contextmanager
def _reserved(floor: Floor, place: PiecePose, width: float, depth: float) -> Iterator[None]:
    """Mark a rectangle of the floor as occupied during the `with` block."""
    before = floor.claimed.copy()
    floor.take(place, width, depth)
    reserved = floor.claimed & ~before
    yield
    floor.claimed[reserved] = False


def _rectangle(x0: float, x1: float, y0: float, y1: float) -> Floats:
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], float)


def _room(
    extent: tuple[float, float, float, float], side: float, site: Site
) -> list[SyntheticMesh]:
    """Return the walls, a door and the furniture of a room.

    `extent` is (x0, x1, y0, y1), metres; `side` is the y coordinate of the wall towards the
    corridor.
    """
    x0, x1, y0, y1 = extent
    rng, t = site.rng, float(site.rng.uniform(0.1, 0.3))
    parts = _partition((x1, y0), (x1, y1), t, (), site)
    if rng.random() < 0.08:  # a niche that is open to the corridor
        return parts
    gap = float(rng.uniform(0.9, 2.2))
    start = float(rng.uniform(0.2, max(0.3, x1 - x0 - gap - 0.3)))
    is_open = rng.random() < 0.75
    parts += _partition((x0, side), (x1, side), t, ((start, start + gap),), site)
    if not is_open:
        parts.append(box(gap, 0.05, 2.1, (x0 + start + gap / 2, side, 0.0)))
        site.floor.take(PiecePose(x0 + start + gap / 2, side, 0.0), gap, t)
    inner = _rectangle(x0 + t / 2 + 0.02, x1 - t / 2 - 0.02, y0 + t / 2, y1 - t / 2)
    own = Site(walls_of(inner), site.top, site.floor, rng)
    at_walls = _ROOMS[int(rng.integers(0, len(_ROOMS)))]
    with _reserved(site.floor, PiecePose(x0 + start + gap / 2, side, 0.0), gap, 3.0):
        for wall in own.walls:
            if rng.random() < 0.6:
                parts += along_wall(wall, at_walls, own)
    return parts


def _partition(
    a: tuple[float, float], b: tuple[float, float], thick: float,
    gaps: tuple[tuple[float, float], ...], site: Site,
) -> list[SyntheticMesh]:  # fmt: skip
    """Return a wall from a to b, up to the ceiling, with lintels over `gaps` (start, end)."""
    length, yaw = math.dist(a, b), math.atan2(b[1] - a[1], b[0] - a[0])
    along, height = np.array([math.cos(yaw), math.sin(yaw)]), site.top.height
    parts, at = [], 0.0
    for start, end in (*gaps, (length, length)):
        if start - at > 0.05:
            x, y = np.array(a) + along * (at + start) / 2
            parts.append(box(start - at, thick, height, (x, y, 0.0), yaw))
            site.floor.take(PiecePose(x, y, yaw), start - at, thick + 0.1)
        if end > start and height > 2.3:
            x, y = np.array(a) + along * (start + end) / 2
            parts.append(box(end - start, thick, height - 2.15, (x, y, 2.15), yaw))
        at = end
    return parts


# Blocks: streets and yards of 50 to 110 m with buildings, walls, cars and trees.
#
# rng  --make_block-->  Premises

#: Outdoor objects, with weights.
_MENUS: tuple[Menu, ...] = (
    {vehicle: 4, tree: 3, pole: 2, bush: 1, screen: 1},
    {tree: 5, bush: 3, pole: 1},
    {vehicle: 5, pole: 2, pile: 2, screen: 2, tree: 1},
)


def make_block(rng: np.random.Generator) -> Premises:
    """Return buildings on slightly uneven ground with objects between them."""
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


def _ground(half: Floats, rng: np.random.Generator) -> SyntheticMesh:
    """Return the ground up to 60 m beyond the block, with hollows of up to 30 cm."""
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


def _building(half: Floats, main: float, site: Site) -> list[SyntheticMesh]:
    """Return a building with recessed windows and doors, or [] if its place is already occupied."""
    rng = site.rng
    w, d, h = rng.uniform((6.0, 5.0, 3.0), (32.0, 16.0, 15.0))
    yaw = main + int(rng.integers(0, 2)) * math.pi / 2 + float(rng.normal(0, 0.02))
    if rng.random() < 0.15:
        yaw = float(rng.uniform(-math.pi, math.pi))
    x, y = rng.uniform(-0.9, 0.9, 2) * half
    place = PiecePose(x, y, yaw)
    if not site.floor.claim(place, w + 1.0, d + 1.0, 0.1):
        return []
    corners = np.array([(-w, -d), (-w, d), (w, d), (w, -d)]) / 2  # clockwise, so walls face outward
    top = Ceiling(h, np.zeros(2))
    rise, deep = float(rng.uniform(2.7, 3.8)), float(rng.uniform(0.1, 0.4))
    walls = [wall_mesh(facade(wall, h, rise, deep, rng), top) for wall in walls_of(corners)]
    parts = [*walls, roof(w, d, h, rng)]
    for _ in range(int(rng.integers(0, 5))):  # porches, bays and boxes on the wall
        a, b, c = rng.uniform((0.8, 0.5, 0.8), (4.0, 2.0, 3.5))
        side = float(rng.choice((-1, 1)))
        x, y = rng.uniform(-0.5, 0.5) * (w - a), side * (d + b) / 2
        low = float(rng.choice((0.0, rng.uniform(0.0, max(0.1, h - c)))))
        parts.append(box(a, b, min(c, h), (x, y, low)))
        c0, s0 = math.cos(yaw), math.sin(yaw)
        if low < 2.5:
            at = PiecePose(place.x + c0 * x - s0 * y, place.y + s0 * x + c0 * y, yaw)
            site.floor.take(at, float(a), float(b))
    return [join(parts).moved((place.x, place.y, -0.3), yaw)]


def facade(wall: Wall, h: float, rise: float, deep: float, rng: np.random.Generator) -> Wall:
    """Return a wall with doors and with rows of windows, some of which are missing."""
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


def roof(w: float, d: float, h: float, rng: np.random.Generator) -> SyntheticMesh:
    """Return a flat roof with eaves, or a gable roof along x."""
    if rng.random() < 0.5:
        return box(w + 0.6, d + 0.6, 0.3, (0, 0, h))
    over, up = d / 2 + 0.4, d * rng.uniform(0.2, 0.5)
    gable = extrude([(-over, 0.0), (over, 0.0), (0.0, up)], w + 0.6)
    lying = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return gable.turned(lying, (-(w + 0.6) / 2, 0.0, h))


def _garden_wall(half: Floats, main: float, site: Site) -> list[SyntheticMesh]:
    rng = site.rng
    long, thick, h = rng.uniform((5.0, 0.15, 0.8), (30.0, 0.5, 2.6))
    yaw = main + int(rng.integers(0, 2)) * math.pi / 2
    x, y = rng.uniform(-0.9, 0.9, 2) * half
    place = PiecePose(x, y, yaw)
    if not site.floor.claim(place, long, thick + 0.4, 0.1):
        return []
    return [box(long, thick, h + 0.3, (place.x, place.y, -0.3), yaw)]


# Ambiguous scenes with symmetries or repetitions.
#
# symmetric_box()  -->  Room      corridor(doors)  -->  Room      rng  --symmetric_hall-->  Premises


def symmetric_box(side: float = 0.6, hall: float = 12.0) -> Room:
    """Return a cube in the centre of an empty square hall; the origin is under the cube.

    The scene is symmetric under rotations of 90 degrees about z, so a view does not determine
    which side of the cube it shows.

    Parameters
    ----------
    side : edge of the cube, metres
    hall : length and width of the hall, metres
    """
    half = hall / 2
    outline = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    top = Ceiling(4.0, np.zeros(2))
    return Room(join([shell(outline, walls_of(outline), top), box(side, side, side)]), outline, top)


def symmetric_hall(rng: np.random.Generator) -> Premises:
    """Return a hall that is symmetric under a rotation of 180 degrees about the origin.

    The half with x > 0 is built like `make_hall`; the other half is a rotated copy.
    """
    # The sides are multiples of a cell, reduced by more than rounding errors can be.
    a, b = (CELL * np.round(rng.uniform((8.0, 5.0), (20.0, 13.0)) / CELL) - 1e-9).tolist()
    outline = _rectangle(-a, a, -b, b)
    top = Ceiling(float(rng.uniform(3.5, 10.0)), np.zeros(2))
    walls = walls_of(outline)
    walls[:2] = [hall_wall(wall, top, rng) for wall in walls[:2]]
    walls[2:] = [
        replace(wall, openings=like.openings)
        for wall, like in zip(walls[2:], walls[:2], strict=True)
    ]
    right = _rectangle(0.0, a, -b, b)
    site = Site(walls, top, Floor(right, CELL), rng)
    keep_doors_free(site)
    parts = [*_columns(site, right), *_girders(site, right)]
    at_walls, free = _KINDS[int(rng.integers(0, len(_KINDS)))]
    lower, upper = replace(walls[0], corner=np.array([0.0, -b]), length=a), walls[2]
    for wall in (lower, walls[1], replace(upper, length=a)):
        parts += along_wall(wall, at_walls, site)
    parts += in_the_open(free, site)
    half = join(parts)
    floor = Floor(outline, CELL)
    claimed = site.floor.claimed
    floor.claimed[:] = np.concatenate([claimed[::-1, ::-1], claimed])
    return Premises(
        "hall", join([shell(outline, walls, top), half, half.moved(yaw=math.pi)]), floor
    )


def corridor(doors: int, pitch: float = 2.0, width: float = 1.8, height: float = 2.5) -> Room:
    """Return a corridor along +x with identical doors in both long walls.

    Views that are one pitch apart look the same; only the ends reveal the position. A wide and high
    corridor is a hall of equal bays.

    Parameters
    ----------
    doors : number of doors in each wall, at least 1
    pitch : distance between doors, metres
    width, height : metres

    Raises
    ------
    ValueError : If there are no doors
    """
    if doors < 1:
        raise ValueError(f"A corridor of {doors} doors cannot be built; pass at least 1.")
    length, top = doors * pitch, Ceiling(height, np.zeros(2))
    outline: Floats = np.array([(0, 0), (length, 0), (length, width), (0, width)], float)
    walls = [
        _with_doors(w, doors, pitch) if k % 2 == 0 else w for k, w in enumerate(walls_of(outline))
    ]
    handles = [
        box(0.12, 0.04, 0.02, (*wall.at(o.end - 0.12, 0.02 - o.deep), 1.04))
        for wall in walls
        for o in wall.openings
    ]
    return Room(join([shell(outline, walls, top), *handles]), outline, top)


def _with_doors(wall: Wall, doors: int, pitch: float) -> Wall:
    middles = (np.arange(doors) + 0.5) * pitch
    openings = tuple(Opening(m - 0.45, m + 0.45, 0.0, 2.03, 0.12) for m in middles.tolist())
    return Wall(wall.corner, wall.along, wall.length, openings)
