"""How rooms are furnished: pieces along walls, in the open and on the floor.

walls, Floor, rng  --along_wall, in_the_open, ...-->  meshes in place
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from sceneprint.synth.clutter import small_thing
from sceneprint.synth.fittings import wall_yaw
from sceneprint.synth.layout import Floor, Place
from sceneprint.synth.mesh import Mesh
from sceneprint.synth.piece import Piece, furnished
from sceneprint.synth.seats import chair, swivel_chair
from sceneprint.synth.shell import Ceiling, Wall
from sceneprint.synth.solids import box
from sceneprint.synth.storage import floor_thing

Maker = Callable[[np.random.Generator], Piece]
Menu = Mapping[Maker, float]  #: what may stand somewhere, and how often


@dataclass(frozen=True, eq=False)
class Site:
    """A room while it is being furnished: what is built, what is free, and the dice."""

    walls: list[Wall]
    top: Ceiling
    floor: Floor
    rng: np.random.Generator


def keep_doors_free(site: Site) -> None:
    """Claim the floor in front of doors, so that nothing is put there."""
    for wall in site.walls:
        for o in wall.openings:
            if o.low == 0.0 and o.high > 1.9:
                x, y = wall.at((o.start + o.end) / 2, 0.3)
                site.floor.claim(Place(x, y, wall_yaw(wall)), o.end - o.start, 0.6, 1.0)


def along_wall(wall: Wall, menu: Menu, site: Site) -> list[Mesh]:
    """Pieces side by side along a wall; how densely differs from wall to wall."""
    rng = site.rng
    parts: list[Mesh] = []
    u, density = rng.uniform(0.0, 0.5), rng.uniform(0.5, 1.0)
    while u < wall.length - 0.4:
        piece = _pick(menu, rng)
        if rng.random() > density or u + piece.width > wall.length:
            u += rng.uniform(0.2, 0.6)
            continue
        gap = rng.uniform(0.02, 0.1)
        x, y = wall.at(u + piece.width / 2, piece.depth / 2 + gap)
        jitter = rng.normal(0, 0.02) if rng.random() < 0.7 else 0.0
        parts += _stand(piece, Place(x, y, wall_yaw(wall) + jitter), site)
        u += piece.width + float(rng.choice((rng.uniform(0.0, 0.03), rng.uniform(0.1, 0.8))))
    return parts


def in_the_open(menu: Menu, site: Site) -> list[Mesh]:
    """Pieces in the middle of the room, square to it or at any yaw."""
    rng = site.rng
    parts: list[Mesh] = []
    spots = site.floor.points[~site.floor.claimed]
    if not len(spots):
        return parts
    for _ in range(3 + round(len(spots) * 0.003 * rng.uniform(0.2, 1.5))):
        yaw = int(rng.integers(0, 4)) * math.pi / 2 + rng.normal(0, 0.06)
        if rng.random() < 0.35:
            yaw = float(rng.uniform(-math.pi, math.pi))
        x, y = spots[int(rng.integers(0, len(spots)))]
        parts += _stand(_pick(menu, rng), Place(x, y, yaw), site)
    return parts


def partitions(site: Site) -> list[Mesh]:
    """Now and then a wall or screen that stands out into the room."""
    rng, floor = site.rng, site.floor
    lowest = float(site.top.at(floor.points[floor.inside]).min())
    parts = []
    for wall in site.walls:
        if rng.random() > 0.12 or wall.length < 2.0:
            continue
        long, thick = rng.uniform(0.6, 2.0), rng.uniform(0.05, 0.14)
        x, y = wall.at(wall.length * rng.uniform(0.25, 0.75), long / 2)
        place = Place(x, y, wall_yaw(wall))
        height = float(rng.choice((rng.uniform(1.1, 1.7), 2.05)))
        if lowest > height + 0.05 and floor.claim(place, thick + 0.1, long):
            parts.append(box(thick, long, height, (x, y, 0.0), place.yaw))
    return parts


def on_the_floor(site: Site) -> list[Mesh]:
    """Bins, boxes, plants and small things on what floor is left."""
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
        if floor.claim(Place(x, y, yaw), piece.width, piece.depth, 0.2):
            parts.append(piece.mesh.moved((x, y, 0), yaw))
    return parts


def _pick(menu: Menu, rng: np.random.Generator) -> Piece:
    weights = np.array(list(menu.values()), float)
    return list(menu)[int(rng.choice(len(menu), p=weights / weights.sum()))](rng)


def _stand(piece: Piece, place: Place, site: Site) -> list[Mesh]:
    """The piece with its load and its chairs at a place, or nothing if there is no room."""
    rng = site.rng
    mesh = furnished(piece, rng).moved((place.x, place.y, 0.0), place.yaw)
    if (mesh.vertices[:, 2] > site.top.at(mesh.vertices[:, :2]) - 0.02).any():
        return []
    if not site.floor.claim(place, piece.width, piece.depth):
        return []
    if rng.random() < 0.06:  # black leather, steel, lacquer
        mesh = mesh.with_loss(float(rng.choice((rng.uniform(0.05, 0.4), 0.9))))
    parts = [mesh]
    if rng.random() < 0.85:
        seat = swivel_chair if rng.random() < (0.7 if piece.seats == 1 else 0.2) else chair
        # a desk has one seat, at its front; a table has some, at any of its sides
        sides = [0] if piece.seats == 1 else rng.permutation(4)[: max(0, -piece.seats)].tolist()
        for side in sides:
            parts += _seat(seat(rng), side, piece, place, site)
    return parts


def _seat(seat: Piece, side: int, piece: Piece, place: Place, site: Site) -> list[Mesh]:
    """A chair at one side of a table (0 is its front), pushed in more or less."""
    rng = site.rng
    yaw = place.yaw + side * math.pi / 2
    half, span = (piece.depth, piece.width) if side % 2 == 0 else (piece.width, piece.depth)
    out = half / 2 + seat.depth / 2 + rng.uniform(-0.25, 0.35)
    across = rng.uniform(-0.3, 0.3) * span
    x = place.x + across * math.cos(yaw) + out * math.sin(yaw)
    y = place.y + across * math.sin(yaw) - out * math.cos(yaw)
    facing = yaw + math.pi + rng.normal(0, 0.25 if rng.random() < 0.7 else 0.9)
    if not site.floor.claim(Place(x, y, facing), seat.width, seat.depth, 0.55):
        return []
    return [seat.mesh.moved((x, y, 0), facing)]
