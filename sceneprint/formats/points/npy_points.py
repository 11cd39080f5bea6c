"""Points as plain arrays: KITTI's .bin, and NPY.

bytes  --read_kitti | read_npy-->  FilePoints
"""

from __future__ import annotations

import numpy as np

from sceneprint.errors import UnreadableCloud
from sceneprint.formats.points.float_rows import FilePoints, check_count, steps
from sceneprint_client.files import NPY_SIGNATURE, npy_header

_KITTI_ROW = 16  #: bytes: x, y, z, intensity


def read_kitti(data: bytes) -> FilePoints:
    """The points of a KITTI scan: x, y, z, intensity as float32, little-endian, and nothing else.

    Raises
    ------
    UnreadableCloud : it is no whole number of points.
    """
    count, rest = divmod(len(data), _KITTI_ROW)
    if rest or not count:
        raise UnreadableCloud(
            f"The file has {len(data)} bytes, and each point of a KITTI scan has {_KITTI_ROW}: "
            "x, y, z and intensity as float32. Copy the file again, or say its true format."
        )
    check_count(count)
    rows = np.frombuffer(data, "<f4").reshape(count, 4)
    return FilePoints(count, (rows[i : i + n, :3].astype(np.float64) for i, n in steps(count)))


def read_npy(data: bytes) -> FilePoints:
    """The points of an NPY file of shape (N, 3), or (N, 4) whose fourth column is passed over.

    Raises
    ------
    UnreadableCloud : it is none, of another type or shape, or its size contradicts its header.
    """
    if not data.startswith(NPY_SIGNATURE):
        raise UnreadableCloud("This is no NPY file. Write the points with numpy.save.")
    shapes = (
        "The shape of the NPY array is not that of points, (N, 3) or (N, 4). "
        "Write x, y and z of each point in a row."
    )
    advice = "points are float32 in metres (float64 and float16 are taken too). Convert it."
    header = npy_header(data, UnreadableCloud, advice, shapes)
    count, width = header.shape
    if width not in (3, 4):
        raise UnreadableCloud(shapes)
    check_count(count)
    expected = count * width * header.dtype.itemsize
    if len(data) - header.start != expected:
        raise UnreadableCloud(
            f"The NPY header announces {count} points of {width} values, and "
            f"{len(data) - header.start} of {expected} bytes follow. Copy or write the file again."
        )
    numbers = np.frombuffer(data, header.dtype, offset=header.start)
    rows = numbers.reshape((count, width), order=header.order)
    return FilePoints(count, (rows[i : i + n, :3].astype(np.float64) for i, n in steps(count)))
