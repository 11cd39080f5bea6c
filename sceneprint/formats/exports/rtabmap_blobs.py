"""Decoding of binary columns of RTAB-Map databases: transforms, calibrations, depth, laser scans.

bytes  --transform-->  (4, 4)          bytes  --matrix-->  array
bytes, version  --cameras-->  RtabmapCamera, ...          bytes  --depth_samples-->  (H, W)

The layouts follow DBDriverSqlite3.cpp, CameraModel.cpp, Compression.cpp and rvl_codec.cpp of
rtabmap 0.10 to 0.23. The axes of the robot's base are x forward, y left, z up. `local_transform`
maps the optical axes of a camera (x right, y down, z forward) to the base. Pixel centres have
integer coordinates.
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

#: Version of a database: major, minor, patch.
Version = tuple[int, int, int]

#: Maximum size of a decompressed matrix, bytes.
_MAXIMUM_MATRIX_BYTES = 256 << 20
#: Element types of OpenCV matrices; the index is the type code.
_ELEMENTS = ("u1", "i1", "<u2", "<i2", "<i4", "<f4", "<f8")
_RVL = b"DEPTHRVL"
_RVL_HEADER = len(_RVL) + 8
#: Number of first bytes of a depth image that determine its kind and size.
DEPTH_HEAD = 32
_AGAIN = "Copy the database again, or export it with rtabmap-reprocess."
#: Default of rtabmap for the transform from optical axes to the base.
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
    fx, fy, cx, cy : intrinsics of the rectified image, pixels
    width, height : size of the colour image, pixels; 0 if not stored
    T_base_camera : (4, 4) transform from optical axes to the robot's base
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    T_base_camera: Floats


class BrokenBlob(ValueError):
    """Error for an invalid value in a column; the message states the reason."""


def transform(blob: bytes) -> Floats | None:
    """Decode a transform (4, 4) from 3 x 4 float32, row by row; return None for the null transform.

    Raise BrokenBlob if the length is wrong, or the transform is not rigid.
    """
    if len(blob) != 48:
        raise BrokenBlob(f"a transform has {len(blob)} bytes, not 48")
    T = np.eye(4)
    T[:3] = np.frombuffer(blob, "<f4").reshape(3, 4)
    if not T[:3].any():
        return None
    try:
        return rigid_transform(T)
    except InvalidPose as cause:
        raise BrokenBlob("a transform is not rigid") from cause


def matrix(blob: bytes) -> NDArray[Any]:
    """Decompress a matrix (rows, columns, channels).

    Three 32-bit integers follow the compressed bytes: rows, columns and the OpenCV type.

    Raise BrokenBlob if the matrix is damaged, or larger than 256 MiB.
    """
    if len(blob) < 12:
        raise BrokenBlob("a matrix is truncated")
    rows, columns, kind = struct.unpack("<3i", blob[-12:])
    channels = ((kind >> 3) & 511) + 1
    if kind & 7 >= len(_ELEMENTS) or min(rows, columns) < 0:
        raise BrokenBlob("the size or type of a matrix is invalid")
    dtype = np.dtype(_ELEMENTS[kind & 7])
    size = rows * columns * channels * dtype.itemsize
    if size > _MAXIMUM_MATRIX_BYTES:
        raise BrokenBlob(f"a matrix declares {size} bytes, which exceeds the limit")
    stream = zlib.decompressobj()
    try:
        content = stream.decompress(blob[:-12], size + 1)
    except zlib.error as cause:
        raise BrokenBlob("a matrix cannot be decompressed") from cause
    if len(content) != size:
        raise BrokenBlob("the size of a matrix differs from the declared size")
    return np.frombuffer(content, dtype).reshape(rows, columns, channels)


def cameras(blob: bytes, version: Version) -> tuple[RtabmapCamera, ...]:
    """Decode the cameras of a node, from left to right in its images; empty for a stereo camera.

    `blob`: calibration. Since 0.18, it has one record per camera. Earlier versions stored float32
    numbers for each camera: fx, fy, cx, cy, (since 0.11.2) width, height, and the local transform.
    Raise BrokenBlob if the calibration is damaged.
    """
    if version >= (0, 18, 0):
        return _read_records(blob)
    numbers = np.frombuffer(blob, "<f4") if len(blob) % 4 == 0 else np.empty(0, "<f4")
    of_camera = 18 if version >= (0, 11, 2) else 16
    if len(numbers) % of_camera == 0 and len(numbers):
        rows = numbers.reshape(-1, of_camera)
        return tuple(_make_camera(*row[:-12].tolist(), local=row[-12:].tobytes()) for row in rows)
    if len(numbers) in (17, 19):  # a stereo camera, which also has a baseline
        return ()
    raise BrokenBlob(f"a calibration has the invalid size of {len(blob)} bytes")


def _make_camera(
    fx: float, fy: float, cx: float, cy: float, width: float = 0, height: float = 0, *, local: bytes
) -> RtabmapCamera:
    if not np.isfinite((fx, fy, cx, cy, width, height)).all():
        raise BrokenBlob("a calibration has values that are not finite")
    T = transform(local) if local else np.array(_OPTICAL)
    if T is None:
        raise BrokenBlob("the local transform of a camera is null")
    return RtabmapCamera(fx, fy, cx, cy, int(width), int(height), T)


def _read_records(blob: bytes) -> tuple[RtabmapCamera, ...]:
    """Decode camera records of 11 integers, K, D, R and P as float64, and a transform."""
    cameras, at = [], 0
    while at < len(blob):
        if len(blob) - at < 44:
            raise BrokenBlob("a calibration is truncated")
        header = struct.unpack_from("<11i", blob, at)
        kind, width, height, k, d, r, p, local = header[3:]
        if kind == 1:
            return ()
        sizes_fit = k in (0, 9) and 0 <= d <= 14 and r in (0, 9) and p in (0, 12)
        end = at + 44 + 8 * (k + d + r + p) + 4 * local
        if kind != 0 or not sizes_fit or local not in (0, 12) or end > len(blob):
            raise BrokenBlob("a calibration has an unknown format")
        numbers = np.frombuffer(blob, "<f8", k + d + r + p, at + 44)
        # the database stores rectified images; P is their camera
        P, K = numbers[k + d + r :].reshape(-1, 4), numbers[:k].reshape(-1, 3)
        lens = P if len(P) and P[0, 0] > 0 else K
        if not len(lens):
            raise BrokenBlob("a calibration has no camera matrix")
        fx, fy, cx, cy = (float(lens[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        part = blob[end - 4 * local : end]
        cameras.append(_make_camera(fx, fy, cx, cy, width, height, local=part))
        at = end
    if not cameras:
        raise BrokenBlob("a calibration is empty")
    return tuple(cameras)


# A depth image is RVL data, a PNG of 16-bit millimetres, or a PNG whose four 8-bit channels form
# float32 metres.

DepthKind = Literal["millimetres", "metres", "rvl"]


def depth_size(head: bytes) -> tuple[DepthKind, int, int] | None:
    """Return the kind, width and height of a depth image; None for other images.

    `head`: first `DEPTH_HEAD` bytes of the image.
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
    """Decode the samples (H, W) of a depth image: uint16 millimetres, or float32 metres.

    Raise UnreadableFrame if the image is damaged, too large, or not a depth image.
    """
    header = depth_size(blob[:DEPTH_HEAD])
    if header is None:
        raise UnreadableFrame(f"The image of the node is not a depth image. {_AGAIN}")
    kind, width, height = header
    if not 1 <= width * height <= MAXIMUM_SAMPLES:
        raise UnreadableFrame(
            f"The depth image declares {width} x {height} samples; it must have 1 to "
            f"{MAXIMUM_SAMPLES}. {_AGAIN}"
        )
    if kind == "millimetres":
        return decode_png(blob)
    return _decode_metres(blob) if kind == "metres" else rvl_samples(blob[len(_RVL) :])


def _decode_metres(blob: bytes) -> Floats32:
    from PIL.PngImagePlugin import PngImageFile

    try:
        # Image.open has a pixel limit that applies to the whole process
        with PngImageFile(io.BytesIO(blob)) as image:
            colours = np.asarray(image)
    except (OSError, ValueError, SyntaxError) as cause:
        raise UnreadableFrame(f"The depth image is damaged ({cause}). {_AGAIN}") from cause
    # the bytes in OpenCV's channel order (blue, green, red, alpha) form a float32
    return np.ascontiguousarray(colours[:, :, [2, 1, 0, 3]]).view("<f4")[:, :, 0]


#: Format numbers of 3D scans; and, for databases of RTAB-Map before 0.16.1, which lack the format,
#: possible numbers of values per point of a 3D scan.
_SOLID_FORMATS, _SOLID_CHANNELS = range(5, 12), (3, 4, 6, 7)


def scan_placement(blob: bytes | None, version: Version) -> tuple[int, Floats]:
    """Return the format of a laser scan (0 if not stored) and T_base_scan (4, 4).

    `blob`: column scan_info, or None. Raise BrokenBlob if the column is damaged.
    """
    if not blob:
        return 0, np.eye(4)
    leading = len(blob) // 4 - 12
    if len(blob) % 4 or leading not in ((7,) if version >= (0, 18, 0) else (2, 3)):
        raise BrokenBlob(f"the description of a laser scan has the invalid size {len(blob)}")
    T = transform(blob[-48:])
    form = {7: 0, 3: 2}.get(leading)
    number = 0.0 if form is None else struct.unpack_from("<f", blob, 4 * form)[0]
    return (int(number) if 0 <= number < 100 else 0), np.eye(4) if T is None else T


def is_solid(tail: bytes, form: int) -> bool:
    """Return whether a laser scan is three-dimensional.

    Parameters
    ----------
    tail : last 12 bytes of the scan, which contain the number of values per point
    form : format from `scan_placement`
    """
    kind = struct.unpack("<3i", tail)[2] if len(tail) == 12 else 0
    channels = ((kind >> 3) & 511) + 1
    if kind & 7 != _ELEMENTS.index("<f4") or channels < 3:
        return False
    return form in _SOLID_FORMATS if form else channels in _SOLID_CHANNELS


def scan_points(blob: bytes, form: int) -> Floats32:
    """Decode the points (N, 3) of a laser scan, metres in the axes of the scan.

    Raise UnreadableCloud if the scan is damaged or two-dimensional.
    """
    try:
        rows = matrix(blob)
    except BrokenBlob as cause:
        raise UnreadableCloud(f"The laser scan is damaged: {cause}. {_AGAIN}") from cause
    if not is_solid(blob[-12:], form):
        raise UnreadableCloud("The laser scan is two-dimensional. Use three-dimensional scans.")
    return np.ascontiguousarray(rows.reshape(-1, rows.shape[2])[:, :3])
