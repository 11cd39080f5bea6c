"""Messages of ROS 2 as its middleware serialises them: PointCloud2 in CDR, of either byte order.

bytes  --is_point_cloud-->  bool
bytes  --read_point_cloud-->  SerializedCloud
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from sceneprint_client.errors import UnreadableCloud

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


def is_point_cloud(head: bytes) -> bool:
    """Whether a file begins as a serialised PointCloud2 with x, y and z does.

    Parameters
    ----------
    head : the file, or its first 10,016 bytes
    """
    if not _is_encapsulated(head):
        return False
    try:
        reader = _Reader(head)
        _read_header(reader)
        names = [one.name for one in _read_fields(reader)]
    except UnreadableCloud:
        return False
    return {"x", "y", "z"} <= set(names)


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
        """The next bytes."""
        if count > self.left:
            raise UnreadableCloud(
                f"The PointCloud2 ends early: {count} bytes are announced at byte {self._at}, and "
                f"{self.left} follow. Serialise it again."
            )
        self._at += count
        return self._data[self._at - count : self._at]

    def byte(self) -> int:
        """The next byte."""
        return self.bytes(1)[0]

    def word(self) -> int:
        """The next number of four bytes, after what aligns it."""
        self.bytes(-self._at % 4)
        (value,) = self._word.unpack(self.bytes(4))
        return int(value)

    def text(self) -> str:
        """The next string, without the zero at its end."""
        length = self.word()
        if length > _LONGEST_NAME + 1:
            raise UnreadableCloud(
                f"A name in the PointCloud2 has {length} bytes, and at most {_LONGEST_NAME} are "
                "read. Serialise it again."
            )
        return bytes(self.bytes(length)).rstrip(b"\0").decode("utf-8", "replace")
