"""Binary columns of RTAB-Map's databases: transforms, matrices, calibrations, depth, laser scans.

bytes  --transform-->  (4, 4)          bytes  --matrix-->  array
bytes, version  --cameras-->  RtabmapCamera, ...          bytes  --depth_samples-->  (H, W)

The layouts are those of rtabmap's DBDriverSqlite3.cpp, CameraModel.cpp, Compression.cpp and
rvl_codec.cpp, of the versions 0.10 to 0.23. Axes: the robot's base has x forward, y left, z up;
`local_transform` leads from the optical axes of a camera (x right, y down, z forward) to the base.
Pixel centres have whole coordinates.
"""

from __future__ import annotations

import io
import struct
import zlib
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import InvalidPose, UnreadableCloud, UnreadableFrame
from sceneprint.formats.depth_file import Samples, decode_png
from sceneprint.types import MAXIMUM_SAMPLES, Floats, Floats32
from sceneprint_client.files import PNG_SIGNATURE
from sceneprint_client.poses import rigid_transform
from sceneprint_client.ros_messages import rvl_samples

#: Of a database: major, minor and patch.
Version = tuple[int, int, int]

#: Most bytes of a matrix once it is inflated.
_MAXIMUM_MATRIX_BYTES = 256 << 20
#: Element types of OpenCV's matrices by their code.
_ELEMENTS = ("u1", "i1", "<u2", "<i2", "<i4", "<f4", "<f8")
_RVL = b"DEPTHRVL"
_RVL_HEADER = len(_RVL) + 8
#: Bytes that tell what a depth image is, and its size.
DEPTH_HEAD = 32
_AGAIN = "Copy the database again, or export it with rtabmap-reprocess."
#: Rotation from optical axes to those of a base: what rtabmap assumes where nothing is stored.
_OPTICAL = (
    (0.0, 0.0, 1.0, 0.0),
    (-1.0, 0.0, 0.0, 0.0),
    (0.0, -1.0, 0.0, 0.0),
    (0.0, 0.0, 0.0, 1.0),
)


@dataclass(frozen=True, eq=False)
class RtabmapCamera:
    """A camera of a node.

    Parameters
    ----------
    fx, fy, cx, cy : pixels of the rectified image
    width, height : of the colour image that they are for; 0 where not stored
    T_base_camera : (4, 4), optical axes to the robot's base
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    T_base_camera: Floats


class BrokenBlob(ValueError):
    """A column that does not hold what it should; its text says why."""


def transform(blob: bytes) -> Floats | None:
    """Return the transform (4, 4) of 3 x 4 float32, row by row; None for the null transform.

    Raises
    ------
    BrokenBlob : the length is another, or it is not rigid.
    """
    if len(blob) != 48:
        raise BrokenBlob(f"a transform has {len(blob)} bytes and not 48")
    T = np.eye(4)
    T[:3] = np.frombuffer(blob, "<f4").reshape(3, 4)
    if not T[:3].any():
        return None
    try:
        return rigid_transform(T)
    except InvalidPose as cause:
        raise BrokenBlob("a transform is not rigid") from cause


def matrix(blob: bytes) -> NDArray[Any]:
    """Return the array (rows, columns, channels) of a matrix that rtabmap deflated.

    Three 32-bit integers behind the deflated bytes give rows, columns and OpenCV's type.

    Raises
    ------
    BrokenBlob : it is damaged, or larger than 256 MiB.
    """
    if len(blob) < 12:
        raise BrokenBlob("a matrix ends early")
    rows, columns, kind = struct.unpack("<3i", blob[-12:])
    channels = ((kind >> 3) & 511) + 1
    if kind & 7 >= len(_ELEMENTS) or min(rows, columns) < 0:
        raise BrokenBlob("the size or type of a matrix is none")
    dtype = np.dtype(_ELEMENTS[kind & 7])
    size = rows * columns * channels * dtype.itemsize
    if size > _MAXIMUM_MATRIX_BYTES:
        raise BrokenBlob(f"a matrix announces {size} bytes")
    stream = zlib.decompressobj()
    try:
        content = stream.decompress(blob[:-12], size + 1)
    except zlib.error as cause:
        raise BrokenBlob("a matrix does not inflate") from cause
    if len(content) != size:
        raise BrokenBlob("a matrix is shorter or longer than it announces")
    return np.frombuffer(content, dtype).reshape(rows, columns, channels)


# Calibrations.


def cameras(blob: bytes, version: Version) -> tuple[RtabmapCamera, ...]:
    """Return the cameras of a node, from left to right in its images; none for a stereo camera.

    Parameters
    ----------
    blob : calibration. From 0.18 on, one record per camera; before, float32 numbers: fx, fy, cx,
        cy, (from 0.11.2 on) width, height, and the local transform of each camera
    version : of the database

    Raises
    ------
    BrokenBlob : it is damaged.
    """
    if version >= (0, 18, 0):
        return _serialized_cameras(blob)
    numbers = np.frombuffer(blob, "<f4") if len(blob) % 4 == 0 else np.empty(0, "<f4")
    of_camera = 18 if version >= (0, 11, 2) else 16
    if len(numbers) % of_camera == 0 and len(numbers):
        rows = numbers.reshape(-1, of_camera)
        return tuple(_camera_of(*row[:-12].tolist(), local=row[-12:].tobytes()) for row in rows)
    if len(numbers) in (17, 19):  # a baseline, and of newer ones the size of the image
        return ()
    raise BrokenBlob(f"a calibration has {len(blob)} bytes")


def _camera_of(
    fx: float, fy: float, cx: float, cy: float, width: float = 0, height: float = 0, *, local: bytes
) -> RtabmapCamera:
    if not np.isfinite((fx, fy, cx, cy, width, height)).all():
        raise BrokenBlob("a calibration is not finite")
    T = transform(local) if local else np.array(_OPTICAL)
    if T is None:
        raise BrokenBlob("the local transform of a camera is null")
    return RtabmapCamera(fx, fy, cx, cy, int(width), int(height), T)


def _serialized_cameras(blob: bytes) -> tuple[RtabmapCamera, ...]:
    """Return the cameras of records: 11 integers, then K, D, R, P as float64, a transform."""
    cameras, at = [], 0
    while at < len(blob):
        if len(blob) - at < 44:
            raise BrokenBlob("a calibration ends early")
        header = struct.unpack_from("<11i", blob, at)
        kind, width, height, k, d, r, p, local = header[3:]
        if kind == 1:
            return ()
        sizes_fit = k in (0, 9) and 0 <= d <= 14 and r in (0, 9) and p in (0, 12)
        end = at + 44 + 8 * (k + d + r + p) + 4 * local
        if kind != 0 or not sizes_fit or local not in (0, 12) or end > len(blob):
            raise BrokenBlob("a calibration is of an unknown form")
        numbers = np.frombuffer(blob, "<f8", k + d + r + p, at + 44)
        # P is the camera of the rectified images, which are the ones stored
        P, K = numbers[k + d + r :].reshape(-1, 4), numbers[:k].reshape(-1, 3)
        lens = P if len(P) and P[0, 0] > 0 else K
        if not len(lens):
            raise BrokenBlob("a calibration has no camera matrix")
        fx, fy, cx, cy = (float(lens[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        part = blob[end - 4 * local : end]
        cameras.append(_camera_of(fx, fy, cx, cy, width, height, local=part))
        at = end
    if not cameras:
        raise BrokenBlob("a calibration is empty")
    return tuple(cameras)


# Depth images: PNG of 16-bit millimetres, PNG of float metres as four bytes of colour, or RVL.

DepthKind = Literal["millimetres", "metres", "rvl"]


def depth_size(head: bytes) -> tuple[DepthKind, int, int] | None:
    """Return kind, width and height of a depth image; None for any other image.

    Parameters
    ----------
    head : its first `DEPTH_HEAD` bytes
    """
    if head.startswith(_RVL) and len(head) >= _RVL_HEADER:
        width, height = struct.unpack_from("<II", head, len(_RVL))
        return "rvl", width, height
    if head.startswith(PNG_SIGNATURE) and len(head) >= 26:
        width, height, bits, colour = struct.unpack_from(">IIBB", head, 16)
        if (bits, colour) == (16, 0):
            return "millimetres", width, height
        if (bits, colour) == (8, 6):
            return "metres", width, height
    return None


def depth_samples(blob: bytes) -> Samples:
    """Return the samples (H, W) of a depth image: uint16 millimetres, or float32 metres.

    Raises
    ------
    UnreadableFrame : it is damaged, too large, or no depth image.
    """
    known = depth_size(blob[:DEPTH_HEAD])
    if known is None:
        raise UnreadableFrame(f"The image of the node holds no depth. {_AGAIN}")
    kind, width, height = known
    if not 1 <= width * height <= MAXIMUM_SAMPLES:
        raise UnreadableFrame(
            f"The depth image announces {width} x {height} samples; 1 to {MAXIMUM_SAMPLES} are "
            f"read. {_AGAIN}"
        )
    if kind == "millimetres":
        return decode_png(blob)
    return _float_samples(blob) if kind == "metres" else rvl_samples(blob[len(_RVL) :])


def _float_samples(blob: bytes) -> Floats32:
    from PIL.PngImagePlugin import PngImageFile

    try:
        # not by Image.open, whose limit of pixels is the program's
        with PngImageFile(io.BytesIO(blob)) as image:
            colours = np.asarray(image)
    except (OSError, ValueError, SyntaxError) as cause:
        raise UnreadableFrame(f"The depth image is damaged ({cause}). {_AGAIN}") from cause
    # OpenCV's order is blue, green, red, alpha: the four bytes of a float32
    return np.ascontiguousarray(colours[:, :, [2, 1, 0, 3]]).view("<f4")[:, :, 0]


# Laser scans.

#: Formats of scans with x, y and z; before 0.16.1 the number of values per point says it.
_SOLID_FORMATS, _SOLID_CHANNELS = range(5, 12), (3, 4, 6, 7)


def scan_placement(blob: bytes | None, version: Version) -> tuple[int, Floats]:
    """Return the format of a laser scan (0 where not stored) and T_base_scan (4, 4).

    Parameters
    ----------
    blob : scan_info, or None
    version : of the database

    Raises
    ------
    BrokenBlob : it is damaged.
    """
    if not blob:
        return 0, np.eye(4)
    leading = len(blob) // 4 - 12
    if len(blob) % 4 or leading not in ((7,) if version >= (0, 18, 0) else (2, 3)):
        raise BrokenBlob(f"the description of a laser scan has {len(blob)} bytes")
    T = transform(blob[-48:])
    form = {7: 0, 3: 2}.get(leading)
    number = 0.0 if form is None else struct.unpack_from("<f", blob, 4 * form)[0]
    return (int(number) if 0 <= number < 100 else 0), np.eye(4) if T is None else T


def is_solid(tail: bytes, form: int) -> bool:
    """Return whether a laser scan has heights.

    Parameters
    ----------
    tail : the last 12 bytes of the scan, which say how many values each point has
    form : as of `scan_placement`
    """
    kind = struct.unpack("<3i", tail)[2] if len(tail) == 12 else 0
    channels = ((kind >> 3) & 511) + 1
    if kind & 7 != _ELEMENTS.index("<f4") or channels < 3:
        return False
    return form in _SOLID_FORMATS if form else channels in _SOLID_CHANNELS


def scan_points(blob: bytes, form: int) -> Floats32:
    """Return the points (N, 3) of a laser scan, metres in its own axes.

    Raises
    ------
    UnreadableCloud : it is damaged, or has no heights.
    """
    try:
        rows = matrix(blob)
    except BrokenBlob as cause:
        raise UnreadableCloud(f"The laser scan is damaged: {cause}. {_AGAIN}") from cause
    if not is_solid(blob[-12:], form):
        raise UnreadableCloud(
            "The laser scan has no heights. Only scans of three dimensions are read."
        )
    return np.ascontiguousarray(rows.reshape(-1, rows.shape[2])[:, :3])
