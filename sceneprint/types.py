"""The records that travel between the parts: frames, and what is made of them.

Inside sceneprint lengths are metres, angles radians, times seconds; any other unit is
in the name. Camera frames are optical: x right, y down, z forward.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.cameras import MAXIMUM_PIXELS, MAXIMUM_SAMPLES, Camera, Intrinsics, Sphere

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints32 = NDArray[np.int32]
Bytes = NDArray[np.uint8]

__all__ = [
    "MAXIMUM_PIXELS",
    "MAXIMUM_SAMPLES",
    "AnyFrame",
    "Bytes",
    "Camera",
    "Cloud",
    "Floats",
    "Floats32",
    "Frame",
    "Geometry",
    "Hierarchy",
    "Intrinsics",
    "Ints32",
    "Patches",
    "Sphere",
    "Surface",
]


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
class Cloud:
    """One point cloud, as the geometry reads it.

    Parameters
    ----------
    points : (N, 3) float32, metres, in the sensor's axes, the viewpoint at the origin; all finite
    has_viewpoint : False for points that were not seen from one place, as those fused of many
        views: nothing is known of free space then
    name : what to call the frame in lines and errors
    pose : (4, 4) T_parent_sensor, or None where unknown; never read by the geometry
    note : what was done to the points on the way, for people; empty where nothing was
    """

    points: Floats32
    has_viewpoint: bool = True
    name: str = ""
    pose: Floats | None = None
    note: str = ""


#: A frame of either kind.
AnyFrame = Frame | Cloud


@dataclass(frozen=True, eq=False)
class Surface:
    """What the sensor saw, as an ordered map of points and normals.

    Points that are in no order, as those of a cloud, are a map of one row without a camera.

    Parameters
    ----------
    points : (h, w, 3) float32, metres, sensor frame; NaN-free, 0 where not valid
    normals : (h, w, 3) float32, unit length, towards the sensor; 0 where not valid
    valid : (h, w) bool
    areas : (h, w) float32, square metres of surface seen by each pixel; 0 where not valid
    camera : of this (reduced) map; None for points in no order
    """

    points: Floats32
    normals: Floats32
    valid: NDArray[np.bool_]
    areas: Floats32
    camera: Camera | None


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
