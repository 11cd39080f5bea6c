"""Selection of a bag's topics with frames, and conversion of their messages to frames.

Bag  --choose_topic-->  FrameTopic  --camera_topic-->  topic of its camera
Image | CompressedImage  --depth_file-->  bytes of a PNG or NPY file
PointCloud2 | CustomMsg  --cloud_file-->  bytes of an NPY file (N, 3)
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sceneprint.errors import DatasetError, FrameError, UnreadableCloud, UnreadableFrame
from sceneprint.formats.dataset.frame_names import OMITTED_IMAGES, is_beside_depth
from sceneprint.formats.depth_file import decode_png, encode_npy, encode_png
from sceneprint.formats.recording.bag import (
    CAMERA,
    CLOUDS,
    COMPRESSED,
    IMAGE,
    Bag,
    BagTopic,
    shared_bag,
)
from sceneprint.formats.recording.scan_window import ScanWindow
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


def depth_file(message: Any, *, compressed: bool) -> bytes:
    """Convert a depth image message to the bytes of a PNG or NPY file.

    Parameters
    ----------
    message : sensor_msgs Image or CompressedImage with depth
    compressed : whether the message is a CompressedImage

    Returns
    -------
    data : 16-bit PNG of millimetres, or NPY file of float32 metres

    Raises
    ------
    UnreadableFrame : If the message has another encoding, or its sizes contradict each other.
    """
    if compressed:
        image = compressed_depth(message)
        if image.inverse is None:
            return image.png if image.samples is None else encode_png(image.samples)
        samples = decode_png(image.png) if image.samples is None else image.samples
        return encode_npy(inverse_depth(samples, *image.inverse))
    samples = depth_samples(message)
    return encode_npy(samples) if samples.dtype.kind == "f" else encode_png(samples)


def cloud_file(message: Any, T_cloud_sensor: Floats | None = None) -> bytes:
    """Convert a PointCloud2 to the bytes of an NPY file of points; see `cloud_points`.

    Parameters
    ----------
    message : sensor_msgs PointCloud2
    T_cloud_sensor : (4, 4) pose of the sensor in the cloud's frame, to convert the points to the
        sensor's axes; None leaves them unchanged
    """
    if T_cloud_sensor is None:
        return encode_npy(cloud_points(message))
    blocks = [np.empty((0, 3)), *cloud_blocks(cloud_table(message))]
    points = (np.concatenate(blocks) - T_cloud_sensor[:3, 3]) @ T_cloud_sensor[:3, :3]
    return encode_npy(points[np.isfinite(points).all(axis=1)].astype(np.float32))


@dataclass(frozen=True)
class FrameTopic:
    """A topic whose messages are frames.

    Parameters
    ----------
    topic : name, type and number of messages
    encoding : encoding of a depth image, such as "16UC1"; None for points
    """

    topic: BagTopic
    encoding: str | None
    frame: str

    @property
    def is_compressed(self) -> bool:
        """Return whether the messages are compressed images."""
        return self.topic.type == COMPRESSED

    @property
    def is_rectified(self) -> bool:
        """Return whether the images are rectified, according to the name of the topic."""
        return is_rectified(self.topic.name)

    @property
    def is_beside_depth(self) -> bool:
        """Return whether the topic's name indicates colour, infrared, confidence or labels.

        `/depth/confidence` does; `/ir_camera/depth/image` does not.
        """
        parts = topic_without_transport(self.topic.name).split("/")
        last = max((i for i, part in enumerate(parts) if "depth" in part.lower()), default=0)
        return self.encoding is not None and any(map(is_beside_depth, parts[last:]))


@dataclass(frozen=True, eq=False)
class BagSource:
    """The source of a frame's bytes: a message of a bag.

    Parameters
    ----------
    log_ns, occurrence : recording time, nanoseconds, and index among the messages with that time
    T_cloud_sensor : see `cloud_file`
    window : scans that are joined to the frame; None if none are
    """

    bag: Bag
    topic: BagTopic
    log_ns: int
    occurrence: int
    T_cloud_sensor: Floats | None = None
    window: ScanWindow | None = None

    def read_bytes(self) -> bytes:
        """Return the message as the bytes of a PNG or NPY file.

        Raise UnreadableFrame or UnreadableCloud if the message has no depth, or is damaged. Raise
        DatasetError if the bag is damaged.
        """
        if self.window is not None:
            with naming(f"{self.bag.path}, {self.topic.name} at {self.log_ns} ns"):
                return encode_npy(self.window.cloud(self.bag, self.topic))
        message = self.bag.at(self.topic.name, self.log_ns, self.occurrence)
        is_cloud = self.topic.type in CLOUDS
        with naming(f"{self.bag.path}, {self.topic.name} at {self.log_ns} ns"):
            try:
                fields = self.bag.decode(message, self.topic.type)
            except DatasetError as cause:  # the message, not the bag, is damaged
                error: type[FrameError] = UnreadableCloud if is_cloud else UnreadableFrame
                raise error("The message is damaged. Record it again.") from cause
            if is_cloud:
                return cloud_file(fields, self.T_cloud_sensor)
            return depth_file(fields, compressed=self.topic.type == COMPRESSED)

    def __reduce__(self) -> tuple[Any, ...]:
        place = self.log_ns, self.occurrence, self.T_cloud_sensor, self.window
        return _restore_source, (self.bag.path, self.topic, *place)


def _restore_source(path: Path, topic: BagTopic, *place: Any) -> BagSource:
    """Return a source that another process pickled, with its bag opened in this process."""
    return BagSource(shared_bag(path), topic, *place)


def frame_topics(bag: Bag) -> list[FrameTopic]:
    """Return the topics of depth images and points, according to their first messages.

    If an image topic exists both raw and compressed, the raw topic is returned.
    """
    topics = []
    for topic in bag.of_type(IMAGE, COMPRESSED, *CLOUDS):
        described = _describe_topic(bag, topic)
        if described is not None:
            topics.append(described)
    raw = {described.topic.name for described in topics if not described.is_compressed}
    return [
        described
        for described in topics
        if not (described.is_compressed and topic_without_transport(described.topic.name) in raw)
    ]


def _describe_topic(bag: Bag, topic: BagTopic) -> FrameTopic | None:
    """Return a topic with the encoding and frame of its first message; None if it has no depth."""
    try:
        message = bag.first(topic.name)
        fields = None if message is None else bag.decode(message, topic.type)
    except DatasetError:  # a damaged topic is not selected automatically
        return None
    if fields is None:
        return None
    encoding = None
    if topic.type not in CLOUDS:
        encoding = image_encoding(fields, compressed=topic.type == COMPRESSED)
        if encoding is None:
            return None
    return FrameTopic(topic, encoding, frame_name(str(fields.header.frame_id)))


def choose_topic(bag: Bag, name: str | None) -> FrameTopic:
    """Return the selected topic of frames.

    `name`: name that the user specifies, or None; images other than depth, such as infrared, are
    selected only by name. Raise DatasetError if no topic fits, or several topics fit and `name` is
    None.
    """
    candidates = frame_topics(bag)
    if name is not None:
        named = [topic for topic in bag.topics if topic.name == name]
        if not named:
            raise DatasetError(
                f"{bag.path}: There is no topic {name!r:.100}. Select one of "
                f"{listed(topic.topic for topic in candidates)}. `sceneprint bag` lists all topics."
            )
        frames = next((topic for topic in candidates if topic.topic.name == name), None)
        if frames is None and named[0].type in (IMAGE, COMPRESSED, *CLOUDS):
            frames = _describe_topic(bag, named[0])
        if frames is None:
            raise DatasetError(
                f"{bag.path}: The topic {printable(name)} ({printable(named[0].type)}, "
                f"{named[0].count} messages) has no depth images ({_SUPPORTED}) and no points. "
                f"Select one of {listed(topic.topic for topic in candidates)}."
            )
        return frames
    candidates = [topic for topic in candidates if not topic.is_beside_depth]
    if not candidates:
        raise DatasetError(
            f"{bag.path}: There is no topic of depth images ({_SUPPORTED}; not {OMITTED_IMAGES}) "
            f"or of points (PointCloud2, CustomMsg). Images are {_list_encodings(bag)}. "
            "Select one with --topic, or record depth or points; packets of a scanner and planar "
            "scans are not read. `sceneprint bag` lists all topics."
        )
    if len(candidates) > 1:
        raise DatasetError(
            f"{bag.path}: {len(candidates)} topics have frames: "
            f"{listed(topic.topic for topic in candidates)}. Select one with --topic."
        )
    return candidates[0]


#: Supported encodings of images, for error messages.
_SUPPORTED = "16UC1, mono16, 32FC1, compressedDepth, or 16-bit PNG"


def _list_encodings(bag: Bag) -> str:
    """Return the encodings of a bag's images as text for error messages."""
    encodings = []
    for topic in bag.of_type(IMAGE, COMPRESSED)[:20]:
        try:
            message = bag.first(topic.name)
            fields = None if message is None else bag.decode(message, topic.type)
        except DatasetError:
            fields = None
        encoding = getattr(fields, "encoding", None) or getattr(fields, "format", "damaged")
        encodings.append(f"{topic.name} ({encoding!r:.40})")
    return printable(", ".join(encodings)) or "missing"


def camera_topic(bag: Bag, frames: FrameTopic, name: str | None) -> BagTopic | None:
    """Select the CameraInfo topic of depth images; return None if none fits.

    It is `name`; otherwise `camera_info` in the namespace of the images; otherwise the only topic
    whose first message has the coordinate frame of the images.

    Parameters
    ----------
    frames : topic of depth images
    name : name that the user specifies; None selects automatically

    Raises
    ------
    DatasetError : If `name` is not a topic of CameraInfo, or several topics have the frame.
    """
    topics = bag.of_type(CAMERA)
    if name is not None:
        topic = next((candidate for candidate in topics if candidate.name == name), None)
        if topic is None:
            raise DatasetError(
                f"{bag.path}: There is no topic {name!r:.100} of CameraInfo. Select one of "
                f"{listed(topics)} with --camera-info."
            )
        return topic
    beside = topic_without_transport(frames.topic.name).rpartition("/")[0] + "/camera_info"
    for candidate in topics:
        if candidate.name == beside:
            return candidate
    fitting = [candidate for candidate in topics if _frame_of(bag, candidate) == frames.frame]
    if len(fitting) > 1:
        raise DatasetError(
            f"{bag.path}: Several cameras fit {frames.topic.name}: {listed(fitting)}. "
            "Select one with --camera-info."
        )
    return fitting[0] if fitting else None


def _frame_of(bag: Bag, topic: BagTopic) -> str | None:
    """Return the coordinate frame of a topic's first message; None if it cannot be decoded."""
    try:
        message = bag.first(topic.name)
        fields = None if message is None else bag.decode(message, topic.type)
    except DatasetError:
        return None
    return None if fields is None else frame_name(str(fields.header.frame_id))


def listed(topics: Iterable[BagTopic]) -> str:
    """Return names, types and message counts of at most 20 topics as text for errors."""
    names = [
        f"{topic.name} ({topic.type.rpartition('/')[2]}, {topic.count} messages)"
        for topic in topics
    ]
    return printable(", ".join(names[:20])) or "none"
