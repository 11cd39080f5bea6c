"""What of a bag becomes frames: which topics, at which poses, and which of the messages.

path, RecordingOptions  --recording_sequence-->  FrameSequence
Bag  --bag_outline-->  BagOutline: what would be taken, for `sceneprint bag info`
stamps, poses  --keyframes-->  places of those far enough from the last, or long enough after it
Image | CompressedImage  --depth_file-->  bytes of a PNG or NPY file
PointCloud2  --cloud_file-->  bytes of an NPY file (N, 3)
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sceneprint.errors import (
    DatasetError,
    FrameError,
    InvalidIntrinsics,
    UnreadableCloud,
    UnreadableFrame,
)
from sceneprint.formats.dataset.frame_reference import FrameReference, FrameSequence, Layout
from sceneprint.formats.depth_file import decode_png, encode_npy, encode_png, inverse_depth
from sceneprint.formats.recording.bag import (
    CAMERA,
    COMPRESSED,
    IMAGE,
    POINTS,
    Bag,
    BagScan,
    BagTopic,
    Progress,
    scan_bag,
    shared_bag,
)
from sceneprint.types import Floats
from sceneprint_client.api.base import GivenBase, checked
from sceneprint_client.errors import printable
from sceneprint_client.files import naming
from sceneprint_client.poses import frame_name
from sceneprint_client.ros_messages import (
    DEPTH_SCALE,
    camera_intrinsics,
    cloud_points,
    compressed_depth,
    depth_samples,
    image_encoding,
    is_rectified,
    topic_without_transport,
)
from sceneprint_client.sidecars import Camera, CloudSource, find_camera

# Which frames are taken: far enough from the last one, or long enough after it.


def keyframes(
    stamps_ns: Sequence[int], poses: Sequence[Floats] | None, metres: float, radians: float,
    seconds: float,
) -> list[int]:  # fmt: skip
    """Return the places of the frames to take; the first is always one.

    Parameters
    ----------
    stamps_ns : N times, in order
    poses : N times T_parent_sensor (4, 4); None where they are not known
    metres, radians : a frame is taken that lies as far from the last one taken, or is turned by
        as much; 0 takes every frame
    seconds : without poses a frame is taken that came as long after the last one taken
    """
    taken: list[int] = []
    for place, stamp in enumerate(stamps_ns):
        if not taken:
            taken.append(place)
        elif poses is None:
            if stamp - stamps_ns[taken[-1]] >= round(seconds * 1e9):
                taken.append(place)
        else:
            distance, angle = _relative_motion(poses[taken[-1]], poses[place])
            if distance >= metres or angle >= radians:
                taken.append(place)
    return taken


def _relative_motion(a: Floats, b: Floats) -> tuple[float, float]:
    """Metres and radians between two poses."""
    turn = a[:3, :3].T @ b[:3, :3]
    cosine = (float(np.trace(turn)) - 1.0) / 2.0
    sine = math.hypot(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]) / 2
    return float(np.linalg.norm(b[:3, 3] - a[:3, 3])), math.atan2(sine, cosine)


# Messages of ROS as the bytes of a frame.


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
        found = compressed_depth(message)
        if found.inverse is None:
            return found.png
        return encode_npy(inverse_depth(decode_png(found.png), *found.inverse))
    samples = depth_samples(message)
    return encode_npy(samples) if samples.dtype.kind == "f" else encode_png(samples)


def cloud_file(message: Any) -> bytes:
    """Return the bytes of an NPY file with the points of a PointCloud2; see `cloud_points`."""
    return encode_npy(cloud_points(message))


# Which topics, at which poses.


@dataclass(frozen=True)
class RecordingOptions:
    """How frames are taken from a bag; what is None is found in it.

    Parameters
    ----------
    topic : of depth images or points
    camera_info : topic of the depth images' camera
    pose_frame : what poses lead to, such as "map" or "odom"
    keyframe_m, keyframe_deg : a frame is taken this far from the last one, or turned by this much;
        0 takes every frame
    keyframe_s : without poses, a frame is taken this long after the last one
    progress : what to call while the bag is read
    """

    topic: str | None = None
    camera_info: str | None = None
    pose_frame: str | None = None
    keyframe_m: float = 0.3
    keyframe_deg: float = 15.0
    keyframe_s: float = 0.5
    progress: Progress | None = None


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
        """Whether its messages are compressed images."""
        return self.topic.type == COMPRESSED

    @property
    def is_rectified(self) -> bool:
        """Whether its images have been rectified, by the name that ROS gives them."""
        return is_rectified(self.topic.name)


@dataclass(frozen=True, eq=False)
class BagSource:
    """One message of a bag: where the bytes of a frame come from.

    Parameters
    ----------
    bag : where it is
    topic : of it
    log_ns, occurrence : when it was recorded, and which of those with that time it is
    """

    bag: Bag
    topic: BagTopic
    log_ns: int
    occurrence: int

    def read_bytes(self) -> bytes:
        """The message as the bytes of a PNG or NPY file.

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
                return cloud_file(fields)
            return depth_file(fields, compressed=self.topic.type == COMPRESSED)

    def __reduce__(self) -> tuple[Any, ...]:
        return _source_in, (self.bag.path, self.topic, self.log_ns, self.occurrence)


def _source_in(path: Path, topic: BagTopic, log_ns: int, occurrence: int) -> BagSource:
    """A source that came from another process: its bag is opened here."""
    return BagSource(shared_bag(path), topic, log_ns, occurrence)


# Topics.


def frame_topics(bag: Bag) -> list[FrameTopic]:
    """Topics of depth images and of points, each judged by its first message.

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
    """A topic by its first message; None where it has no depth."""
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
    """The topic whose messages are the frames.

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
                f"{_listed(one.topic for one in candidates)}; `sceneprint bag info` lists all."
            )
        found = next((one for one in candidates if one.topic.name == wanted), None)
        if found is None and named[0].type in (IMAGE, COMPRESSED, POINTS):
            found = _frame_topic(bag, named[0])
        if found is None:
            raise DatasetError(
                f"{bag.path}: The topic {printable(wanted)} ({printable(named[0].type)}, "
                f"{named[0].count} messages) has no depth images (16UC1, mono16, 32FC1, or PNG of "
                "compressedDepth) and no points. Choose one of "
                f"{_listed(one.topic for one in candidates)}."
            )
        return found
    if not candidates:
        raise DatasetError(
            f"{bag.path}: There is no topic of depth images (16UC1, mono16, 32FC1, or PNG of "
            "compressedDepth) or of points (PointCloud2). `sceneprint bag info` lists what is "
            "there."
        )
    if len(candidates) > 1:
        raise DatasetError(
            f"{bag.path}: {len(candidates)} topics can be taken: "
            f"{_listed(one.topic for one in candidates)}. Choose one with --topic."
        )
    return candidates[0]


def camera_topic(bag: Bag, frames: FrameTopic, wanted: str | None) -> BagTopic | None:
    """The topic of the camera of depth images: beside theirs, else the only one of their frame.

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
                f"{_listed(known)} with --camera-info."
            )
        return found
    beside = topic_without_transport(frames.topic.name).rpartition("/")[0] + "/camera_info"
    for one in known:
        if one.name == beside:
            return one
    fitting = [one for one in known if _frame_of(bag, one) == frames.frame]
    if len(fitting) > 1:
        raise DatasetError(
            f"{bag.path}: The camera of {frames.topic.name} may be that of {_listed(fitting)}. "
            "Choose one with --camera-info."
        )
    return fitting[0] if fitting else None


def _frame_of(bag: Bag, topic: BagTopic) -> str | None:
    """The frame of a topic's first message."""
    try:
        message = bag.first(topic.name)
        fields = None if message is None else bag.decode(message, topic.type)
    except DatasetError:
        return None
    return None if fields is None else frame_name(str(fields.header.frame_id))


def _listed(topics: Iterable[BagTopic]) -> str:
    """Names for people."""
    names = [f"{one.name} ({one.type.rpartition('/')[2]}, {one.count} messages)" for one in topics]
    return printable(", ".join(names[:20])) or "none"


# Frames.


def recording_sequence(
    path: Path, options: RecordingOptions, name: str | None = None
) -> FrameSequence:
    """Return the frames of a recording that are taken; their samples are read when asked for.

    Parameters
    ----------
    path : an .mcap, .db3 or .bag file, or a rosbag2 folder
    options : what to take
    name : of the sequence; default: that of the file

    Returns
    -------
    sequence : its `note` says what was left out, and why

    Raises
    ------
    DatasetError : the recording cannot be read, or nothing in it can be taken, or several topics
        can be.
    InvalidIntrinsics : its camera is none, or has a lens that is not supported.
    MissingDependency : rosbags is not installed.
    """
    bag = Bag(path)
    frames = choose_topic(bag, options.topic)
    info = None if frames.encoding is None else camera_topic(bag, frames, options.camera_info)
    scan = scan_bag(bag, frames.topic, info, options.progress)
    camera = None if frames.encoding is None else _camera(bag, frames, info, scan)
    name = recording_name(path) if name is None else name
    motion = _motion(bag, scan, frames, options)
    references = [
        _reference(bag, frames, scan, camera, motion, name, place) for place in motion.taken
    ]
    return FrameSequence(
        name,
        path,
        Layout.RECORDING,
        f"{name}/{motion.world}" if motion.world else name,
        None,
        tuple(references),
        note=_note(frames, scan, motion),
    )


def recording_name(path: Path) -> str:
    """The name of a recording without what tells its format."""
    return path.name if path.is_dir() else path.stem


@dataclass(eq=False)
class _Motion:
    """Where the sensor was, by the place of each frame.

    Parameters
    ----------
    world : what poses lead to; None where they are not known
    base : frame of the robot; None where nothing tells
    poses, mountings : T_world_sensor and T_base_sensor of each frame, where known
    ups : up in the sensor's axes of each frame, where known
    taken : places of the keyframes
    unknown : how many frames have no pose at their time
    """

    world: str | None
    base: str | None
    poses: list[Floats | None]
    mountings: list[Floats | None]
    ups: list[Floats | None]
    taken: list[int]
    unknown: int


def _motion(bag: Bag, scan: BagScan, frames: FrameTopic, options: RecordingOptions) -> _Motion:
    stamps, tree = scan.stamps_ns, scan.tree
    world = frame_name(options.pose_frame or "") or tree.world_of(frames.frame)
    if options.pose_frame is not None and tree.path(options.pose_frame, frames.frame) is None:
        raise DatasetError(
            f"{bag.path}: No transforms lead from {frames.frame or 'the sensor'} to "
            f"{options.pose_frame!r:.100}. Frames above it are "
            f"{', '.join(tree.ancestors(frames.frame)[1:]) or 'none'}."
        )
    poses: list[Floats | None] = [None] * len(stamps)
    if world is not None:
        poses = tree.poses(world, frames.frame, stamps)
    known = [place for place, pose in enumerate(poses) if pose is not None]
    unknown = len(poses) - len(known) if world is not None else 0
    order = sorted(known or range(len(stamps)), key=lambda place: stamps[place])
    chosen = keyframes(
        [stamps[place] for place in order],
        [pose for place in order if (pose := poses[place]) is not None] if known else None,
        options.keyframe_m,
        math.radians(options.keyframe_deg),
        options.keyframe_s,
    )
    base = tree.base_of(frames.frame, world)
    mountings: list[Floats | None] = [None] * len(stamps)
    if base is not None:
        mountings = tree.poses(base, frames.frame, stamps)
    taken = [order[place] for place in chosen]
    ups = _ups(scan, frames.frame, taken)
    return _Motion(world if known else None, base, poses, mountings, ups, taken, unknown)


def _ups(scan: BagScan, sensor: str, taken: list[int]) -> list[Floats | None]:
    """Up in the sensor's axes of the frames taken, of the IMU with most measurements that does not
    move against the sensor.
    """
    ups: list[Floats | None] = [None] * len(scan.stamps_ns)
    for imu in sorted(scan.imus, key=lambda name: (-len(scan.imus[name]), name)):
        T_sensor_imu = scan.tree.fixed_transform(sensor, imu)
        if T_sensor_imu is None:
            continue
        found = scan.imus[imu].up_at([scan.stamps_ns[place] for place in taken])
        for place, up in zip(taken, found, strict=True):
            ups[place] = None if up is None else T_sensor_imu[:3, :3] @ up
        break
    return ups


def _reference(
    bag: Bag, frames: FrameTopic, scan: BagScan, camera: Camera | None, motion: _Motion, name: str,
    place: int,
) -> FrameReference:  # fmt: skip
    up, T_base_sensor, base = motion.ups[place], motion.mountings[place], None
    direction = None if up is None else (float(up[0]), float(up[1]), float(up[2]))
    if T_base_sensor is not None:
        base = checked(
            GivenBase, f"{bag.path}: the mounting", matrix=T_base_sensor.tolist(),
            base_frame=motion.base,
        )  # fmt: skip
    return FrameReference(
        f"{name}/{place:06d}",
        bag.path / f"{place:06d}",
        None if camera is None else replace(camera, up=direction or camera.up),
        scan.stamps_ns[place] * 1e-9,
        motion.poses[place],
        CloudSource(up=direction) if camera is None else None,
        source=BagSource(bag, frames.topic, *scan.places[place]),
        base=base,
        original=f"{frames.topic.name}/{_seconds(scan.stamps_ns[place])}",
        sequence=place,
    )


def _seconds(stamp_ns: int) -> str:
    """A stamp in seconds, to the nanosecond, which no float holds."""
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


def _camera(bag: Bag, frames: FrameTopic, topic: BagTopic | None, scan: BagScan) -> Camera:
    """The camera of depth images: of the bag, else of an intrinsics.json beside it."""
    if topic is not None and scan.info is not None:
        with naming(f"{bag.path}, {topic.name}"):
            return Camera(camera_intrinsics(scan.info, rectified=frames.is_rectified), DEPTH_SCALE)
    try:
        return find_camera(bag.path.parent)
    except DatasetError as cause:
        known = _listed(bag.of_type(CAMERA))
        said = "is not calibrated" if topic is not None else "is unknown"
        raise DatasetError(
            f"{bag.path}: The camera of {frames.topic.name} {said}; topics of CameraInfo are "
            f"{known}. Choose one with --camera-info, or write an intrinsics.json beside the "
            "recording."
        ) from cause


def _note(frames: FrameTopic, scan: BagScan, motion: _Motion) -> str:
    """What was taken and what was left out, for people."""
    total, taken = len(scan.stamps_ns), len(motion.taken)
    between = total - taken - (motion.unknown if motion.world else 0)
    left = [
        f"{count} {reason}"
        for count, reason in (
            (between, "between keyframes"),
            (motion.unknown if motion.world else 0, "without a transform at their time"),
            (scan.damaged, "damaged messages of other topics"),
        )
        if count
    ]
    where = f"poses in {motion.world}" if motion.world else "no poses"
    if motion.unknown and motion.world is None:
        where = "no poses, as no transform is known at the time of any frame"
    told = f"{taken} of {total} frames of {printable(frames.topic.name)} taken, {where}"
    return f"{told}; left out: {', '.join(left)}" if left else told


# What a bag holds, for people.


@dataclass(frozen=True)
class BagOutline:
    """What a bag holds, and what would be taken of it.

    Parameters
    ----------
    kind : of its files
    start_ns, end_ns : when the first message was recorded, and the last
    topics : all of them
    frames : the topics that can be taken
    chosen : the one that would be taken, or None
    sequence : the frames that would be taken, or None
    problem : why nothing would be taken; empty where something would
    """

    kind: str
    start_ns: int
    end_ns: int
    topics: tuple[BagTopic, ...]
    frames: tuple[FrameTopic, ...]
    chosen: FrameTopic | None
    camera: str | None
    sequence: FrameSequence | None
    problem: str


def bag_outline(path: Path, options: RecordingOptions) -> BagOutline:
    """Return what a bag holds, and what would be taken of it with these options.

    Raises
    ------
    DatasetError : it cannot be read at all.
    MissingDependency : rosbags is not installed.
    """
    bag = Bag(path)
    try:
        frames = tuple(frame_topics(bag))
        chosen, camera, sequence, problem = None, None, None, ""
        try:
            chosen = choose_topic(bag, options.topic)
            if chosen.encoding is not None:
                topic = camera_topic(bag, chosen, options.camera_info)
                camera = None if topic is None else topic.name
            sequence = recording_sequence(path, options)
        except (DatasetError, InvalidIntrinsics) as error:
            problem = str(error)
        kind = "ROS 1" if bag.is_ros1 else "ROS 2"
        return BagOutline(
            kind, bag.start_ns, bag.end_ns, bag.topics, frames, chosen, camera, sequence, problem
        )
    finally:
        bag.close()
