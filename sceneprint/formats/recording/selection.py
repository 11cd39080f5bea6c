"""What of a bag becomes frames: which of the messages, at which poses.

path, RecordingOptions  --recording_sequences-->  FrameSequence of each part
Bag  --bag_outline-->  BagOutline: what would be taken, for `sceneprint bag`
stamps, poses  --keyframes-->  places of those far enough from the last, or long enough after it
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sceneprint.errors import DatasetError, InvalidIntrinsics, SceneprintError
from sceneprint.formats.dataset.frame_reference import FrameReference, FrameSequence, Layout
from sceneprint.formats.recording.bag import CAMERA, Bag, BagTopic
from sceneprint.formats.recording.scan import BagPart, BagScan, Progress, scan_bag
from sceneprint.formats.recording.topics import (
    BagSource,
    FrameTopic,
    camera_topic,
    choose_topic,
    frame_topics,
    listed,
)
from sceneprint.formats.sample_range import sample_range
from sceneprint.types import Floats
from sceneprint_client.api.base import GivenBase, checked
from sceneprint_client.api.frames import SampleRange, pooled_range
from sceneprint_client.errors import printable
from sceneprint_client.files import naming
from sceneprint_client.ros_messages import DEPTH_SCALE, camera_intrinsics
from sceneprint_client.sidecars import Camera, CloudSource, find_camera
from sceneprint_client.transforms import (
    BASES,
    FASTEST,
    TOLERANCE_S,
    WORLDS,
    TransformTree,
    UnknownTransform,
    frame_name,
)

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
    """Return the metres and radians between two poses."""
    turn = a[:3, :3].T @ b[:3, :3]
    cosine = (float(np.trace(turn)) - 1.0) / 2.0
    sine = math.hypot(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]) / 2
    return float(np.linalg.norm(b[:3, 3] - a[:3, 3])), math.atan2(sine, cosine)


# The keyframes.


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
    sensor_frame : where the sensor is, of points in another frame
    depth_scale : stored units per metre of 16-bit depth; None: 1000, or as an intrinsics.json says
    progress : what to call while the bag is read
    """

    topic: str | None = None
    camera_info: str | None = None
    pose_frame: str | None = None
    keyframe_m: float = 0.3
    keyframe_deg: float = 15.0
    keyframe_s: float = 0.5
    sensor_frame: str | None = None
    depth_scale: float | None = None
    progress: Progress | None = None


# Frames.


def recording_sequences(
    path: Path, options: RecordingOptions, name: str | None = None
) -> tuple[FrameSequence, ...]:
    """Return the frames of a recording that are taken; their samples are read when asked for.

    Parameters
    ----------
    path : an .mcap, .db3 or .bag file, or a rosbag2 folder
    options : what to take
    name : of the sequence; default: that of the file

    Returns
    -------
    sequences : one, or one for each part with frames where stamps go back; the `note` of the first
        says what was taken and left out of all, and why

    Raises
    ------
    DatasetError : the recording cannot be read, or nothing in it can be taken, or several topics
        can be.
    InvalidIntrinsics : its camera is none, or has a lens that is not supported.
    MissingDependency : rosbags is not installed.
    """
    bag = Bag(path)
    frames = choose_topic(bag, options.topic)
    name = recording_name(path) if name is None else name
    return tuple(_sequences_of(bag, frames, options, name))


def _sequences_of(
    bag: Bag, frames: FrameTopic, options: RecordingOptions, name: str
) -> list[FrameSequence]:
    """Return the frames of a topic that are taken; see `recording_sequences`."""
    if options.depth_scale is not None and frames.encoding in (None, "32FC1"):
        raise DatasetError(
            f"{bag.path}: {frames.topic.name} is {frames.encoding or 'points'} in metres, and has "
            "no depth scale. Leave --depth-scale out."
        )
    info = None if frames.encoding is None else camera_topic(bag, frames, options.camera_info)
    scan = scan_bag(bag, frames.topic, info, options.progress)
    cameras = (
        {} if frames.encoding is None else _cameras(bag, frames, info, scan, options.depth_scale)
    )
    sensor = _sensor(bag, scan, frames, options)
    motions = _motions(bag, scan, frames, sensor, options)
    note = _note(frames, scan, motions)
    if sensor != frames.frame:
        note += f"; points are taken from {frames.frame} to their sensor, {sensor}"
    lenses = {camera.intrinsics for camera in cameras.values()}
    if len(lenses) > 1:
        note += (
            f"; {len(lenses)} cameras, as the camera info changes: each frame has that of its time"
        )
    if not any(motion.taken for motion in motions):
        raise DatasetError(
            f"{bag.path}: {note}. Record transforms of one publisher, or choose another frame with "
            "--pose-frame."
        )
    sequences: list[FrameSequence] = []
    for number, motion in enumerate(motions, 1):
        part = name if len(motions) == 1 else f"{name}.part{number}"
        references = [
            _reference(bag, frames, scan, cameras.get(place), motion, part, place)
            for place in motion.taken
        ]
        if references:
            parent = f"{part}/{motion.world}" if motion.world else part
            sequences.append(
                FrameSequence(
                    part, bag.path, Layout.RECORDING, parent, None, tuple(references),
                    note="" if sequences else note,
                    lost=0 if sequences else _lost(scan, motions),
                )
            )  # fmt: skip
    return sequences


#: Frames of a recording that are read for its range.
_SAMPLED = 9


def sampled_range(
    sequences: Sequence[FrameSequence],
) -> tuple[SampleRange | None, SceneprintError | None]:
    """Return the range of some frames from the first to the last, and why none could be read."""
    frames = [one for sequence in sequences for one in sequence.frames]
    found, error = list[SampleRange](), None
    for place in sorted(set(np.linspace(0, len(frames) - 1, _SAMPLED).round().astype(int))):
        try:
            found.append(sample_range(frames[place].read()))
        except SceneprintError as cause:
            error = cause
    return pooled_range(found), None if found else error


def recording_name(path: Path) -> str:
    """Return the name of a recording without the suffix of its format."""
    return path.name if path.is_dir() else path.stem


def _sensor(bag: Bag, scan: BagScan, frames: FrameTopic, options: RecordingOptions) -> str:
    """Return the frame of the sensor: that of the messages, unless it is named, or points are in
    the frame of the world, as those that FAST-LIO has registered.

    Raises
    ------
    DatasetError : points are in the frame of the world, and transforms do not tell their sensor.
    """
    frame, trees = frames.frame, [part.tree for part in scan.parts]
    wanted = options.sensor_frame
    if frames.encoding is not None or (wanted is None and not _is_world(frame, trees)):
        return frame
    leaves = sorted({leaf for tree in trees for leaf in tree.leaves(frame)})
    if wanted is None and len(leaves) == 1:
        return leaves[0]
    if wanted is not None and any(tree.path(frame, wanted) is not None for tree in trees):
        return str(frame_name(wanted))
    below = ", ".join(leaves[:20])
    what = (
        "where its sensor was is not known" if wanted is None else f"{wanted!r:.100} is not below"
    )
    remedy = f"Choose one of {below} with --sensor-frame" if below else "Record /tf or odometry"
    raise DatasetError(
        f"{bag.path}: The points of {frames.topic.name} are in {frame or 'no frame'}, and {what}. "
        f"{remedy}, or take the topic of the raw scans."
    )


def _is_world(frame: str, trees: Sequence[TransformTree]) -> bool:
    """Return whether points in a frame have been taken out of the axes of their sensor: it is
    called like a world, or sensors move in it and it moves in none.
    """
    name = frame.rpartition("/")[2]
    if name in WORLDS or name == _WORLD_OF_LOAM:
        return True
    return name not in BASES and any(
        tree.moves_below(frame) and tree.world_of(frame) is None for tree in trees
    )


#: What LOAM and FAST-LIO call the frame in which they started.
_WORLD_OF_LOAM = "camera_init"


@dataclass(eq=False)
class _Motion:
    """Where the sensor was in one part of a recording, by the place of each frame.

    Parameters
    ----------
    world : what poses lead to; None where they are not known
    base : frame of the robot; None where nothing tells
    poses, mountings : T_world_sensor and T_base_sensor of each frame, where known
    ups : up in the sensor's axes of each frame, where known
    cloud_poses : T_cloud_sensor of each frame whose points are not in the axes of the sensor
    taken : places of the keyframes
    unknown : of the frames without a pose, why
    remarks : what else is to be said of transforms above the sensor
    is_broken : whether one of these is passed over
    """

    world: str | None
    base: str | None = None
    poses: dict[int, Floats] = field(default_factory=dict)
    mountings: dict[int, Floats] = field(default_factory=dict)
    ups: dict[int, Floats] = field(default_factory=dict)
    cloud_poses: dict[int, Floats] = field(default_factory=dict)
    taken: list[int] = field(default_factory=list)
    unknown: dict[int, UnknownTransform] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    is_broken: bool = False

    @property
    def is_disputed(self) -> bool:
        """Return whether transforms contradict each other."""
        return any(why.nearest_s is None for why in self.unknown.values())


def _motions(
    bag: Bag, scan: BagScan, frames: FrameTopic, sensor: str, options: RecordingOptions
) -> list[_Motion]:
    """Return the motion in each part that has frames."""
    parts = [
        (part, range(part.first, end))
        for part, end in zip(scan.parts, scan.ends, strict=True)
        if end > part.first
    ]
    wanted = options.pose_frame
    trees = [part.tree for part, _ in parts]
    if wanted is not None and all(tree.path(wanted, sensor) is None for tree in trees):
        above = dict.fromkeys(one for tree in trees for one in tree.ancestors(sensor)[1:])
        raise DatasetError(
            f"{bag.path}: No transforms lead from {sensor or 'the sensor'} to "
            f"{wanted!r:.100}. Frames above it are {', '.join(above) or 'none'}."
        )
    motions = [
        _motion(part, places, scan, (sensor, frames.frame), wanted) for part, places in parts
    ]
    with_poses = any(motion.poses for motion in motions)
    is_elsewhere = sensor != frames.frame
    if not with_poses and (is_elsewhere or any(motion.is_disputed for motion in motions)):
        return motions  # frames without poses would hide that the transforms are wrong
    for (part, places), motion in zip(parts, motions, strict=True):
        _choose(motion, part, places, scan, sensor, options, with_poses=with_poses)
    return motions


def _motion(
    part: BagPart, places: range, scan: BagScan, names: tuple[str, str], wanted: str | None
) -> _Motion:
    """Return the poses and mountings of a sensor in one part, before keyframes are chosen."""
    tree, (sensor, frame) = part.tree, names
    stamps = [scan.stamps_ns[place] for place in places]
    world = frame_name(wanted or "") or tree.world_of(sensor)
    motion = _Motion(world, tree.base_of(sensor, world))
    above = set(tree.ancestors(sensor))
    for (parent, child), (reason, count) in sorted(tree.passed_over.items()):
        if child in above:
            times = "" if count == 1 else f"{count} times "
            motion.remarks.append(f"{parent} -> {child} is passed over {times}as {reason}")
            motion.is_broken = True
    for (parent, child), length in sorted(tree.normalised.items()):
        if child in above:
            motion.remarks.append(
                f"{parent} -> {child} is normalised, as its quaternion has the length {length:.3g}"
            )
    if world is not None:
        for place, found in zip(places, tree.lookup(world, sensor, stamps), strict=True):
            if isinstance(found, UnknownTransform):
                motion.unknown[place] = found
            else:
                motion.poses[place] = found
    if sensor != frame:
        within = tree.poses(frame, sensor, stamps)
        motion.cloud_poses = {
            place: T for place, T in zip(places, within, strict=True) if T is not None
        }
        motion.poses = {
            place: T for place, T in motion.poses.items() if place in motion.cloud_poses
        }
    if motion.base is not None:
        mountings = tree.poses(motion.base, sensor, stamps)
        motion.mountings = {
            place: T for place, T in zip(places, mountings, strict=True) if T is not None
        }
    return motion


def _choose(
    motion: _Motion, part: BagPart, places: range, scan: BagScan, sensor: str,
    options: RecordingOptions, *, with_poses: bool,
) -> None:  # fmt: skip
    """Choose the keyframes of one part: among frames with poses where the recording has any, else
    by time.
    """
    stamps, poses = scan.stamps_ns, motion.poses
    if not with_poses:
        motion.world = None
    order = sorted(poses if with_poses else places, key=lambda place: stamps[place])
    chosen = keyframes(
        [stamps[place] for place in order],
        [poses[place] for place in order] if with_poses else None,
        options.keyframe_m,
        math.radians(options.keyframe_deg),
        options.keyframe_s,
    )
    motion.taken = [order[place] for place in chosen]
    motion.ups = _ups(part, sensor, motion.taken, stamps)


def _ups(
    part: BagPart, sensor: str, taken: list[int], stamps_ns: Sequence[int]
) -> dict[int, Floats]:
    """Return up in the sensor's axes of the frames taken, by the IMU with most measurements that
    does not move against the sensor.
    """
    for imu in sorted(part.imus, key=lambda name: (-len(part.imus[name]), name)):
        T_sensor_imu = part.tree.fixed_transform(sensor, imu)
        if T_sensor_imu is None:
            continue
        found = part.imus[imu].up_at([stamps_ns[place] for place in taken])
        return {
            place: T_sensor_imu[:3, :3] @ up
            for place, up in zip(taken, found, strict=True)
            if up is not None
        }
    return {}


def _reference(
    bag: Bag, frames: FrameTopic, scan: BagScan, camera: Camera | None, motion: _Motion, name: str,
    place: int,
) -> FrameReference:  # fmt: skip
    up, T_base_sensor, base = motion.ups.get(place), motion.mountings.get(place), None
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
        motion.poses.get(place),
        CloudSource(up=direction) if camera is None else None,
        source=BagSource(bag, frames.topic, *scan.places[place], motion.cloud_poses.get(place)),
        base=base,
        original=f"{frames.topic.name}/{_seconds(scan.stamps_ns[place])}",
        sequence=place,
    )


def _seconds(stamp_ns: int) -> str:
    """Return a stamp in seconds, to the nanosecond, which no float holds."""
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


def _cameras(
    bag: Bag, frames: FrameTopic, topic: BagTopic | None, scan: BagScan, scale: float | None
) -> dict[int, Camera]:
    """Return the camera of each depth image: by the CameraInfo of its time, else of an
    intrinsics.json beside the bag.
    """
    if topic is None or not scan.infos:
        beside = _camera_beside(bag, frames, topic)
        beside = replace(beside, depth_scale=scale or beside.depth_scale)
        return dict.fromkeys(range(len(scan.stamps_ns)), beside)
    with naming(f"{bag.path}, {topic.name}"):
        cameras = [
            Camera(camera_intrinsics(info, rectified=frames.is_rectified), scale or DEPTH_SCALE)
            for info in scan.infos
        ]
    found, last = dict[int, Camera](), 0
    for part, end in zip(scan.parts, scan.ends, strict=True):
        places = range(part.first, end)
        numbers = [last] * len(places)
        if part.infos:
            numbers = part.info_at([scan.stamps_ns[place] for place in places])
            last = part.infos[-1]
        found.update((place, cameras[one]) for place, one in zip(places, numbers, strict=True))
    return found


def _camera_beside(bag: Bag, frames: FrameTopic, topic: BagTopic | None) -> Camera:
    try:
        return find_camera(bag.path.parent)
    except DatasetError as cause:
        known = listed(bag.of_type(CAMERA))
        said = "is not calibrated" if topic is not None else "is unknown"
        raise DatasetError(
            f"{bag.path}: The camera of {frames.topic.name} {said}; topics of CameraInfo are "
            f"{known}. Choose one with --camera-info, or write an intrinsics.json beside the "
            "recording."
        ) from cause


def _note(frames: FrameTopic, scan: BagScan, motions: list[_Motion]) -> str:
    """Return what was taken and what was left out, for people."""
    total, taken = len(scan.stamps_ns), sum(len(motion.taken) for motion in motions)
    poses = sum(len(motion.poses) for motion in motions)
    worlds = sorted({motion.world for motion in motions if motion.poses and motion.world})
    text = (
        f"{taken} of {total} frames of {printable(frames.topic.name)} taken, poses of {poses} of "
        f"{total} frames{' in ' if worlds else ''}{', '.join(worlds)}"
    )
    if poses < total:
        text += f"; {total - poses} without: {_reasons(frames, motions)}"
    without = _without_pose(scan, motions)
    left = [
        f"{count} {reason}"
        for count, reason in (
            (total - taken - without, "between keyframes"),
            (without, "without a pose"),
            (scan.damaged, "damaged messages of other topics"),
        )
        if count
    ]
    if left:
        text += f"; left out: {', '.join(left)}"
    if len(motions) > 1:
        text += f"; split into {len(motions)} parts, as stamps go back"
    remarks = dict.fromkeys(one for motion in motions for one in motion.remarks)
    return printable("; ".join([text, *list(remarks)[:5]]))


def _lost(scan: BagScan, motions: list[_Motion]) -> int:
    """Return how many frames or their poses are left out, and damaged messages."""
    has_poses = any(motion.poses for motion in motions)
    if not has_poses and any(motion.is_broken for motion in motions):
        return len(scan.stamps_ns)
    return _without_pose(scan, motions) + scan.damaged


def _without_pose(scan: BagScan, motions: list[_Motion]) -> int:
    """Return how many frames are left out as they have no pose, which others have."""
    poses = sum(len(motion.poses) for motion in motions)
    is_left_out = poses or not any(motion.taken for motion in motions)
    return len(scan.stamps_ns) - poses if is_left_out else 0


def _reasons(frames: FrameTopic, motions: list[_Motion]) -> str:
    """Return why frames have no poses, by transforms, the most frequent first."""
    whys = [why for motion in motions for why in motion.unknown.values()]
    found = []
    for (transform, disputed), count in Counter(
        (why.transform, why.nearest_s is None) for why in whys
    ).most_common(3):
        if disputed:
            reason = (
                f"samples of {transform} contradict each other (two publishers, or {FASTEST:g} m/s)"
            )
        else:
            nearest = min(
                why.nearest_s for why in whys
                if why.transform == transform and why.nearest_s is not None
            )  # fmt: skip
            within = f"within {TOLERANCE_S * 1e3:g} ms (nearest {nearest:.2g} s)"
            reason = f"no sample of {transform}{f' {within}' if math.isfinite(nearest) else ''}"
        found.append(reason if len(whys) == count else f"{reason}: {count}")
    if not found:
        return (
            f"no transforms lead from {frames.frame or 'their frame'} to a frame in which it moves"
        )
    return ", ".join(found)


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
    sequences : the frames that would be taken; none where nothing would be
    range : of some of these frames
    problem : why nothing would be taken; empty where something would
    """

    kind: str
    start_ns: int
    end_ns: int
    topics: tuple[BagTopic, ...]
    frames: tuple[FrameTopic, ...]
    chosen: FrameTopic | None
    camera: str | None
    sequences: tuple[FrameSequence, ...]
    range: SampleRange | None
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
        chosen, camera, depth, problem = None, None, None, ""
        sequences: tuple[FrameSequence, ...] = ()
        try:
            chosen = choose_topic(bag, options.topic)
            if chosen.encoding is not None:
                topic = camera_topic(bag, chosen, options.camera_info)
                camera = None if topic is None else topic.name
            sequences = tuple(_sequences_of(bag, chosen, options, recording_name(path)))
            depth, unreadable = sampled_range(sequences)
            if unreadable is not None:
                sequences, problem = (), str(unreadable)
        except (DatasetError, InvalidIntrinsics) as error:
            problem = str(error)
        kind = "ROS 1" if bag.is_ros1 else "ROS 2"
        return BagOutline(
            kind,
            bag.start_ns,
            bag.end_ns,
            bag.topics,
            frames,
            chosen,
            camera,
            sequences,
            depth,
            problem,
        )
    finally:
        bag.close()
