"""Parameters of views, derived from a model and a robot's sensor.

Lengths scale with the sensor's range; heights above the floor depend on the robot.
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

#: Maximum range of a model for depth cameras, metres. Models for scanners have a longer range.
_FARTHEST_CAMERA = 20.0
#: Default camera: a Kinect at half resolution.
DEFAULT_CAMERA = Intrinsics(width=320, height=240, fx=292.5, fy=292.5, cx=159.5, cy=119.5)
#: Default heights of the sensor above the floor, metres: for a camera on a small robot, on a large
#: robot and in a hand, and for a scanner on a robot.
CAMERA_HEIGHTS: tuple[float, ...] = (0.4, 1.0, 1.6)
SCANNER_HEIGHTS: tuple[float, ...] = (1.0,)
#: Maximum elevation of a scanner above and below its horizon, rad.
_ELEVATION = math.pi / 4.0


class SensorModel(Protocol):
    """The part of a model's parameters that describes its sensor."""

    @property
    def depth(self) -> DepthParameters:
        """Return the parameters for depth images, which include the range of a camera."""

    @property
    def cloud(self) -> CloudParameters:
        """Return the parameters for clouds, which include the range and resolution of a scanner."""


@dataclass(frozen=True)
class ViewParameters:
    """Parameters for selecting and rendering views of a surface; lengths in metres.

    Parameters
    ----------
    camera : pinhole camera without distortion; None for a scanner that sees all around
    step : angle between a scanner's points, rad
    elevation : maximum elevation of a scanner above and below its horizon, rad
    nearest, farthest : range of the sensor
    heights : ascending heights of the sensor above the floor
    spacing : distance between candidate viewpoints
    clearance : minimum distance from a viewpoint to a surface
    grain : distance within which points of a cloud are merged
    cell : size of the pieces of surface that views must cover
    most_views : maximum number of views
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
    """Derive the parameters of views from a model.

    Parameters
    ----------
    model : parameters of the model; with a range above 20 m, it is for scanners
    camera : camera of the robot, without lens distortion; None selects a scanner if the model is
        for scanners, otherwise a default camera
    heights : heights of the sensor above the floor, metres; None selects the sensor's defaults

    Raises
    ------
    InvalidRequest : If there are no heights, or a height is not above 0
    """
    if heights is not None and not (heights and all(0 < h < math.inf for h in heights)):
        raise InvalidRequest(
            f"The heights of the sensor above the floor are {list(heights)}. Specify at least one "
            "height; all must be above 0 m."
        )
    if camera is None and model.cloud.maximum_range > _FARTHEST_CAMERA:
        nearest, farthest = model.cloud.minimum_range, model.cloud.maximum_range
        usual, view = SCANNER_HEIGHTS, None
    else:
        nearest, farthest = model.depth.minimum_depth, model.depth.maximum_depth
        usual, view = CAMERA_HEIGHTS, camera or DEFAULT_CAMERA
    if view is not None:
        view = Intrinsics(view.width, view.height, view.fx, view.fy, view.cx, view.cy)
    return ViewParameters(
        camera=view,
        step=model.cloud.image_angle,
        elevation=_ELEVATION,
        nearest=nearest,
        farthest=farthest,
        heights=tuple(sorted(heights)) if heights is not None else usual,
        spacing=farthest / (25.0 if view else 40.0),
        clearance=max(nearest, farthest / 100.0),
        grain=farthest / 600.0,
        cell=farthest / 100.0,
    )
