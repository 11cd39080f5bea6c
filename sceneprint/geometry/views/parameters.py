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
from sceneprint.types import Camera, Intrinsics, Sphere

#: A model that looks farther than this, in metres, is one of scans: no depth camera does.
_FARTHEST_CAMERA = 20.0
#: The camera where none is named: that of a Kinect at half its resolution.
DEFAULT_CAMERA = Intrinsics(width=320, height=240, fx=292.5, fy=292.5, cx=159.5, cy=119.5)
#: Heights of the sensor above the floor, metres, where none is named: of a camera on a small
#: robot, on a large one and in a hand; of a scanner on a robot.
CAMERA_HEIGHTS: tuple[float, ...] = (0.4, 1.0, 1.6)
SCANNER_HEIGHTS: tuple[float, ...] = (1.0,)


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
    """How views of a surface are chosen and rendered.

    Parameters
    ----------
    camera : a pinhole camera, or a Sphere: a scanner that sees a full turn, its pole upwards
    nearest, farthest : range of the sensor, metres
    heights : of the sensor above the floor, metres, rising
    spacing : between viewpoints that are considered, metres
    clearance : from a viewpoint to the nearest surface, metres
    """

    camera: Camera
    nearest: float
    farthest: float
    heights: tuple[float, ...]
    spacing: float
    clearance: float


def view_parameters(
    model: SensorModel, camera: Intrinsics | None = None, heights: Sequence[float] | None = None
) -> ViewParameters:
    """Return how views are made for a model.

    Parameters
    ----------
    model : parameters of the model; one that looks farther than 20 m is one of scans
    camera : of the robot; None: of a scanner where the model is one of scans, else a usual one
    heights : of the sensor above the floor, metres; None: usual ones of such a sensor

    Raises
    ------
    InvalidRequest : a height is not a number, or is not above the floor.
    """
    if heights is not None and not (heights and all(0 < h < math.inf for h in heights)):
        raise InvalidRequest(
            f"Heights of the sensor above the floor are {list(heights)}. Name one or more, each "
            "above 0 metres."
        )
    if camera is None and model.cloud.maximum_range > _FARTHEST_CAMERA:
        nearest, farthest = model.cloud.minimum_range, model.cloud.maximum_range
        seen: Camera = _scanner(model.cloud.image_angle)
        usual = SCANNER_HEIGHTS
    else:
        nearest, farthest = model.depth.minimum_depth, model.depth.maximum_depth
        seen, usual = camera or DEFAULT_CAMERA, CAMERA_HEIGHTS
    return ViewParameters(
        camera=seen,
        nearest=nearest,
        farthest=farthest,
        heights=tuple(sorted(heights)) if heights is not None else usual,
        spacing=farthest / 20.0,
        clearance=max(nearest, farthest / 100.0),
    )


def _scanner(step: float) -> Sphere:
    """A full turn and all elevations, in steps of about so much, radians."""
    width = math.ceil(2.0 * math.pi / step)
    unit = 2.0 * math.pi / width
    height = math.floor(math.pi / unit)
    return Sphere(width, height, unit, -math.pi + unit / 2, (height - 1) / 2 * unit)
