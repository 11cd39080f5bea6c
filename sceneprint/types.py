"""The records that travel between the parts: frames and their camera.

Inside sceneprint lengths are metres, angles radians, times seconds; any other unit is
in the name. Camera frames are optical: x right, y down, z forward.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import InvalidIntrinsics

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints32 = NDArray[np.int32]
Bytes = NDArray[np.uint8]

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


@dataclass(frozen=True, eq=False)
class Frame:
    """One depth image, undistorted, as the geometry reads it.

    Parameters
    ----------
    depth : (H, W) float32, metres along the optical axis (z); 0 where missing
    intrinsics : the camera, without distortion
    name : what to call the frame in lines and errors
    pose : (4, 4) T_parent_sensor, or None where unknown; never read by the geometry
    """

    depth: Floats32
    intrinsics: Intrinsics
    name: str = ""
    pose: Floats | None = None


@dataclass(frozen=True, eq=False)
class Surface:
    """What the sensor saw, as an ordered map of points and normals.

    Parameters
    ----------
    points : (h, w, 3) float32, metres, sensor frame; NaN-free, 0 where not valid
    normals : (h, w, 3) float32, unit length, towards the sensor; 0 where not valid
    valid : (h, w) bool
    areas : (h, w) float32, square metres of surface seen by each pixel; 0 where not valid
    intrinsics : the camera of this (reduced) map
    """

    points: Floats32
    normals: Floats32
    valid: NDArray[np.bool_]
    areas: Floats32
    intrinsics: Intrinsics


@dataclass(frozen=True, eq=False)
class Patches:
    """Surface patches of one level, {x_i} of Sec. III.

    Parameters
    ----------
    means : (P, 3) float64, metres: l of Eq. (1)
    normals : (P, 3) float64, unit length, towards the sensor: n of Eq. (1)
    areas : (P,) float64, square metres
    sizes : (P,) int32, pixels of the surface map
    coherences : (P,) float64 in (0, 1], length of the mean of the pixels' normals; 1 where flat
    """

    means: Floats
    normals: Floats
    areas: Floats
    sizes: Ints32
    coherences: Floats

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """The segmentation hierarchy {X_h} of Sec. III-F, finest level first.

    Parameters
    ----------
    levels : H levels of patches
    labels : H maps (h, w) int32: index of each pixel's patch in that level, -1 for none
    """

    levels: tuple[Patches, ...]
    labels: tuple[Ints32, ...]


@dataclass(frozen=True, eq=False)
class Geometry:
    """What validation needs of a frame, and all it needs: the geometry artifact.

    Parameters
    ----------
    surface : (h, w) points and normals
    patches : P patches of one metric size, for correspondences
    descriptors : (P, d) uint8, macro-scale surroundings of each patch; compared by distance
    model_id : of the model that made it; artifacts of two models are never compared
    """

    surface: Surface
    patches: Patches
    descriptors: Bytes
    model_id: str
