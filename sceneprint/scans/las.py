"""LAS files (ASPRS LAS 1.0 to 1.4), and LAZ by the package lazrs.

bytes  --read_las-->  RawPoints

Every point format begins with X, Y, Z as whole numbers, which a scale and an offset make lengths.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import UnreadableCloud
from sceneprint.scans.laz import inflated_records
from sceneprint.scans.raw import RawPoints, check_count, steps
from sceneprint.types import Floats

SIGNATURE = b"LASF"
_SMALLEST_HEADER = 227  #: bytes
_AGAIN = "Copy or write the file again."

#: Bytes of a record by point format.
_RECORDS = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)

Records = NDArray[np.void]


def read_las(data: bytes) -> RawPoints:
    """The points of a LAS or LAZ file.

    Raises
    ------
    UnreadableCloud : it is none, of an unknown format, or its header does not fit what follows it.
    MissingDependency : it is LAZ, and lazrs is not installed.
    """
    if len(data) < _SMALLEST_HEADER or not data.startswith(SIGNATURE):
        raise UnreadableCloud("This is no LAS file, or its header is cut off. Copy it again.")
    minor, (header, start) = data[25], struct.unpack_from("<HI", data, 94)
    form, length, count = struct.unpack_from("<BHI", data, 104)
    packed, form = bool(form & 0x80), form & 0x3F
    if data[24] != 1 or minor > 4 or form >= len(_RECORDS) or length < _RECORDS[form]:
        raise UnreadableCloud(
            f"The LAS header tells version {data[24]}.{minor}, point format {form} and records of "
            f"{length} bytes, and known are versions up to 1.4, formats up to 10 and their sizes. "
            f"{_AGAIN}"
        )
    if minor == 4 and len(data) >= 255 and header >= 375:
        (count,) = struct.unpack_from("<Q", data, 247)  # beyond 32 bits, and for formats from 6
    if not _SMALLEST_HEADER <= header <= start <= len(data):
        raise UnreadableCloud(
            f"The LAS header has {header} bytes, and points from byte {start} of {len(data)}. "
            f"{_AGAIN}"
        )
    check_count(count)
    transform = struct.unpack_from("<6d", data, 131)
    if not all(map(math.isfinite, transform)) or 0.0 in transform[:3]:
        raise UnreadableCloud(f"The scale of the LAS file is {transform[:3]}. {_AGAIN}")
    row = np.dtype({"names": list("xyz"), "formats": ["<i4"] * 3, "offsets": [0, 4, 8],
                    "itemsize": length})  # fmt: skip
    if packed:
        records = inflated_records(data, header, start, form, length, count, row)
    else:
        if count * length > len(data) - start:
            raise UnreadableCloud(
                f"The LAS header announces {count} points of {length} bytes, and "
                f"{len(data) - start} of {count * length} bytes follow. {_AGAIN}"
            )
        table = np.frombuffer(data, row, count, start)
        records = (table[i : i + n] for i, n in steps(count))
    return RawPoints(count, _lengths(records, transform))


def _lengths(records: Iterator[Records], transform: tuple[float, ...]) -> Iterator[Floats]:
    for rows in records:
        block = np.empty((len(rows), 3))
        for k, name in enumerate("xyz"):
            block[:, k] = rows[name]
        yield block * transform[:3] + transform[3:]
