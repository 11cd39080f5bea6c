"""Reading of ROS files with rosbags: MCAP, rosbag2 folders and databases, ROS 1 bags.

path  --Bag-->  topics, raw messages; raw message  --Bag.decode-->  its fields

rosbags raises arbitrary exceptions for damaged files, so all calls run within `_dataset_errors`.
Decompression is limited.
"""

from __future__ import annotations

import bz2
import struct
import threading
import weakref
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sceneprint.errors import DatasetError, MissingDependency, SceneprintError, UnreadableCloud
from sceneprint_client.errors import printable
from sceneprint_client.files import read_livox_scan
from sceneprint_client.formats import format_named

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader as Ros1Reader
    from rosbags.rosbag2 import Reader as Ros2Reader
    from rosbags.typesys.store import Typestore

#: Metadata file of a rosbag2 folder.
_METADATA = "metadata.yaml"
#: Maximum size of a decompressed chunk, bytes; recorders write 1 to 4 MB.
MAXIMUM_CHUNK_BYTES = 256 << 20
#: Maximum size of a message, bytes.
MAXIMUM_MESSAGE_BYTES = 256 << 20

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
POINTS = "sensor_msgs/msg/PointCloud2"
#: Message types of the Livox drivers.
LIVOX = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")
#: All message types with points.
CLOUDS = (POINTS, *LIVOX)
CAMERA = "sensor_msgs/msg/CameraInfo"
IMU = "sensor_msgs/msg/Imu"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
#: Type of transforms in ROS 1 before tf2; it has the same fields.
OLD_TRANSFORMS = "tf/msg/tfMessage"
_TRANSFORMS_FIELDS = "geometry_msgs/TransformStamped[] transforms"
#: Message types that `Bag.decode` supports.
TYPES = (IMAGE, COMPRESSED, *CLOUDS, CAMERA, IMU, ODOMETRY, TRANSFORMS, OLD_TRANSFORMS)


#: Commands that make unfinished and compressed recordings readable, by the last suffix.
_REMEDIES = {
    ".active": "rosbag reindex", ".gz": "gunzip", ".bz2": "bunzip2", ".xz": "unxz",
    ".lz4": "unlz4", ".zst": "unzstd", ".zstd": "unzstd",
}  # fmt: skip


def is_packed(path: Path) -> bool:
    """Return whether a file is an unfinished or compressed recording, such as run.bag.active."""
    inner = path.name[: -len(path.suffix)].lower().removesuffix(".orig")
    return path.suffix.lower() in _REMEDIES and format_named(inner, "recording") is not None


def is_recording(path: Path) -> bool:
    """Return whether a path is a ROS recording, by its suffix or a metadata file in it."""
    if path.is_dir():
        return (path / _METADATA).is_file() and not (path / "intrinsics.json").is_file()
    return format_named(path.name, "recording") is not None or is_packed(path)


@dataclass(frozen=True)
class BagTopic:
    """A topic of a bag.

    Parameters
    ----------
    name : name such as "/camera/depth/image_raw"
    type : type of the messages, such as "sensor_msgs/msg/Image"
    count : number of messages
    """

    name: str
    type: str
    count: int


@dataclass(frozen=True)
class RawMessage:
    """A serialised message of a bag.

    Parameters
    ----------
    topic : name of the topic
    log_ns : time of recording, nanoseconds
    data : serialised content
    """

    topic: str
    log_ns: int
    data: bytes


class Bag:
    """An open ROS recording that threads may share.

    `path`: .mcap, .db3 or .bag file, or rosbag2 folder. Raise DatasetError if the file does not
    exist, is damaged, or has an unsupported format. Raise MissingDependency if rosbags is not
    installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        is_bag = path.suffix.lower() == ".bag" and not path.is_dir()
        self._lock = threading.RLock()
        if not path.exists():
            raise DatasetError(f"{path}: The file or folder does not exist. Check the path.")
        if is_packed(path):
            suffix = path.suffix.lower()
            cause = "was not closed" if suffix == ".active" else "is compressed"
            raise DatasetError(
                f"{path}: The recording {cause}. Run `{_REMEDIES[suffix]}` on it, and remove "
                f"{path.suffix} from its name."
            )
        _types(ros1=is_bag)  # this limits rosbags before it opens the file
        with _dataset_errors(path):
            self._reader = _open_reader(path, ros1=is_bag)
        self._closes = weakref.finalize(self, self._reader.close)
        with _dataset_errors(path):
            self._connections: list[Connection] = [
                connection
                for connection in self._reader.connections
                if _serialization(connection) in ("cdr", "ros1")
            ]
            self.is_ros1 = any(_serialization(entry) == "ros1" for entry in self._connections)
            self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time
            self.topics = _topics(self._connections)
        self._types = _types(ros1=self.is_ros1)

    def close(self) -> None:
        """Close the file; later calls do nothing."""
        self._closes()

    def of_type(self, *types: str) -> list[BagTopic]:
        """Return the topics of these types that have messages, sorted by name."""
        return [topic for topic in self.topics if topic.type in types and topic.count]

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Yield the messages of topics in recording order.

        Parameters
        ----------
        topics : names of the topics
        start_ns, stop_ns : bounds, start <= time of recording < stop, nanoseconds; None for none

        Raises
        ------
        DatasetError : If the file is damaged, or a message is too large.
        """
        connections = [connection for connection in self._connections if connection.topic in topics]
        if not connections:
            return
        with self._lock, _dataset_errors(self.path):
            for connection, log_ns, data in self._reader.messages(connections, start_ns, stop_ns):
                if connection.topic not in topics:  # a damaged index yields other topics
                    continue
                if len(data) > MAXIMUM_MESSAGE_BYTES:
                    raise DatasetError(
                        f"{self.path}: A message of {connection.topic} has {len(data)} bytes; the "
                        f"limit is {MAXIMUM_MESSAGE_BYTES}. Exclude the topic."
                    )
                yield RawMessage(connection.topic, log_ns, bytes(data))

    def first(self, topic: str) -> RawMessage | None:
        """Return the first message of a topic; None if it has no messages."""
        with self._lock:
            messages = self.messages([topic])
            try:
                return next(messages, None)
            finally:
                messages.close()  # type: ignore[attr-defined]  # the generator holds the lock

    def at(self, topic: str, log_ns: int, occurrence: int) -> RawMessage:
        """Return the message of a topic that was recorded at `log_ns` nanoseconds.

        `occurrence`: index among the messages with the same time. Raise DatasetError if the message
        no longer exists, or the file is damaged.
        """
        with self._lock:
            messages = list(self.messages([topic], log_ns, log_ns + 1))
        if occurrence >= len(messages):
            raise DatasetError(
                f"{self.path}: The message of {topic} at {log_ns} ns no longer exists. Read the "
                "recording again."
            )
        return messages[occurrence]

    def decode(self, message: RawMessage, kind: str) -> Any:
        """Decode a message to an object with its fields as attributes.

        `kind`: type of the message, one of TYPES. Raise DatasetError if the bytes are not a message
        of this type.
        """
        if kind in LIVOX:
            try:
                return read_livox_scan(message.data, ros1=self.is_ros1)
            except UnreadableCloud as cause:
                raise DatasetError(f"{self.path}, {message.topic}: {cause}") from cause
        type_name = TRANSFORMS if kind == OLD_TRANSFORMS else kind
        with _dataset_errors(self.path, f"a message of {message.topic} does not decode"):
            if self.is_ros1:
                return self._types.deserialize_ros1(message.data, type_name)
            return self._types.deserialize_cdr(message.data, type_name)

    def stamp_ns(self, message: RawMessage) -> int:
        """Return the time in the header of a message, else the recording time, nanoseconds."""
        stamp = self.header_ns(message)
        return message.log_ns if stamp is None else stamp

    def header_ns(self, message: RawMessage) -> int | None:
        """Return the measurement time of a message, nanoseconds; None if its header has no time.

        Only the header is decoded.
        """
        head = message.data[:12]
        if len(head) < 12:
            return None
        if self.is_ros1:
            seconds, nanoseconds = struct.unpack_from("<II", head, 4)
        else:
            order = "<" if head[1] & 1 else ">"
            seconds, nanoseconds = struct.unpack_from(f"{order}iI", head, 4)
        if seconds < 0 or not (seconds or nanoseconds) or nanoseconds >= 1_000_000_000:
            return None
        return int(seconds) * 1_000_000_000 + int(nanoseconds)


@lru_cache(maxsize=4)
def shared_bag(path: Path) -> Bag:
    """Return an open bag from a cache, for frame references that come from other processes."""
    return Bag(path)


def _serialization(connection: Connection) -> str:
    """Return the serialisation format of a topic; "ros1" for ROS 1 bags, which do not state it."""
    return str(getattr(connection.ext, "serialization_format", "ros1"))


def _topics(connections: list[Connection]) -> tuple[BagTopic, ...]:
    """Return the topics, sorted by name; a topic with several types has an entry per type."""
    counts: dict[tuple[str, str], int] = {}
    for connection in connections:
        package, _, name = connection.msgtype.partition("/")  # ROS 1 in MCAP has sensor_msgs/Image
        key = (str(connection.topic), f"{package}/msg/{name.removeprefix('msg/')}")
        counts[key] = counts.get(key, 0) + int(connection.msgcount)
    return tuple(BagTopic(name, kind, n) for (name, kind), n in sorted(counts.items()))


def _open_reader(path: Path, *, ros1: bool) -> Ros1Reader | Ros2Reader:
    if ros1:
        from rosbags.rosbag1 import Reader as Ros1Reader

        bag = Ros1Reader(path)
        bag.open()
        return bag
    from rosbags.rosbag2 import Reader as Ros2Reader

    recording = Ros2Reader(path)
    recording.open()
    return recording


@contextmanager
def _dataset_errors(path: Path, what: str = "The recording cannot be read") -> Iterator[None]:
    """Convert exceptions that rosbags raises within a `with` block to DatasetError."""
    try:
        yield
    except (SceneprintError, GeneratorExit):
        raise
    except Exception as cause:
        reason = " ".join(str(cause).split()) or type(cause).__name__
        what = what[0].upper() + what[1:]
        text = printable(f"{what} ({reason:.200}). {_advice(path)}")
        raise DatasetError(f"{path}: {text}") from cause


def _advice(path: Path) -> str:
    """Return the advice for a recording that may be truncated."""
    suffix = path.suffix.lower()
    tool = {".mcap": "mcap recover", ".bag": "rosbag reindex"}.get(suffix, "ros2 bag reindex")
    return (
        f"If the recorder was killed before it closed the file, run `{tool}`; otherwise, copy it "
        "again."
    )


def require_rosbags() -> None:
    """Raise MissingDependency if rosbags is not installed."""
    if find_spec("rosbags") is None:
        raise MissingDependency(
            "ROS recordings require rosbags, which is not installed. "
            "Run: pip install 'rosbags>=0.11.9,<0.12'"
        )


@lru_cache(maxsize=2)
def _types(*, ros1: bool) -> Typestore:
    """Return the standard message definitions; the definitions in a bag are not trusted.

    Raise MissingDependency if rosbags is not installed.
    """
    require_rosbags()
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    _limit_decompression()
    _read_any_profile()
    types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if TRANSFORMS not in types.fielddefs:
        types.register(get_types_from_msg(_TRANSFORMS_FIELDS, TRANSFORMS))
    return types


def load_readers() -> None:
    """Load rosbags and its decompressors before a process is confined."""
    for ros1 in (False, True):
        _types(ros1=ros1)
    import rosbags.serde.primitives  # noqa: F401  (rosbags generates code that imports it)

    _zstd()
    _lz4()


def _limit_decompression() -> None:
    """Limit decompressed chunks to their declared size and to MAXIMUM_CHUNK_BYTES.

    rosbags decompresses a chunk completely before it checks the size, so a damaged or malicious
    chunk could exhaust memory. Therefore, limited functions replace its decompressors.
    """
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import storage_mcap as mcap

    mcap.DECOMPRESSORS["zstd"] = lambda data, size: _inflate(_zstd(), data, size)
    mcap.DECOMPRESSORS["lz4"] = lambda data, size: _inflate(_lz4(), data, size)
    ros1.decompressors["bz2"] = lambda data: _inflate(
        bz2.BZ2Decompressor(), data, MAXIMUM_CHUNK_BYTES
    )
    ros1.decompressors["lz4"] = lambda data: _inflate(_lz4(), data, MAXIMUM_CHUNK_BYTES)


def _read_any_profile() -> None:
    """Make rosbags accept MCAP files without the ROS 2 profile, such as those of ROS 1.

    Their channels state the serialisation, and the message definitions in the file are not needed.
    """
    from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
    from rosbags.rosbag2 import reader
    from rosbags.rosbag2 import storage_mcap as mcap

    class ProfiledReader(mcap.McapReader):
        """A reader of MCAP files that assumes the profile "ros2"."""

        def _open(self) -> None:
            opened, self.bio = self.bio, _Profiled(self.bio)  # type: ignore[assignment]
            try:
                super()._open()
            finally:
                self.bio = opened

    none = MessageDefinition(MessageDefinitionFormat.NONE, "")
    mcap.get_msgdef = lambda _: none  # type: ignore[assignment]
    reader.DirectoryReader.STORAGE_PLUGINS["mcap"] = ProfiledReader  # type: ignore[index]
    reader.Reader.STORAGE_PLUGINS[".mcap"] = ProfiledReader  # type: ignore[index]


_PROFILE = struct.pack("<I4s", 4, b"ros2")


class _Profiled:
    """An MCAP file that reads as if its header started with the profile "ros2"."""

    def __init__(self, file: Any) -> None:
        self._file = file

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def read(self, size: int = -1) -> bytes:
        """Return the next bytes, with the length and the profile replaced."""
        place = self._file.tell()
        if place == 17:
            return _PROFILE + bytes(self._file.read(size - len(_PROFILE)))
        data: bytes = self._file.read(size)
        if place == 9:
            data = struct.pack("<Q", struct.unpack("<Q", data)[0] + len(_PROFILE))
        return data


def _zstd() -> Any:
    import sys

    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd.ZstdDecompressor()


def _lz4() -> Any:
    from lz4.frame import LZ4FrameDecompressor

    return LZ4FrameDecompressor()


def _inflate(stream: Any, data: bytes, most: int) -> bytes:
    """Decompress a chunk; raise ValueError if its content exceeds `most` bytes."""
    if most > MAXIMUM_CHUNK_BYTES:
        raise ValueError(f"a chunk declares {most} bytes, more than {MAXIMUM_CHUNK_BYTES}")
    content: bytes = stream.decompress(data, most + 1)
    if len(content) > most or not stream.eof:
        raise ValueError(f"a chunk does not end within {most} bytes")
    return content
