"""Entities of a scene over time, independent of the viewer, and their appearance.

Moment  --SceneStream.write-->  SceneWriter (MCAP)

Entities form a tree by their paths. The first part of a path is the space: the name of a coordinate
frame, such as the parent frame of a map's poses. Below an entity with a `Placement`, coordinates
are in its child frame. Cameras are drawn as outlines; colours show heights and answers.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from sceneprint.pictures import viridis
from sceneprint.types import Bytes, Floats
from sceneprint_client.api.base import CameraIntrinsics

#: Red, green and blue, 0 to 255.
Colour = tuple[int, int, int]
#: Path of an entity, starting with the space.
EntityPath = tuple[str, ...]


@dataclass(frozen=True, eq=False)
class PointSet:
    """A set of coloured points.

    Parameters
    ----------
    points : (N, 3) metres
    colours : (N, 3) uint8
    size_m : diameter of a drawn point, metres
    """

    points: Floats
    colours: Bytes
    size_m: float


@dataclass(frozen=True, eq=False)
class Placement:
    """The pose of a coordinate frame.

    Parameters
    ----------
    T_parent_child : (4, 4)
    child : name of the frame, unique in the scene
    """

    T_parent_child: Floats
    child: str


@dataclass(frozen=True, eq=False)
class LineSet:
    """A set of line strips.

    Parameters
    ----------
    strips : (M, 3) points of each strip, metres
    width_px : width on the screen, pixels
    """

    strips: Sequence[Floats]
    colours: Sequence[Colour]
    width_px: float = 2.0


@dataclass(frozen=True, eq=False)
class TextLabel:
    """A label at a position (3,), in metres."""

    position: Floats
    text: str
    colour: Colour


@dataclass(frozen=True, eq=False)
class UpAxis:
    """The up direction of a space, a unit vector (3,)."""

    up: Floats


@dataclass(frozen=True, eq=False)
class TextPage:
    """A text about the scene."""

    text: str


Content = PointSet | Placement | LineSet | TextLabel | UpAxis | TextPage


@dataclass(frozen=True, eq=False)
class SceneEntity:
    """A drawn object of a scene, with a unique path."""

    path: EntityPath
    content: Content


@dataclass(frozen=True, eq=False)
class Moment:
    """The content of a scene at one time.

    Parameters
    ----------
    entities : entities that are visible until the next moment
    index : index of the query, from 0; None for permanent entities
    stamp_ns : time of capture, nanoseconds since 1970; None if unknown
    """

    entities: Sequence[SceneEntity]
    index: int | None = None
    stamp_ns: int | None = None


class SceneWriter(Protocol):
    """Protocol of writers of a scene."""

    def write(self, moment: Moment, gone: Collection[SceneEntity]) -> None:
        """Write a moment; `gone` contains the entities of the previous moment that have ended."""


class SceneStream:
    """Stream of moments to a writer; it determines the entities that end with each moment."""

    def __init__(self, writer: SceneWriter) -> None:
        self._writer = writer
        self.is_empty = True
        self._there: dict[EntityPath, SceneEntity] = {}

    def write(self, moment: Moment) -> None:
        """Write the next moment, which replaces the previous one but not permanent entities."""
        self.is_empty = False
        gone: list[SceneEntity] = []
        if moment.index is not None:
            there = {entity.path: entity for entity in moment.entities}
            gone = [entity for path, entity in self._there.items() if path not in there]
            self._there = there
        self._writer.write(moment, gone)


def space_of(path: EntityPath) -> str:
    """Return the space of an entity."""
    return path[0]


# The appearance of cameras, heights and answers.

QUERY: Colour = (255, 140, 0)
STRONG: Colour = (60, 120, 255)
WEAK: Colour = (120, 180, 255)
#: Colour of unconfirmed entities: ambiguous matches and alternative poses.
UNSURE: Colour = (235, 70, 200)
TRACK: Colour = (150, 150, 150)
CONFIRMED: Colour = (60, 190, 90)
OUTVOTED: Colour = (220, 50, 50)
#: Colours of the first and the second session of an association.
SESSIONS: tuple[Colour, Colour] = (QUERY, STRONG)

#: Depth of the outline of a camera's image, and length of axes, metres.
FRUSTUM_M, AXES_M = 0.25, 0.5
#: Depth of small outlines, metres, and width of thin lines, pixels.
SMALL_M, THIN_PX = 0.1, 1.0
#: Diameters of points of the map, of matches and of the query, metres. They differ so that points
#: on the same surface remain visible.
MAP_POINT_M, MATCH_POINT_M, QUERY_POINT_M = 0.012, 0.018, 0.024
_SCANNERS_TIMES = 4.0
#: Percentiles of height at the ends of the colour scale, which exclude stray points.
_RANGE = (1.0, 99.0)
#: Factor that dims the colours of heights, because the map is the background.
_DIMMED = 0.6


def frustum(camera: CameraIntrinsics, colour: Colour, depth_m: float = FRUSTUM_M) -> LineSet:
    """Return the outline of a camera's view in its optical frame, with a mark at the upper edge.

    Lens distortion is ignored.
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
    """Return the axes of a sensor without a camera: x red, y green, z blue."""
    strips = [np.array([np.zeros(3), length_m * axis]) for axis in np.eye(3)]
    return LineSet(strips, [(230, 60, 60), (70, 190, 70), (70, 110, 240)])


def sensor_outline(camera: CameraIntrinsics | None, colour: Colour) -> LineSet:
    """Return a camera's frustum, or the axes of another sensor."""
    return sensor_axes() if camera is None else frustum(camera, colour)


def small_outline(camera: CameraIntrinsics | None, colour: Colour) -> LineSet:
    """Return a small `sensor_outline` with thin lines."""
    drawn = sensor_axes(SMALL_M) if camera is None else frustum(camera, colour, SMALL_M)
    return replace(drawn, width_px=THIN_PX)


def point_size(base_m: float, *, cameras: bool) -> float:
    """Return the diameter of points, metres; points of scanners, which see farther, are larger."""
    return base_m if cameras else _SCANNERS_TIMES * base_m


def height_colours(points: Floats, up: Floats) -> Bytes:
    """Return the colours (N, 3) of points by height along `up`: low is violet, high is yellow."""
    if not len(points):
        return np.zeros((0, 3), np.uint8)
    heights = points @ up
    low, high = np.percentile(heights, _RANGE)
    colours = viridis((heights - low) / max(high - low, 1e-9))
    dimmed: Bytes = np.rint(_DIMMED * colours).astype(np.uint8)
    return dimmed


def plain_colours(count: int, colour: Colour) -> Bytes:
    """Return `count` copies of one colour, (count, 3)."""
    return np.tile(np.array(colour, np.uint8), (count, 1))


def nearest_axis(direction: Floats) -> Floats:
    """Return the positive or negative axis (3,) that is nearest to a direction."""
    axis = np.zeros(3)
    largest = int(np.argmax(np.abs(direction)))
    axis[largest] = 1.0 if direction[largest] >= 0 else -1.0
    return axis


def up_of_sensors(poses: Sequence[Floats], *, cameras: bool) -> Floats:
    """Return the axis (3,) of a parent frame that is probably up if most sensors are upright.

    Parameters
    ----------
    poses : (4, 4) T_parent_sensor of each sensor; without poses, the result is z
    cameras : whether up is -y of the sensors, as in optical frames, instead of z
    """
    if not poses:
        return np.array([0.0, 0.0, 1.0])
    ups = np.stack([-T[:3, 1] if cameras else T[:3, 2] for T in poses])
    return nearest_axis(ups.mean(axis=0))
