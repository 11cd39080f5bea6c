"""Topics of a bag that can be frames, and their messages as the bytes of frames.

Bag  --choose_topic-->  FrameTopic  --camera_topic-->  topic of its camera
Image | CompressedImage  --depth_file-->  bytes of a PNG or NPY file
PointCloud2  --cloud_file-->  bytes of an NPY file (N, 3)
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sceneprint.errors import DatasetError, FrameError, UnreadableCloud, UnreadableFrame
from sceneprint.formats.depth_file import decode_png, encode_npy, encode_png
from sceneprint.formats.recording.bag import (
    CAMERA,
    COMPRESSED,
    IMAGE,
    POINTS,
    Bag,
    BagTopic,
    shared_bag,
)
from sceneprint.types import Floats
from sceneprint_client.errors import printable
from sceneprint_client.files import naming
from sceneprint_client.ros_messages import (
    cloud_blocks,
    cloud_points,
    cloud_table,
    compressed_depth,
    depth_samples,
    image_encoding,
    inverse_depth,
    is_rectified,
    topic_without_transport,
)
from sceneprint_client.transforms import frame_name

# Messages of ROS as the bytes of a frame.


def depth_file(message: Any, *, compressed: bool) -> bytes:
    """Return the bytes of a PNG or NPY file with the samples of a depth image.

    Parameters
    ----------
    message : sensor_msgs Image, or CompressedImage of depth
    compressed : which of them

    Returns
    -------
    data : a 16-bit PNG of millimetres, or an NPY array of float32 metres

    Raises
    ------
    UnreadableFrame : the message is of another encoding, or its sizes contradict each other.
    """
    if compressed:
        found = compressed_depth(message)
        if found.inverse is None:
            return found.png if found.samples is None else encode_png(found.samples)
        samples = decode_png(found.png) if found.samples is None else found.samples
        return encode_npy(inverse_depth(samples, *found.inverse))
    samples = depth_samples(message)
    return encode_npy(samples) if samples.dtype.kind == "f" else encode_png(samples)


def cloud_file(message: Any, T_cloud_sensor: Floats | None = None) -> bytes:
    """Return the bytes of an NPY file with the points of a PointCloud2; see `cloud_points`.

    Parameters
    ----------
    message : sensor_msgs PointCloud2
    T_cloud_sensor : where given, the points are taken into the axes of the sensor
    """
    if T_cloud_sensor is None:
        return encode_npy(cloud_points(message))
    found = [np.empty((0, 3)), *cloud_blocks(cloud_table(message))]
    points = (np.concatenate(found) - T_cloud_sensor[:3, 3]) @ T_cloud_sensor[:3, :3]
    return encode_npy(points[np.isfinite(points).all(axis=1)].astype(np.float32))


@dataclass(frozen=True)
class FrameTopic:
    """A topic whose messages are frames.

    Parameters
    ----------
    topic : name, type and number of messages
    encoding : of a depth image, such as "16UC1"; None of points
    frame : the sensor's, of its first message
    """

    topic: BagTopic
    encoding: str | None
    frame: str

    @property
    def is_compressed(self) -> bool:
        """Return whether its messages are compressed images."""
        return self.topic.type == COMPRESSED

    @property
    def is_rectified(self) -> bool:
        """Return whether its images have been rectified, by the name that ROS gives them."""
        return is_rectified(self.topic.name)


@dataclass(frozen=True, eq=False)
class BagSource:
    """One message of a bag: where the bytes of a frame come from.

    Parameters
    ----------
    bag : where it is
    topic : of it
    log_ns, occurrence : when it was recorded, and which of those with that time it is
    T_cloud_sensor : (4, 4) where points are not in the axes of the sensor, and become so
    """

    bag: Bag
    topic: BagTopic
    log_ns: int
    occurrence: int
    T_cloud_sensor: Floats | None = None

    def read_bytes(self) -> bytes:
        """Return the message as the bytes of a PNG or NPY file.

        Raises
        ------
        UnreadableFrame, UnreadableCloud : it holds no depth, or is damaged.
        DatasetError : the bag is damaged there.
        """
        message = self.bag.at(self.topic.name, self.log_ns, self.occurrence)
        is_cloud = self.topic.type == POINTS
        with naming(f"{self.bag.path}, {self.topic.name} at {self.log_ns} ns"):
            try:
                fields = self.bag.decode(message, self.topic.type)
            except DatasetError as cause:  # of this message alone
                error: type[FrameError] = UnreadableCloud if is_cloud else UnreadableFrame
                raise error("The message is damaged. Record it again.") from cause
            if is_cloud:
                return cloud_file(fields, self.T_cloud_sensor)
            return depth_file(fields, compressed=self.topic.type == COMPRESSED)

    def __reduce__(self) -> tuple[Any, ...]:
        place = self.log_ns, self.occurrence, self.T_cloud_sensor
        return _source_in, (self.bag.path, self.topic, *place)


def _source_in(path: Path, topic: BagTopic, *place: Any) -> BagSource:
    """Return a source that came from another process: its bag is opened here."""
    return BagSource(shared_bag(path), topic, *place)


# The topics that are taken.


def frame_topics(bag: Bag) -> list[FrameTopic]:
    """Return the topics of depth images and of points, each judged by its first message.

    Of an image that is there raw and compressed, the raw one is given.
    """
    found = []
    for topic in bag.of_type(IMAGE, COMPRESSED, POINTS):
        one = _frame_topic(bag, topic)
        if one is not None:
            found.append(one)
    raw = {one.topic.name for one in found if not one.is_compressed}
    return [
        one
        for one in found
        if not (one.is_compressed and topic_without_transport(one.topic.name) in raw)
    ]


def _frame_topic(bag: Bag, topic: BagTopic) -> FrameTopic | None:
    """Return a topic as its first message describes it; None where it has no depth."""
    try:
        message = bag.first(topic.name)
        fields = None if message is None else bag.decode(message, topic.type)
    except DatasetError:  # a damaged one is no candidate; whoever names it learns why
        return None
    if fields is None:
        return None
    encoding = None
    if topic.type != POINTS:
        encoding = image_encoding(fields, compressed=topic.type == COMPRESSED)
        if encoding is None:
            return None
    return FrameTopic(topic, encoding, frame_name(str(fields.header.frame_id)))


def choose_topic(bag: Bag, wanted: str | None) -> FrameTopic:
    """Return the topic whose messages are the frames.

    Raises
    ------
    DatasetError : there is none, or several and none is named.
    """
    candidates = frame_topics(bag)
    if wanted is not None:
        named = [one for one in bag.topics if one.name == wanted]
        if not named:
            raise DatasetError(
                f"{bag.path}: There is no topic {wanted!r:.100}. Choose one of "
                f"{listed(one.topic for one in candidates)}; `sceneprint bag` lists all."
            )
        found = next((one for one in candidates if one.topic.name == wanted), None)
        if found is None and named[0].type in (IMAGE, COMPRESSED, POINTS):
            found = _frame_topic(bag, named[0])
        if found is None:
            raise DatasetError(
                f"{bag.path}: The topic {printable(wanted)} ({printable(named[0].type)}, "
                f"{named[0].count} messages) has no depth images ({_READ}) and no points. Choose "
                f"one of {listed(one.topic for one in candidates)}."
            )
        return found
    if not candidates:
        raise DatasetError(
            f"{bag.path}: There is no topic of depth images ({_READ}) or of points (PointCloud2). "
            f"Images are {_encodings(bag)}. `sceneprint bag` lists all topics."
        )
    if len(candidates) > 1:
        raise DatasetError(
            f"{bag.path}: {len(candidates)} topics can be taken: "
            f"{listed(one.topic for one in candidates)}. Choose one with --topic."
        )
    return candidates[0]


#: What is read of images, for people.
_READ = "16UC1, mono16, 32FC1, compressedDepth, or PNG of 16 bits"


def _encodings(bag: Bag) -> str:
    """Return the encodings of the images of a bag, for people."""
    found = []
    for topic in bag.of_type(IMAGE, COMPRESSED)[:20]:
        try:
            message = bag.first(topic.name)
            fields = None if message is None else bag.decode(message, topic.type)
        except DatasetError:
            fields = None
        encoding = getattr(fields, "encoding", None) or getattr(fields, "format", "damaged")
        found.append(f"{topic.name} ({encoding!r:.40})")
    return printable(", ".join(found)) or "not there"


def camera_topic(bag: Bag, frames: FrameTopic, wanted: str | None) -> BagTopic | None:
    """Return the topic of the camera of depth images: beside theirs, else the only one of their
    frame.

    Raises
    ------
    DatasetError : the one that is named is none, or several fit.
    """
    known = bag.of_type(CAMERA)
    if wanted is not None:
        found = next((one for one in known if one.name == wanted), None)
        if found is None:
            raise DatasetError(
                f"{bag.path}: There is no topic {wanted!r:.100} of CameraInfo. Choose one of "
                f"{listed(known)} with --camera-info."
            )
        return found
    beside = topic_without_transport(frames.topic.name).rpartition("/")[0] + "/camera_info"
    for one in known:
        if one.name == beside:
            return one
    fitting = [one for one in known if _frame_of(bag, one) == frames.frame]
    if len(fitting) > 1:
        raise DatasetError(
            f"{bag.path}: The camera of {frames.topic.name} may be that of {listed(fitting)}. "
            "Choose one with --camera-info."
        )
    return fitting[0] if fitting else None


def _frame_of(bag: Bag, topic: BagTopic) -> str | None:
    """Return the frame of a topic's first message."""
    try:
        message = bag.first(topic.name)
        fields = None if message is None else bag.decode(message, topic.type)
    except DatasetError:
        return None
    return None if fields is None else frame_name(str(fields.header.frame_id))


def listed(topics: Iterable[BagTopic]) -> str:
    """Return the names of topics, for people."""
    names = [f"{one.name} ({one.type.rpartition('/')[2]}, {one.count} messages)" for one in topics]
    return printable(", ".join(names[:20])) or "none"
