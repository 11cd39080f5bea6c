"""Sidecar files of a frame: its camera, the layout of its points, and its pose.

folder  --find_camera-->  Camera            `intrinsics.json` beside the frames or above them
folder  --find_cloud_source-->  CloudSource `clouds.json` beside the frames or above, optional
text  --read_pose-->  T_parent_sensor (4, 4)
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from sceneprint_client.api.base import Intrinsics
from sceneprint_client.errors import DatasetError, InvalidIntrinsics, InvalidPose, SceneprintError
from sceneprint_client.files import naming, read_object, read_text
from sceneprint_client.formats import CloudFormat
from sceneprint_client.poses import TOLERANCE, rigid_transform

#: A position in metres, or a direction.
Position = tuple[float, float, float]
_NO_UP = (
    "up is {}, not a direction. Write a list of three numbers of length 1 in the sensor's axes, "
    "such as [0, -1, 0] for a camera that is held level."
)
_PARENTS = 4  #: number of folders to search above the folder of the frames
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
    """Intrinsics of a depth camera, and its encoding of depth.

    Parameters
    ----------
    intrinsics : intrinsics of the depth images, with distortion
    depth_scale : stored units per metre
    along_ray : whether depth is the range along the pixel's ray instead of z
    up : unit vector in the camera's axes if the camera is carried level; None if unknown

    Raises
    ------
    InvalidIntrinsics : If the depth scale is not positive, or `up` is not a unit vector.
    """

    intrinsics: Intrinsics
    depth_scale: float = 1000.0
    along_ray: bool = False
    up: Position | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.depth_scale) and self.depth_scale > 0):
            raise InvalidIntrinsics(
                f"The depth scale {self.depth_scale} is not a positive number. Specify the stored "
                "units per metre, such as 1000 for millimetres."
            )
        if self.up is not None and not is_unit(self.up):
            raise InvalidIntrinsics(_NO_UP.format(self.up))


def is_unit(vector: Position) -> bool:
    """Return whether a vector has length 1, within 0.01."""
    return abs(math.hypot(*vector) - 1.0) <= TOLERANCE


def find_camera(folder: Path) -> Camera:
    """Return the camera of the nearest `intrinsics.json`, in this folder or up to 4 above.

    Raise DatasetError if there is no such file; the message shows an example. Raise
    InvalidIntrinsics if the file is invalid; see `read_camera`.
    """
    if (file := _nearest(folder, INTRINSICS_FILE)) is not None:
        return read_camera(file)
    raise DatasetError(
        f"{folder}: There is no {INTRINSICS_FILE} here or in the {_PARENTS} folders above, so the "
        f"camera is unknown. Write a file such as {_INTRINSICS_EXAMPLE} (pixels; depth_scale is "
        "stored units per metre)."
    )


def read_camera(path: Path) -> Camera:
    """Return the camera of a JSON file.

    Fields: width, height, fx, fy, cx, cy in pixels. Optional fields and their defaults:
    depth_scale (1000), distortion (none), depth_along_ray (false), up (unknown).

    Raise InvalidIntrinsics, which names the file, if it cannot be read, is not a JSON object, lacks
    a field, has an unknown field, or has an invalid value.
    """
    fields = read_object(path, _MAXIMUM_BYTES, InvalidIntrinsics, _INTRINSICS_EXAMPLE)
    with naming(str(path)):
        return _camera(fields)


def _camera(fields: dict[str, object]) -> Camera:
    missing = [name for name in _REQUIRED if name not in fields]
    if missing:
        raise InvalidIntrinsics(
            f"{', '.join(missing)} is missing. Write an object such as {_INTRINSICS_EXAMPLE}."
        )
    unknown = sorted(set(fields) - {*_REQUIRED, *_OPTIONAL})
    if unknown:
        # Without this check, a misspelt optional field would have no effect.
        raise InvalidIntrinsics(
            f"{', '.join(unknown)!r:.80} is not a field of intrinsics.json. "
            f"The fields are {', '.join((*_REQUIRED, *_OPTIONAL))}."
        )
    distortion = fields.get("distortion", [])
    if not isinstance(distortion, list):
        raise InvalidIntrinsics(
            "distortion is not a list. Write [k1, k2, p1, p2], optionally with k3, or k3 to k6."
        )
    along_ray = fields.get("depth_along_ray", False)
    if not isinstance(along_ray, bool):
        raise InvalidIntrinsics("depth_along_ray is not a boolean. Write true or false.")
    number = partial(_number, error=InvalidIntrinsics)
    return Camera(
        Intrinsics(
            width=_whole(fields, "width"),
            height=_whole(fields, "height"),
            fx=number("fx", fields["fx"]),
            fy=number("fy", fields["fy"]),
            cx=number("cx", fields["cx"]),
            cy=number("cy", fields["cy"]),
            distortion=tuple(number("distortion", value) for value in distortion),
        ),
        depth_scale=number("depth_scale", fields.get("depth_scale", 1000)),
        along_ray=along_ray,
        up=_up(fields.get("up"), InvalidIntrinsics),
    )


def _whole(fields: dict[str, object], name: str) -> int:
    """Return an integer field; raise InvalidIntrinsics for another type."""
    value = fields[name]
    if isinstance(value, bool) or not isinstance(value, int):
        raise InvalidIntrinsics(
            f"{name} is {value!r:.40}, not a whole number. Write the size in pixels."
        )
    return value


def _number(name: str, value: object, error: type[SceneprintError]) -> float:
    """Return the value of a field as float; raise `error` if it is not a number."""
    # bool is a subclass of int.
    if not isinstance(value, bool) and isinstance(value, int | float):
        with suppress(OverflowError):  # integers in JSON have no upper limit
            return float(value)
    raise error(f"{name} is {value!r:.40}, not a number. Write a number.")


def _up(value: object, error: type[SceneprintError]) -> Position | None:
    """Return a direction of length 1, or None for None; raise `error` for other values."""
    if value is None:
        return None
    if isinstance(value, list) and len(value) == len("xyz"):
        x, y, z = (_number("up", number, error) for number in value)
        if is_unit((x, y, z)):
            return x, y, z
    raise error(_NO_UP.format(f"{value!r:.60}"))


def _nearest(folder: Path, name: str) -> Path | None:
    """Return the nearest file of a name, in this folder or up to 4 above, or None."""
    absolute = folder.resolve() if ".." in folder.parts else folder.absolute()
    places = (absolute, *absolute.parents[:_PARENTS])
    return next((place / name for place in places if (place / name).is_file()), None)


# Layout of points.


CLOUDS_FILE = "clouds.json"
_CLOUDS_EXAMPLE = (
    '{"viewpoint": {"x": 0, "y": 0, "z": 1.7}, "units_per_metre": 1, "format": "kitti"}'
)
_FIELDS = ("viewpoint", "units_per_metre", "format", "up", "row")
_LONGEST_ROW = 32
_FORMATS: tuple[CloudFormat, ...] = get_args(CloudFormat)


class Unsaid(Enum):
    """Marker of an unspecified viewpoint: the viewpoint in the file, otherwise the origin."""

    UNSAID = "unsaid"


UNSAID = Unsaid.UNSAID


@dataclass(frozen=True)
class CloudSource:
    """Layout of a file of points.

    Parameters
    ----------
    file_format : format; None if the first bytes determine it
    viewpoint : position of the sensor in the file's axes, metres; None for points from many
        viewpoints; UNSAID: the viewpoint in the file, otherwise the origin
    up : unit vector in the file's axes if the sensor is carried level; None if unknown
    row : names of the float32 values in each row of a .bin file, such as x, y, z, i, ring; None: x,
        y, z and intensity
    """

    file_format: CloudFormat | None = None
    viewpoint: Position | Unsaid | None = UNSAID
    units_per_metre: float = 1.0
    up: Position | None = None
    row: tuple[str, ...] | None = None


def row_of(text: str) -> tuple[str, ...]:
    """Return the names of the values in a row, from a text such as x,y,z,i,ring.

    Raise DatasetError if x, y or z is missing or repeated, or there are more than 32 names.
    """
    names = tuple(name.strip().lower() for name in text.split(","))
    if any(names.count(axis) != 1 for axis in "xyz") or len(names) > _LONGEST_ROW:
        raise DatasetError(
            f"The row {text!r:.80} must name x, y and z once each, and at most {_LONGEST_ROW} "
            "values. Write it like x,y,z,i,ring."
        )
    return names


def find_cloud_source(folder: Path) -> CloudSource:
    """Return the layout in the nearest `clouds.json`, in this folder or up to 4 above.

    Without such a file, all fields have their defaults.

    Raise DatasetError if the file cannot be read, is not a JSON object, or has an invalid field.
    """
    path = _nearest(folder, CLOUDS_FILE)
    if path is None:
        return CloudSource()
    fields = read_object(path, _MAXIMUM_BYTES, DatasetError, _CLOUDS_EXAMPLE)
    with naming(str(path)):
        unknown = sorted(set(fields) - {*_FIELDS})
        if unknown:
            raise DatasetError(
                f"{', '.join(unknown)!r:.80} is not a field of clouds.json. "
                f"The fields are {', '.join(_FIELDS)}."
            )
        file_format = fields.get("format")
        if file_format is not None and file_format not in _FORMATS:
            raise DatasetError(
                f"format is {file_format!r:.40}. Supported formats are {', '.join(_FORMATS)}."
            )
        units = _cloud_number("units_per_metre", fields.get("units_per_metre", 1.0))
        if not units > 0.0:
            raise DatasetError(f"units_per_metre is {units}. Write 1000 for millimetres.")
        row = fields.get("row")
        if row is not None and file_format not in (None, "kitti"):
            raise DatasetError(
                f"row is valid only for .bin files, but format is {file_format}. Remove row or "
                "format."
            )
        return CloudSource(
            file_format, _viewpoint(fields), units, _up(fields.get("up"), DatasetError),
            None if row is None else row_of(str(row)),
        )  # fmt: skip


def _viewpoint(fields: dict[str, object]) -> Position | Unsaid | None:
    if "viewpoint" not in fields:
        return UNSAID
    value = fields["viewpoint"]
    if value is None:
        return None
    if not isinstance(value, dict) or set(value) != {"x", "y", "z"}:
        raise DatasetError(
            f"viewpoint is {value!r:.60}. Write it like {_CLOUDS_EXAMPLE}, or null for points "
            "without a common viewpoint."
        )
    x, y, z = (_cloud_number(axis, value[axis]) for axis in "xyz")
    return x, y, z


def _cloud_number(name: str, value: object) -> float:
    """Return the value of a field as float; raise DatasetError if it is not a finite number."""
    number = _number(name, value, DatasetError)
    if not math.isfinite(number):
        raise DatasetError(f"{name} is {number}, not a finite number. Write a finite number.")
    return number


# Poses.

_MAXIMUM_POSE_BYTES = 65_536


def read_pose(path: Path) -> NDArray[np.float64]:
    """Return T_parent_sensor (4, 4) of a text file with 16 numbers, row by row.

    Raise InvalidPose, which names the file, if it cannot be read or its matrix is not rigid.
    """
    words = read_text(path, _MAXIMUM_POSE_BYTES, InvalidPose).split()
    with naming(str(path)):
        if len(words) != 16:
            raise InvalidPose(
                f"The file holds {len(words)} words, but a pose has 16 numbers. "
                "Write 4 rows of 4 numbers, sensor to parent."
            )
        return rigid_transform(np.array(pose_numbers(words)).reshape(4, 4))


def pose_numbers(words: list[str]) -> list[float]:
    """Convert the words of a pose to numbers; raise InvalidPose if a word is not a number."""
    try:
        return [float(word) for word in words]
    except ValueError as cause:
        raise InvalidPose(f"A word is not a number ({cause}). Write only numbers.") from cause
