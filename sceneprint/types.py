"""Records that modules exchange: frames, and the data computed from them.

Lengths are metres, angles radians, times seconds; other units are in the name. Camera frames are
optical: x right, y down, z forward. Clouds use their sensor's axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import InvalidIntrinsics
from sceneprint_client.api.base import MAXIMUM_PIXELS, MAXIMUM_SAMPLES, Intrinsics

__all__ = [
    "MAXIMUM_PIXELS",
    "MAXIMUM_SAMPLES",
    "AnyFrame",
    "Bytes",
    "Camera",
    "Cloud",
    "DepthFrame",
    "Floats",
    "Floats32",
    "Geometry",
    "Hierarchy",
    "Intrinsics",
    "Ints32",
    "Patches",
    "ReferenceSurface",
    "Sphere",
    "Surface",
]


@dataclass(frozen=True)
class Sphere:
    """The camera of a range image around a viewpoint, with equal steps in azimuth and elevation.

    Let (a, b, c) be the sensor's axes in cyclic order, with c as the pole. A direction has
    azimuth = atan2(b, a) and elevation = asin(c); column = (azimuth - left) / step, with the
    azimuth relative to column 0, and row = (top - elevation) / step. Pixel centres are at integers.

    Parameters
    ----------
    width, height : size of the image, pixels
    step : angle between adjacent pixels, radians
    left : azimuth of column 0, radians
    top : elevation of row 0, radians
    pole : index of the axis of elevation: 0, 1 or 2

    Raises
    ------
    InvalidIntrinsics : If the image is empty, has too many pixels, or covers more than a sphere
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
            raise InvalidIntrinsics(f"{self} is not a range image. Sign the cloud again.")
        if self.width * self.height > MAXIMUM_SAMPLES:
            raise InvalidIntrinsics(
                f"A range image of {self.width} x {self.height} exceeds the limit of "
                f"{MAXIMUM_SAMPLES} samples. Sign the cloud with a coarser model."
            )
        # rounding errors can extend the image beyond the sphere by half a pixel
        if not (0 < (self.width - 1) * self.step < 2 * math.pi) or not (
            0 <= (self.height - 1) * self.step <= math.pi + self.step
        ):
            raise InvalidIntrinsics(f"{self} covers more than a sphere. Sign the cloud again.")

    @property
    def is_closed(self) -> bool:
        """Return whether the last column adjoins the first."""
        return self.width * self.step > 2 * math.pi - self.step / 2

    @property
    def sees_around(self) -> bool:
        """Return whether the image covers more than three quarters of a turn."""
        return self.width * self.step > 1.5 * math.pi


#: The camera of a surface.
Camera = Intrinsics | Sphere


Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints32 = NDArray[np.int32]
Ints64 = NDArray[np.int64]
Bytes = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """An undistorted depth image, from which signatures and artifacts are computed.

    Parameters
    ----------
    depth : (H, W) float32, metres along the optical axis (z); 0 if missing
    intrinsics : intrinsics without distortion
    name : name of the frame in messages
    pose : (4, 4) T_parent_sensor; None if unknown. The signature does not depend on it
    """

    depth: Floats32
    intrinsics: Intrinsics
    name: str = ""
    pose: Floats | None = None


@dataclass(frozen=True, eq=False)
class Cloud:
    """A point cloud, from which signatures and artifacts are computed.

    Parameters
    ----------
    points : (N, 3) float32, metres, in the sensor's axes, with the viewpoint at the origin; finite
    has_viewpoint : whether all points were observed from the origin; False for fused points, whose
        free space is unknown
    name : name of the frame in messages
    pose : (4, 4) T_parent_sensor; None if unknown. The signature does not depend on it
    note : description of earlier changes to the points, for display; may be empty
    """

    points: Floats32
    has_viewpoint: bool = True
    name: str = ""
    pose: Floats | None = None
    note: str = ""


@dataclass(frozen=True, eq=False)
class ReferenceSurface:
    """A surface that was imported as a map: a point cloud or a triangle mesh.

    Parameters
    ----------
    points : (N, 3) float32, metres, relative to `offset`; finite
    triangles : (M, 3) int32 indices of points, counterclockwise as seen from the front; None for a
        cloud
    offset : (3,) float64, metres; points + offset are the coordinates in the file. It is zero
        unless the points are more than a kilometre from the origin
    up : (3,) float64, unit vector that points up, against gravity
    """

    points: Floats32
    triangles: Ints32 | None
    offset: Floats
    up: Floats


#: A depth image or a cloud.
AnyFrame = DepthFrame | Cloud


@dataclass(frozen=True, eq=False)
class Surface:
    """The observed surface, as an image of points and normals.

    Unordered points, such as a fused cloud, form an image of one row without a camera.

    Parameters
    ----------
    points : (h, w, 3) float32, metres, in the sensor's frame; 0 if invalid, never NaN
    normals : (h, w, 3) float32 unit vectors towards the sensor; 0 if invalid
    valid : (h, w) bool
    areas : (h, w) float32, square metres of surface per pixel; 0 if invalid
    camera : camera of this image; None for unordered points
    spread : for a scan, unordered points that are evenly distributed over its surface
        (`range_image.spread_points`); None for other frames
    """

    points: Floats32
    normals: Floats32
    valid: NDArray[np.bool_]
    areas: Floats32
    camera: Camera | None
    spread: Surface | None = field(default=None, kw_only=True)

    @property
    def fitted(self) -> Surface:
        """Return the surface for fine alignment: the spread points of a scan, else this surface."""
        return self if self.spread is None else self.spread


@dataclass(frozen=True, eq=False)
class Patches:
    """The surface patches of one level, {x_i} of Sec. III.

    Parameters
    ----------
    means : (P, 3) float64, metres; l of Eq. (1)
    normals : (P, 3) float64 unit vectors towards the sensor; n of Eq. (1)
    areas : (P,) float64, square metres
    sizes : (P,) int32, number of pixels
    coherences : (P,) float64 in (0, 1], length of the mean of the pixels' normals; 1 if flat
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
    labels : H images (h, w) int32, index of each pixel's patch in the level; -1 without a patch
    """

    levels: tuple[Patches, ...]
    labels: tuple[Ints32, ...]


@dataclass(frozen=True, eq=False)
class Geometry:
    """The geometry artifact of a frame: all data that validation requires.

    Parameters
    ----------
    surface : (h, w) points and normals
    patches : P patches of the same metric size, for correspondences
    descriptors : (P, d) uint8, descriptors of the patches' macro-scale surroundings
    model_id : id of the model; artifacts of different models cannot be compared
    """

    surface: Surface
    patches: Patches
    descriptors: Bytes
    model_id: str


#: Kinds of cameras; NOWHERE stands for unordered points without a camera.
PINHOLE, SPHERE, NOWHERE = 0, 1, 2


def camera_of(camera: Camera | None, nearest: float) -> Floats:
    """Return a camera as an array (7,) for kernels: its kind, `nearest` and five parameters.

    Parameters
    ----------
    camera : camera; None for unordered points
    nearest : minimum depth at which kernels project points, metres
    """
    if isinstance(camera, Intrinsics):
        return np.array([PINHOLE, nearest, camera.fx, camera.fy, camera.cx, camera.cy, 0.0])
    if isinstance(camera, Sphere):
        closed = camera.width if camera.is_closed else 0
        return np.array(
            [SPHERE, nearest, camera.step, camera.left, camera.top, camera.pole, closed], float
        )
    return np.array([NOWHERE, nearest, 0.0, 0.0, 0.0, 0.0, 0.0])


def kind_of(camera: Camera | None) -> int:
    """Return the kind of a camera, the first element of `camera_of`."""
    return int(camera_of(camera, 0.0)[0])
