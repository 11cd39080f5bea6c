"""Furnished rooms: the scenes from which synthetic depth frames are taken.

rng  --make_room-->  Room: mesh, outline, ceiling
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sceneprint.synth.arrangement import (
    Menu,
    Site,
    along_wall,
    in_the_open,
    keep_doors_free,
    on_the_floor,
    partitions,
)
from sceneprint.synth.fittings import fittings, overhead, pierced
from sceneprint.synth.layout import Floor, inside
from sceneprint.synth.mesh import Mesh, join
from sceneprint.synth.rays import Caster
from sceneprint.synth.seats import bed, sofa, stool, swivel_chair
from sceneprint.synth.shell import Ceiling, Wall, ceiling, floor_plan, shell, walls_of
from sceneprint.synth.storage import (
    counter,
    cupboard,
    floor_thing,
    fridge,
    kitchen_row,
    shelf,
    stairs,
)
from sceneprint.synth.tables import desk, round_table, table
from sceneprint.types import Floats, Floats32, Ints32

#: kinds of rooms: what stands against walls, what stands free, and how often each
_KINDS: tuple[tuple[Menu, Menu], ...] = (
    (
        {desk: 5, shelf: 3, cupboard: 2, table: 1, floor_thing: 1},
        {desk: 3, table: 2, swivel_chair: 1},
    ),
    ({kitchen_row: 6, fridge: 2, cupboard: 2, shelf: 1}, {table: 3, round_table: 1, counter: 2}),
    ({sofa: 3, shelf: 3, cupboard: 3, desk: 1}, {table: 2, sofa: 2, round_table: 1, stool: 2}),
    ({bed: 3, cupboard: 3, desk: 2, shelf: 2}, {stool: 2, floor_thing: 2, table: 1}),
    ({shelf: 4, cupboard: 3, floor_thing: 3, stairs: 1}, {floor_thing: 4, shelf: 2, table: 1}),
    (
        dict.fromkeys((desk, kitchen_row, sofa, bed, shelf, cupboard, fridge, table, stairs), 1),
        dict.fromkeys((table, round_table, desk, counter, sofa, stool, floor_thing), 1),
    ),
)
_FREQUENCIES = (0.27, 0.23, 0.15, 0.1, 0.1, 0.15)


@dataclass(frozen=True, eq=False)
class Room:
    """A closed scene in which a camera can move.

    Parameters
    ----------
    mesh : all surfaces; solids face outward, the shell faces the room
    outline : (n, 2) floor plan, counter-clockwise, metres
    ceiling : height over every point of the floor
    """

    mesh: Mesh
    outline: Floats
    ceiling: Ceiling

    @property
    def vertices(self) -> Floats32:
        """(V, 3) metres, z up."""
        return self.mesh.vertices.astype(np.float32)

    @property
    def faces(self) -> Ints32:
        """(F, 3) indices into vertices."""
        return self.mesh.faces

    @property
    def size(self) -> Floats:
        """(3,) extents of the room along x, y, z, metres."""
        return np.array([*np.ptp(self.outline, axis=0), self.ceiling.at(self.outline).max()])

    @cached_property
    def caster(self) -> Caster:
        """The mesh ready for rays; built at the first use."""
        return Caster(self.mesh)


def make_room(rng: np.random.Generator) -> Room:
    """A room of 2.5 to 8 m with furniture, fittings and clutter, all drawn from rng."""
    outline = floor_plan(rng)
    top = ceiling(rng, outline)
    walls = [pierced(w, rng, _depth_behind(w, outline)) for w in walls_of(outline)]
    site = Site(walls, top, Floor(outline), rng)
    keep_doors_free(site)
    parts = [shell(outline, walls, top), overhead(outline, top, rng)]
    parts += [fittings(w, top, rng) for w in walls]
    parts += partitions(site)
    at_walls, free = _KINDS[int(rng.choice(len(_KINDS), p=_FREQUENCIES))]
    for wall in walls:
        parts += along_wall(wall, at_walls, site)
    parts += in_the_open(free, site)
    parts += on_the_floor(site)
    return Room(join(parts), outline, top)


def _depth_behind(wall: Wall, outline: Floats) -> float:
    """How deep a recess may go, metres, without meeting the room or another recess."""
    along = np.linspace(-0.3, wall.length + 0.3, 15)
    for depth in (2.0, 1.0, 0.5, 0.25):
        behind = np.linspace(0.01, depth + 0.1, 12)
        probes = np.array([wall.at(u, -out) for u in along for out in behind])
        if not inside(outline, probes).any():
            return depth
    return 0.08  # at a corner that juts into the room, where two walls share what is behind
