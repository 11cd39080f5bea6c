"""What a LAS file says of the units of its coordinates.

bytes  --las_units_per_metre-->  1 for metres, 3.28 for feet, or None
"""

from __future__ import annotations

import re
import struct

from sceneprint.errors import UnreadableCloud
from sceneprint.formats.points.rows import FileBytes

_VLR = 54  #: bytes of a record's own header
_MOST_VLRS = 1000
_GEO_KEYS, _WKT = 34735, 2112
_MODEL, _LINEAR_UNIT, _GEOGRAPHIC = 1024, 3076, 2
#: Codes of EPSG: metre, international foot, US survey foot.
_UNITS = {9001: 1.0, 9002: 1 / 0.3048, 9003: 3937 / 1200}
_WKT_UNIT = re.compile(r'UNIT\s*\[\s*"([^"]{1,60})"\s*,\s*([0-9.eE+-]{1,30})')


def las_units_per_metre(data: FileBytes) -> float | None:
    """Return how many units of the file's coordinates are a metre; None where it does not say.

    Raises
    ------
    UnreadableCloud : the coordinates are degrees.
    """
    header, start = struct.unpack_from("<HI", data, 94)
    (count,) = struct.unpack_from("<I", data, 100)
    at = header
    for _ in range(min(count, _MOST_VLRS)):
        if at + _VLR > start:
            break
        user, number, length = struct.unpack_from("<16sHH", data, at + 2)
        body = data[at + _VLR : min(at + _VLR + length, start)]
        if user.rstrip(b"\0") == b"LASF_Projection":
            found = None
            if number == _GEO_KEYS:
                found = _of_keys(body)
            elif number == _WKT:
                found = _of_wkt(body.decode("latin-1"))
            if found is not None:
                return found
        at += _VLR + length
    return None


def _of_keys(body: bytes) -> float | None:
    """Units of a directory of GeoTIFF keys."""
    numbers = struct.unpack_from(f"<{len(body) // 2}H", body)
    keys = {
        key: value
        for key, location, _, value in zip(*(iter(numbers[4:]),) * 4, strict=False)
        if location == 0
    }
    if keys.get(_MODEL) == _GEOGRAPHIC:
        raise _degrees()
    return _UNITS.get(keys.get(_LINEAR_UNIT, 0))


def _of_wkt(text: str) -> float | None:
    """Units of a coordinate system in well-known text: the first length in it."""
    head = text.lstrip()[:8].upper()
    if head.startswith(("GEOGCS", "GEOGCRS")):
        raise _degrees()
    for name, value in _WKT_UNIT.findall(text):
        if "degree" not in name.lower() and "radian" not in name.lower():
            try:
                metres = float(value)
            except ValueError:
                return None
            return 1.0 / metres if 1e-6 < metres < 1e6 else None
    return None


def _degrees() -> UnreadableCloud:
    return UnreadableCloud(
        "The coordinates of the LAS file are degrees of longitude and latitude. Project them to "
        "metres (UTM, for example with `pdal translate` and filters.reprojection), and upload "
        "that file."
    )
