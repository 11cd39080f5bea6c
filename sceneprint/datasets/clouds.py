"""How the clouds of a sequence are to be read: `clouds.json` beside them or above them, or nothing.

folder  --find_cloud_source-->  CloudSource  --read_cloud-->  Cloud
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import get_args

from sceneprint.datasets.files import read_bytes, read_object
from sceneprint.errors import DatasetError, UnreadableCloud, naming
from sceneprint.scans import (
    MAXIMUM_BYTES,
    SUFFIXES,
    UNSAID,
    CloudFormat,
    Position,
    Scan,
    Unsaid,
    decode_scan,
)
from sceneprint.types import Floats

FILE_NAME = "clouds.json"
_PARENTS = 4  #: folders above the clouds that are looked into, as for a camera
_MAXIMUM_BYTES = 65_536
_EXAMPLE = '{"viewpoint": {"x": 0, "y": 0, "z": 1.7}, "units_per_metre": 1, "format": "kitti"}'
_FIELDS = ("viewpoint", "units_per_metre", "format")
_FORMATS: tuple[CloudFormat, ...] = get_args(CloudFormat)


@dataclass(frozen=True)
class CloudSource:
    """How a file of points is to be read.

    Parameters
    ----------
    file_format : of it, or None: its first bytes tell
    viewpoint : where the sensor was, metres in the file's axes; None for points of many views;
        UNSAID: as the file says, else the origin
    units_per_metre : of its coordinates
    """

    file_format: CloudFormat | None = None
    viewpoint: Position | Unsaid | None = UNSAID
    units_per_metre: float = 1.0


def read_cloud(
    path: Path, source: CloudSource, *, name: str = "", pose: Floats | None = None
) -> Scan:
    """Return the points of a file, and how they were read.

    Raises
    ------
    UnreadableCloud : the file is absent or too large; and as `decode_scan`. Each error names the
        file.
    """
    data = read_bytes(path, MAXIMUM_BYTES, UnreadableCloud)
    told = source.file_format
    if told is None and SUFFIXES.get(path.suffix.lower()) == "kitti":
        told = "kitti"  # the one that its content does not tell
    with naming(str(path)):
        scan = decode_scan(
            data,
            file_format=told,
            viewpoint=source.viewpoint,
            units_per_metre=source.units_per_metre,
            pose=pose,
        )
    return replace(scan, cloud=replace(scan.cloud, name=name))


def is_cloud(file: str) -> bool:
    """Whether a file of that name holds points whatever is beside it; a .npy may be depth."""
    suffix = PurePath(file).suffix.lower()
    return suffix in SUFFIXES and suffix != ".npy"


def find_cloud_source(folder: Path) -> CloudSource:
    """Return what the nearest `clouds.json` says, here or up to 4 folders above; without one,
    nothing is said.

    Raises
    ------
    DatasetError : it cannot be read, is no JSON object, or has a field or value that is none.
    """
    absolute = folder.resolve() if ".." in folder.parts else folder.absolute()
    for place in (absolute, *absolute.parents[:_PARENTS]):
        candidate = place / FILE_NAME
        if candidate.is_file():
            return _read(candidate)
    return CloudSource()


def _read(path: Path) -> CloudSource:
    fields = read_object(path, _MAXIMUM_BYTES, DatasetError, _EXAMPLE)
    with naming(str(path)):
        unknown = sorted(set(fields) - {*_FIELDS})
        if unknown:
            raise DatasetError(
                f"{', '.join(unknown)!r:.80} is no field of it. "
                f"The fields are {', '.join(_FIELDS)}."
            )
        told = fields.get("format")
        if told is not None and told not in _FORMATS:
            raise DatasetError(f"format is {told!r:.40}. Known are {', '.join(_FORMATS)}.")
        units = _number("units_per_metre", fields.get("units_per_metre", 1.0))
        if not units > 0.0:
            raise DatasetError(f"units_per_metre is {units}. Write 1000 for millimetres.")
        return CloudSource(told, _viewpoint(fields), units)


def _viewpoint(fields: dict[str, object]) -> Position | Unsaid | None:
    if "viewpoint" not in fields:
        return UNSAID
    told = fields["viewpoint"]
    if told is None:
        return None
    if not isinstance(told, dict) or set(told) != {"x", "y", "z"}:
        raise DatasetError(
            f"viewpoint is {told!r:.60}. Write it such as {_EXAMPLE}, or null for points that were "
            "not seen from one place."
        )
    return _number("x", told["x"]), _number("y", told["y"]), _number("z", told["z"])


def _number(name: str, value: object) -> float:
    if not isinstance(value, bool) and isinstance(value, int | float):
        try:
            number = float(value)
        except OverflowError:  # JSON has whole numbers of any length
            number = math.inf
        if math.isfinite(number):
            return number
    raise DatasetError(f"{name} is {value!r:.40}, no finite number. Write it as one.")
