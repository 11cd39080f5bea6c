"""Selection of a bag's frames, and computation of their poses.

path, RecordingOptions  --recording_sequences-->  FrameSequence of each part
stamps, poses  --keyframes-->  indices of frames far enough from the previous keyframe
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sceneprint.errors import DatasetError
from sceneprint.formats.dataset.frame_reference import FrameReference, FrameSequence, Layout
from sceneprint.formats.recording.bag import CAMERA, Bag, BagTopic
from sceneprint.formats.recording.scan import BagPart, BagScan, Progress, scan_bag
from sceneprint.formats.recording.scan_window import ScanWindow, scan_seconds, scan_windows
from sceneprint.formats.recording.topics import (
    BagSource,
    FrameTopic,
    camera_topic,
    choose_topic,
    listed,
)
from sceneprint.types import Floats
from sceneprint_client.api.base import GivenBase, checked
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


def keyframes(
    stamps_ns: Sequence[int], poses: Sequence[Floats] | None, metres: float, radians: float,
    seconds: float,
) -> list[int]:  # fmt: skip
    """Select keyframes; return their indices. The first frame is always a keyframe.

    Parameters
    ----------
    stamps_ns : time of each frame in order, nanoseconds
    poses : T_parent_sensor (4, 4) of each frame; None if unknown
    metres, radians : minimum distance or angle from the previous keyframe; 0 selects all frames
    seconds : minimum time after the previous keyframe, for frames without poses
    """
    places: list[int] = []
    for place, stamp in enumerate(stamps_ns):
        if not places:
            places.append(place)
        elif poses is None:
            if stamp - stamps_ns[places[-1]] >= round(seconds * 1e9):
                places.append(place)
        else:
            distance, angle = _relative_motion(poses[places[-1]], poses[place])
            if distance >= metres or angle >= radians:
                places.append(place)
    return places


def _relative_motion(a: Floats, b: Floats) -> tuple[float, float]:
    """Return the distance and the angle between two poses, metres and radians."""
    turn = a[:3, :3].T @ b[:3, :3]
    cosine = (float(np.trace(turn)) - 1.0) / 2.0
    sine = math.hypot(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]) / 2
    return math.dist(a[:3, 3], b[:3, 3]), math.atan2(sine, cosine)


@dataclass(frozen=True)
class RecordingOptions:
    """Options for the frames of a bag; None selects a value from the content of the bag.

    Parameters
    ----------
    camera_info : topic of the CameraInfo of the depth images
    pose_frame : parent frame of the poses, such as "map" or "odom"
    keyframe_m, keyframe_deg : minimum distance or angle from the previous keyframe; 0 selects all
        frames
    keyframe_s : minimum time after the previous keyframe, for frames without poses, seconds
    sensor_frame : frame of the sensor, if points are in another frame
    depth_scale : stored units per metre of 16-bit depth; None selects the value of an
        intrinsics.json, or 1000
    join_m : length of the path whose scans are joined to a frame, metres; 0 joins no scans
    progress : callback while the bag is read; see Progress
    """

    topic: str | None = None
    camera_info: str | None = None
    pose_frame: str | None = None
    keyframe_m: float = 0.3
    keyframe_deg: float = 15.0
    keyframe_s: float = 0.5
    sensor_frame: str | None = None
    depth_scale: float | None = None
    join_m: float = 0.0
    progress: Progress | None = None


def recording_sequences(
    path: Path, options: RecordingOptions, name: str | None = None
) -> tuple[FrameSequence, ...]:
    """Return the keyframes of a recording; their samples are read on demand.

    Parameters
    ----------
    path : .mcap, .db3 or .bag file, or rosbag2 folder
    options : topics and keyframes to select
    name : name of the sequence; None selects the name of the file

    Returns
    -------
    sequences : one sequence, or several if stamps jump back; the `note` of the first sequence
        describes the selected frames, and the omitted frames with reasons

    Raises
    ------
    DatasetError : If the recording cannot be read, has no suitable topic, or has several.
    InvalidIntrinsics : If the camera is invalid, or its lens is not supported.
    MissingDependency : If rosbags is not installed.
    """
    bag = Bag(path)
    frames = choose_topic(bag, options.topic)
    name = recording_name(path) if name is None else name
    return tuple(sequences_of(bag, frames, options, name))


def sequences_of(
    bag: Bag, frames: FrameTopic, options: RecordingOptions, name: str
) -> list[FrameSequence]:
    """Return the keyframes of a topic; see `recording_sequences`."""
    if options.depth_scale is not None and frames.encoding in (None, "32FC1"):
        raise DatasetError(
            f"{bag.path}: {frames.topic.name} has {frames.encoding or 'points'} in metres, so a "
            "depth scale does not apply. Omit --depth-scale."
        )
    if options.join_m and frames.encoding is not None:
        raise DatasetError(
            f"{bag.path}: {frames.topic.name} has depth images, but --join-m joins only scans. "
            "Omit it."
        )
    info = None if frames.encoding is None else camera_topic(bag, frames, options.camera_info)
    scan = scan_bag(bag, frames.topic, info, options.progress)
    cameras = (
        {}
        if frames.encoding is None
        else _select_cameras(bag, frames, info, scan, options.depth_scale)
    )
    sensor = _select_sensor(bag, scan, frames, options)
    is_timed = options.join_m and sensor == frames.frame
    seconds = scan_seconds(bag, frames.topic, scan) if is_timed else None
    motions = _compute_motions(bag, scan, frames, sensor, options, seconds or 0.0)
    note = _describe_selection(frames, scan, motions)
    counts = [len(window.scans) for motion in motions for window in motion.windows.values()]
    if counts:
        note += f"; each frame joins the scans of {options.join_m:g} m (a median of "
        note += f"{np.median(counts):g} scans), "
        note += "without correction for motion" if seconds is None else "corrected for motion"
    if sensor != frames.frame:
        note += f"; points are transformed from {frames.frame} to their sensor, {sensor}"
    lenses = {camera.intrinsics for camera in cameras.values()}
    if len(lenses) > 1:
        note += (
            f"; {len(lenses)} cameras, because the camera info changes: each frame has the camera "
            "of its time"
        )
    if not any(motion.keyframes for motion in motions):
        raise DatasetError(
            f"{bag.path}: {note}. Record transforms of a single publisher, or select another frame "
            "with --pose-frame."
        )
    sequences: list[FrameSequence] = []
    for number, motion in enumerate(motions, 1):
        part = name if len(motions) == 1 else f"{name}.part{number}"
        references = [
            _make_reference(bag, frames, scan, cameras.get(place), motion, part, place)
            for place in motion.keyframes
        ]
        if references:
            parent = f"{part}/{motion.world}" if motion.world else part
            sequences.append(
                FrameSequence(
                    part, bag.path, Layout.RECORDING, parent, None, tuple(references),
                    note="" if sequences else note,
                    lost=0 if sequences else _count_lost(scan, motions),
                )
            )  # fmt: skip
    return sequences


def recording_name(path: Path) -> str:
    """Return the name of a recording without the suffix of its format."""
    return path.name if path.is_dir() else path.stem


def _select_sensor(bag: Bag, scan: BagScan, frames: FrameTopic, options: RecordingOptions) -> str:
    """Return the coordinate frame of the sensor.

    It is the frame of the messages, unless the user specifies another frame or the points are in a
    world frame, such as the registered points of FAST-LIO.

    Raise DatasetError if points are in a world frame and the transforms do not determine their
    sensor.
    """
    frame, trees = frames.frame, [part.tree for part in scan.parts]
    stated = options.sensor_frame
    if frames.encoding is not None or (stated is None and not _is_world(frame, trees)):
        return frame
    leaves = sorted({leaf for tree in trees for leaf in tree.leaves(frame)})
    if stated is None and len(leaves) == 1:
        return leaves[0]
    if stated is not None and any(tree.path(frame, stated) is not None for tree in trees):
        return str(frame_name(stated))
    below = ", ".join(leaves[:20])
    what = "the sensor is unknown" if stated is None else f"{stated!r:.100} is not below this frame"
    remedy = f"Select one of {below} with --sensor-frame" if below else "Record /tf or odometry"
    raise DatasetError(
        f"{bag.path}: The points of {frames.topic.name} are in {frame or 'no frame'}, and {what}. "
        f"{remedy}, or use the topic of the raw scans."
    )


def _is_world(frame: str, trees: Sequence[TransformTree]) -> bool:
    """Return whether a coordinate frame is a world frame, so that its points are not in sensor
    axes.

    World frames have usual names, or sensors move in them and they move in no other frame.
    """
    name = frame.rpartition("/")[2]
    if name in WORLDS or name == _WORLD_OF_LOAM:
        return True
    return name not in BASES and any(
        tree.moves_below(frame) and tree.world_of(frame) is None for tree in trees
    )


#: Name of the world frame of LOAM and FAST-LIO.
_WORLD_OF_LOAM = "camera_init"


@dataclass(eq=False)
class _Motion:
    """The motion of the sensor in a part of a recording; keys are indices of frames.

    Parameters
    ----------
    world : parent frame of the poses; None if unknown
    base : frame of the robot; None if unknown
    poses, mountings : known T_world_sensor and T_base_sensor
    ups : known up directions in the sensor's axes
    cloud_poses : T_cloud_sensor of frames whose points are in other axes than the sensor's
    keyframes : indices of the keyframes
    unknown : reasons why frames have no pose
    windows : scans that are joined to the keyframes
    remarks : remarks for users on the transforms above the sensor
    is_broken : whether one of these transforms is ignored
    """

    world: str | None
    base: str | None = None
    poses: dict[int, Floats] = field(default_factory=dict)
    mountings: dict[int, Floats] = field(default_factory=dict)
    ups: dict[int, Floats] = field(default_factory=dict)
    cloud_poses: dict[int, Floats] = field(default_factory=dict)
    keyframes: list[int] = field(default_factory=list)
    unknown: dict[int, UnknownTransform] = field(default_factory=dict)
    windows: dict[int, ScanWindow] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    is_broken: bool = False

    @property
    def is_disputed(self) -> bool:
        """Return whether transforms contradict each other."""
        return any(why.nearest_s is None for why in self.unknown.values())


def _compute_motions(
    bag: Bag, scan: BagScan, frames: FrameTopic, sensor: str, options: RecordingOptions,
    scan_s: float,
) -> list[_Motion]:  # fmt: skip
    """Return the motion in each part with frames; `scan_s` is the duration of a scan, seconds."""
    parts = [
        (part, range(part.first, end))
        for part, end in zip(scan.parts, scan.ends, strict=True)
        if end > part.first
    ]
    world = options.pose_frame
    trees = [part.tree for part, _ in parts]
    if world is not None and all(tree.path(world, sensor) is None for tree in trees):
        above = dict.fromkeys(frame for tree in trees for frame in tree.ancestors(sensor)[1:])
        raise DatasetError(
            f"{bag.path}: There are no transforms from {sensor or 'the sensor'} to "
            f"{world!r:.100}. Select one of the frames above the sensor: "
            f"{', '.join(above) or 'none'}."
        )
    motions = [
        _compute_motion(part, places, scan, (sensor, frames.frame), world, scan_s)
        for part, places in parts
    ]
    with_poses = any(motion.poses for motion in motions)
    if options.join_m and not with_poses:
        raise DatasetError(
            f"{bag.path}: {_describe_selection(frames, scan, motions)}. Joining scans requires "
            "odometry: omit --join-m, or record /tf or odometry."
        )
    is_elsewhere = sensor != frames.frame
    if not with_poses and (is_elsewhere or any(motion.is_disputed for motion in motions)):
        return motions  # the caller reports the contradictory transforms
    for (part, places), motion in zip(parts, motions, strict=True):
        _select_keyframes(motion, part, places, scan, sensor, options, with_poses=with_poses)
        if options.join_m:
            names = motion.world or "", sensor, frames.frame
            motion.windows = scan_windows(
                scan, part.tree, motion.poses, motion.keyframes, names, options.join_m
            )
    return motions


def _compute_motion(
    part: BagPart, places: range, scan: BagScan, names: tuple[str, str], pose_frame: str | None,
    scan_s: float,
) -> _Motion:  # fmt: skip
    """Return the poses and mountings of a sensor in a part, without a selection of keyframes."""
    tree, (sensor, frame) = part.tree, names
    stamps = [scan.stamps_ns[place] for place in places]
    world = frame_name(pose_frame or "") or tree.world_of(sensor)
    motion = _Motion(world, tree.base_of(sensor, world))
    above = set(tree.ancestors(sensor))
    for (parent, child), (reason, count) in sorted(tree.passed_over.items()):
        if child in above:
            times = "" if count == 1 else f"{count} times "
            motion.remarks.append(f"{parent} -> {child} is ignored {times}because {reason}")
            motion.is_broken = True
    for (parent, child), length in sorted(tree.normalised.items()):
        if child in above:
            motion.remarks.append(
                f"{parent} -> {child} is normalised: its quaternion has the length {length:.3g}"
            )
    if stampless := sum(place in scan.stampless for place in places):
        motion.remarks.append(
            f"{stampless} frames have no time stamp, and get the time of recording"
        )
    motion.remarks += [
        f"{topic} is ignored because its child_frame_id is empty"
        for topic, samples in part.odometry.items()
        if not samples
    ]
    motion.remarks += part.ignored_odometry
    if world is not None:
        poses = tree.lookup(world, sensor, stamps)
        ends = poses
        if scan_s:
            ends = tree.lookup(world, sensor, [stamp + round(scan_s * 1e9) for stamp in stamps])
        for place, pose, end in zip(places, poses, ends, strict=True):
            if isinstance(pose, UnknownTransform):
                motion.unknown[place] = pose
            elif isinstance(end, UnknownTransform):
                motion.unknown[place] = end
            else:
                motion.poses[place] = pose
    motion.remarks += [
        f"{parent} -> {child} jumps by {step:.2g} m or rad, so poses before and after may not agree"
        for (parent, child), step in sorted(tree.jumps.items())
    ]
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


def _select_keyframes(
    motion: _Motion, part: BagPart, places: range, scan: BagScan, sensor: str,
    options: RecordingOptions, *, with_poses: bool,
) -> None:  # fmt: skip
    """Select the keyframes of a part: by pose if the recording has poses, otherwise by time."""
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
    motion.keyframes = [order[place] for place in chosen]
    motion.ups = _compute_ups(part, sensor, motion.keyframes, stamps)


def _compute_ups(
    part: BagPart, sensor: str, keyframes: list[int], stamps_ns: Sequence[int]
) -> dict[int, Floats]:
    """Return the up directions (3,) of keyframes in the sensor's axes, by index.

    They are computed from the IMU with the most measurements among those fixed to the sensor.
    """
    for imu in sorted(part.imus, key=lambda name: (-len(part.imus[name]), name)):
        T_sensor_imu = part.tree.fixed_transform(sensor, imu)
        if T_sensor_imu is None:
            continue
        ups = part.imus[imu].up_at([stamps_ns[place] for place in keyframes])
        return {
            place: T_sensor_imu[:3, :3] @ up
            for place, up in zip(keyframes, ups, strict=True)
            if up is not None
        }
    return {}


def _make_reference(
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
        source=BagSource(
            bag,
            frames.topic,
            *scan.places[place],
            motion.cloud_poses.get(place),
            motion.windows.get(place),
        ),
        base=base,
        original=f"{frames.topic.name}/{_format_stamp(scan.stamps_ns[place])}",
        sequence=place,
    )


def _format_stamp(stamp_ns: int) -> str:
    """Format a stamp in seconds; a float cannot represent nanoseconds."""
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


def _select_cameras(
    bag: Bag, frames: FrameTopic, topic: BagTopic | None, scan: BagScan, scale: float | None
) -> dict[int, Camera]:
    """Return the camera of each depth image, by index, from CameraInfo or an intrinsics.json."""
    if topic is None or not scan.infos:
        beside = _find_camera(bag, frames, topic)
        beside = replace(beside, depth_scale=scale or beside.depth_scale)
        return dict.fromkeys(range(len(scan.stamps_ns)), beside)
    with naming(f"{bag.path}, {topic.name}"):
        cameras = [
            Camera(camera_intrinsics(info, rectified=frames.is_rectified), scale or DEPTH_SCALE)
            for info in scan.infos
        ]
    by_place, last = dict[int, Camera](), 0
    for part, end in zip(scan.parts, scan.ends, strict=True):
        places = range(part.first, end)
        numbers = [last] * len(places)
        if part.infos:
            numbers = part.info_at([scan.stamps_ns[place] for place in places])
            last = part.infos[-1]
        by_place.update(
            (place, cameras[number]) for place, number in zip(places, numbers, strict=True)
        )
    return by_place


def _find_camera(bag: Bag, frames: FrameTopic, topic: BagTopic | None) -> Camera:
    try:
        return find_camera(bag.path.parent)
    except DatasetError as cause:
        topics = listed(bag.of_type(CAMERA))
        state = "is not calibrated" if topic is not None else "is unknown"
        raise DatasetError(
            f"{bag.path}: The camera of {frames.topic.name} {state}; topics of CameraInfo are "
            f"{topics}. Select one with --camera-info, or write an intrinsics.json beside the "
            "recording."
        ) from cause


def _describe_selection(frames: FrameTopic, scan: BagScan, motions: list[_Motion]) -> str:
    total, selected = len(scan.stamps_ns), sum(len(motion.keyframes) for motion in motions)
    poses = sum(len(motion.poses) for motion in motions)
    worlds = sorted({motion.world for motion in motions if motion.poses and motion.world})
    text = (
        f"{selected} of {total} frames of {printable(frames.topic.name)} used, poses of {poses} "
        f"of {total} frames{' in ' if worlds else ''}{', '.join(worlds)}"
    )
    if poses < total:
        text += f"; {total - poses} without: {_describe_unknown(frames, scan, motions)}"
    without = _count_without_pose(scan, motions)
    skipped = [
        f"{count} {reason}"
        for count, reason in (
            (total - selected - without, "between keyframes"),
            (without, "without a pose"),
            (scan.damaged, "damaged messages of other topics"),
        )
        if count
    ]
    if skipped:
        text += f"; skipped: {', '.join(skipped)}"
    if len(motions) > 1:
        text += f"; split into {len(motions)} parts, because stamps jump back"
    remarks = dict.fromkeys(remark for motion in motions for remark in motion.remarks)
    return printable("; ".join([text, *list(remarks)[:5]]))


def _count_lost(scan: BagScan, motions: list[_Motion]) -> int:
    """Return the number of unexpectedly omitted frames or poses, and of damaged messages."""
    if not any(motion.poses for motion in motions) and (
        any(motion.is_broken or motion.unknown for motion in motions)
        or any(
            part.odometry or any(map(part.tree.moves_below, part.tree.frames()))
            for part in scan.parts
        )
    ):
        return len(scan.stamps_ns)
    return _count_without_pose(scan, motions) + scan.damaged


def _count_without_pose(scan: BagScan, motions: list[_Motion]) -> int:
    """Return the number of frames that are omitted because only other frames have poses."""
    poses = sum(len(motion.poses) for motion in motions)
    is_left_out = poses or not any(motion.keyframes for motion in motions)
    return len(scan.stamps_ns) - poses if is_left_out else 0


def _describe_unknown(frames: FrameTopic, scan: BagScan, motions: list[_Motion]) -> str:
    whys = [why for motion in motions for why in motion.unknown.values()]
    reasons = []
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
        reasons.append(reason if len(whys) == count else f"{reason}: {count}")
    if not reasons:
        if not frames.frame:
            return "their messages do not name a coordinate frame (frame_id)"
        reason = f"there are no transforms from {frames.frame} to a frame in which it moves"
        if any(motion.is_broken for motion in motions):
            return reason
        trees = [part.tree for part in scan.parts]
        moving = sorted({name for tree in trees for name in tree.frames() if tree.world_of(name)})
        return (
            f"{reason} (moving frames: {', '.join(moving[:5])}; is /tf_static recorded?)"
            if moving
            else f"{reason} (record /tf and /tf_static, or odometry)"
        )
    return ", ".join(reasons)
