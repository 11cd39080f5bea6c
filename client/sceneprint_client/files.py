"""Readers of whole files up to a size limit, of NPY headers, and of ROS 2 messages.

path  --read_bytes | read_text | read_object-->  content
bytes  --npy_header-->  NpyHeader: type, shape, order, offset of the numbers
bytes  --read_point_cloud | read_livox_scan-->  SerializedCloud
"""

from __future__ import annotations

import ast
import json
import stat
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple

import numpy as np

from sceneprint_client.api.base import MAXIMUM_SAMPLES
from sceneprint_client.errors import FrameError, SceneprintError, UnreadableCloud

#: Number of bytes in one read.
_PIECE = 1 << 20


def read_bytes(path: Path, limit: int, error: type[SceneprintError]) -> bytes:
    """Return the content of a regular file of at most `limit` bytes.

    Parameters
    ----------
    limit : maximum size of the file, bytes
    error : class of the error to raise

    Raises
    ------
    error : If the file is missing, is not a regular file (reading a pipe could block forever), is
        too large, or is not readable.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise error(f"{path}: This is not a regular file. Specify a file that holds the data.")
        with path.open("rb") as file:
            data = _read_some(file, limit + 1)
    except (OSError, ValueError) as cause:  # A NUL in the path raises ValueError.
        reason = getattr(cause, "strerror", None) or cause
        raise error(
            f"{path}: The file cannot be read ({reason}). Check its path and its permissions."
        ) from cause
    if len(data) > limit:
        raise error(
            f"{path}: The file has more than {limit} bytes, the limit for this kind of file. "
            "Check that it is the right file."
        )
    return data


def _read_some(file: BinaryIO, most: int) -> bytes:
    """Read at most `most` bytes in pieces; a single read would allocate `most` bytes at once."""
    pieces, remaining = [], most
    while piece := file.read(min(remaining, _PIECE)):
        pieces.append(piece)
        remaining -= len(piece)
    return b"".join(pieces)


def read_text(path: Path, limit: int, error: type[SceneprintError]) -> str:
    """Return a UTF-8 text file of at most `limit` bytes; see `read_bytes` for the errors."""
    try:
        return read_bytes(path, limit, error).decode("utf-8-sig")
    except UnicodeDecodeError as cause:
        raise error(
            f"{path}: The file is not UTF-8 text ({cause.reason} at byte {cause.start}). "
            "Check that it is the right file."
        ) from cause


def read_object(
    path: Path, limit: int, error: type[SceneprintError], example: str
) -> dict[str, object]:
    """Return the object of a JSON file.

    Raise `error` if the file cannot be read or does not hold a JSON object. The message names the
    file. See `read_text` for the parameters.
    """
    text = read_text(path, limit, error)
    with naming(str(path)):
        try:
            fields = json.loads(text)
        except (ValueError, RecursionError) as cause:
            raise error(f"This is not JSON ({cause}). Write it like {example}.") from cause
        if not isinstance(fields, dict):
            raise error(f"This is not a JSON object. Write an object such as {example}.")
    return fields


def data_lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield the number and content of each line that is neither empty nor a # comment."""
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.strip()
        if content and not content.startswith("#"):
            yield number, content


#: Maximum sizes of a depth image file and of a point file, bytes.
MAXIMUM_IMAGE_BYTES = 8 * MAXIMUM_SAMPLES + 65_536
MAXIMUM_CLOUD_BYTES = 512 << 20


PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
NPY_SIGNATURE = b"\x93NUMPY"
_MAXIMUM_HEADER = 10_000  #: bytes, as in numpy; parsing a literal of this length is safe
_FLOATING = ("<f4", "<f8", "<f2", ">f4", ">f8", ">f2")
_WHOLE = ("<u2", ">u2")


@dataclass(frozen=True)
class NpyHeader:
    """Header of an NPY file with a two-dimensional array of floating-point or uint16 numbers."""

    dtype: np.dtype[Any]
    shape: tuple[int, int]
    order: Literal["C", "F"]
    start: int  #: offset of the numbers, bytes


def npy_header(
    data: bytes, error: type[FrameError], advice: str, shapes: str, *, whole: bool = False
) -> NpyHeader:
    """Return the header of an NPY file with a two-dimensional floating-point array.

    Parameters
    ----------
    data : the file, or its first 10,016 bytes
    error : class of the error to raise
    advice : sentence for the error if the array has another type
    shapes : sentences for the error if the array has another shape
    whole : whether to accept uint16 too

    Raises
    ------
    error : If the header cannot be read, or the array has another type or shape.
    """
    fields, start = _fields(data, error)
    dtype = _dtype(fields["descr"], error, advice, _FLOATING + _WHOLE if whole else _FLOATING)
    shape = fields["shape"]
    if (
        not isinstance(shape, tuple)
        or len(shape) != 2
        or not all(type(n) is int and n >= 0 for n in shape)
    ):
        raise error(shapes)
    return NpyHeader(dtype, shape, "F" if fields["fortran_order"] is True else "C", start)


def _fields(data: bytes, error: type[FrameError]) -> tuple[dict[str, object], int]:
    """Return the header of an NPY file and the offset of its numbers; raise `error` if invalid."""
    damaged = "The header of the NPY file cannot be read. Write the file with numpy.save."
    size = {1: 2, 2: 4, 3: 4}.get(data[6]) if len(data) >= 12 else None
    if size is None:
        raise error(damaged)
    (length,) = struct.unpack_from("<H" if size == 2 else "<I", data, 8)
    start = 8 + size + length
    if length > _MAXIMUM_HEADER or start > len(data):
        raise error(
            f"The NPY header claims a length of {length} bytes, which exceeds the file or the "
            f"limit ({_MAXIMUM_HEADER}). Copy or write the file again."
        )
    try:
        header = ast.literal_eval(data[8 + size : start].decode("utf-8").strip())
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as cause:
        raise error(damaged) from cause
    if not isinstance(header, dict) or set(header) != {"descr", "fortran_order", "shape"}:
        raise error(damaged)
    if not isinstance(header["fortran_order"], bool):
        raise error(damaged)
    return header, start


def _dtype(
    described: object, error: type[FrameError], advice: str, types: tuple[str, ...]
) -> np.dtype[Any]:
    """Return the described type if it is one of `types`; raise `error` with `advice` if not."""
    if described == "|O":
        raise error(
            "The NPY file holds pickled Python objects, which can run code when they are loaded. "
            "Write a plain float32 array in metres."
        )
    # The type is compared, not parsed, since np.dtype accepts almost any text.
    if not isinstance(described, str) or described not in types:
        raise error(
            f"The NPY file holds {described if isinstance(described, str) else 'records'!r:.40}, "
            f"and {advice}"
        )
    return np.dtype(described)


LAS_SIGNATURE = b"LASF"


# ROS 2 messages as the middleware serialises them: PointCloud2 in CDR, in either byte order.

#: Length of the encapsulation header, bytes; alignment counts from its end.
_HEAD = 4
#: Maximum length of a frame's or field's name, bytes, and maximum number of fields of a point.
_LONGEST_NAME, _MOST_FIELDS = 255, 64
#: Maximum number of bytes after the message: middleware pads to whole words.
_MOST_PADDING = 7


@dataclass(frozen=True)
class SerializedField:
    """A sensor_msgs/PointField."""

    name: str
    offset: int
    datatype: int
    count: int


class SerializedStamp(NamedTuple):
    """A builtin_interfaces/Time."""

    sec: int
    nanosec: int


class SerializedHeader(NamedTuple):
    """A std_msgs/Header."""

    stamp: SerializedStamp
    frame_id: str


@dataclass(frozen=True, eq=False)
class SerializedCloud:
    """A sensor_msgs/PointCloud2 whose data is a view of the serialised bytes.

    Attributes have the names of ROS, so an instance can replace a message.

    Parameters
    ----------
    header : stamp and frame of the sensor
    height, width, point_step, row_step, is_bigendian, fields, data : as in the message, without a
        check that they are consistent
    """

    header: SerializedHeader
    height: int
    width: int
    fields: tuple[SerializedField, ...]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: memoryview


def read_point_cloud(data: bytes) -> SerializedCloud:
    """Return the message of a serialised PointCloud2 without copying its data.

    Raise UnreadableCloud if the bytes are not such a message, are truncated, or have trailing data.
    """
    if not _is_encapsulated(data):
        raise UnreadableCloud(
            "This is not a serialised PointCloud2: it does not start with a CDR header. Send the "
            "output of rclpy.serialization.serialize_message."
        )
    reader = _Reader(data)
    header = _read_header(reader)
    height, width = reader.word(), reader.word()
    fields = _read_fields(reader)
    is_bigendian = reader.byte() != 0
    point_step, row_step, size = reader.word(), reader.word(), reader.word()
    points = reader.bytes(size)
    reader.byte()  # is_dense is ignored: missing points are detected by their values
    if reader.left > _MOST_PADDING:
        raise UnreadableCloud(
            f"{reader.left} bytes follow the end of the PointCloud2, so it is damaged or has "
            "another type. Serialise it again."
        )
    return SerializedCloud(
        header, height, width, fields, is_bigendian, point_step, row_step, points
    )


#: Fields that are read from a point of a CustomMsg, and length of a point without padding, bytes.
_LIVOX_FIELDS = (
    SerializedField("offset_time", 0, 6, 1),
    SerializedField("x", 4, 7, 1),
    SerializedField("y", 8, 7, 1),
    SerializedField("z", 12, 7, 1),
    SerializedField("tag", 17, 2, 1),
    SerializedField("line", 18, 2, 1),
)
_LIVOX_POINT = 19


def read_livox_scan(data: bytes, *, ros1: bool = False) -> SerializedCloud:
    """Return a serialised CustomMsg of livox_ros_driver or livox_ros_driver2 as a PointCloud2.

    Parameters
    ----------
    data : message in the serialisation of ROS 2, or of ROS 1
    ros1 : whether ROS 1 serialised the message

    Raises
    ------
    UnreadableCloud : If the bytes are not such a message, are truncated, or have trailing data.
    """
    if not ros1 and not _is_encapsulated(data):
        raise UnreadableCloud(
            "This is not a serialised CustomMsg: it does not start with a CDR header. Send the "
            "output of rclpy.serialization.serialize_message."
        )
    reader = _Reader(data, ros1=ros1)
    header = _read_header(reader)
    reader.align(8)
    reader.bytes(8)  # timebase, which the stamp of the header repeats
    declared = reader.word()
    reader.bytes(4)  # skip lidar_id and rsvd
    count = reader.word()
    # CDR pads a point to whole words, except the last one.
    step = _LIVOX_POINT if ros1 else _LIVOX_POINT + 1
    points = reader.bytes(max(count * step - (not ros1), 0))
    if count != declared or reader.left > _MOST_PADDING:
        raise UnreadableCloud(
            f"The CustomMsg declares {declared} points, but holds {count}, and {reader.left} bytes "
            "follow. It is damaged or has another type. Record it again."
        )
    if count and not ros1:
        points = memoryview(bytes(points) + b"\0")
    return SerializedCloud(
        header, 1, count, _LIVOX_FIELDS, reader.is_bigendian, step, count * step, points
    )


def _is_encapsulated(data: bytes) -> bool:
    """Return whether the bytes start with a plain CDR header: 0, byte order, 0, padding."""
    return len(data) >= _HEAD and data[0] == 0 and data[1] <= 1 and data[2] == 0 and data[3] <= 3


def _read_header(reader: _Reader) -> SerializedHeader:
    if reader.is_ros1:
        reader.word()  # skip seq
    seconds, nanoseconds = reader.word(), reader.word()
    if nanoseconds >= 1_000_000_000:
        raise UnreadableCloud(
            f"The stamp of the message has {nanoseconds} nanoseconds, so it is damaged or has "
            "another type. Serialise it again."
        )
    return SerializedHeader(SerializedStamp(seconds, nanoseconds), reader.text())


def _read_fields(reader: _Reader) -> tuple[SerializedField, ...]:
    count = reader.word()
    if count > _MOST_FIELDS:
        raise UnreadableCloud(
            f"The PointCloud2 declares {count} fields; the limit is {_MOST_FIELDS}. "
            "Serialise it again with fewer fields."
        )
    return tuple(
        SerializedField(reader.text(), reader.word(), reader.byte(), reader.word())
        for _ in range(count)
    )


class _Reader:
    """Reader of the values of a message; raises UnreadableCloud at a premature end."""

    def __init__(self, data: bytes, *, ros1: bool = False) -> None:
        self.is_ros1, self.is_bigendian = ros1, not ros1 and not data[1] & 1
        self._data = memoryview(data)
        self._word = struct.Struct(">I" if self.is_bigendian else "<I")
        self._at = 0 if ros1 else _HEAD

    @property
    def left(self) -> int:
        """Number of unread bytes."""
        return len(self._data) - self._at

    def bytes(self, count: int) -> memoryview:
        """Return the next bytes."""
        if count > self.left:
            raise UnreadableCloud(
                f"The message is truncated: {count} bytes are expected at byte {self._at}, but "
                f"only {self.left} follow. Serialise it again."
            )
        self._at += count
        return self._data[self._at - count : self._at]

    def byte(self) -> int:
        """Return the next byte."""
        return self.bytes(1)[0]

    def align(self, size: int) -> None:
        """Skip the padding before a number of `size` bytes; ROS 1 does not pad."""
        self.bytes(0 if self.is_ros1 else (_HEAD - self._at) % size)

    def word(self) -> int:
        """Return the next number of four bytes, after alignment."""
        self.align(4)
        (value,) = self._word.unpack(self.bytes(4))
        return int(value)

    def text(self) -> str:
        """Return the next string, without its terminating zero."""
        length = self.word()
        if length > _LONGEST_NAME + 1:
            raise UnreadableCloud(
                f"A name in the message has {length} bytes; the limit is {_LONGEST_NAME}. "
                "Serialise it again."
            )
        return bytes(self.bytes(length)).rstrip(b"\0").decode("utf-8", "replace")


@contextmanager
def naming(subject: str) -> Iterator[None]:
    """Prefix messages of SceneprintErrors raised in the block with a subject, such as a path."""
    try:
        yield
    except SceneprintError as error:
        if not subject:
            raise
        raise type(error)(f"{subject}: {error}") from error
