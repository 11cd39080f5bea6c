"""A piece of furniture: its mesh, its footprint, and where other things can rest on it.

    Surface, rng  --scatter-->  small objects on that surface

A piece stands on z = 0 with its footprint centred on the origin; its back, the side that
goes to a wall, faces +y, its front faces -y.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sceneprint.synth.clutter import small_thing
from sceneprint.synth.mesh import Mesh, join


@dataclass(frozen=True)
class Surface:
    """A horizontal rectangle on which things rest.

    Parameters
    ----------
    x, y : middle, metres, in the piece's frame
    width, depth : extent along x and y, metres
    z : height, metres
    headroom : free height above, metres
    density : objects a square metre
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
    mesh : standing on z = 0, back towards +y
    width, depth : footprint along x and y, metres
    surfaces : where things rest
    seats : 1 for a chair at its front; -n for n chairs, each at any side; 0 for none
    """

    mesh: Mesh
    width: float
    depth: float
    surfaces: tuple[Surface, ...] = ()
    seats: int = 0


def scatter(surface: Surface, rng: np.random.Generator) -> Mesh:
    """Small objects that rest on a surface, apart from each other, mostly square to it."""
    wanted = rng.poisson(surface.density * surface.width * surface.depth)
    placed: list[tuple[float, float, float]] = []
    parts: list[Mesh] = []
    for _ in range(min(wanted, 40)):
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


def furnished(piece: Piece, rng: np.random.Generator) -> Mesh:
    """The piece with things on all its surfaces; how full it is differs from piece to piece."""
    fullness = float(np.clip(rng.lognormal(0.1, 0.7), 0.1, 3.0))
    loads = [
        scatter(Surface(**{**vars(s), "density": s.density * fullness}), rng)
        for s in piece.surfaces
    ]
    return join([piece.mesh, *loads])
