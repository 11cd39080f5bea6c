"""A scene as entities over time, in the terms of no viewer, and how things look in it.

Moment  --SceneStream.write-->  SceneWriter (MCAP)

Entities form a tree by their paths. The first part of a path is the space: the name of the frame
of coordinates that all of it lies in, such as the parent frame of a map's poses. Below an entity
with a `Placement` all coordinates are those of its child frame. Cameras are outlines; heights and
answers have colours.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from sceneprint.pictures import viridis
from sceneprint.types import Bytes, Floats
from sceneprint_client.api.base import CameraIntrinsics

#: Red, green, blue, 0 to 255.
Colour = tuple[int, int, int]
#: From the space down.
EntityPath = tuple[str, ...]


@dataclass(frozen=True, eq=False)
class PointSet:
    """Points.

    Parameters
    ----------
    points : (N, 3) metres
    colours : (N, 3)
    size_m : diameter that a point is drawn with
    """

    points: Floats
    colours: Bytes
    size_m: float


@dataclass(frozen=True, eq=False)
class Placement:
    """Where a frame of coordinates lies.

    Parameters
    ----------
    T_parent_child : (4, 4)
    child : name of the frame; no other placement of the scene has it
    """

    T_parent_child: Floats
    child: str


@dataclass(frozen=True, eq=False)
class LineSet:
    """Strips of lines.

    Parameters
    ----------
    strips : each (M, 3) metres
    colours : of each strip
    width_px : on the screen
    """

    strips: Sequence[Floats]
    colours: Sequence[Colour]
    width_px: float = 2.0


@dataclass(frozen=True, eq=False)
class TextLabel:
    """A short text in space.

    Parameters
    ----------
    position : (3,) metres
    text, colour : of it
    """

    position: Floats
    text: str
    colour: Colour


@dataclass(frozen=True, eq=False)
class UpAxis:
    """Which way is up in a space.

    Parameters
    ----------
    up : (3,) unit vector
    """

    up: Floats


@dataclass(frozen=True, eq=False)
class TextPage:
    """What is said of the scene, for people, in lines."""

    text: str


Content = PointSet | Placement | LineSet | TextLabel | UpAxis | TextPage


@dataclass(frozen=True, eq=False)
class SceneEntity:
    """Something in a scene.

    Parameters
    ----------
    path : from its space down; one content each
    content : what is drawn there
    """

    path: EntityPath
    content: Content


@dataclass(frozen=True, eq=False)
class Moment:
    """What a scene holds at one time.

    Parameters
    ----------
    entities : those that are there until the next moment
    index : of the frame that was asked, from 0; None for what is there at all times
    stamp_ns : when it was taken, nanoseconds since 1970; None where not known
    """

    entities: Sequence[SceneEntity]
    index: int | None = None
    stamp_ns: int | None = None


class SceneWriter(Protocol):
    """A file that takes a scene."""

    def write(self, moment: Moment, gone: Collection[SceneEntity]) -> None:
        """Add a moment; `gone` are entities of the one before that it does not have."""


class SceneStream:
    """A scene while it is written, which knows what each moment replaces.

    Parameters
    ----------
    writer : of the scene's file
    """

    def __init__(self, writer: SceneWriter) -> None:
        self._writer = writer
        self.is_empty = True
        self._there: dict[EntityPath, SceneEntity] = {}

    def write(self, moment: Moment) -> None:
        """Add a moment in the place of the one before; what is there at all times stays."""
        self.is_empty = False
        gone: list[SceneEntity] = []
        if moment.index is not None:
            there = {one.path: one for one in moment.entities}
            gone = [one for path, one in self._there.items() if path not in there]
            self._there = there
        self._writer.write(moment, gone)


def space_of(path: EntityPath) -> str:
    """Return the space that an entity lies in."""
    return path[0]


# How cameras, heights and answers look.

QUERY: Colour = (255, 140, 0)
STRONG: Colour = (60, 120, 255)
WEAK: Colour = (120, 180, 255)
#: Of what is not confirmed: ambiguous matches, and poses that compete.
UNSURE: Colour = (235, 70, 200)
TRACK: Colour = (150, 150, 150)
CONFIRMED: Colour = (60, 190, 90)
OUTVOTED: Colour = (220, 50, 50)
#: Of the first and the second session of an association.
SESSIONS: tuple[Colour, Colour] = (QUERY, STRONG)

#: Depth at which the outline of a camera's picture is drawn, and length of axes, metres.
FRUSTUM_M, AXES_M = 0.25, 0.5
#: The same of a sensor that is one of many, and the width of its lines and of edges, pixels.
SMALL_M, THIN_PX = 0.1, 1.0
#: Diameters of points, metres: the query's stand out of the surfaces that its matches share with
#: it, and these out of the map. A scanner sees farther than a camera, so its points are larger.
MAP_POINT_M, MATCH_POINT_M, QUERY_POINT_M = 0.012, 0.018, 0.024
_SCANNERS_TIMES = 4.0
#: Percentiles of height at the ends of the colours: stray points must not flatten all others.
_RANGE = (1.0, 99.0)
#: What height leaves of a colour: the map is the background.
_DIMMED = 0.6


def frustum(camera: CameraIntrinsics, colour: Colour, depth_m: float = FRUSTUM_M) -> LineSet:
    """The outline of what a camera sees, in its optical frame, with a tick at the upper edge.

    Lens distortion is left out.
    """
    columns = np.array([-0.5, camera.width - 0.5])
    rows = np.array([-0.5, camera.height - 0.5])
    (left, right), (top, bottom) = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    corners = depth_m * np.array(
        [(left, top, 1.0), (right, top, 1.0), (right, bottom, 1.0), (left, bottom, 1.0)]
    )
    centre = np.zeros(3)
    tick = (corners[0] + corners[1]) / 2 - np.array([0.0, 0.2 * depth_m, 0.0])
    sides = [np.array([centre, corner]) for corner in corners]
    strips = [*sides, corners[[0, 1, 2, 3, 0]], np.array([corners[0], tick, corners[1]])]
    return LineSet(strips, [colour] * len(strips))


def sensor_axes(length_m: float = AXES_M) -> LineSet:
    """Return the axes of a sensor that is no camera: x red, y green, z blue."""
    strips = [np.array([np.zeros(3), length_m * axis]) for axis in np.eye(3)]
    return LineSet(strips, [(230, 60, 60), (70, 190, 70), (70, 110, 240)])


def sensor_outline(camera: CameraIntrinsics | None, colour: Colour) -> LineSet:
    """Return a camera's frustum, or the axes of another sensor."""
    return sensor_axes() if camera is None else frustum(camera, colour)


def small_outline(camera: CameraIntrinsics | None, colour: Colour) -> LineSet:
    """Return as `sensor_outline`, of one sensor of many."""
    drawn = sensor_axes(SMALL_M) if camera is None else frustum(camera, colour, SMALL_M)
    return replace(drawn, width_px=THIN_PX)


def point_size(base_m: float, *, cameras: bool) -> float:
    """Return the diameter of points of cameras, or of scanners, metres."""
    return base_m if cameras else _SCANNERS_TIMES * base_m


def height_colours(points: Floats, up: Floats) -> Bytes:
    """Colours (N, 3) of points (N, 3) by their height along `up`: low is violet, high yellow."""
    if not len(points):
        return np.zeros((0, 3), np.uint8)
    heights = points @ up
    low, high = np.percentile(heights, _RANGE)
    colours = viridis((heights - low) / max(high - low, 1e-9))
    dimmed: Bytes = np.rint(_DIMMED * colours).astype(np.uint8)
    return dimmed


def plain_colours(count: int, colour: Colour) -> Bytes:
    """Return one colour (count, 3)."""
    return np.tile(np.array(colour, np.uint8), (count, 1))


def nearest_axis(direction: Floats) -> Floats:
    """Return the axis (3,), positive or negative, that is nearest to a direction."""
    axis = np.zeros(3)
    largest = int(np.argmax(np.abs(direction)))
    axis[largest] = 1.0 if direction[largest] >= 0 else -1.0
    return axis


def up_of_sensors(poses: Sequence[Floats], *, cameras: bool) -> Floats:
    """The axis (3,) of a parent frame that is likely up: sensors are carried upright on average.

    Parameters
    ----------
    poses : each (4, 4) T_parent_sensor; of none z is taken
    cameras : whether up is -y of the sensors, as in optical frames; else z
    """
    if not poses:
        return np.array([0.0, 0.0, 1.0])
    ups = np.stack([-T[:3, 1] if cameras else T[:3, 2] for T in poses])
    return nearest_axis(ups.mean(axis=0))
