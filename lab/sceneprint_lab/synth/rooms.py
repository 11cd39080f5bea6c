"""Furnished rooms: pieces along walls, in the open and on the floor.

walls, Floor, rng  --along_wall, in_the_open, ...-->  meshes in place
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sceneprint.types import Floats, Floats32, Ints32
from sceneprint_lab.synth.furniture import (
    Piece,
    bed,
    chair,
    counter,
    cupboard,
    desk,
    fittings,
    floor_thing,
    fridge,
    kitchen_row,
    overhead,
    round_table,
    shelf,
    small_thing,
    sofa,
    stairs,
    stool,
    swivel_chair,
    table,
    wall_yaw,
    with_objects,
    with_openings,
)
from sceneprint_lab.synth.mesh import (
    Ceiling,
    SyntheticMesh,
    Wall,
    box,
    ceiling,
    floor_plan,
    join,
    shell,
    walls_of,
)
from sceneprint_lab.synth.sensors import Caster

# The grid of a floor's occupied cells, which prevents pieces from overlapping.
#
# PiecePose  --Floor.claim-->  whether the place was free

CELL = 0.05  #: edge length of a cell of a room's grid, metres


@dataclass(frozen=True)
class PiecePose:
    """The pose of a piece: x and y, metres; yaw, radians."""

    x: float
    y: float
    yaw: float


class Floor:
    """The floor within an outline (n, 2), and its occupied cells.

    Parameters
    ----------
    outline : corners, counter-clockwise, metres
    cell : edge length of the grid's cells, metres
    """

    def __init__(self, outline: Floats, cell: float = CELL) -> None:
        low, high = outline.min(axis=0), outline.max(axis=0)
        shape = np.ceil((high - low) / cell).astype(int)
        x = low[0] + (np.arange(shape[0]) + 0.5) * cell
        y = low[1] + (np.arange(shape[1]) + 0.5) * cell
        self.cell, self._low = cell, low
        self.points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        self.inside = inside(outline, self.points)
        self.claimed = ~self.inside

    def claim(self, place: PiecePose, width: float, depth: float, overlap: float = 0.0) -> bool:
        """Mark a rotated rectangle of the floor as occupied if it is free; return whether it was.

        Parameters
        ----------
        place : centre and yaw of the rectangle
        width, depth : extents, metres
        overlap : share of the rectangle that may already be occupied, [0, 1]; the whole rectangle
            must lie inside the room
        """
        part, cells = self._cells(place, width, depth)
        total = width * depth / self.cell**2
        within = np.count_nonzero(cells & self.inside[part])
        free = np.count_nonzero(cells & ~self.claimed[part])
        # Rounding may lose a strip, half a cell wide, along the walls.
        slack = (width + depth) / self.cell + 2
        if within < total - slack or free < within * (1 - overlap) - 1e-9:
            return False
        self.claimed[part] |= cells
        return True

    def take(self, place: PiecePose, width: float, depth: float) -> None:
        """Mark a rotated rectangle as occupied without checking that it is free and inside."""
        part, cells = self._cells(place, width, depth)
        self.claimed[part] |= cells

    def _cells(
        self, place: PiecePose, width: float, depth: float
    ) -> tuple[tuple[slice, slice], NDArray[np.bool_]]:
        """Return slices of the grid around a rectangle, and a mask of the cells it covers."""
        reach = math.hypot(width, depth) / 2 + self.cell
        middle = np.array([place.x, place.y])
        first = np.floor((middle - reach - self._low) / self.cell).astype(int).clip(0)
        last = np.ceil((middle + reach - self._low) / self.cell).astype(int).clip(0)
        part = (slice(first[0], last[0]), slice(first[1], last[1]))
        points = self.points[part]
        c, s = math.cos(place.yaw), math.sin(place.yaw)
        dx, dy = points[..., 0] - place.x, points[..., 1] - place.y
        along, across = np.abs(c * dx + s * dy), np.abs(c * dy - s * dx)
        return part, (along <= width / 2) & (across <= depth / 2)


def inside(outline: Floats, points: Floats) -> NDArray[np.bool_]:
    """Return a mask (...,) of the floor points (..., 2) that are inside an outline (n, 2)."""
    x, y = points[..., 0], points[..., 1]
    result = np.zeros(x.shape, bool)
    for (ax, ay), (bx, by) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if ay == by:
            continue
        crosses = (ay > y) != (by > y)
        result ^= crosses & (x < ax + (y - ay) / (by - ay) * (bx - ax))
    return result


Maker = Callable[[np.random.Generator], Piece]
Menu = Mapping[Maker, float]  #: builders of objects, and their weights


@dataclass(frozen=True, eq=False)
class Site:
    """A room under construction: its walls, ceiling and floor, and the random generator."""

    walls: list[Wall]
    top: Ceiling
    floor: Floor
    rng: np.random.Generator


def keep_doors_free(site: Site) -> None:
    """Mark the floor in front of doors as occupied, so that no piece blocks them."""
    for wall in site.walls:
        for o in wall.openings:
            if o.low == 0.0 and o.high > 1.9:
                x, y = wall.at((o.start + o.end) / 2, 0.3)
                site.floor.claim(PiecePose(x, y, wall_yaw(wall)), o.end - o.start, 0.6, 1.0)


def along_wall(wall: Wall, menu: Menu, site: Site) -> list[SyntheticMesh]:
    """Return random pieces side by side along a wall, with a random density."""
    rng = site.rng
    parts: list[SyntheticMesh] = []
    u, density = rng.uniform(0.0, 0.5), rng.uniform(0.5, 1.0)
    while u < wall.length - 0.4:
        piece = _pick(menu, rng)
        if rng.random() > density or u + piece.width > wall.length:
            u += rng.uniform(0.2, 0.6)
            continue
        gap = rng.uniform(0.02, 0.1)
        x, y = wall.at(u + piece.width / 2, piece.depth / 2 + gap)
        jitter = rng.normal(0, 0.02) if rng.random() < 0.7 else 0.0
        parts += _stand(piece, PiecePose(x, y, wall_yaw(wall) + jitter), site)
        u += piece.width + float(rng.choice((rng.uniform(0.0, 0.03), rng.uniform(0.1, 0.8))))
    return parts


def in_the_open(menu: Menu, site: Site) -> list[SyntheticMesh]:
    """Return random pieces at free places, aligned with the axes or with a random yaw."""
    rng = site.rng
    parts: list[SyntheticMesh] = []
    spots = site.floor.points[~site.floor.claimed]
    if not len(spots):
        return parts
    for _ in range(3 + round(len(spots) * 0.003 * rng.uniform(0.2, 1.5))):
        yaw = int(rng.integers(0, 4)) * math.pi / 2 + rng.normal(0, 0.06)
        if rng.random() < 0.35:
            yaw = float(rng.uniform(-math.pi, math.pi))
        x, y = spots[int(rng.integers(0, len(spots)))]
        parts += _stand(_pick(menu, rng), PiecePose(x, y, yaw), site)
    return parts


def partitions(site: Site) -> list[SyntheticMesh]:
    """Return free-standing partitions perpendicular to some of the walls."""
    rng, floor = site.rng, site.floor
    lowest = float(site.top.at(floor.points[floor.inside]).min())
    parts = []
    for wall in site.walls:
        if rng.random() > 0.12 or wall.length < 2.0:
            continue
        long, thick = rng.uniform(0.6, 2.0), rng.uniform(0.05, 0.14)
        x, y = wall.at(wall.length * rng.uniform(0.25, 0.75), long / 2)
        place = PiecePose(x, y, wall_yaw(wall))
        height = float(rng.choice((rng.uniform(1.1, 1.7), 2.05)))
        if lowest > height + 0.05 and floor.claim(place, thick + 0.1, long):
            parts.append(box(thick, long, height, (x, y, 0.0), place.yaw))
    return parts


def on_the_floor(site: Site) -> list[SyntheticMesh]:
    """Return bins, boxes, plants and small objects on the remaining floor."""
    rng, floor = site.rng, site.floor
    parts = []
    for _ in range(rng.integers(3, 16)):
        spots = floor.points[~floor.claimed]
        if not len(spots):
            break
        x, y = spots[int(rng.integers(0, len(spots)))]
        yaw = rng.uniform(-math.pi, math.pi)
        if rng.random() < 0.5:
            piece = floor_thing(rng)
        else:
            mesh = small_thing(rng)
            reach = 2 * np.abs(mesh.vertices[:, :2]).max(axis=0)
            piece = Piece(mesh, float(reach[0]), float(reach[1]))
        if floor.claim(PiecePose(x, y, yaw), piece.width, piece.depth, 0.2):
            parts.append(piece.mesh.moved((x, y, 0), yaw))
    return parts


def _pick(menu: Menu, rng: np.random.Generator) -> Piece:
    weights = np.array(list(menu.values()), float)
    return list(menu)[int(rng.choice(len(menu), p=weights / weights.sum()))](rng)


def _stand(piece: Piece, place: PiecePose, site: Site) -> list[SyntheticMesh]:
    """Return a piece at a place, with objects and chairs, or [] if it does not fit."""
    rng = site.rng
    mesh = with_objects(piece, rng).moved((place.x, place.y, 0.0), place.yaw)
    if (mesh.vertices[:, 2] > site.top.at(mesh.vertices[:, :2]) - 0.02).any():
        return []
    if not site.floor.claim(place, piece.width, piece.depth):
        return []
    if rng.random() < 0.06:  # black leather, steel or lacquer
        mesh = mesh.with_loss(float(rng.choice((rng.uniform(0.05, 0.4), 0.9))))
    parts = [mesh]
    if rng.random() < 0.85:
        seat = swivel_chair if rng.random() < (0.7 if piece.seats == 1 else 0.2) else chair
        # A desk has one seat, at its front; a table has seats at random sides.
        sides = [0] if piece.seats == 1 else rng.permutation(4)[: max(0, -piece.seats)].tolist()
        for side in sides:
            parts += _seat(seat(rng), side, piece, place, site)
    return parts


def _seat(
    seat: Piece, side: int, piece: Piece, place: PiecePose, site: Site
) -> list[SyntheticMesh]:
    """Return a chair at a side of a table (0: front), at a random distance, or [] if it does not
    fit.
    """
    rng = site.rng
    yaw = place.yaw + side * math.pi / 2
    half, span = (piece.depth, piece.width) if side % 2 == 0 else (piece.width, piece.depth)
    out = half / 2 + seat.depth / 2 + rng.uniform(-0.25, 0.35)
    across = rng.uniform(-0.3, 0.3) * span
    x = place.x + across * math.cos(yaw) + out * math.sin(yaw)
    y = place.y + across * math.sin(yaw) - out * math.cos(yaw)
    facing = yaw + math.pi + rng.normal(0, 0.25 if rng.random() < 0.7 else 0.9)
    if not site.floor.claim(PiecePose(x, y, facing), seat.width, seat.depth, 0.55):
        return []
    return [seat.mesh.moved((x, y, 0), facing)]


# Furnished rooms as scenes of synthetic depth frames.
#
# rng  --make_room-->  Room: mesh, outline, ceiling

#: Kinds of rooms: objects along walls and free-standing objects, with weights.
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
    """A closed scene for a camera.

    Parameters
    ----------
    mesh : all surfaces; normals of solids face outward, those of the shell inward
    outline : (n, 2) floor plan, counter-clockwise, metres
    ceiling : ceiling
    """

    mesh: SyntheticMesh
    outline: Floats
    ceiling: Ceiling

    @property
    def vertices(self) -> Floats32:
        """Return the vertices (V, 3), metres, z up."""
        return self.mesh.vertices.astype(np.float32)

    @property
    def faces(self) -> Ints32:
        """Return the indices (F, 3) of the vertices of each face."""
        return self.mesh.faces

    @property
    def size(self) -> Floats:
        """Return the extents (3,) of the room along x, y and z, metres."""
        return np.array([*np.ptp(self.outline, axis=0), self.ceiling.at(self.outline).max()])

    @cached_property
    def caster(self) -> Caster:
        """Ray caster of the mesh, built at the first use."""
        return Caster(self.mesh)


def make_room(rng: np.random.Generator) -> Room:
    """Return a random room of 2.5 to 8 m with furniture, fittings and clutter."""
    outline = floor_plan(rng)
    top = ceiling(rng, outline)
    walls = [with_openings(w, rng, _depth_behind(w, outline)) for w in walls_of(outline)]
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
    """Return the maximum depth, metres, at which recesses in a wall do not meet the room again."""
    along = np.linspace(-0.3, wall.length + 0.3, 15)
    for depth in (2.0, 1.0, 0.5, 0.25):
        behind = np.linspace(0.01, depth + 0.1, 12)
        probes = np.array([wall.at(u, -out) for u in along for out in behind])
        if not inside(outline, probes).any():
            return depth
    return 0.08  # two walls share the space behind a re-entrant corner
