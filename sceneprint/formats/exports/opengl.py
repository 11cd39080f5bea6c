"""Conversion of OpenGL and ARKit cameras to optical axes, and validation of JSON values.

T_world_camera (OpenGL)  --optical-->  T_world_camera (optical)
Lens, size of the depth image  --depth_camera-->  Camera

The axes of OpenGL and ARKit cameras are x right, y up, z backward; optical axes are x right, y
down, z forward. OpenGL and ARKit measure the principal point from the corner of the image, so the
centre of the first pixel is at (0.5, 0.5) instead of (0, 0).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneprint.errors import DatasetError, InvalidPose, UnreadableFrame
from sceneprint.formats.dataset.frame_reference import (
    FrameReference,
    FrameSequence,
    Layout,
    count_lost,
)
from sceneprint.formats.depth_file import size_of
from sceneprint.types import Floats, Intrinsics
from sceneprint_client.errors import printable
from sceneprint_client.formats import HEAD, titles_of
from sceneprint_client.poses import rigid_transform
from sceneprint_client.sidecars import Camera, Position

#: Transform from optical to OpenGL axes: it inverts y and z.
_T_OPENGL_OPTICAL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Lens:
    """The pinhole camera of a colour image; the principal point is relative to the image's corner.

    Parameters
    ----------
    fx, fy, cx, cy : intrinsics, pixels
    width, height : size of the image, pixels
    distortion : k1, k2, p1, p2 and optionally k3; empty if there is none
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()


def optical(T_world_camera: Floats) -> Floats:
    """Convert the pose (4, 4) of a camera with OpenGL axes to the pose with optical axes."""
    return T_world_camera @ _T_OPENGL_OPTICAL


def depth_camera(
    lens: Lens, size: tuple[int, int], depth_scale: float, up: Position | None = None
) -> Camera:
    """Return the camera of a depth image that has the same view as a colour image.

    Parameters
    ----------
    lens : camera of the colour image
    size : width and height of the depth image, which may be smaller
    depth_scale : stored units per metre
    up : unit vector that points up, in optical axes; None if unknown

    Raises
    ------
    DatasetError : If the images have different aspect ratios.
    InvalidIntrinsics : If the camera is invalid.
    """
    across, down = size[0] / lens.width, size[1] / lens.height
    if not math.isclose(across, down, rel_tol=0.02):
        raise DatasetError(
            f"The depth image has {size[0]} x {size[1]} pixels, but the camera has the aspect "
            f"ratio {lens.width} x {lens.height}. Export both in the same orientation."
        )
    intrinsics = Intrinsics(
        width=size[0], height=size[1], fx=lens.fx * across, fy=lens.fy * down,
        cx=lens.cx * across - 0.5, cy=lens.cy * down - 0.5, distortion=lens.distortion,
    )  # fmt: skip
    return Camera(intrinsics, depth_scale, up=up)


def depth_size(path: Path) -> tuple[int, int]:
    """Return the width and height of a depth image from its first bytes.

    Raise UnreadableFrame if the file cannot be read, or is not a depth image.
    """
    try:
        with path.open("rb") as file:
            head = file.read(HEAD)
    except OSError as cause:
        raise UnreadableFrame(
            f"{path.name}: The file cannot be read ({cause.strerror}). Check its permissions."
        ) from cause
    size = size_of(head)
    if size is None or 0 in size:
        raise UnreadableFrame(
            f"{path.name}: The format is none of {titles_of('depth')}. Copy the file again."
        )
    return size


def number(value: object, what: str) -> float:
    """Return a JSON value as a float; raise DatasetError unless it is a finite number."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            if math.isfinite(value):
                return float(value)
        except OverflowError:
            pass
    raise DatasetError(f"{what} is {value!r:.40}, not a finite number. Export the file again.")


def pixels(value: object, what: str) -> int:
    """Return a JSON value as an int; raise DatasetError unless it is a size in pixels."""
    size = number(value, what)
    if not 1 <= size <= 1e6 or size != int(size):
        raise DatasetError(f"{what} is {size:g}, not a size in pixels. Export the file again.")
    return int(size)


def transform(rows: object, what: str) -> Floats:
    """Return the transform (4, 4) of 3 or 4 rows; raise DatasetError unless it is rigid."""
    T = np.eye(4)
    if not isinstance(rows, list) or len(rows) not in (3, 4):
        raise DatasetError(f"{what} does not have 3 or 4 rows. Export the file again.")
    for place, row in enumerate(rows):
        if not isinstance(row, list) or len(row) != 4:
            raise DatasetError(f"{what} has a row without 4 numbers. Export the file again.")
        T[place] = [number(value, what) for value in row]
    try:
        return rigid_transform(T)
    except InvalidPose as cause:
        raise DatasetError(f"{what} is invalid: {cause}") from cause


def sequence_of(
    folder: Path, layout: Layout, name: str, frames: Sequence[FrameReference],
    left_out: Counter[str], remedy: str,
) -> FrameSequence:  # fmt: skip
    """Return a sequence whose note lists the omitted frames.

    Parameters
    ----------
    frames : frames in order
    left_out : number of omitted frames by reason
    remedy : advice for users if there are no frames

    Raises
    ------
    DatasetError : If there are no frames.
    """
    reasons = [f"{count} {printable(reason)}" for reason, count in left_out.most_common(5)]
    if not frames:
        why = f" ({'; '.join(reasons)})" if reasons else ""
        raise DatasetError(
            f"{folder}: No frame of this {layout.value} export has depth{why}. {remedy}"
        )
    note = f"{len(frames)} frames of {layout.value} used"
    note += f"; skipped: {'; '.join(reasons)}" if reasons else ""
    lost = count_lost(left_out)
    return FrameSequence(name, folder, layout, name, None, tuple(frames), note, lost=lost)
