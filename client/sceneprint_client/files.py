"""Files of frames: their content up to a limit, headers of NPY files, and messages of ROS 2.

path  --read_bytes | read_text | read_object-->  content
bytes  --npy_header-->  NpyHeader: type, shape, order, where the numbers begin
bytes  --read_point_cloud-->  SerializedCloud
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
from typing import Any, BinaryIO, Literal

import numpy as np

from sceneprint_client.api.base import MAXIMUM_SAMPLES
from sceneprint_client.errors import FrameError, SceneprintError, UnreadableCloud

#: Bytes that are read at once.
_PIECE = 1 << 20


def read_bytes(path: Path, limit: int, error: type[SceneprintError]) -> bytes:
    """Return the content of a regular file of at most `limit` bytes.

    Parameters
    ----------
    path : the file
    limit : bytes; a larger file is refused unread
    error : what to raise

    Raises
    ------
    error : the file is absent, is no regular file (a pipe could wait for ever), is too
        large, or may not be read.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise error(f"{path}: This is no regular file. Name a file that holds the data.")
        with path.open("rb") as file:
            data = _read_some(file, limit + 1)
    except (OSError, ValueError) as cause:  # ValueError: a NUL in the name
        reason = getattr(cause, "strerror", None) or cause
        raise error(
            f"{path}: The file cannot be read ({reason}). Check its name and your rights."
        ) from cause
    if len(data) > limit:
        raise error(
            f"{path}: The file has more than {limit} bytes, the most that is read. "
            "Check that it is the file you meant."
        )
    return data


def _read_some(file: BinaryIO, most: int) -> bytes:
    """Return at most so many bytes; `file.read(most)` would allocate as many for a file of ten."""
    pieces, left = [], most
    while piece := file.read(min(left, _PIECE)):
        pieces.append(piece)
        left -= len(piece)
    return b"".join(pieces)


def read_text(path: Path, limit: int, error: type[SceneprintError]) -> str:
    """Return a UTF-8 text file of at most `limit` bytes; raises as `read_bytes`."""
    try:
        return read_bytes(path, limit, error).decode("utf-8-sig")
    except UnicodeDecodeError as cause:
        raise error(
            f"{path}: The file is no text ({cause.reason} at byte {cause.start}). "
            "Check that it is the file you meant."
        ) from cause


def read_object(
    path: Path, limit: int, error: type[SceneprintError], example: str
) -> dict[str, object]:
    """Return the object of a JSON file.

    Parameters
    ----------
    path, limit, error : see `read_text`
    example : what such a file looks like, for errors

    Raises
    ------
    SceneprintError : as `read_text`; or it is no JSON, or no object. It names the file.
    """
    text = read_text(path, limit, error)
    with naming(str(path)):
        try:
            fields = json.loads(text)
        except (ValueError, RecursionError) as cause:
            raise error(f"This is not JSON ({cause}). Write it such as {example}.") from cause
        if not isinstance(fields, dict):
            raise error(f"This is no JSON object. Write it such as {example}.")
    return fields


def data_lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield number and content of the lines that are neither empty nor a # comment."""
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.strip()
        if content and not content.startswith("#"):
            yield number, content


#: Longest files of a depth image and of points that are read, bytes.
MAXIMUM_IMAGE_BYTES = 8 * MAXIMUM_SAMPLES + 65_536
MAXIMUM_CLOUD_BYTES = 512 << 20


PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
NPY_SIGNATURE = b"\x93NUMPY"
_MAXIMUM_HEADER = 10_000  #: bytes, as in numpy; a literal that long can still be parsed safely
_FLOATING = ("<f4", "<f8", "<f2", ">f4", ">f8", ">f2")
_WHOLE = ("<u2", ">u2")


@dataclass(frozen=True)
class NpyHeader:
    """What an NPY file says of itself: an array of two dimensions, floating or uint16."""

    dtype: np.dtype[Any]
    shape: tuple[int, int]
    order: Literal["C", "F"]
    start: int  #: of its numbers, bytes


def npy_header(
    data: bytes, error: type[FrameError], advice: str, shapes: str, *, whole: bool = False
) -> NpyHeader:
    """Return the header of an NPY file of floating numbers in rows and columns.

    Parameters
    ----------
    data : the file, or its first 10,016 bytes
    error : to raise
    advice : what to write instead of an array of another type; a sentence
    shapes : what to write instead of one of another shape; two sentences
    whole : take uint16 too

    Raises
    ------
    error : it cannot be read, or is of another type or shape.
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
    """Return the header and the place where the numbers begin."""
    damaged = "The header of the NPY file cannot be read. Write the file with numpy.save."
    size = {1: 2, 2: 4, 3: 4}.get(data[6]) if len(data) >= 12 else None
    if size is None:
        raise error(damaged)
    (length,) = struct.unpack_from("<H" if size == 2 else "<I", data, 8)
    start = 8 + size + length
    if length > _MAXIMUM_HEADER or start > len(data):
        raise error(
            f"The NPY header announces {length} bytes of itself, more than it has or may have "
            f"({_MAXIMUM_HEADER}). Copy or write the file again."
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
    if described == "|O":
        raise error(
            "The NPY file holds pickled Python objects, which could run code. "
            "Write a plain float32 array in metres."
        )
    # compared, not parsed: np.dtype would take almost anything
    if not isinstance(described, str) or described not in types:
        raise error(
            f"The NPY file holds {described if isinstance(described, str) else 'records'!r:.40}, "
            f"and {advice}"
        )
    return np.dtype(described)


LAS_SIGNATURE = b"LASF"


# Messages of ROS 2 as its middleware serialises them: PointCloud2 in CDR, of either byte order.

#: Bytes of the encapsulation: kind and options; positions are aligned from its end.
_HEAD = 4
#: Longest name of a frame or a field, bytes; and most fields of a point.
_LONGEST_NAME, _MOST_FIELDS = 255, 64
#: Most bytes after the message: middleware fills up to whole words.
_MOST_PADDING = 7


@dataclass(frozen=True)
class SerializedField:
    """A sensor_msgs/PointField."""

    name: str
    offset: int
    datatype: int
    count: int


@dataclass(frozen=True, eq=False)
class SerializedCloud:
    """A sensor_msgs/PointCloud2, whose data are a view of the bytes that it was read from.

    Names are those of ROS, so that it may stand where a message does.

    Parameters
    ----------
    stamp_ns : nanoseconds
    frame_id : of the sensor
    height, width, point_step, row_step, is_bigendian, fields, data : as ROS has them; whether they
        fit each other has not been looked at
    """

    stamp_ns: int
    frame_id: str
    height: int
    width: int
    fields: tuple[SerializedField, ...]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: memoryview


def read_point_cloud(data: bytes) -> SerializedCloud:
    """Return the message of a serialised PointCloud2; takes no memory beside its bytes.

    Raises
    ------
    UnreadableCloud : the bytes are no such message, end early, or go on after it.
    """
    if not _is_encapsulated(data):
        raise UnreadableCloud(
            "This is no serialised PointCloud2: its first bytes are not those of CDR. Send what "
            "rclpy.serialization.serialize_message gives."
        )
    reader = _Reader(data)
    stamp_ns, frame_id, height, width = _read_header(reader)
    fields = _read_fields(reader)
    is_bigendian = reader.byte() != 0
    point_step, row_step, size = reader.word(), reader.word(), reader.word()
    points = reader.bytes(size)
    reader.byte()  # is_dense: points that are missing are found anyway
    if reader.left > _MOST_PADDING:
        raise UnreadableCloud(
            f"{reader.left} bytes follow the end of the PointCloud2, so it is damaged or of "
            "another type. Serialise it again."
        )
    return SerializedCloud(
        stamp_ns, frame_id, height, width, fields, is_bigendian, point_step, row_step, points
    )


def _is_encapsulated(data: bytes) -> bool:
    """Whether bytes begin as plain CDR does: 0, byte order, and options that only say padding."""
    return len(data) >= _HEAD and data[0] == 0 and data[1] <= 1 and data[2] == 0 and data[3] <= 3


def _read_header(reader: _Reader) -> tuple[int, str, int, int]:
    """Stamp in nanoseconds, frame, height and width."""
    seconds, nanoseconds = reader.word(), reader.word()
    if nanoseconds >= 1_000_000_000:
        raise UnreadableCloud(
            f"The stamp of the PointCloud2 has {nanoseconds} nanoseconds, so it is damaged or of "
            "another type. Serialise it again."
        )
    return seconds * 1_000_000_000 + nanoseconds, reader.text(), reader.word(), reader.word()


def _read_fields(reader: _Reader) -> tuple[SerializedField, ...]:
    count = reader.word()
    if count > _MOST_FIELDS:
        raise UnreadableCloud(
            f"The PointCloud2 announces {count} fields, and at most {_MOST_FIELDS} are read. "
            "Serialise it again, or leave some out."
        )
    return tuple(
        SerializedField(reader.text(), reader.word(), reader.byte(), reader.word())
        for _ in range(count)
    )


class _Reader:
    """Values of a message one after the other; UnreadableCloud where it ends before one."""

    def __init__(self, data: bytes) -> None:
        self._data = memoryview(data)
        self._word = struct.Struct("<I" if data[1] & 1 else ">I")
        self._at = _HEAD

    @property
    def left(self) -> int:
        """Bytes that were not read."""
        return len(self._data) - self._at

    def bytes(self, count: int) -> memoryview:
        """Return the next bytes."""
        if count > self.left:
            raise UnreadableCloud(
                f"The PointCloud2 ends early: {count} bytes are announced at byte {self._at}, and "
                f"{self.left} follow. Serialise it again."
            )
        self._at += count
        return self._data[self._at - count : self._at]

    def byte(self) -> int:
        """Return the next byte."""
        return self.bytes(1)[0]

    def word(self) -> int:
        """Return the next number of four bytes, after what aligns it."""
        self.bytes(-self._at % 4)
        (value,) = self._word.unpack(self.bytes(4))
        return int(value)

    def text(self) -> str:
        """Return the next string, without the zero at its end."""
        length = self.word()
        if length > _LONGEST_NAME + 1:
            raise UnreadableCloud(
                f"A name in the PointCloud2 has {length} bytes, and at most {_LONGEST_NAME} are "
                "read. Serialise it again."
            )
        return bytes(self.bytes(length)).rstrip(b"\0").decode("utf-8", "replace")


@contextmanager
def naming(subject: str) -> Iterator[None]:
    """Let errors raised inside begin with what they are about."""
    try:
        yield
    except SceneprintError as error:
        if not subject:
            raise
        raise type(error)(f"{subject}: {error}") from error
