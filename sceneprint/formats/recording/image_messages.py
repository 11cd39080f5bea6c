"""Depth images and cameras of ROS, as the bytes and the camera of a frame.

Image | CompressedImage  --depth_file-->  bytes of a PNG or NPY file
CameraInfo  --intrinsics_of-->  Intrinsics
"""

from __future__ import annotations

import io
import math
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import InvalidIntrinsics, UnreadableFrame
from sceneprint.formats.image.depth_file import PNG_SIGNATURE, decode_png, encode_png
from sceneprint.types import MAXIMUM_SAMPLES, Floats32
from sceneprint_client.sidecars import Intrinsics

#: Encodings of images that are depth: 16-bit millimetres, or metres (REP 118).
ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
#: Stored units per metre of the 16-bit ones.
DEPTH_SCALE = 1000.0
#: Bytes before the PNG of a compressedDepth message: a format, and two floats a and b.
_HEADER_BYTES = 12
#: Bytes within which the PNG begins.
_MOST_BEFORE_PNG = 64


def image_encoding(message: Any, *, compressed: bool) -> str | None:
    """Encoding of an image's depth; None where it is of colour, or compressed otherwise.

    Parameters
    ----------
    message : sensor_msgs Image, or CompressedImage
    compressed : which of them
    """
    if not compressed:
        return str(message.encoding) if message.encoding in ENCODINGS else None
    told = str(message.format)
    if "compressedDepth" not in told:
        return None
    encoding = told.partition(";")[0].strip()
    return encoding if encoding in ENCODINGS else None


def depth_file(message: Any, *, compressed: bool) -> bytes:
    """Return the bytes of a PNG or NPY file with the samples of a depth image.

    Parameters
    ----------
    message : sensor_msgs Image, or CompressedImage of compressed_depth_image_transport
    compressed : which of them

    Returns
    -------
    data : a 16-bit PNG of millimetres, or an NPY array of float32 metres

    Raises
    ------
    UnreadableFrame : the message is of another encoding, or its sizes contradict each other.
    """
    if compressed:
        return _decompressed(message)
    kind = ENCODINGS.get(message.encoding)
    if kind is None:
        raise UnreadableFrame(
            f"The image has the encoding {message.encoding!r:.40}, and depth is 16UC1, mono16 or "
            "32FC1. Name the topic of the depth images."
        )
    samples = _samples(message, np.dtype((">" if message.is_bigendian else "<") + kind))
    if kind == "f4":
        return npy_file(samples.astype("<f4"))
    return encode_png(samples.astype(np.uint16))


def _samples(message: Any, kind: np.dtype[Any]) -> NDArray[Any]:
    """Samples (H, W) of an image whose rows may be longer than they need to be."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    row = width * kind.itemsize
    if not 0 < width * height <= MAXIMUM_SAMPLES or step < row:
        raise UnreadableFrame(
            f"The image announces {width} x {height} samples in rows of {step} bytes; 1 to "
            f"{MAXIMUM_SAMPLES} samples are read. Record it again."
        )
    data = np.frombuffer(memoryview(message.data), np.uint8)
    if len(data) < step * height:
        raise UnreadableFrame(
            f"The image has {len(data)} bytes, and {height} rows of {step} bytes are announced. "
            "Record it again."
        )
    rows = data[: step * height].reshape(height, step)[:, :row]
    return np.ascontiguousarray(rows).view(kind)


def _decompressed(message: Any) -> bytes:
    """The PNG of a 16UC1 image as it is; of 32FC1 the metres that its inverse depth stands for."""
    encoding = image_encoding(message, compressed=True)
    data = bytes(memoryview(message.data))
    at = data.find(PNG_SIGNATURE, 0, _MOST_BEFORE_PNG)
    if encoding is None or at < 0:
        raise UnreadableFrame(
            f"The image has the format {message.format!r:.60}, and of compressed depth only PNG of "
            "16UC1 and 32FC1 is read. Record the raw topic, or set the transport's format to png."
        )
    if encoding != "32FC1":
        return data[at:]
    if at < _HEADER_BYTES:
        raise UnreadableFrame(
            "The image of 32FC1 lacks the 12 bytes that say how its depth is stored. Record it "
            "again."
        )
    a, b = struct.unpack_from("<ff", data, 4)
    if not (math.isfinite(a) and math.isfinite(b) and a > 0):
        raise UnreadableFrame(
            f"The image stores inverse depth by a = {a:g} and b = {b:g}, and these are no such "
            "numbers. Record it again."
        )
    return npy_file(inverse_depth(decode_png(data[at:]), a, b))


def inverse_depth(samples: NDArray[np.uint16], a: float, b: float) -> Floats32:
    """Metres (H, W) of quantised inverse depth, z = a / (v - b); 0 where missing."""
    values = np.arange(65_536, dtype=np.float64)
    with np.errstate(all="ignore"):
        table = (a / (values - b)).astype(np.float32)
    table[~(np.isfinite(table) & (table > 0))] = 0.0
    table[0] = 0.0
    return table[samples]


def npy_file(samples: NDArray[Any]) -> bytes:
    """Bytes of an NPY file."""
    file = io.BytesIO()
    np.save(file, np.ascontiguousarray(samples))
    return file.getvalue()


# The camera.


def is_calibrated(info: Any) -> bool:
    """Whether a CameraInfo says anything: drivers without a calibration send zeros."""
    k = _numbers(info, "k", 9)
    return k is not None and k[0] > 0 and k[4] > 0


def intrinsics_of(info: Any, *, rectified: bool) -> Intrinsics:
    """Return the camera that a CameraInfo describes.

    Parameters
    ----------
    info : sensor_msgs CameraInfo
    rectified : whether the images have been rectified: their camera is P, without distortion

    Raises
    ------
    InvalidIntrinsics : it describes no camera, or a lens that is not supported.
    """
    k, p = _numbers(info, "k", 9), _numbers(info, "p", 12)
    if k is None:
        raise InvalidIntrinsics("The camera info has no matrix K. Calibrate the camera.")
    fx, fy, cx, cy = k[0], k[4], k[2], k[5]
    distortion: tuple[float, ...] = ()
    if rectified and p is not None and p[0] > 0 and p[5] > 0:
        fx, fy, cx, cy = p[0], p[5], p[2], p[6]
    elif not rectified:
        distortion = _distortion(info)
    if int(info.binning_x) > 1 or int(info.binning_y) > 1:
        raise InvalidIntrinsics(
            f"The camera info has a binning of {info.binning_x} x {info.binning_y}, which is not "
            "supported. Write the camera of the binned images into an intrinsics.json."
        )
    width, height, roi = int(info.width), int(info.height), info.roi
    if int(roi.width) and int(roi.height):
        width, height = int(roi.width), int(roi.height)
        cx, cy = cx - int(roi.x_offset), cy - int(roi.y_offset)
    return Intrinsics(width, height, fx, fy, cx, cy, distortion)


def _distortion(info: Any) -> tuple[float, ...]:
    """Coefficients k1, k2, p1, p2[, k3] of a lens, none where it does not distort."""
    told = getattr(info, "d", None)
    d = [float(value) for value in (info.D if told is None else told)]
    if not any(d):
        return ()
    model = str(info.distortion_model)
    if model in ("plumb_bob", "rational_polynomial", "") and len(d) in (4, 5, 8, 12, 14):
        if not any(d[5:]):
            return tuple(d[:5])
        raise InvalidIntrinsics(
            "The camera info has the lens model rational_polynomial with k4, k5 or k6, of which "
            "only k1, k2, p1, p2 and k3 are supported. Record the rectified images."
        )
    raise InvalidIntrinsics(
        f"The camera info has the lens model {model!r:.40} with {len(d)} coefficients; supported "
        "is plumb_bob. Record the rectified images."
    )


def _numbers(info: Any, name: str, count: int) -> list[float] | None:
    """A matrix of a CameraInfo: ROS 1 has capital names, ROS 2 small ones."""
    found = getattr(info, name, None)
    numbers = [float(value) for value in (getattr(info, name.upper()) if found is None else found)]
    return numbers if len(numbers) == count else None
