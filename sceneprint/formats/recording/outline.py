"""Outline of a recording for users: its topics, and the frames that an upload would select.

path, RecordingOptions  --bag_outline-->  BagOutline, with `findings` as text
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from sceneprint.errors import DatasetError, InvalidIntrinsics, SceneprintError
from sceneprint.formats.dataset.frame_reference import FrameSequence
from sceneprint.formats.recording.bag import Bag, BagTopic
from sceneprint.formats.recording.selection import RecordingOptions, recording_name, sequences_of
from sceneprint.formats.recording.topics import FrameTopic, camera_topic, choose_topic, frame_topics
from sceneprint.formats.sample_range import sample_range
from sceneprint_client.api.frames import SampleRange, pooled_range
from sceneprint_client.errors import printable
from sceneprint_client.frame_files import meta_of

#: Uses of topics without frames, by type.
_USES = [
    (re.compile(pattern), use)
    for pattern, use in (
        ("/TFMessage$|/tfMessage$|/Odometry$", "transforms"), ("/Imu$", "up"),
        ("/Image$|/CompressedImage$", "no depth by its encoding"),
        ("/Pose|/Path$|/TransformStamped$", "poses, not read: record /tf or odometry"),
        ("Packet|/VelodyneScan$", "packets, not read: record the driver's PointCloud2"),
        ("/LaserScan$|/MultiEchoLaserScan$", "a scan of one plane, not read"),
    )
]  # fmt: skip
#: Number of frames that are read to determine the depth range of a recording.
_SAMPLED = 9


@dataclass(frozen=True)
class BagOutline:
    """The content of a bag, and the frames that an upload would select.

    Parameters
    ----------
    kind : format of the files
    start_ns, end_ns : recording times of the first and of the last message, nanoseconds
    frames : topics with frames
    chosen : selected topic of frames; None if there is none
    camera : name of the camera topic of `chosen`; None if there is none
    sequences : sequences of the selected frames; may be empty
    problem : reason why no frames are selected; empty if frames are selected
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

    @property
    def seconds(self) -> float:
        """Return the duration of the recording, seconds."""
        return max(self.end_ns - self.start_ns, 0) * 1e-9

    @property
    def span(self) -> str:
        """Return the duration and start of the recording as text."""
        if self.end_ns < self.start_ns:
            return "no messages"
        try:
            start = datetime.fromtimestamp(self.start_ns * 1e-9, UTC)
        except (ValueError, OverflowError, OSError):
            return f"{self.seconds:.1f} s"
        return f"{self.seconds:.1f} s from {start:%Y-%m-%dT%H:%M:%SZ}"

    def use_of(self, topic: BagTopic) -> str:
        """Return how an upload can use a topic, as text; empty if it cannot."""
        if topic.name == self.camera:
            return "camera"
        frames = next((entry for entry in self.frames if entry.topic == topic), None)
        if frames is None:
            return next((use for kind, use in _USES if kind.search(topic.type)), "")
        use = "not depth by its name" if frames.is_beside_depth else frames.encoding or "points"
        is_used = self.chosen is not None and topic == self.chosen.topic
        return f"{use}, used" if is_used else use

    @property
    def findings(self) -> list[str]:
        """Return lines on the selected frames: omissions, camera, poses, mounting, up and range."""
        lines = [line for sequence in self.sequences for line in _describe_frames(sequence)]
        return lines if self.range is None else [*lines, str(self.range)]


def bag_outline(path: Path, options: RecordingOptions) -> BagOutline:
    """Read the content of a bag, and the frames that an upload with these options would select.

    `problem` contains the error if no frames can be selected. Raise DatasetError if the bag cannot
    be read. Raise MissingDependency if rosbags is not installed.
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
            sequences = tuple(sequences_of(bag, chosen, options, recording_name(path)))
            depth, unreadable = sampled_range(sequences)
            if unreadable is not None:
                sequences, problem = (), str(unreadable)
        except (DatasetError, InvalidIntrinsics) as error:
            problem = str(error)
        kind = "ROS 1" if bag.is_ros1 else "ROS 2"
        return BagOutline(
            kind, bag.start_ns, bag.end_ns, bag.topics, frames, chosen, camera, sequences, depth,
            problem,
        )  # fmt: skip
    finally:
        bag.close()


def sampled_range(
    sequences: Sequence[FrameSequence],
) -> tuple[SampleRange | None, SceneprintError | None]:
    """Return (range of some frames, None), or (None, error) if none of them is readable."""
    frames = [frame for sequence in sequences for frame in sequence.frames]
    ranges, error = list[SampleRange](), None
    for place in sorted(set(np.linspace(0, len(frames) - 1, _SAMPLED).round().astype(int))):
        try:
            ranges.append(sample_range(frames[place].read()))
        except SceneprintError as cause:
            error = cause
    return pooled_range(ranges), None if ranges else error


def _describe_frames(sequence: FrameSequence) -> list[str]:
    """Return the note of a sequence, and lines on its camera, poses, mounting and up directions."""
    first = sequence.frames[0]
    lines = [sequence.note] if sequence.note else []
    if first.camera is not None:
        k = first.camera.intrinsics
        lens = f", distortion {' '.join(f'{d:g}' for d in k.distortion)}" if k.distortion else ""
        lines.append(
            f"camera: {k.width} x {k.height}, fx {k.fx:g}, fy {k.fy:g}, cx {k.cx:g}, cy {k.cy:g}"
            f"{lens}"
        )
    lines.append(f"poses: {f'in {sequence.parent_frame}' if first.pose is not None else 'none'}")
    base = meta_of(first, with_pose=False).T_base_sensor
    if base is not None and base.matrix is not None:
        x, y, z = (round(row[3], 3) + 0.0 for row in base.matrix[:3])
        lines.append(f"mounting: at {x:.3f} {y:.3f} {z:.3f} m in {printable(str(base.base_frame))}")
    sensors = (frame.camera or frame.cloud for frame in sequence.frames)
    ups = sum(sensor is not None and sensor.up is not None for sensor in sensors)
    lines.append(f"up: known for {ups} of {len(sequence.frames)} frames")
    return lines
