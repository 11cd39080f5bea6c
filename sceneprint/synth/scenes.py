"""Scenes made to be hard: the same from several sides, or the same again and again.

symmetric_box()  -->  Room        corridor(doors)  -->  Room
"""

from __future__ import annotations

import numpy as np

from sceneprint.synth.mesh import join
from sceneprint.synth.rooms import Room
from sceneprint.synth.shell import Ceiling, Opening, Wall, shell, walls_of
from sceneprint.synth.solids import box
from sceneprint.types import Floats


def symmetric_box(side: float = 0.6, hall: float = 12.0) -> Room:
    """A cube in the middle of the floor of an empty square hall, the origin under it.

    Turned by 90 degrees about z the scene is the same: which side of the box a view shows
    cannot be told from the view.

    Parameters
    ----------
    side : edge of the cube, metres
    hall : length and width of the hall, metres
    """
    half = hall / 2
    outline = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    top = Ceiling(4.0, np.zeros(2))
    return Room(join([shell(outline, walls_of(outline), top), box(side, side, side)]), outline, top)


def corridor(doors: int, pitch: float = 2.0) -> Room:
    """A corridor along +x with identical doors in both long walls, one every `pitch` metres.

    A view shifted by a pitch sees the same doors; only the ends tell where it is.

    Parameters
    ----------
    doors : doors in each wall, at least 1
    pitch : distance from door to door, metres
    """
    if doors < 1:
        raise ValueError(f"A corridor of {doors} doors cannot be built; ask for 1 or more.")
    length, width, top = doors * pitch, 1.8, Ceiling(2.5, np.zeros(2))
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
