"""How a sensor looks: pixels to directions.

Camera frames are optical: x right, y down, z forward. Clouds keep their sensor's axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from sceneprint.errors import InvalidIntrinsics

#: Most samples a depth image may have (an 8-megapixel sensor); more is refused unread.
MAXIMUM_SAMPLES = 8_388_608

#: Longest focal length and farthest principal point that are believed, pixels.
MAXIMUM_PIXELS = 1e7


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera: pixel = (fx x/z + cx, fy y/z + cy), pixel centres at integers.

    Parameters
    ----------
    width, height : size of the image, pixels
    fx, fy : focal lengths, pixels
    cx, cy : principal point, pixels
    distortion : Brown-Conrady coefficients k1, k2, p1, p2[, k3] in OpenCV's order and
        meaning; empty for an image without distortion

    Raises
    ------
    InvalidIntrinsics : a size below 1, a focal length that is not positive and finite, a
        principal point that is not finite, or a number of coefficients other than 0, 4, 5.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise InvalidIntrinsics(
                f"The image size {self.width} x {self.height} is empty. "
                "Give the width and height of the depth image in pixels."
            )
        if self.width * self.height > MAXIMUM_SAMPLES:
            raise InvalidIntrinsics(
                f"The image size {self.width} x {self.height} exceeds the limit of "
                f"{MAXIMUM_SAMPLES} samples. Send the image at a lower resolution."
            )
        for name, value in (("fx", self.fx), ("fy", self.fy)):
            if not (math.isfinite(value) and value > 0):
                raise InvalidIntrinsics(
                    f"The focal length {name} = {value} is not a positive number, so pixels "
                    "have no direction. Give it in pixels, as the sensor's calibration states."
                )
            if not 1e-3 <= value <= MAXIMUM_PIXELS:
                raise InvalidIntrinsics(
                    f"The focal length {name} = {value:g} is that of no camera. "
                    "Give it in pixels, as the sensor's calibration states."
                )
        if not (math.isfinite(self.cx) and math.isfinite(self.cy)):
            raise InvalidIntrinsics(
                f"The principal point ({self.cx}, {self.cy}) is not finite. "
                "Give cx and cy in pixels, as the sensor's calibration states."
            )
        if max(abs(self.cx), abs(self.cy)) > MAXIMUM_PIXELS:
            raise InvalidIntrinsics(
                f"The principal point ({self.cx:g}, {self.cy:g}) is that of no camera. "
                "Give cx and cy in pixels, as the sensor's calibration states."
            )
        if len(self.distortion) not in (0, 4, 5):
            raise InvalidIntrinsics(
                f"{len(self.distortion)} distortion coefficients were given. "
                "Give k1, k2, p1, p2 and optionally k3, or none."
            )
        if not all(math.isfinite(k) for k in self.distortion):
            raise InvalidIntrinsics(
                f"The distortion coefficients {self.distortion} are not all finite. "
                "Give k1, k2, p1, p2 and optionally k3 as the calibration states."
            )

    def without_distortion(self) -> Intrinsics:
        """The same camera after its images have been undistorted."""
        return replace(self, distortion=())


@dataclass(frozen=True)
class Sphere:
    """The "camera" of a range image about a viewpoint: azimuth by elevation, in equal steps.

    With (a, b, c) the sensor's axes in cyclic order such that c is the pole, a direction has
    azimuth = atan2(b, a) and elevation = asin(c); column = (azimuth - left) / step, where azimuth
    counts on from that of column 0, and row = (top - elevation) / step. Centres at integers.

    Parameters
    ----------
    width, height : size of the image, pixels
    step : from pixel to pixel either way, radians
    left : azimuth of column 0, radians
    top : elevation of row 0, radians
    pole : 0, 1 or 2: the axis that elevation is measured towards

    Raises
    ------
    InvalidIntrinsics : no image, one of too many pixels, or one that covers more than a sphere.
    """

    width: int
    height: int
    step: float
    left: float
    top: float
    pole: int = 2

    def __post_init__(self) -> None:
        within = self.width >= 1 and self.height >= 1 and self.pole in (0, 1, 2)
        if not (within and math.isfinite(self.left) and math.isfinite(self.top)):
            raise InvalidIntrinsics(f"{self} is no range image. Sign the cloud again.")
        if self.width * self.height > MAXIMUM_SAMPLES:
            raise InvalidIntrinsics(
                f"A range image of {self.width} x {self.height} exceeds the limit of "
                f"{MAXIMUM_SAMPLES} samples. Sign the cloud with a coarser model."
            )
        # half a pixel more than a turn, or than half of one, is rounding
        if not (0 < (self.width - 1) * self.step < 2 * math.pi) or not (
            0 <= (self.height - 1) * self.step <= math.pi + self.step
        ):
            raise InvalidIntrinsics(f"{self} covers more than a sphere. Sign the cloud again.")

    @property
    def is_closed(self) -> bool:
        """Whether the last column is a neighbour of the first."""
        return self.width * self.step > 2 * math.pi - self.step / 2

    @property
    def sees_around(self) -> bool:
        """Whether three quarters of a turn or more are seen, whichever way the sensor is turned."""
        return self.width * self.step > 1.5 * math.pi


#: Either kind of looking.
Camera = Intrinsics | Sphere
