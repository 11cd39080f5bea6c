"""Storeys: corridors with rooms on both sides, 20 to 70 m long.

rng  --make_storey-->  Premises
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from sceneprint.synth.arrangement import Menu, Site, along_wall, in_the_open, on_the_floor
from sceneprint.synth.bulk import machine, person, pile, rack, screen
from sceneprint.synth.fittings import overhead
from sceneprint.synth.layout import Floor, Place
from sceneprint.synth.mesh import Mesh, join
from sceneprint.synth.premises import CELL, Premises
from sceneprint.synth.shell import Ceiling, shell, walls_of
from sceneprint.synth.solids import box
from sceneprint.synth.storage import counter, cupboard, fridge, shelf
from sceneprint.synth.tables import desk, round_table, table
from sceneprint.types import Floats

#: what stands along the walls of a room, and how often
_ROOMS: tuple[Menu, ...] = (
    {desk: 3, shelf: 2, cupboard: 2},
    {cupboard: 2, shelf: 2},
    {rack: 3, pile: 2, machine: 1},
    {fridge: 2, cupboard: 3, counter: 1},
)
#: what stands free in any room
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
    """A storey with one corridor along it, perhaps one across, and rooms off them."""
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
            if x <= cross < x + 2.5:  # the corridor across passes here
                x = cross + float(rng.uniform(2.0, 3.5))
                continue
            end = min(x + float(rng.uniform(2.8, 11.0)), long, cross if x < cross else math.inf)
            parts += _room((x, end, y0, y1), side, site)
            x = end
    with _kept_free(site.floor, Place(long / 2, low + hall / 2, 0.0), long, hall):
        parts += in_the_open(_OPEN, site)
        parts += on_the_floor(site)
    return Premises("storey", join(parts), site.floor)


@contextmanager
def _kept_free(floor: Floor, place: Place, width: float, depth: float) -> Iterator[None]:
    """For as long as it lasts nothing can be put into a rectangle."""
    before = floor.claimed.copy()
    floor.take(place, width, depth)
    kept = floor.claimed & ~before
    yield
    floor.claimed[kept] = False


def _rectangle(x0: float, x1: float, y0: float, y1: float) -> Floats:
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], float)


def _room(extent: tuple[float, float, float, float], side: float, site: Site) -> list[Mesh]:
    """One room: walls towards the next room and the corridor, a door, furniture."""
    x0, x1, y0, y1 = extent
    rng, t = site.rng, float(site.rng.uniform(0.1, 0.3))
    parts = _partition((x1, y0), (x1, y1), t, (), site)
    if rng.random() < 0.08:  # a niche, open to the corridor
        return parts
    gap = float(rng.uniform(0.9, 2.2))
    start = float(rng.uniform(0.2, max(0.3, x1 - x0 - gap - 0.3)))
    is_open = rng.random() < 0.75
    parts += _partition((x0, side), (x1, side), t, ((start, start + gap),), site)
    if not is_open:
        parts.append(box(gap, 0.05, 2.1, (x0 + start + gap / 2, side, 0.0)))
        site.floor.take(Place(x0 + start + gap / 2, side, 0.0), gap, t)
    inner = _rectangle(x0 + t / 2 + 0.02, x1 - t / 2 - 0.02, y0 + t / 2, y1 - t / 2)
    own = Site(walls_of(inner), site.top, site.floor, rng)
    at_walls = _ROOMS[int(rng.integers(0, len(_ROOMS)))]
    with _kept_free(site.floor, Place(x0 + start + gap / 2, side, 0.0), gap, 3.0):
        for wall in own.walls:
            if rng.random() < 0.6:
                parts += along_wall(wall, at_walls, own)
    return parts


def _partition(
    a: tuple[float, float], b: tuple[float, float], thick: float,
    gaps: tuple[tuple[float, float], ...], site: Site,
) -> list[Mesh]:  # fmt: skip
    """A wall from a to b up to the ceiling; over its gaps there is a lintel."""
    length, yaw = math.dist(a, b), math.atan2(b[1] - a[1], b[0] - a[0])
    along, height = np.array([math.cos(yaw), math.sin(yaw)]), site.top.height
    parts, at = [], 0.0
    for start, end in (*gaps, (length, length)):
        if start - at > 0.05:
            x, y = np.array(a) + along * (at + start) / 2
            parts.append(box(start - at, thick, height, (x, y, 0.0), yaw))
            site.floor.take(Place(x, y, yaw), start - at, thick + 0.1)
        if end > start and height > 2.3:
            x, y = np.array(a) + along * (start + end) / 2
            parts.append(box(end - start, thick, height - 2.15, (x, y, 2.15), yaw))
        at = end
    return parts
