"""The files of ROS: MCAP, rosbag2 folders and databases, ROS 1 bags. The boundary to rosbags.

path  --Bag-->  topics, raw messages; raw message  --Bag.decode-->  its fields
Bag, topics  --scan_bag-->  BagScan: transforms, odometry, IMU, the camera, the times of frames

rosbags raises whatever its parsers meet in a damaged file, so every call into it is made within
`_stated`, and what it decompresses is limited.
"""

from __future__ import annotations

import bz2
import struct
import threading
import weakref
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sceneprint.errors import DatasetError, MissingDependency, SceneprintError
from sceneprint_client.errors import printable
from sceneprint_client.files import RECORDING_SUFFIXES, naming
from sceneprint_client.poses import MOST_SAMPLES, Accelerations, TransformTree, frame_name
from sceneprint_client.ros_messages import (
    is_calibrated,
    pose_row,
    stamp_of,
    transform_row,
    vector_row,
)

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader as Ros1Reader
    from rosbags.rosbag2 import Reader as Ros2Reader
    from rosbags.typesys.store import Typestore

#: What a rosbag2 folder has beside its databases.
_METADATA = "metadata.yaml"
#: Most bytes of one chunk once it is decompressed; recorders write 1 to 4 MB.
MAXIMUM_CHUNK_BYTES = 256 << 20
#: Most bytes of one message.
MAXIMUM_MESSAGE_BYTES = 256 << 20

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
POINTS = "sensor_msgs/msg/PointCloud2"
CAMERA = "sensor_msgs/msg/CameraInfo"
IMU = "sensor_msgs/msg/Imu"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
#: Transforms that ROS 1 wrote before tf2; the fields are the same.
OLD_TRANSFORMS = "tf/msg/tfMessage"
_TRANSFORMS_FIELDS = "geometry_msgs/TransformStamped[] transforms"
#: Types of messages that are decoded, and no others.
TYPES = (IMAGE, COMPRESSED, POINTS, CAMERA, IMU, ODOMETRY, TRANSFORMS, OLD_TRANSFORMS)


def is_recording(path: Path) -> bool:
    """Whether a path is a recording of ROS by its name, or a folder with a rosbag2's metadata."""
    if path.is_dir():
        return (path / _METADATA).is_file() and not (path / "intrinsics.json").is_file()
    return path.suffix.lower() in RECORDING_SUFFIXES


@dataclass(frozen=True)
class BagTopic:
    """A topic of a bag.

    Parameters
    ----------
    name : such as "/camera/depth/image_raw"
    type : of its messages, such as "sensor_msgs/msg/Image"
    count : of its messages
    """

    name: str
    type: str
    count: int


@dataclass(frozen=True)
class RawMessage:
    """A message as it was recorded.

    Parameters
    ----------
    topic : its name
    log_ns : when it was recorded, nanoseconds
    data : its bytes, as ROS serialised them
    """

    topic: str
    log_ns: int
    data: bytes


class Bag:
    """A recording of ROS, open until it is closed or nobody refers to it; safe among threads.

    Parameters
    ----------
    path : an .mcap, .db3 or .bag file, or a rosbag2 folder

    Raises
    ------
    DatasetError : there is no such file, or it is damaged or of a kind that is not read.
    MissingDependency : rosbags is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.is_ros1 = path.suffix.lower() == ".bag" and not path.is_dir()
        self._lock = threading.RLock()
        if not path.exists():
            raise DatasetError(f"{path}: There is no such file or folder. Check the path.")
        self._types = _types(ros1=self.is_ros1)
        with _stated(path):
            self._reader = _open_reader(path, ros1=self.is_ros1)
        self._closes = weakref.finalize(self, _close, self._reader)
        with _stated(path):
            self._connections: list[Connection] = list(self._reader.connections)
            self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time
            self.topics = _topics(self._connections)

    def close(self) -> None:
        """Close the file; later calls do nothing."""
        self._closes()

    def of_type(self, *types: str) -> list[BagTopic]:
        """Topics of these types that have messages, by name."""
        return [one for one in self.topics if one.type in types and one.count]

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Messages of topics in the order in which they were recorded.

        Parameters
        ----------
        topics : their names
        start_ns, stop_ns : recorded from the first on, and before the second

        Raises
        ------
        DatasetError : the file is damaged where they are.
        """
        wanted = [one for one in self._connections if one.topic in topics]
        if not wanted:
            return
        with self._lock, _stated(self.path):
            for connection, log_ns, data in self._reader.messages(wanted, start_ns, stop_ns):
                if len(data) > MAXIMUM_MESSAGE_BYTES:
                    raise DatasetError(
                        f"{self.path}: A message of {connection.topic} has {len(data)} bytes; at "
                        f"most {MAXIMUM_MESSAGE_BYTES} are read. Leave the topic out."
                    )
                yield RawMessage(connection.topic, log_ns, bytes(data))

    def first(self, topic: str) -> RawMessage | None:
        """The first message of a topic; None where it has none."""
        with self._lock:
            messages = self.messages([topic])
            try:
                return next(messages, None)
            finally:
                messages.close()  # type: ignore[attr-defined]  # a generator, which holds the lock

    def at(self, topic: str, log_ns: int, occurrence: int) -> RawMessage:
        """The message of a topic with this time of recording; of several, by number from 0.

        Raises
        ------
        DatasetError : there is none any more, or the file is damaged.
        """
        with self._lock:
            found = list(self.messages([topic], log_ns, log_ns + 1))
        if occurrence >= len(found):
            raise DatasetError(
                f"{self.path}: The message of {topic} at {log_ns} ns is no longer there. Read the "
                "recording again."
            )
        return found[occurrence]

    def decode(self, message: RawMessage, kind: str) -> Any:
        """The fields of a message, as attributes.

        Parameters
        ----------
        message : of this bag
        kind : one of TYPES

        Raises
        ------
        DatasetError : its bytes are not of this type.
        """
        known = TRANSFORMS if kind == OLD_TRANSFORMS else kind
        with _stated(self.path, f"a message of {message.topic} does not decode"):
            if self.is_ros1:
                return self._types.deserialize_ros1(message.data, known)
            return self._types.deserialize_cdr(message.data, known)

    def stamp_ns(self, message: RawMessage) -> int:
        """When a message with a header was measured, nanoseconds; of one that says nothing, when
        it was recorded. Only the beginning is decoded.
        """
        head = message.data[:12]
        if len(head) < 12:
            return message.log_ns
        if self.is_ros1:
            seconds, nanoseconds = struct.unpack_from("<II", head, 4)
        else:
            order = "<" if head[1] & 1 else ">"
            seconds, nanoseconds = struct.unpack_from(f"{order}iI", head, 4)
        if seconds <= 0 or nanoseconds >= 1_000_000_000:
            return message.log_ns
        return int(seconds) * 1_000_000_000 + int(nanoseconds)


@lru_cache(maxsize=4)
def shared_bag(path: Path) -> Bag:
    """A bag that all frames of this process share whose references came from another process."""
    return Bag(path)


def _topics(connections: list[Connection]) -> tuple[BagTopic, ...]:
    """Topics by name; one with messages of several types is there with each."""
    counts: dict[tuple[str, str], int] = {}
    for one in connections:
        key = (str(one.topic), str(one.msgtype))
        counts[key] = counts.get(key, 0) + int(one.msgcount)
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


def _close(reader: Ros1Reader | Ros2Reader) -> None:
    reader.close()


@contextmanager
def _stated(path: Path, what: str = "The recording cannot be read") -> Iterator[None]:
    """Turn whatever rosbags raises into an error of ours."""
    try:
        yield
    except (SceneprintError, GeneratorExit):
        raise
    except Exception as cause:
        reason = " ".join(str(cause).split()) or type(cause).__name__
        what = what[0].upper() + what[1:]
        told = printable(f"{what} ({reason:.200}). {_advice(path)}")
        raise DatasetError(f"{path}: {told}") from cause


def _advice(path: Path) -> str:
    """What mends a recording that was cut off."""
    suffix = path.suffix.lower()
    tool = {".mcap": "mcap recover", ".bag": "rosbag reindex"}.get(suffix, "ros2 bag reindex")
    return (
        f"If the recorder was stopped before it closed the file, run `{tool}`; else copy it again."
    )


# rosbags itself, and how much it may decompress.


@lru_cache(maxsize=2)
def _types(*, ros1: bool) -> Typestore:
    """Definitions of the messages of ROS; those in the bag are not needed, and may be of anything.

    Raises
    ------
    MissingDependency : rosbags is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as cause:
        raise MissingDependency(
            "Recordings of ROS are read with rosbags, which is not installed. "
            "Run: pip install 'sceneprint[ros]'"
        ) from cause
    _limit_decompression()
    types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if TRANSFORMS not in types.fielddefs:
        types.register(get_types_from_msg(_TRANSFORMS_FIELDS, TRANSFORMS))
    return types


def _limit_decompression() -> None:
    """Let chunks become no larger than they announce or than we take.

    rosbags inflates a chunk whole before it compares the size, so that a damaged or hostile one
    would fill the memory. Its tables of decompressors are the place where it can be limited.
    """
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import storage_mcap as mcap

    mcap.DECOMPRESSORS["zstd"] = lambda data, size: _inflate(_zstd(), data, size)
    mcap.DECOMPRESSORS["lz4"] = lambda data, size: _inflate(_lz4(), data, size)
    ros1.decompressors["bz2"] = lambda data: _inflate(
        bz2.BZ2Decompressor(), data, MAXIMUM_CHUNK_BYTES
    )
    ros1.decompressors["lz4"] = lambda data: _inflate(_lz4(), data, MAXIMUM_CHUNK_BYTES)


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
    """Content of one compressed chunk of at most so many bytes."""
    if most > MAXIMUM_CHUNK_BYTES:
        raise ValueError(f"a chunk announces {most} bytes, more than {MAXIMUM_CHUNK_BYTES}")
    found: bytes = stream.decompress(data, most + 1)
    if len(found) > most or not stream.eof:
        raise ValueError(f"a chunk does not end within {most} bytes")
    return found


# One pass over a bag.

#: What to call when so many of all messages have been read.
Progress = Callable[[int, int], None]
#: Most messages of one topic of frames.
MOST_FRAMES = 2_000_000


@dataclass(eq=False)
class BagScan:
    """What one pass over a bag gives.

    Parameters
    ----------
    tree : transforms, and odometry where no transform says the same
    imus : measurements by the frame of the IMU
    info : the first CameraInfo that is calibrated, or None
    stamps_ns : when each frame was measured, in the order in which they were recorded
    places : when each was recorded, and which of those with that time it is
    damaged : messages that did not decode, and were passed over
    """

    tree: TransformTree = field(default_factory=TransformTree)
    imus: dict[str, Accelerations] = field(default_factory=dict)
    info: Any = None
    stamps_ns: list[int] = field(default_factory=list)
    places: list[tuple[int, int]] = field(default_factory=list)
    damaged: int = 0


@dataclass(frozen=True)
class _Odometry:
    """A pose of a robot in the frame of its odometry."""

    parent: str
    child: str
    stamp_ns: int
    sample: list[float]


def scan_bag(
    bag: Bag, frames: BagTopic | None, camera: BagTopic | None, progress: Progress | None
) -> BagScan:
    """Read what moves, and when the frames were measured; their samples are not decoded.

    Parameters
    ----------
    bag : to read
    frames : the topic of the frames, or None
    camera : the topic of their camera, or None
    progress : what to call now and then

    Raises
    ------
    DatasetError : the bag is damaged, or too long.
    """
    kinds = {
        one.name: one.type for one in bag.of_type(TRANSFORMS, OLD_TRANSFORMS, ODOMETRY, IMU)
    } | ({} if camera is None else {camera.name: camera.type})
    names = [*kinds, *([] if frames is None else [frames.name])]
    total = sum(one.count for one in bag.topics if one.name in names)
    scan, odometry = BagScan(), dict[str, list[_Odometry]]()
    for done, message in enumerate(bag.messages(names)):
        if progress is not None and done % 64 == 0:
            progress(done, total)
        with naming(str(bag.path)):
            if frames is not None and message.topic == frames.name:
                _count_frame(scan, bag, message)
            else:
                _take(scan, odometry, bag, message, kinds[message.topic])
    if progress is not None:
        progress(total, total)
    _add_odometry(scan.tree, odometry)
    return scan


def _count_frame(scan: BagScan, bag: Bag, message: RawMessage) -> None:
    same = bool(scan.places) and scan.places[-1][0] == message.log_ns
    scan.places.append((message.log_ns, scan.places[-1][1] + 1 if same else 0))
    scan.stamps_ns.append(bag.stamp_ns(message))
    if len(scan.places) > MOST_FRAMES:
        raise DatasetError(f"There are more than {MOST_FRAMES} frames. Cut the bag into parts.")


def _take(
    scan: BagScan, odometry: dict[str, list[_Odometry]], bag: Bag, message: RawMessage, kind: str
) -> None:
    """Keep what a message says that is not of a frame."""
    if kind == CAMERA and scan.info is not None:
        return
    try:
        fields = bag.decode(message, kind)
    except DatasetError:
        scan.damaged += 1
        return
    if kind == CAMERA:
        scan.info = fields if is_calibrated(fields) else None
    elif kind == IMU:
        if float(fields.linear_acceleration_covariance[0]) < 0:  # it has no accelerometer
            return
        measured = scan.imus.setdefault(frame_name(fields.header.frame_id), Accelerations())
        measured.add(
            bag.stamp_ns(message),
            vector_row(fields.linear_acceleration),
            vector_row(fields.angular_velocity),
        )
    elif kind == ODOMETRY:
        parent, child = frame_name(fields.header.frame_id), frame_name(fields.child_frame_id)
        known = odometry.setdefault(message.topic, [])
        if parent and child and len(known) < MOST_SAMPLES:
            known.append(
                _Odometry(parent, child, bag.stamp_ns(message), pose_row(fields.pose.pose))
            )
    else:
        _take_transforms(scan.tree, message, fields)


def _take_transforms(tree: TransformTree, message: RawMessage, fields: Any) -> None:
    fixed = message.topic.rpartition("/")[2] == "tf_static"
    for one in fields.transforms:
        tree.add(
            str(one.header.frame_id), str(one.child_frame_id),
            stamp_of(one.header), transform_row(one.transform), fixed=fixed,
        )  # fmt: skip


def _add_odometry(tree: TransformTree, odometry: dict[str, list[_Odometry]]) -> None:
    """Where tf does not say the same; of several topics of one edge, that with most messages."""
    edges: dict[tuple[str, str], list[_Odometry]] = {}
    for topic in sorted(odometry, key=lambda name: len(odometry[name])):
        for one in odometry[topic][:1]:
            edges[one.parent, one.child] = odometry[topic]
    for (parent, child), samples in edges.items():
        if tree.has_edge(parent, child):
            continue
        for one in samples:
            if (one.parent, one.child) == (parent, child):
                tree.add(parent, child, one.stamp_ns, one.sample, fixed=False)
