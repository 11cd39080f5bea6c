"""Units of the coordinates of a LAS file, according to its header.

bytes  --las_units_per_metre-->  1 for metres, 3.28 for feet, or None
"""

from __future__ import annotations

import re
import struct

from sceneprint.errors import UnreadableCloud
from sceneprint.formats.points.las import las_records
from sceneprint.formats.points.rows import FileBytes

_GEO_KEYS, _WKT = 34735, 2112
_MODEL, _LINEAR_UNIT, _GEOGRAPHIC = 1024, 3076, 2
#: Units per metre by EPSG code: metre, international foot, US survey foot.
_UNITS = {9001: 1.0, 9002: 1 / 0.3048, 9003: 3937 / 1200}
_WKT_UNIT = re.compile(r'UNIT\s*\[\s*"([^"]{1,60})"\s*,\s*([0-9.eE+-]{1,30})')


def las_units_per_metre(data: FileBytes) -> float | None:
    """Read the units per metre of the file's coordinates; return None if the file states none.

    Raise UnreadableCloud if the coordinates are degrees.
    """
    for user, number, content in las_records(data):
        if user == b"LASF_Projection" and number in (_GEO_KEYS, _WKT):
            is_wkt = number == _WKT
            units = _read_wkt(content.decode("latin-1")) if is_wkt else _read_geo_keys(content)
            if units is not None:
                return units
    return None


def _read_geo_keys(body: bytes) -> float | None:
    """Read the units per metre from a directory of GeoTIFF keys; return None if it has none."""
    numbers = struct.unpack_from(f"<{len(body) // 2}H", body)
    keys = {
        key: value
        for key, location, _, value in zip(*(iter(numbers[4:]),) * 4, strict=False)
        if location == 0
    }
    if keys.get(_MODEL) == _GEOGRAPHIC:
        raise _degrees_error()
    return _UNITS.get(keys.get(_LINEAR_UNIT, 0))


def _read_wkt(text: str) -> float | None:
    """Read the units per metre from the first length unit in well-known text; or return None."""
    head = text.lstrip()[:8].upper()
    if head.startswith(("GEOGCS", "GEOGCRS")):
        raise _degrees_error()
    for name, value in _WKT_UNIT.findall(text):
        if "degree" not in name.lower() and "radian" not in name.lower():
            try:
                metres = float(value)
            except ValueError:
                return None
            return 1.0 / metres if 1e-6 < metres < 1e6 else None
    return None


def _degrees_error() -> UnreadableCloud:
    return UnreadableCloud(
        "The coordinates of the LAS file are longitude and latitude in degrees. Convert them to "
        "metres, for example to UTM with `pdal translate` and filters.reprojection, and upload "
        "the new file."
    )
