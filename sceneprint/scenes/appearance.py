"""How cameras, heights and answers look in a scene: outlines and colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sceneprint.previews import viridis
from sceneprint.scenes.scene import Colour, LineSet
from sceneprint.types import Bytes, Floats
from sceneprint_client.api.frames import CameraIntrinsics

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
    """The axes of a sensor that is no camera: x red, y green, z blue."""
    strips = [np.array([np.zeros(3), length_m * axis]) for axis in np.eye(3)]
    return LineSet(strips, [(230, 60, 60), (70, 190, 70), (70, 110, 240)])


def sensor_outline(camera: CameraIntrinsics | None, colour: Colour) -> LineSet:
    """A camera's frustum, or the axes of another sensor."""
    return sensor_axes() if camera is None else frustum(camera, colour)


def small_outline(camera: CameraIntrinsics | None, colour: Colour) -> LineSet:
    """As `sensor_outline`, of one sensor of many."""
    drawn = sensor_axes(SMALL_M) if camera is None else frustum(camera, colour, SMALL_M)
    return replace(drawn, width_px=THIN_PX)


def point_size(base_m: float, *, cameras: bool) -> float:
    """The diameter of points of cameras, or of scanners, metres."""
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
    """One colour (count, 3)."""
    return np.tile(np.array(colour, np.uint8), (count, 1))


def nearest_axis(direction: Floats) -> Floats:
    """The axis (3,), positive or negative, that is nearest to a direction."""
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
