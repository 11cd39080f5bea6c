"""Sequences out: the files that `find_sequences` reads, each whole or absent.

Camera, depth (H, W), T_parent_sensor (4, 4)  -->  intrinsics.json, *.png, *.txt
rows of `trajectory_row`  --trajectory_text-->  what `read_trajectory` reads
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from sceneprint.atomic_files import write_whole
from sceneprint.types import Floats, Floats32
from sceneprint_client.poses import quaternion_of
from sceneprint_client.sidecars import INTRINSICS_FILE, Camera, rigid_transform

_LARGEST = 65_534  #: stored units; 65535 reads as missing


def write_intrinsics(folder: Path, camera: Camera) -> Path:
    """Write `intrinsics.json` into the folder and return its path."""
    lens = camera.intrinsics
    fields: dict[str, object] = {
        "width": lens.width,
        "height": lens.height,
        "fx": lens.fx,
        "fy": lens.fy,
        "cx": lens.cx,
        "cy": lens.cy,
        "depth_scale": camera.depth_scale,
    }
    if lens.distortion:
        fields["distortion"] = list(lens.distortion)
    if camera.along_ray:
        fields["depth_along_ray"] = True
    if camera.up is not None:
        fields["up"] = list(camera.up)
    path = folder / INTRINSICS_FILE
    write_whole(path, (json.dumps(fields, indent=2) + "\n").encode())
    return path


def write_depth_png(path: Path, depth: Floats32, depth_scale: float) -> None:
    """Write a depth image as a 16-bit greyscale PNG.

    Parameters
    ----------
    path : the file
    depth : (H, W) metres; what is not finite, not positive, or beyond 65534 stored units
        is written as 0, missing
    depth_scale : stored units per metre

    Raises
    ------
    ValueError : the depth is not two-dimensional or empty, or the scale is no positive
        number.
    """
    from PIL import Image

    if depth.ndim != 2 or depth.size == 0:
        raise ValueError(f"depth has shape {depth.shape}, not (H, W)")
    if not (math.isfinite(depth_scale) and depth_scale > 0):
        raise ValueError(f"depth_scale is {depth_scale}, not a positive number")
    with np.errstate(all="ignore"):
        units = np.rint(depth.astype(np.float64) * depth_scale)
        units[~((units > 0) & (units <= _LARGEST))] = 0.0
    buffer = io.BytesIO()
    Image.fromarray(units.astype(np.uint16)).save(buffer, format="PNG")
    write_whole(path, buffer.getvalue())


def write_pose(path: Path, T_parent_sensor: Floats) -> None:
    """Write a (4, 4) pose as text, row by row, without loss.

    Raises
    ------
    InvalidPose : it is not a rigid transform.
    """
    rows = rigid_transform(T_parent_sensor)
    text = "".join(" ".join(f"{value:.17g}" for value in row) + "\n" for row in rows)
    write_whole(path, text.encode())


def trajectory_row(stamp: float, T_parent_sensor: Floats) -> list[float]:
    """A pose (4, 4) as TUM has it: t tx ty tz qx qy qz qw, seconds and metres."""
    T = T_parent_sensor
    return [stamp, *T[:3, 3].tolist(), *quaternion_of(T[:3, :3]).tolist()]


def trajectory_text(rows: Iterable[Sequence[float]], comments: Iterable[str] = ()) -> str:
    """A TUM trajectory as text, without loss.

    Parameters
    ----------
    rows : of `trajectory_row`
    comments : lines of the head: the frames of the poses belong there. What is no printable
        ASCII is escaped
    """
    lines = [f"# {comment.encode('unicode_escape').decode('ascii')}" for comment in comments]
    lines += [" ".join(repr(float(number)) for number in row) for row in rows]
    return "\n".join([*lines, ""])
