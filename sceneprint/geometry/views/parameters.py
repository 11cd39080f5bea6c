"""The sensor that views are rendered for, and where it may be.

Lengths are shares of the sensor's range, but for heights above the floor: those are the robot's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from sceneprint.errors import InvalidRequest
from sceneprint.geometry.surface.cloud import CloudParameters
from sceneprint.geometry.surface.depth_image import DepthParameters
from sceneprint.types import Intrinsics

#: A model that looks farther than this, in metres, is one of scans: no depth camera does.
_FARTHEST_CAMERA = 20.0
#: The camera where none is named: that of a Kinect at half its resolution.
DEFAULT_CAMERA = Intrinsics(width=320, height=240, fx=292.5, fy=292.5, cx=159.5, cy=119.5)
#: Heights of the sensor above the floor, metres, where none is named: of a camera on a small
#: robot, on a large one and in a hand; of a scanner on a robot.
CAMERA_HEIGHTS: tuple[float, ...] = (0.4, 1.0, 1.6)
SCANNER_HEIGHTS: tuple[float, ...] = (1.0,)
#: Scanners see about so far above and below their horizon, rad.
_ELEVATION = math.pi / 4.0


class SensorModel(Protocol):
    """What the parameters of a model say of its sensor."""

    @property
    def depth(self) -> DepthParameters:
        """Range of a depth camera."""

    @property
    def cloud(self) -> CloudParameters:
        """Range and resolution of a scanner."""


@dataclass(frozen=True)
class ViewParameters:
    """How views of a surface are chosen and rendered; lengths in metres.

    Parameters
    ----------
    camera : a pinhole camera without distortion; None: a scanner that sees all around
    step : angle between points that the scanner sees, rad
    elevation : the scanner sees as far above and below its horizon, rad
    nearest, farthest : range of the sensor
    heights : of the sensor above the floor, rising
    spacing : between viewpoints that are considered
    clearance : from a viewpoint to the nearest surface
    grain : points of a cloud that are nearer to each other become one
    cell : size of the pieces of surface that views are to cover
    most_views : that are chosen, at most
    """

    camera: Intrinsics | None
    step: float
    elevation: float
    nearest: float
    farthest: float
    heights: tuple[float, ...]
    spacing: float
    clearance: float
    grain: float
    cell: float
    most_views: int = 2000


def view_parameters(
    model: SensorModel, camera: Intrinsics | None = None, heights: Sequence[float] | None = None
) -> ViewParameters:
    """Return how views are made for a model.

    Parameters
    ----------
    model : parameters of the model; one that looks farther than 20 m is one of scans
    camera : of the robot, its lens distortion is left out; None: a scanner where the model is one
        of scans, else a usual camera
    heights : of the sensor above the floor, metres; None: usual ones of such a sensor

    Raises
    ------
    InvalidRequest : there is no height, or one is not above 0.
    """
    if heights is not None and not (heights and all(0 < h < math.inf for h in heights)):
        raise InvalidRequest(
            f"The heights of the sensor above the floor are {list(heights)}. Name one or more, "
            "each above 0 metres."
        )
    if camera is None and model.cloud.maximum_range > _FARTHEST_CAMERA:
        nearest, farthest = model.cloud.minimum_range, model.cloud.maximum_range
        usual, seen = SCANNER_HEIGHTS, None
    else:
        nearest, farthest = model.depth.minimum_depth, model.depth.maximum_depth
        usual, seen = CAMERA_HEIGHTS, camera or DEFAULT_CAMERA
    if seen is not None:
        seen = Intrinsics(seen.width, seen.height, seen.fx, seen.fy, seen.cx, seen.cy)
    return ViewParameters(
        camera=seen,
        step=model.cloud.image_angle,
        elevation=_ELEVATION,
        nearest=nearest,
        farthest=farthest,
        heights=tuple(sorted(heights)) if heights is not None else usual,
        spacing=farthest / (25.0 if seen else 40.0),
        clearance=max(nearest, farthest / 100.0),
        grain=farthest / 600.0,
        cell=farthest / 100.0,
    )
