"""Halls: works, stores, foyers, garages of 15 to 75 m.

rng  --make_hall-->  Premises
"""

from __future__ import annotations

import numpy as np

from sceneprint.synth.arrangement import Menu, Site, along_wall, in_the_open, keep_doors_free
from sceneprint.synth.bulk import cabin, machine, person, pile, rack, screen, tank, vehicle
from sceneprint.synth.fittings import wall_yaw
from sceneprint.synth.layout import Floor, Place
from sceneprint.synth.mesh import Mesh, join
from sceneprint.synth.premises import CELL, Premises
from sceneprint.synth.shell import Ceiling, Opening, Wall, floor_plan, shell, walls_of
from sceneprint.synth.solids import box, cylinder, tube
from sceneprint.synth.storage import stairs
from sceneprint.types import Floats

#: what stands along the walls of a hall, what stands free, and how often each
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
    """A hall with columns, girders, galleries, doors and what stands about in it."""
    outline = floor_plan(rng) * rng.uniform(4.5, 9.0)
    top = Ceiling(float(rng.uniform(3.5, 12.0)), np.zeros(2))
    walls = [_pierced(wall, top, rng) for wall in walls_of(outline)]
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


def _pierced(wall: Wall, top: Ceiling, rng: np.random.Generator) -> Wall:
    """The wall with gates, doors and a row of windows, nothing above anything else."""
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


def _columns(site: Site, outline: Floats) -> list[Mesh]:
    """A grid of columns, some left out."""
    rng = site.rng
    if rng.random() < 0.2:
        return []
    low, high = outline.min(axis=0), outline.max(axis=0)
    pitch, size = rng.uniform(4.0, 10.0, 2), float(rng.uniform(0.25, 0.9))
    start, share, is_round = rng.uniform(1.0, 5.0, 2), rng.uniform(0.7, 1.0), rng.random() < 0.4
    parts = []
    for x in np.arange(low[0] + start[0], high[0], pitch[0]):
        for y in np.arange(low[1] + start[1], high[1], pitch[1]):
            place = Place(float(x), float(y), 0.0)
            if rng.random() > share or not site.floor.claim(place, size, size):
                continue
            height = float(site.top.at(np.array([x, y])))
            mesh = cylinder(size / 2, height) if is_round else box(size, size, height)
            parts.append(mesh.moved((x, y, 0.0)))
    return parts


def _girders(site: Site, outline: Floats) -> list[Mesh]:
    """Girders under the ceiling, ducts and lamps below them."""
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


def _gallery(wall: Wall, site: Site) -> list[Mesh]:
    """A floor half way up along part of a wall, on posts, with a rail."""
    rng = site.rng
    start = rng.uniform(0.0, 0.4) * wall.length
    long = rng.uniform(0.4, 0.9) * (wall.length - start)
    deep, z = rng.uniform(1.5, 5.0), rng.uniform(2.6, site.top.height - 2.2)
    yaw, parts = wall_yaw(wall), []
    x, y = wall.at(start + long / 2, deep / 2)
    parts.append(box(long, deep, 0.25, (x, y, z), yaw))
    for u in np.arange(start + 0.3, start + long, rng.uniform(3.0, 6.0)):
        x, y = wall.at(float(u), deep - 0.3)
        if site.floor.claim(Place(x, y, yaw), 0.25, 0.25):
            parts.append(box(0.25, 0.25, z, (x, y, 0.0), yaw))
    posts = [wall.at(float(u), deep - 0.1) for u in np.arange(start + 0.1, start + long, 1.6)]
    parts += [box(0.06, 0.06, 1.1, (*at, z + 0.25), yaw) for at in posts]
    x, y = wall.at(start + long / 2, deep - 0.1)
    parts += [box(long, 0.06, 0.08, (x, y, z + up), yaw) for up in (0.7, 1.3)]
    return parts


def _pilasters(wall: Wall, site: Site) -> list[Mesh]:
    """Half columns along a wall, where no opening is."""
    rng = site.rng
    if rng.random() < 0.5:
        return []
    parts, yaw = [], wall_yaw(wall)
    wide, deep = rng.uniform(0.2, 0.8), rng.uniform(0.1, 0.6)
    for u in np.arange(rng.uniform(1.0, 4.0), wall.length - 0.5, rng.uniform(3.0, 8.0)):
        if any(o.start - wide < u < o.end + wide for o in wall.openings):
            continue
        x, y = wall.at(float(u), deep / 2)
        site.floor.take(Place(x, y, yaw), wide, deep)
        parts.append(box(wide, deep, site.top.height, (x, y, 0.0), yaw))
    return parts
