"""The door for frames: stored samples and a camera in, a `Frame` out.

bytes  --decode_png | decode_npy-->  samples (H, W)  --make_frame-->  Frame
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.datasets import npy, png
from sceneprint.datasets.files import read_bytes
from sceneprint.errors import InvalidIntrinsics, UnreadableFrame, UselessFrame, naming
from sceneprint.geometry.rectification import ray_to_axis, undistort
from sceneprint.geometry.rigid import rigid_transform
from sceneprint.scans.npy_headers import SIGNATURE
from sceneprint.types import Floats, Floats32, Frame, Intrinsics

#: What some sensors store, besides 0, where they measured nothing.
_MISSING = 65_535


def make_frame(
    samples: NDArray[Any],
    intrinsics: Intrinsics,
    *,
    depth_scale: float = 1000.0,
    along_ray: bool = False,
    name: str = "",
    pose: Floats | None = None,
) -> Frame:
    """Return the frame that the geometry reads: metres, z along the axis, no distortion.

    Parameters
    ----------
    samples : (H, W) uint16 in stored units, 0 and 65535 where missing; or floating in
        metres, NaN, infinite and <= 0 where missing
    intrinsics : the camera that took the image, with its distortion
    depth_scale : stored units per metre; floating samples are metres whatever it is
    along_ray : the samples are ranges along the pixel's ray and not z
    name : what to call the frame in lines and errors
    pose : (4, 4) T_parent_sensor, or None where unknown

    Returns
    -------
    frame : depth (H, W) float32, metres, 0 where missing

    Raises
    ------
    UnreadableFrame : the samples are of another type or not two-dimensional.
    InvalidIntrinsics : they do not fit the image, or the depth scale is no positive number.
    InvalidPose : the pose is not a rigid transform.
    UselessFrame : no sample remains.
    """
    with naming(name):
        if not (math.isfinite(depth_scale) and depth_scale > 0):
            raise InvalidIntrinsics(
                f"The depth scale {depth_scale} is not a positive number. "
                "Give the stored units per metre, 1000 for millimetres."
            )
        depth = _metres(samples, depth_scale)
        height, width = depth.shape
        if (width, height) != (intrinsics.width, intrinsics.height):
            raise InvalidIntrinsics(
                f"The image has {width} x {height} pixels, the intrinsics are of "
                f"{intrinsics.width} x {intrinsics.height}. Give those of this image, as a "
                "resized image has others."
            )
        # the ray of a sample is that of the distorted pixel, so before undistorting
        if along_ray:
            depth = ray_to_axis(depth, intrinsics)
        if intrinsics.distortion:
            depth = undistort(depth, intrinsics)
        if not depth.any():
            raise UselessFrame(
                f"All {depth.size} samples are missing. Check that the sensor saw something "
                "within its range."
            )
        return Frame(
            depth=depth,
            intrinsics=intrinsics.without_distortion(),
            name=name,
            pose=None if pose is None else rigid_transform(pose),
        )


def read_frame(
    path: Path,
    intrinsics: Intrinsics,
    *,
    depth_scale: float = 1000.0,
    along_ray: bool = False,
    name: str = "",
    pose: Floats | None = None,
) -> Frame:
    """Return the frame of a PNG or NPY file; its content tells which, not its name.

    Parameters
    ----------
    path : the file; the rest as for `make_frame`

    Raises
    ------
    UnreadableFrame : the file is absent or too large; and as `decode_frame`. Each error names
        the file.
    """
    data = read_bytes(path, png.MAXIMUM_BYTES, UnreadableFrame)
    with naming(str(path)):
        frame = decode_frame(
            data, intrinsics, depth_scale=depth_scale, along_ray=along_ray, pose=pose
        )
    return replace(frame, name=name)


def decode_frame(
    data: bytes,
    intrinsics: Intrinsics,
    *,
    depth_scale: float = 1000.0,
    along_ray: bool = False,
    name: str = "",
    pose: Floats | None = None,
) -> Frame:
    """Return the frame of the bytes of a PNG or NPY file.

    Parameters
    ----------
    data : the whole file; the rest as for `make_frame`

    Raises
    ------
    UnreadableFrame : neither PNG nor NPY; and as `decode_png`, `decode_npy` and `make_frame`.
    """
    with naming(name):
        frame = make_frame(
            _decode(data), intrinsics, depth_scale=depth_scale, along_ray=along_ray, pose=pose
        )
    return replace(frame, name=name)


def _decode(data: bytes) -> NDArray[np.uint16] | Floats32:
    if not data:
        raise UnreadableFrame("The file is empty. Copy or write it again.")
    if data.startswith(png.SIGNATURE):
        return png.decode_png(data)
    if data.startswith(SIGNATURE):
        return npy.decode_npy(data)
    raise UnreadableFrame(
        "This is neither PNG nor NPY. Write the depth as a 16-bit greyscale PNG, or as a "
        "float32 array in metres with numpy.save."
    )


def _metres(samples: NDArray[Any], depth_scale: float) -> Floats32:
    """Return (H, W) float32 metres, 0 where missing."""
    if not isinstance(samples, np.ndarray):
        raise TypeError(f"samples must be a numpy array, not {type(samples).__name__}")
    if samples.ndim != 2 or samples.size == 0:
        raise UnreadableFrame(
            f"The samples have shape {samples.shape}, and a depth image has two dimensions. "
            "Send one image of height x width."
        )
    with np.errstate(all="ignore"):  # what overflows float32 is missing
        if samples.dtype.kind == "u" and samples.dtype.itemsize == 2:
            values = np.arange(_MISSING + 1, dtype=np.uint16)
            if samples.size > values.size:  # fewer values than samples: each is divided once
                return np.ascontiguousarray(_metres(values[None], depth_scale)[0][samples])
            depth = (samples / depth_scale).astype(np.float32)
            depth[samples == _MISSING] = 0.0
        elif samples.dtype.kind == "f":
            depth = np.array(samples, dtype=np.float32, order="C")
        else:
            raise UnreadableFrame(
                f"The samples are {samples.dtype}, and depth is uint16 in stored units or "
                "float32 in metres. Convert them."
            )
        depth[~(np.isfinite(depth) & (depth > 0.0))] = 0.0
    return depth
