"""The camera of a sequence: `intrinsics.json` beside its frames or above them.

folder  --find_camera-->  Camera
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from sceneprint.datasets.files import read_object
from sceneprint.errors import DatasetError, InvalidIntrinsics, naming
from sceneprint.types import Intrinsics

FILE_NAME = "intrinsics.json"
_PARENTS = 4  #: folders above the frames that are looked into
_MAXIMUM_BYTES = 65_536
_EXAMPLE = (
    '{"width": 640, "height": 480, "fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5, '
    '"depth_scale": 1000}'
)
_REQUIRED = ("width", "height", "fx", "fy", "cx", "cy")
_OPTIONAL = ("depth_scale", "distortion", "depth_along_ray")


@dataclass(frozen=True)
class Camera:
    """A sensor: its lens, and how it stores depth.

    Parameters
    ----------
    intrinsics : of the depth images, with their distortion
    depth_scale : stored units per metre
    along_ray : depth is the range along the pixel's ray and not z

    Raises
    ------
    InvalidIntrinsics : the depth scale is no positive number.
    """

    intrinsics: Intrinsics
    depth_scale: float = 1000.0
    along_ray: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.depth_scale) and self.depth_scale > 0):
            raise InvalidIntrinsics(
                f"The depth scale {self.depth_scale} is not a positive number. "
                "Give the stored units per metre, 1000 for millimetres."
            )


def find_camera(folder: Path) -> Camera:
    """Return the camera of the nearest `intrinsics.json`, here or up to 4 folders above.

    Raises
    ------
    DatasetError : there is none; the message shows one to write.
    InvalidIntrinsics : as `read_camera`.
    """
    absolute = folder.resolve() if ".." in folder.parts else folder.absolute()
    for place in (absolute, *absolute.parents[:_PARENTS]):
        candidate = place / FILE_NAME
        if candidate.is_file():
            return read_camera(candidate)
    raise DatasetError(
        f"{folder}: There is no {FILE_NAME} here or in the {_PARENTS} folders above, so the "
        f"camera is unknown. Write one such as {_EXAMPLE} (pixels; depth_scale is stored "
        "units per metre)."
    )


def read_camera(path: Path) -> Camera:
    """Return the camera that a JSON file describes.

    Fields: width, height, fx, fy, cx, cy in pixels; and, if they differ from what is said
    here, depth_scale (1000), distortion (none), depth_along_ray (false).

    Raises
    ------
    InvalidIntrinsics : the file cannot be read, is no JSON object, lacks a field, has one
        too many, or a value that no camera has; names the file.
    """
    fields = read_object(path, _MAXIMUM_BYTES, InvalidIntrinsics, _EXAMPLE)
    with naming(str(path)):
        return _camera(fields)


def _camera(fields: dict[str, object]) -> Camera:
    missing = [name for name in _REQUIRED if name not in fields]
    if missing:
        raise InvalidIntrinsics(f"{', '.join(missing)} is missing. Write it such as {_EXAMPLE}.")
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
            fx=_number("fx", fields["fx"]),
            fy=_number("fy", fields["fy"]),
            cx=_number("cx", fields["cx"]),
            cy=_number("cy", fields["cy"]),
            distortion=tuple(_number("distortion", value) for value in distortion),
        ),
        depth_scale=_number("depth_scale", fields.get("depth_scale", 1000)),
        along_ray=along_ray,
    )


def _whole(fields: dict[str, object], name: str) -> int:
    value = fields[name]
    if isinstance(value, bool) or not isinstance(value, int):
        raise InvalidIntrinsics(
            f"{name} is {value!r:.40}, not a whole number. Write the size in pixels."
        )
    return value


def _number(name: str, value: object) -> float:
    # bool is a kind of int in Python; "true" is no length in pixels
    if not isinstance(value, bool) and isinstance(value, int | float):
        try:
            return float(value)
        except OverflowError:
            pass
    raise InvalidIntrinsics(f"{name} is {value!r:.40}, not a number. Write it as one.")
