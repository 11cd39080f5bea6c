"""Contents of decoded ROS messages: depth, points, cameras and poses.

Image  --depth_samples-->  (H, W);  CompressedImage  --compressed_depth-->  CompressedDepth
PointCloud2  --cloud_points-->  (N, 3);  PointCloud2  --timed_points-->  (N, 3), seconds (N,)
CameraInfo  --camera_intrinsics-->  Intrinsics
Transform | Pose  --transform_row | pose_row-->  x y z, quaternion

A message is any object with the attributes of its ROS type, from rclpy, rosbags or ROS 1.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint_client.api.base import MAXIMUM_SAMPLES, Intrinsics
from sceneprint_client.errors import InvalidIntrinsics, UnreadableCloud, UnreadableFrame, printable
from sceneprint_client.files import PNG_SIGNATURE
from sceneprint_client.poses import Floats

# Depth images.

#: Encodings of depth images: 16-bit millimetres, or metres (REP 118).
ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
#: Stored units per metre in 16-bit images.
DEPTH_SCALE = 1000.0
#: Length of the header of a compressedDepth message, bytes: a format, and two floats a and b.
TRANSPORT_BYTES = 12
#: Maximum offset of the PNG, bytes.
_MOST_BEFORE_PNG = 64
#: Number of first bytes of a PNG that contain its bit depth and colour type.
_PNG_HEAD = 26


def image_encoding(message: Any, *, compressed: bool) -> str | None:
    """Return the encoding of a depth image; None for colour or another compression.

    Parameters
    ----------
    message : sensor_msgs Image or CompressedImage
    compressed : whether it is a CompressedImage
    """
    if not compressed:
        return str(message.encoding) if message.encoding in ENCODINGS else None
    encoding = str(message.format).partition(";")[0].strip()
    if "compressedDepth" in str(message.format):
        return encoding if encoding in ENCODINGS else None
    # A PNG of 16 bits and one channel holds depth.
    head = bytes(memoryview(message.data)[:_PNG_HEAD])
    is_deep = head.startswith(PNG_SIGNATURE) and head[24:26] == b"\x10\x00"
    encoding = encoding if encoding in ENCODINGS else "16UC1"
    return encoding if is_deep and encoding != "32FC1" else None


def depth_samples(message: Any) -> NDArray[Any]:
    """Return the samples (H, W) of a depth image: uint16 millimetres, or float32 metres.

    `message`: sensor_msgs Image. Raise UnreadableFrame if the encoding is not supported, or the
    sizes contradict each other.
    """
    kind = ENCODINGS.get(message.encoding)
    if kind is None:
        raise UnreadableFrame(
            f"The image has the encoding {message.encoding!r:.40}, but depth must be 16UC1, mono16 "
            "or 32FC1. Specify the topic of the depth images."
        )
    samples = _samples(message, np.dtype((">" if message.is_bigendian else "<") + kind))
    return samples.astype("<" + kind)


def _samples(message: Any, kind: np.dtype[Any]) -> NDArray[Any]:
    """Return the samples (H, W) of an image, without the padding of its rows."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    row = width * kind.itemsize
    if not 0 < width * height <= MAXIMUM_SAMPLES or step < row:
        raise UnreadableFrame(
            f"The image declares {width} x {height} samples in rows of {step} bytes; the limit is "
            f"{MAXIMUM_SAMPLES} samples. Record it again."
        )
    data = np.frombuffer(memoryview(message.data), np.uint8)
    if len(data) < step * height:
        raise UnreadableFrame(
            f"The image has {len(data)} bytes, but declares {height} rows of {step} bytes. "
            "Record it again."
        )
    rows = data[: step * height].reshape(height, step)[:, :row]
    return np.ascontiguousarray(rows).view(kind)


@dataclass(frozen=True, eq=False)
class CompressedDepth:
    """A compressed depth image.

    Parameters
    ----------
    png : PNG of 16-bit samples; empty for another compression
    samples : (H, W) samples of another compression; None for PNG
    inverse : a and b of a 32FC1 image with z = a / (v - b) metres; None for 16UC1 millimetres
    """

    png: bytes
    samples: NDArray[np.uint16] | None
    inverse: tuple[float, float] | None

    def body(self) -> bytes | NDArray[Any]:
        """Return the frame for a service: a PNG, with its header if the depth is inverse, or an
        array of millimetres or metres.
        """
        if self.samples is not None:
            return (
                self.samples if self.inverse is None else inverse_depth(self.samples, *self.inverse)
            )
        if self.inverse is None:
            return self.png
        return struct.pack("<iff", 0, *self.inverse) + self.png


def compressed_depth(message: Any) -> CompressedDepth:
    """Return the samples of a compressed depth image and their relation to metres.

    `message`: sensor_msgs CompressedImage of compressed_depth_image_transport (PNG or RVL), or of a
    16-bit PNG. Raise UnreadableFrame if the compression is not supported, or its header is missing.
    """
    encoding = image_encoding(message, compressed=True)
    data = bytes(memoryview(message.data))
    at = data.find(PNG_SIGNATURE, 0, _MOST_BEFORE_PNG)
    is_rvl = "rvl" in str(message.format).partition("compressedDepth")[2].lower()
    if encoding is None or (at < 0 and not is_rvl):
        raise UnreadableFrame(
            f"The image has the format {message.format!r:.60}; compressed depth must be PNG or "
            "RVL of 16UC1 or 32FC1. Record the raw topic, or set the transport's format "
            "to png."
        )
    samples = rvl_samples(data[TRANSPORT_BYTES:]) if is_rvl else None
    png = b"" if is_rvl else data[at:]
    if encoding != "32FC1":
        return CompressedDepth(png, samples, None)
    if not is_rvl and at < TRANSPORT_BYTES:
        raise UnreadableFrame(
            "The 32FC1 image lacks the 12-byte header with its quantisation. Record it again."
        )
    a, b = struct.unpack_from("<ff", data, 4)
    if not (math.isfinite(a) and math.isfinite(b) and a > 0):
        raise UnreadableFrame(
            f"The image stores inverse depth with a = {a:g} and b = {b:g}, which are out of range. "
            "Record it again."
        )
    return CompressedDepth(png, samples, (a, b))


def inverse_depth(samples: NDArray[np.uint16], a: float, b: float) -> NDArray[np.float32]:
    """Return metres (H, W) of quantised inverse depth, z = a / (v - b); 0 where missing."""
    values = np.arange(65_536, dtype=np.float64)
    with np.errstate(all="ignore"):
        table = (a / (values - b)).astype(np.float32)
    table[~(np.isfinite(table) & (table > 0))] = 0.0
    table[0] = 0.0
    return table[samples]


def rvl_samples(data: bytes) -> NDArray[np.uint16]:
    """Return the samples (H, W) of RVL data that follow a width and a height.

    Runs of zeros alternate with runs of values, stored as zigzag-coded differences between
    neighbours. Numbers are groups of three bits, lowest first, each with a continuation bit, in
    big-endian words of 32 bits (Wilson, Fast Lossless Depth Image Compression, 2017).

    Raise UnreadableFrame if the data is truncated, the size is invalid, or a sample exceeds 16
    bits.
    """
    broken = UnreadableFrame("The RVL-compressed image is damaged. Record it again.")
    width, height = struct.unpack_from("<II", data) if len(data) >= 8 else (0, 0)
    if not 0 < width * height <= MAXIMUM_SAMPLES:
        raise broken
    words = np.frombuffer(data[8 : 8 + (len(data) - 8) // 4 * 4], "<u4").astype(">u4")
    packed = words.view(np.uint8)
    nibbles = np.stack([packed >> 4, packed & 15], axis=1).reshape(-1).astype(np.int64)
    ends = np.flatnonzero(nibbles < 8)
    if not len(ends):
        raise broken
    starts = np.concatenate([[0], ends[:-1] + 1])
    place = np.arange(ends[-1] + 1) - np.repeat(starts, ends - starts + 1)
    parts = (nibbles[: ends[-1] + 1] & 7) << np.minimum(3 * place, 60)
    numbers = np.add.reduceat(parts, starts)
    samples = np.zeros(width * height, np.int64)
    done, at, last = 0, 0, 0
    while done < len(samples):
        if at + 2 > len(numbers):
            raise broken
        zeros, values = int(numbers[at]), int(numbers[at + 1])
        done, at = done + zeros, at + 2
        if zeros < 0 or values < 0 or done + values > len(samples) or at + values > len(numbers):
            raise broken
        if values:
            coded = numbers[at : at + values]
            samples[done : done + values] = last + np.cumsum((coded >> 1) ^ -(coded & 1))
            done, at = done + values, at + values
            last = int(samples[done - 1])
        elif not zeros:
            raise broken
    if samples.min() < 0 or samples.max() > 65_535:
        raise broken
    return samples.astype(np.uint16).reshape(height, width)


# Cameras.


def is_calibrated(info: Any) -> bool:
    """Return whether a CameraInfo is calibrated; drivers without a calibration send zeros."""
    k = _numbers(info, "k", 9)
    return k is not None and k[0] > 0 and k[4] > 0


def camera_intrinsics(info: Any, *, rectified: bool) -> Intrinsics:
    """Return the intrinsics of a CameraInfo.

    Parameters
    ----------
    info : sensor_msgs CameraInfo
    rectified : whether the images are rectified, so that their camera is P without distortion

    Raises
    ------
    InvalidIntrinsics : If `info` does not describe a camera, or has a binning or a lens model that
        is not supported.
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
            "supported. Write the intrinsics of the binned images to an intrinsics.json."
        )
    width, height, roi = int(info.width), int(info.height), info.roi
    if int(roi.width) and int(roi.height):
        width, height = int(roi.width), int(roi.height)
        cx, cy = cx - int(roi.x_offset), cy - int(roi.y_offset)
    return Intrinsics(width, height, fx, fy, cx, cy, distortion)


def is_rectified(topic: str) -> bool:
    """Return whether the name of a topic indicates rectified images."""
    return "rect" in topic_without_transport(topic).rpartition("/")[2]


def topic_without_transport(topic: str) -> str:
    """Return the name of an image topic without the suffix of its compression."""
    base, _, last = topic.rpartition("/")
    return base if last in ("compressedDepth", "compressed") else topic


#: Names of lens models of fisheye cameras.
_FISHEYE = re.compile("equi|kannala|fisheye|theta|fov|omni|unified|sphere|mei", re.IGNORECASE)


def _distortion(info: Any) -> tuple[float, ...]:
    """Return the lens coefficients k1, k2, p1, p2[, k3[, k4, k5, k6]]; () if all are 0.

    Raise InvalidIntrinsics for another lens model. Coefficients of 0 of a fisheye model do not
    describe a pinhole camera.
    """
    distortion = getattr(info, "d", None)
    d = [float(value) for value in (info.D if distortion is None else distortion)]
    model = str(info.distortion_model)
    if not any(d) and not _FISHEYE.search(model):
        return ()
    if model in ("plumb_bob", "rational_polynomial", "") and len(d) in (4, 5, 8, 12, 14):
        if not any(d[8:]):
            return tuple(d[:8] if any(d[5:]) else d[:5])
        raise InvalidIntrinsics(
            "The camera info has a lens with thin prisms or a tilted sensor; only the coefficients "
            "k1 to k6, p1 and p2 are supported. Record the rectified images."
        )
    raise InvalidIntrinsics(
        f"The camera info has the lens model {model!r:.40} with {len(d)} coefficients; only "
        "plumb_bob and rational_polynomial are supported. Record the rectified images."
    )


def _numbers(info: Any, name: str, count: int) -> list[float] | None:
    """Return the `count` numbers of a matrix of a CameraInfo (ROS 1: upper-case name), or None."""
    values = getattr(info, name, None)
    numbers = [float(v) for v in (getattr(info, name.upper()) if values is None else values)]
    return numbers if len(numbers) == count else None


# Points.

#: NumPy types by the type number of sensor_msgs/PointField.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
#: Fields of a PointCloud2 with the time of a point: integers in nanoseconds, floating point in
#: seconds, after the message's stamp, or for `timestamp` after the epoch of its clock.
TIME_FIELDS = (
    "offset_time",  # CustomMsg of Livox
    "t",  # Ouster
    "time",  # Velodyne
    "timestamp",  # Hesai and RoboSense in seconds; PointCloud2 of Livox in nanoseconds
)
#: Longest time from the first to the last point of a scan, seconds; longer times are ignored.
LONGEST_SCAN_S = 1.0
#: Bit of Livox's field `tag` that is set for noise, as FAST-LIO reads it: a third or later return
#: (Avia, Horizon), or low confidence (Mid-360).
_NOISE = 0x20
#: Maximum number of points of a message.
MOST_POINTS = 20_000_000
#: Number of points in one block of a conversion.
_BLOCK = 1 << 16


def cloud_points(message: Any) -> NDArray[np.float32]:
    """Return the valid points (N, 3) of a message, metres.

    Points are invalid if they are noise, not finite, or at the sensor's origin, which some drivers
    write for missing returns.

    `message`: sensor_msgs PointCloud2 with fields x, y and z, organised or not. Raise
    UnreadableCloud if x, y or z is missing, or the sizes contradict each other.
    """
    table, blocks = cloud_table(message), []
    with np.errstate(all="ignore"):  # coordinates that overflow count as missing
        for block in cloud_blocks(table):
            points = block.astype(np.float32)
            blocks.append(points[np.isfinite(points).all(axis=1)])
    return np.concatenate(blocks) if blocks else np.empty((0, 3), np.float32)


def timed_points(message: Any) -> tuple[Floats, Floats | None]:
    """Return the valid points (N, 3) of a message, metres, and their times after its stamp (N,).

    The times, seconds, are None if they are missing or span more than a second. If the sensor and
    the stamp use different clocks, times count from the earliest point. The parameter and the
    errors are those of `cloud_points`.
    """
    table = cloud_table(message)
    points = np.concatenate([np.empty((0, 3)), *cloud_blocks(table)])
    with np.errstate(all="ignore"):  # coordinates that overflow count as missing
        is_valid = np.isfinite(points.astype(np.float32)).all(axis=1)
    name = time_field(table)
    if name is None or not is_valid.any():
        return points[is_valid], None
    times = table[name].reshape(-1)[is_valid].astype(np.float64)
    unit = 1.0 if table.dtype[name].kind == "f" else 1e-9
    if name == "timestamp":
        stamp_ns = stamp_of(message.header)
        by_unit = [times - stamp_ns * 1e-9, (times - stamp_ns) * 1e-9]
        seconds = min(by_unit, key=lambda times_after: abs(float(times_after[0])))
    else:
        seconds = times * unit
    if not np.ptp(seconds) <= LONGEST_SCAN_S:
        return points[is_valid], None
    if np.abs(seconds).max() > LONGEST_SCAN_S:
        seconds = seconds - seconds.min()
    return points[is_valid], seconds


def time_field(table: NDArray[np.void]) -> str | None:
    """Return the name of the time field of a `cloud_table`, or None."""
    return next((name for name in TIME_FIELDS if name in (table.dtype.names or ())), None)


def cloud_table(message: Any) -> NDArray[np.void]:
    """Return x, y, z, time and Livox tag of a PointCloud2 as a structured view (rows, columns).

    The parameter and the errors are those of `cloud_points`.
    """
    width, height = int(message.width), int(message.height)
    step, row = int(message.point_step), int(message.row_step)
    data = memoryview(message.data).cast("B")
    if width * height > MOST_POINTS:
        raise UnreadableCloud(
            f"The cloud declares {width} x {height} points; the limit is {MOST_POINTS}. "
            "Downsample it."
        )
    if height == 1 or row == 0:  # some drivers do not set row_step
        row = width * step
    if step < 1 or row < width * step or len(data) < row * height:
        raise UnreadableCloud(
            f"The cloud has {len(data)} bytes, but declares {height} rows of {width} points of "
            f"{step} bytes. Record it again."
        )
    if not width * height:
        return np.empty((0, 0), [(name, "f4") for name in "xyz"])
    kind = _point_type(message, step)
    table: NDArray[np.void] = np.ndarray((height, width), kind, data, strides=(row, step))
    return table


def cloud_blocks(table: NDArray[np.void]) -> Iterator[Floats]:
    """Yield the points of a table in blocks (n, 3), with NaN for noise and the sensor's origin."""
    height, width = table.shape
    rows = max(1, _BLOCK // max(width, 1))
    for first in range(0, height, rows):
        for column in range(0, width, _BLOCK):
            part = table[first : first + rows, column : column + _BLOCK]
            block = np.empty((part.size, 3))
            for axis, name in enumerate("xyz"):
                block[:, axis] = part[name].reshape(-1)
            block[~block.any(axis=1)] = np.nan
            if "tag" in (table.dtype.names or ()):
                block[(part["tag"].reshape(-1) & _NOISE) != 0] = np.nan
            yield block


def _point_type(message: Any, step: int) -> np.dtype[Any]:
    """Return the structured type of a point of `step` bytes, with the fields of `cloud_table`."""
    order = ">" if message.is_bigendian else "<"
    fields: dict[str, tuple[str, int]] = {}
    for field in message.fields:
        kind = _TYPES.get(int(field.datatype))
        if kind is not None and int(field.count) in (0, 1):
            fields[str(field.name)] = (order + kind, int(field.offset))
    names = list("xyz")
    if fields.keys().isdisjoint(names):  # some drivers write X, Y and Z
        fields = {
            name.lower() if name in ("X", "Y", "Z") else name: fields[name] for name in fields
        }
    if not fields.keys() >= set(names):
        listed = ", ".join(str(field.name) for field in message.fields[:20])
        raise UnreadableCloud(
            f"The cloud has the fields {printable(listed[:120]) or 'none'}, but x, y and z are "
            "required. Specify the topic of the points."
        )
    names += [name for name in TIME_FIELDS if name in fields][:1]
    if "line" in fields and fields.get("tag", ("", 0))[0].endswith("u1"):
        names.append("tag")
    if any(fields[name][1] + np.dtype(fields[name][0]).itemsize > step for name in names):
        raise UnreadableCloud(
            f"The fields of the cloud do not fit into its points of {step} bytes. Record it again."
        )
    layout: Any = {
        "names": names,
        "formats": [fields[name][0] for name in names],
        "offsets": [fields[name][1] for name in names],
        "itemsize": step,
    }
    points: np.dtype[Any] = np.dtype(layout)
    return points


# Stamps and poses.


def stamp_of(header: Any) -> int:
    """Return the stamp of a message's header, nanoseconds."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def transform_row(transform: Any) -> list[float]:
    """Return x y z and the quaternion x y z w of a geometry_msgs Transform."""
    turn = transform.rotation
    return [*vector_row(transform.translation), *vector_row(turn), float(turn.w)]


def pose_row(pose: Any) -> list[float]:
    """Return x y z and the quaternion x y z w of a geometry_msgs Pose."""
    turn = pose.orientation
    return [*vector_row(pose.position), *vector_row(turn), float(turn.w)]


def vector_row(vector: Any) -> list[float]:
    """Return x y z of a geometry_msgs Vector3, Point or Quaternion."""
    return [float(vector.x), float(vector.y), float(vector.z)]
