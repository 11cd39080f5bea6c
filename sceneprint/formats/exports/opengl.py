"""Cameras as graphics and ARKit describe them: axes, principal points, sizes; frames of a folder.

T_world_camera (OpenGL)  --optical-->  T_world_camera (optical)
Lens, size of the depth image  --depth_camera-->  Camera

In OpenGL's and ARKit's axes a camera has x to the right, y up and z backward; ours are optical: x
right, y down, z forward. Their principal point is measured from the corner of the image, so that
the centre of the first pixel is at (0.5, 0.5); ours has it at (0, 0).
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

#: From optical axes to those of OpenGL: y and z point the other way.
_T_OPENGL_OPTICAL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Lens:
    """A pinhole camera of a colour image; the principal point is measured from its corner.

    Parameters
    ----------
    fx, fy, cx, cy : pixels
    width, height : of the image
    distortion : k1, k2, p1, p2 and optionally k3; empty for none
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()


def optical(T_world_camera: Floats) -> Floats:
    """Return the pose of optical axes (4, 4), of one of OpenGL's axes (4, 4)."""
    return T_world_camera @ _T_OPENGL_OPTICAL


def depth_camera(
    lens: Lens, size: tuple[int, int], depth_scale: float, up: Position | None = None
) -> Camera:
    """Return the camera of a depth image that shows what a colour image shows.

    Parameters
    ----------
    lens : of the colour image
    size : width and height of the depth image, which may be smaller
    depth_scale : stored units per metre
    up : unit vector in optical axes, or None

    Raises
    ------
    DatasetError : the depth image is of another shape than the colour image.
    InvalidIntrinsics : the camera is none.
    """
    across, down = size[0] / lens.width, size[1] / lens.height
    if not math.isclose(across, down, rel_tol=0.02):
        raise DatasetError(
            f"The depth image has {size[0]} x {size[1]} pixels and the camera {lens.width} x "
            f"{lens.height}, which is of another shape. Export both in one orientation."
        )
    intrinsics = Intrinsics(
        width=size[0], height=size[1], fx=lens.fx * across, fy=lens.fy * down,
        cx=lens.cx * across - 0.5, cy=lens.cy * down - 0.5, distortion=lens.distortion,
    )  # fmt: skip
    return Camera(intrinsics, depth_scale, up=up)


def depth_size(path: Path) -> tuple[int, int]:
    """Return width and height of a depth image, by its first bytes.

    Raises
    ------
    UnreadableFrame : the file cannot be read, or is of no format of depth.
    """
    try:
        with path.open("rb") as file:
            head = file.read(HEAD)
    except OSError as cause:
        raise UnreadableFrame(
            f"{path.name}: The file cannot be read ({cause.strerror}). Check your rights."
        ) from cause
    size = size_of(head)
    if size is None or 0 in size:
        raise UnreadableFrame(f"{path.name}: This is none of {titles_of('depth')}. Copy it again.")
    return size


# Values of JSON files.


def number(value: object, what: str) -> float:
    """Return a finite number of a JSON file; DatasetError where it is none."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            if math.isfinite(value):
                return float(value)
        except OverflowError:
            pass
    raise DatasetError(f"{what} is {value!r:.40}, not a finite number. Export it again.")


def pixels(value: object, what: str) -> int:
    """Return a size of a JSON file in pixels; DatasetError where it is none."""
    size = number(value, what)
    if not 1 <= size <= 1e6 or size != int(size):
        raise DatasetError(f"{what} is {size:g}, not a size in pixels. Export it again.")
    return int(size)


def transform(rows: object, what: str) -> Floats:
    """Return a transform (4, 4) of 3 or 4 rows of a JSON file; DatasetError if it is not rigid."""
    T = np.eye(4)
    if not isinstance(rows, list) or len(rows) not in (3, 4):
        raise DatasetError(f"{what} has not 3 or 4 rows. Export it again.")
    for place, row in enumerate(rows):
        if not isinstance(row, list) or len(row) != 4:
            raise DatasetError(f"{what} has a row without 4 numbers. Export it again.")
        T[place] = [number(value, what) for value in row]
    try:
        return rigid_transform(T)
    except InvalidPose as cause:
        raise DatasetError(f"{what} is none: {cause}") from cause


# Sequences.


def sequence_of(
    folder: Path, layout: Layout, name: str, frames: Sequence[FrameReference],
    left_out: Counter[str], remedy: str,
) -> FrameSequence:  # fmt: skip
    """Return a sequence whose note says what was left out.

    Parameters
    ----------
    folder : or file, of the frames
    layout, name : of the sequence
    frames : in order
    left_out : number of frames by the reason
    remedy : what to do where no frame is there

    Raises
    ------
    DatasetError : there is no frame.
    """
    reasons = [f"{count} {printable(reason)}" for reason, count in left_out.most_common(5)]
    if not frames:
        why = f" ({'; '.join(reasons)})" if reasons else ""
        raise DatasetError(
            f"{folder}: No frame of this {layout.value} export has depth{why}. {remedy}"
        )
    note = f"{len(frames)} frames of {layout.value} taken"
    note += f"; left out: {'; '.join(reasons)}" if reasons else ""
    lost = count_lost(left_out)
    return FrameSequence(name, folder, layout, name, None, tuple(frames), note, lost=lost)
