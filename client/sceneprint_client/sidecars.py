"""What lies beside a frame's file: its camera, how its points are read, its pose.

folder  --find_camera-->  Camera          `intrinsics.json` beside the frames or above them
folder  --find_cloud_source-->  CloudSource          `clouds.json` likewise, or nothing
text  --read_pose-->  T_parent_sensor (4, 4)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from sceneprint_client.api.base import Intrinsics
from sceneprint_client.errors import DatasetError, InvalidIntrinsics, InvalidPose
from sceneprint_client.files import naming, read_object, read_text
from sceneprint_client.formats import CloudFormat
from sceneprint_client.poses import TOLERANCE, rigid_transform

#: A place, metres, or a direction.
Position = tuple[float, float, float]
_NO_UP = (
    "up is {}, no direction. Write a list of three numbers of length 1 in the sensor's axes, such "
    "as [0, -1, 0] of a camera that is held level."
)
_PARENTS = 4  #: folders above the frames that are looked into
_MAXIMUM_BYTES = 65_536


INTRINSICS_FILE = "intrinsics.json"
_INTRINSICS_EXAMPLE = (
    '{"width": 640, "height": 480, "fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5, '
    '"depth_scale": 1000}'
)
_REQUIRED = ("width", "height", "fx", "fy", "cx", "cy")
_OPTIONAL = ("depth_scale", "distortion", "depth_along_ray", "up")


@dataclass(frozen=True)
class Camera:
    """A sensor: its lens, and how it stores depth.

    Parameters
    ----------
    intrinsics : of the depth images, with their distortion
    depth_scale : stored units per metre
    along_ray : depth is the range along the pixel's ray and not z
    up : unit vector in the camera's axes, of one that is carried level; None where not known

    Raises
    ------
    InvalidIntrinsics : the depth scale is no positive number, or `up` not of length 1.
    """

    intrinsics: Intrinsics
    depth_scale: float = 1000.0
    along_ray: bool = False
    up: Position | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.depth_scale) and self.depth_scale > 0):
            raise InvalidIntrinsics(
                f"The depth scale {self.depth_scale} is not a positive number. "
                "Give the stored units per metre, 1000 for millimetres."
            )
        if self.up is not None and not is_unit(self.up):
            raise InvalidIntrinsics(_NO_UP.format(self.up))


def is_unit(vector: Position) -> bool:
    """Return whether three numbers are of length 1, to a hundredth."""
    return abs(math.hypot(*vector) - 1.0) <= TOLERANCE


def find_camera(folder: Path) -> Camera:
    """Return the camera of the nearest `intrinsics.json`, here or up to 4 folders above.

    Raises
    ------
    DatasetError : there is none; the message shows one to write.
    InvalidIntrinsics : as `read_camera`.
    """
    absolute = folder.resolve() if ".." in folder.parts else folder.absolute()
    for place in (absolute, *absolute.parents[:_PARENTS]):
        candidate = place / INTRINSICS_FILE
        if candidate.is_file():
            return read_camera(candidate)
    raise DatasetError(
        f"{folder}: There is no {INTRINSICS_FILE} here or in the {_PARENTS} folders above, so the "
        f"camera is unknown. Write one such as {_INTRINSICS_EXAMPLE} (pixels; depth_scale is "
        "stored units per metre)."
    )


def read_camera(path: Path) -> Camera:
    """Return the camera that a JSON file describes.

    Fields: width, height, fx, fy, cx, cy in pixels; and, if they differ from what is said
    here, depth_scale (1000), distortion (none), depth_along_ray (false), up (not known).

    Raises
    ------
    InvalidIntrinsics : the file cannot be read, is no JSON object, lacks a field, has one
        too many, or a value that no camera has; names the file.
    """
    fields = read_object(path, _MAXIMUM_BYTES, InvalidIntrinsics, _INTRINSICS_EXAMPLE)
    with naming(str(path)):
        return _camera(fields)


def _camera(fields: dict[str, object]) -> Camera:
    missing = [name for name in _REQUIRED if name not in fields]
    if missing:
        raise InvalidIntrinsics(
            f"{', '.join(missing)} is missing. Write it such as {_INTRINSICS_EXAMPLE}."
        )
    unknown = sorted(set(fields) - {*_REQUIRED, *_OPTIONAL})
    if unknown:
        # a misspelt optional field would otherwise be silently without effect
        raise InvalidIntrinsics(
            f"{', '.join(unknown)!r:.80} is no field of it. "
            f"The fields are {', '.join((*_REQUIRED, *_OPTIONAL))}."
        )
    distortion = fields.get("distortion", [])
    if not isinstance(distortion, list):
        raise InvalidIntrinsics("distortion is no list. Write k1, k2, p1, p2 and optionally k3.")
    along_ray = fields.get("depth_along_ray", False)
    if not isinstance(along_ray, bool):
        raise InvalidIntrinsics("depth_along_ray is neither true nor false. Write one of them.")
    return Camera(
        Intrinsics(
            width=_whole(fields, "width"),
            height=_whole(fields, "height"),
            fx=_intrinsics_number("fx", fields["fx"]),
            fy=_intrinsics_number("fy", fields["fy"]),
            cx=_intrinsics_number("cx", fields["cx"]),
            cy=_intrinsics_number("cy", fields["cy"]),
            distortion=tuple(_intrinsics_number("distortion", value) for value in distortion),
        ),
        depth_scale=_intrinsics_number("depth_scale", fields.get("depth_scale", 1000)),
        along_ray=along_ray,
        up=_camera_up(fields.get("up")),
    )


def _camera_up(told: object) -> Position | None:
    if told is None:
        return None
    if not isinstance(told, list) or len(told) != len("xyz"):
        raise InvalidIntrinsics(_NO_UP.format(f"{told!r:.60}"))
    x, y, z = (_intrinsics_number("up", value) for value in told)
    return x, y, z


def _whole(fields: dict[str, object], name: str) -> int:
    value = fields[name]
    if isinstance(value, bool) or not isinstance(value, int):
        raise InvalidIntrinsics(
            f"{name} is {value!r:.40}, not a whole number. Write the size in pixels."
        )
    return value


def _intrinsics_number(name: str, value: object) -> float:
    # bool is a kind of int in Python; "true" is no length in pixels
    if not isinstance(value, bool) and isinstance(value, int | float):
        try:
            return float(value)
        except OverflowError:
            pass
    raise InvalidIntrinsics(f"{name} is {value!r:.40}, not a number. Write it as one.")


# How points are read.


CLOUDS_FILE = "clouds.json"
_CLOUDS_EXAMPLE = (
    '{"viewpoint": {"x": 0, "y": 0, "z": 1.7}, "units_per_metre": 1, "format": "kitti"}'
)
_FIELDS = ("viewpoint", "units_per_metre", "format", "up", "row")
_LONGEST_ROW = 32
_FORMATS: tuple[CloudFormat, ...] = get_args(CloudFormat)


class Unsaid(Enum):
    """What is given for a viewpoint of which nothing is said: the file says it, or the origin."""

    UNSAID = "unsaid"


UNSAID = Unsaid.UNSAID


@dataclass(frozen=True)
class CloudSource:
    """How a file of points is to be read.

    Parameters
    ----------
    file_format : of it, or None: its first bytes tell
    viewpoint : where the sensor was, metres in the file's axes; None for points of many views;
        UNSAID: as the file says, else the origin
    units_per_metre : of its coordinates
    up : unit vector in the file's axes, of a sensor that is carried level; None where not known
    row : names of the float32 in each row of a .bin file, such as x, y, z, i, ring; None: x, y, z
        and intensity
    """

    file_format: CloudFormat | None = None
    viewpoint: Position | Unsaid | None = UNSAID
    units_per_metre: float = 1.0
    up: Position | None = None
    row: tuple[str, ...] | None = None


def row_of(text: str) -> tuple[str, ...]:
    """Return the names of the values of a row, of text such as x,y,z,i,ring.

    Raises
    ------
    DatasetError : x, y or z is not among them once, or they are more than 32.
    """
    names = tuple(name.strip().lower() for name in text.split(","))
    if any(names.count(axis) != 1 for axis in "xyz") or len(names) > _LONGEST_ROW:
        raise DatasetError(
            f"The row {text!r:.80} does not name x, y and z once each, or more than "
            f"{_LONGEST_ROW} values. Write it such as x,y,z,i,ring."
        )
    return names


def find_cloud_source(folder: Path) -> CloudSource:
    """Return what the nearest `clouds.json` says, here or up to 4 folders above; without one,
    nothing is said.

    Raises
    ------
    DatasetError : it cannot be read, is no JSON object, or has a field or value that is none.
    """
    absolute = folder.resolve() if ".." in folder.parts else folder.absolute()
    for place in (absolute, *absolute.parents[:_PARENTS]):
        candidate = place / CLOUDS_FILE
        if candidate.is_file():
            return _read_source(candidate)
    return CloudSource()


def _read_source(path: Path) -> CloudSource:
    fields = read_object(path, _MAXIMUM_BYTES, DatasetError, _CLOUDS_EXAMPLE)
    with naming(str(path)):
        unknown = sorted(set(fields) - {*_FIELDS})
        if unknown:
            raise DatasetError(
                f"{', '.join(unknown)!r:.80} is no field of it. "
                f"The fields are {', '.join(_FIELDS)}."
            )
        file_format = fields.get("format")
        if file_format is not None and file_format not in _FORMATS:
            raise DatasetError(f"format is {file_format!r:.40}. Known are {', '.join(_FORMATS)}.")
        units = _cloud_number("units_per_metre", fields.get("units_per_metre", 1.0))
        if not units > 0.0:
            raise DatasetError(f"units_per_metre is {units}. Write 1000 for millimetres.")
        row = fields.get("row")
        if row is not None and file_format not in (None, "kitti"):
            raise DatasetError(f"row is of .bin files, and format is {file_format}. Leave one out.")
        return CloudSource(
            file_format, _viewpoint(fields), units, _cloud_up(fields.get("up")),
            None if row is None else row_of(str(row)),
        )  # fmt: skip


def _cloud_up(told: object) -> Position | None:
    if told is None:
        return None
    if isinstance(told, list) and len(told) == len("xyz"):
        x, y, z = (_cloud_number("up", value) for value in told)
        if is_unit((x, y, z)):
            return x, y, z
    raise DatasetError(_NO_UP.format(f"{told!r:.60}"))


def _viewpoint(fields: dict[str, object]) -> Position | Unsaid | None:
    if "viewpoint" not in fields:
        return UNSAID
    told = fields["viewpoint"]
    if told is None:
        return None
    if not isinstance(told, dict) or set(told) != {"x", "y", "z"}:
        raise DatasetError(
            f"viewpoint is {told!r:.60}. Write it such as {_CLOUDS_EXAMPLE}, or null for points "
            "that were not seen from one place."
        )
    return (
        _cloud_number("x", told["x"]),
        _cloud_number("y", told["y"]),
        _cloud_number("z", told["z"]),
    )


def _cloud_number(name: str, value: object) -> float:
    if not isinstance(value, bool) and isinstance(value, int | float):
        try:
            number = float(value)
        except OverflowError:  # JSON has whole numbers of any length
            number = math.inf
        if math.isfinite(number):
            return number
    raise DatasetError(f"{name} is {value!r:.40}, no finite number. Write it as one.")


# Poses.

_MAXIMUM_POSE_BYTES = 65_536


def read_pose(path: Path) -> NDArray[np.float64]:
    """Return T_parent_sensor (4, 4) of a text file with 16 numbers, row by row.

    Raises
    ------
    InvalidPose : the file cannot be read, or as `rigid_transform`; names the file.
    """
    words = read_text(path, _MAXIMUM_POSE_BYTES, InvalidPose).split()
    with naming(str(path)):
        if len(words) != 16:
            raise InvalidPose(
                f"The file holds {len(words)} words and a pose is 16 numbers. "
                "Write 4 rows of 4, sensor to parent."
            )
        return rigid_transform(np.array(_numbers(words)).reshape(4, 4))


def _numbers(words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as cause:
        raise InvalidPose(f"A word is no number ({cause}). Write numbers only.") from cause
