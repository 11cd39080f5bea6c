"""`sceneprint bag`, and the options of all commands that read ROS recordings."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from sceneprint.cli import number_within, positive_number
from sceneprint.cli.output import one_line, print_error, progress_bar
from sceneprint.errors import InvalidRequest
from sceneprint.formats.dataset import FrameSequence, find_recordings, find_sequences
from sceneprint.formats.dataset.frame_reference import Layout
from sceneprint.formats.recording.outline import BagOutline, bag_outline
from sceneprint.formats.recording.selection import RecordingOptions
from sceneprint_client.formats import titles_of
from sceneprint_client.sidecars import Camera

_DEFAULT = RecordingOptions()


def add_recording_options(command: argparse.ArgumentParser) -> None:
    """Add `--topic` and the other options for recordings."""
    group = command.add_argument_group(
        "ROS recordings", f"for {titles_of('recording', last='or')} files, and rosbag2 folders"
    )
    for option, metavar, text in (
        ("--topic", "NAME", "topic of depth images or points (default: the only one)"),
        ("--camera-info", "NAME",
         "topic of the depth camera's calibration (default: the one beside the images)"),
        ("--pose-frame", "FRAME",
         "parent frame of poses (default: map, else odom, else the topmost frame)"),
        ("--sensor-frame", "FRAME",
         "frame of the sensor, for points in the world frame (default: the only leaf frame below "
         "the world frame)"),
    ):  # fmt: skip
        group.add_argument(option, metavar=metavar, help=text)
    group.add_argument(
        "--depth-scale", type=positive_number, metavar="UNITS",
        help="depth units per metre in 16-bit images, also in folders (default: that of "
        "intrinsics.json, else 1000, for millimetres)",
    )  # fmt: skip
    for option, default, metavar, text in (
        ("--keyframe-m", _DEFAULT.keyframe_m, "METRES",
         "minimum distance between frames; 0 takes every frame (default: 0.3)"),
        ("--keyframe-deg", _DEFAULT.keyframe_deg, "DEGREES",
         "or minimum rotation between frames (default: 15)"),
        ("--keyframe-s", _DEFAULT.keyframe_s, "SECONDS",
         "minimum time between frames without poses (default: 0.5)"),
        ("--join-m", _DEFAULT.join_m, "METRES",
         "join the scans of this distance by odometry, corrected for motion, such as 2 for a Livox "
         "(default: 0, each scan alone)"),
    ):  # fmt: skip
        group.add_argument(option, type=_from_zero, default=default, metavar=metavar, help=text)


def _from_zero(text: str) -> float:
    return number_within(text, lambda number: 0 <= number < math.inf, "a number of at least 0")


@contextmanager
def recording_options(options: argparse.Namespace) -> Iterator[RecordingOptions]:
    """Yield the options for recordings; show a progress bar while a recording is read."""
    names = (
        "topic", "camera_info", "pose_frame", "keyframe_m", "keyframe_deg", "keyframe_s",
        "join_m", "sensor_frame", "depth_scale",
    )  # fmt: skip
    with progress_bar("read recording", "message", delay=0.5, leave=False) as progress:
        fields = {name: getattr(options, name) for name in names}
        yield RecordingOptions(**fields, progress=progress)


def with_depth_scale(sequence: FrameSequence, scale: float | None) -> FrameSequence:
    """Return a sequence with a depth scale; unchanged if it is a recording, or the scale is None.

    Raise InvalidRequest if the frames are clouds, or their files define the unit.
    """
    if scale is None or sequence.layout is Layout.RECORDING:  # recordings handle the scale
        return sequence
    if sequence.layout.is_export or any(frame.camera is None for frame in sequence.frames):
        raise InvalidRequest(
            f"--depth-scale is for depth images without a unit, but {sequence.name} defines its "
            "unit. Omit the option.",
            (("depth_scale", "not allowed for these files"),),
        )
    frames = tuple(
        replace(frame, camera=replace(frame.camera, depth_scale=scale))
        for frame in sequence.frames
        if frame.camera is not None
    )
    return replace(sequence, frames=frames)


def sequences_at(
    path: Path, options: argparse.Namespace, camera: Camera | None = None
) -> tuple[FrameSequence, ...]:
    """Return the sequences at a path (see `find_sequences`); print notes on omitted data."""
    with recording_options(options) as recording:
        sequences = find_sequences(path, recording, camera)
    for sequence in sequences:
        print_note(sequence)
    return tuple(with_depth_scale(sequence, options.depth_scale) for sequence in sequences)


def print_note(sequence: FrameSequence) -> None:
    """Print the note of a sequence on omitted data, if any, on standard error."""
    if sequence.note:
        print_error(f"{one_line(str(sequence.folder))}: {sequence.note}")


# `sceneprint bag`.


def add_bag(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint bag`."""
    command.add_argument("path", type=Path, metavar="PATH", help="a recording, or a folder of them")
    add_recording_options(command)
    command.set_defaults(run=run_bag)


def run_bag(options: argparse.Namespace) -> int:
    """List the topics of a ROS recording (an MCAP file, a rosbag2 folder or database, or a ROS 1
    bag), and the frames, camera and poses that an upload would use. The exit code is 1 if a
    recording has no usable frame.
    """
    outlines: list[BagOutline] = []
    for path in find_recordings(options.path) or [options.path]:
        with recording_options(options) as recording:
            outlines.append(bag_outline(path, recording))
        print("\n".join(_outline_lines(path, outlines[-1])))
    return 0 if all(outline.sequences for outline in outlines) else 1


def _outline_lines(path: Path, outline: BagOutline) -> list[str]:
    count = sum(topic.count for topic in outline.topics)
    lines = [
        f"{one_line(str(path))}: {outline.kind}, {count} messages of {len(outline.topics)} topics, "
        f"{outline.span}"
    ]
    width = max((len(one_line(topic.name)) for topic in outline.topics), default=0)
    kinds = max((len(one_line(topic.type)) for topic in outline.topics), default=0)
    for topic in outline.topics:
        rate = ""
        if outline.seconds > 0 and topic.count > 1:
            rate = f"{topic.count / outline.seconds:.1f} Hz"
        lines.append(
            f"  {one_line(topic.name):{width}}  {one_line(topic.type):{kinds}}  {topic.count:8}  "
            f"{rate:>9}  {outline.use_of(topic)}".rstrip()
        )
    if not outline.sequences:
        return [*lines, f"no frame can be used: {one_line(outline.problem)}"]
    return [*lines, *outline.findings]
