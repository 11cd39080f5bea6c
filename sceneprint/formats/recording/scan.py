"""Reading of a bag's transforms, odometry, cameras and time stamps in one pass.

Bag, topics  --scan_bag-->  BagScan
stamps in recording order  -->  BagPart, ...: a part ends where the clock was set back
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sceneprint.errors import DatasetError
from sceneprint.formats.recording.bag import (
    CAMERA,
    IMU,
    ODOMETRY,
    OLD_TRANSFORMS,
    TRANSFORMS,
    Bag,
    BagTopic,
    RawMessage,
)
from sceneprint_client.files import naming
from sceneprint_client.poses import Accelerations
from sceneprint_client.ros_messages import (
    is_calibrated,
    pose_row,
    stamp_of,
    transform_row,
    vector_row,
)
from sceneprint_client.transforms import (
    MOST_SAMPLES,
    TOLERANCE_S,
    TransformTree,
    frame_name,
    motion,
)

#: Callback with the number of messages that have been read, and the number of all messages.
Progress = Callable[[int, int], None]
#: Maximum number of messages in the topic of the frames.
MOST_FRAMES = 2_000_000


#: Maximum decrease between stamps of a source, seconds. After a larger decrease, the clock counts
#: as set back.
_OUT_OF_ORDER_S = 0.1
#: Number of jumps back and forth after which the stamps of a source are ignored, because it has
#: several publishers with different delays.
_MOST_FLIPS = 8
#: Maximum number of parts of a recording, and of distinct CameraInfo messages.
MOST_PARTS, MOST_INFOS = 1000, 100_000
#: Maximum difference between values of a static transform, metres and radians, and maximum number
#: of stored values.
_FIXED, _MOST_FIXED = 0.1, 100


@dataclass(eq=False)
class BagPart:
    """A part of a recording within which stamps do not jump back.

    Parameters
    ----------
    first : index of the first frame
    tree : transforms, and odometry for edges without transforms
    imus : measurements by coordinate frame of the IMU
    odometry : poses by topic
    ignored_odometry : notes on odometry topics that another topic replaces
    info_stamps_ns, infos : stamp of each calibrated CameraInfo, ns, and index in `BagScan.infos`
    """

    first: int
    tree: TransformTree = field(default_factory=TransformTree)
    imus: dict[str, Accelerations] = field(default_factory=dict)
    odometry: dict[str, list[_Odometry]] = field(default_factory=dict)
    ignored_odometry: list[str] = field(default_factory=list)
    info_stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    infos: array[int] = field(default_factory=lambda: array("q"))

    def info_at(self, stamps_ns: Sequence[int]) -> list[int]:
        """Return the index of the CameraInfo for each stamp.

        It is the last CameraInfo up to the stamp, or else the first. A later CameraInfo that is
        nearer and within 20 ms takes precedence.
        """
        times = np.frombuffer(self.info_stamps_ns, np.int64)
        order = np.argsort(times, kind="stable")
        times, infos = times[order], np.frombuffer(self.infos, np.int64)[order]
        stamps = np.asarray(stamps_ns, np.int64)
        before = np.maximum(np.searchsorted(times, stamps, "right") - 1, 0)
        after = np.minimum(before + 1, len(times) - 1)
        ahead = times[after] - stamps
        is_after = (ahead < np.abs(stamps - times[before])) & (ahead <= TOLERANCE_S * 1e9)
        numbers: list[int] = infos[np.where(is_after & (ahead >= 0), after, before)].tolist()
        return numbers


@dataclass(eq=False)
class BagScan:
    """The result of a pass over a bag.

    Parameters
    ----------
    parts : at least one part, in order
    infos : distinct calibrated CameraInfo messages
    stamps_ns : measurement time of each frame, nanoseconds, in recording order
    places : recording time of each frame, nanoseconds, and its index among messages with that time
    damaged : number of messages that were skipped because they do not decode
    stampless : indices of the frames without a measurement time
    fixed : values of each static transform, by parent and child; the last value counts
    """

    parts: list[BagPart] = field(default_factory=lambda: [BagPart(0)])
    infos: list[Any] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)
    places: list[tuple[int, int]] = field(default_factory=list)
    damaged: int = 0
    stampless: set[int] = field(default_factory=set)
    fixed: dict[tuple[str, str], list[list[float]]] = field(default_factory=dict)

    @property
    def ends(self) -> list[int]:
        """Return the end of each part: the index after its last frame."""
        return [*(part.first for part in self.parts[1:]), len(self.stamps_ns)]


@dataclass(frozen=True)
class _Odometry:
    """The pose of a robot in its odometry frame."""

    parent: str
    child: str
    stamp_ns: int
    sample: list[float]


class _SeveralClocks(Exception):
    """The stamps of a source jump back and forth."""

    def __init__(self, source: str) -> None:
        super().__init__(source)
        self.source = source


@dataclass(eq=False)
class _Clocks:
    """The latest stamps of the sources within a part; sources are topics, and transforms of tf.

    `ignored`: sources whose stamps do not determine the clock.
    """

    ignored: set[str]
    latest: dict[str, int] = field(default_factory=dict)
    _last: dict[str, int] = field(default_factory=dict)
    _back: dict[str, int] = field(default_factory=dict)
    _flips: dict[str, int] = field(default_factory=dict)

    def goes_back(self, source: str, stamp_ns: int) -> bool:
        """Record a stamp; return whether the clock was set back.

        Raise _SeveralClocks if the stamps of the source jump back and forth.
        """
        if stamp_ns <= 0 or source in self.ignored:
            return False
        last = self._last.get(source, stamp_ns)
        self._last[source] = stamp_ns
        if source in self._back and stamp_ns - last >= 0.5 * self._back[source]:
            del self._back[source]
            self._flips[source] = self._flips.get(source, 0) + 1
            if self._flips[source] >= _MOST_FLIPS:
                raise _SeveralClocks(source)
        latest = self.latest.get(source, stamp_ns)
        if latest - stamp_ns <= _OUT_OF_ORDER_S * 1e9:
            self.latest[source] = max(latest, stamp_ns)
            return False
        self._back[source] = latest - stamp_ns
        self.latest = {source: stamp_ns}
        return True


def scan_bag(
    bag: Bag, frames: BagTopic | None, camera: BagTopic | None, progress: Progress | None
) -> BagScan:
    """Read the transforms, odometry, cameras and frame times of a bag, without decoding samples.

    Parameters
    ----------
    bag : open recording
    frames : topic of the frames; None reads no frames
    camera : topic of the frames' CameraInfo; None reads no cameras
    progress : callback every 64 messages; None for no callback

    Raises
    ------
    DatasetError : If the bag is damaged or too long.
    """
    ignored = set[str]()
    while True:
        scanner = _Scanner(bag, frames, camera, _Clocks(ignored))
        try:
            return scanner.scan(progress)
        except _SeveralClocks as error:
            ignored.add(error.source)


class _Scanner:
    """The state of a pass over a bag; for the parameters, see `scan_bag`."""

    def __init__(
        self, bag: Bag, frames: BagTopic | None, camera: BagTopic | None, clocks: _Clocks
    ) -> None:
        self._bag, self._frames, self._clocks = bag, frames, clocks
        self._kinds = {
            topic.name: topic.type
            for topic in bag.of_type(TRANSFORMS, OLD_TRANSFORMS, ODOMETRY, IMU)
        } | ({} if camera is None else {camera.name: camera.type})
        self._scan = BagScan()
        # index of each CameraInfo by its bytes after the stamp; -1 if uncalibrated
        self._info_numbers: dict[bytes, int] = {}

    def scan(self, progress: Progress | None) -> BagScan:
        """Read all messages; for errors, see `scan_bag`. Raise _SeveralClocks if `_Clocks` does."""
        scan, frames = self._scan, self._frames
        names = [*self._kinds, *([] if frames is None else [frames.name])]
        total = sum(topic.count for topic in self._bag.topics if topic.name in names)
        for done, message in enumerate(self._bag.messages(names)):
            if progress is not None and done % 64 == 0:
                progress(done, total)
            with naming(str(self._bag.path)):
                if frames is not None and message.topic == frames.name:
                    self._count_frame(message)
                else:
                    self._record_message(message, self._kinds[message.topic])
        if progress is not None:
            progress(total, total)
        for part in scan.parts:
            _add_odometry(part)
            _add_fixed(part.tree, scan.fixed)
        return scan

    def _part_at(self, source: str, stamp_ns: int) -> BagPart:
        """Return the part to which a stamp belongs; start a new part if the clock was set back."""
        parts = self._scan.parts
        if self._clocks.goes_back(source, stamp_ns):
            if len(parts) == MOST_PARTS:
                raise DatasetError(
                    f"The stamps jump back more than {MOST_PARTS} times, most recently in "
                    f"{source}. Split the bag."
                )
            parts.append(BagPart(len(self._scan.stamps_ns)))
        return parts[-1]

    def _count_frame(self, message: RawMessage) -> None:
        scan = self._scan
        header = self._bag.header_ns(message)
        stamp = message.log_ns if header is None else header
        if header is None:
            scan.stampless.add(len(scan.places))
        self._part_at(message.topic, stamp)
        same = bool(scan.places) and scan.places[-1][0] == message.log_ns
        scan.places.append((message.log_ns, scan.places[-1][1] + 1 if same else 0))
        scan.stamps_ns.append(stamp)
        if len(scan.places) > MOST_FRAMES:
            raise DatasetError(f"There are more than {MOST_FRAMES} frames. Split the bag.")

    def _record_message(self, message: RawMessage, kind: str) -> None:
        """Record transforms, odometry, a CameraInfo or IMU data; count damaged messages."""
        scan, bag = self._scan, self._bag
        if kind == CAMERA and message.data[12:] in self._info_numbers:
            self._record_info(message, self._info_numbers[message.data[12:]])
            return
        try:
            fields = bag.decode(message, kind)
        except DatasetError:
            scan.damaged += 1
            return
        if kind == CAMERA:
            if len(scan.infos) == MOST_INFOS:
                raise DatasetError(
                    f"{message.topic} has more than {MOST_INFOS} different camera infos. Split the "
                    "bag."
                )
            number = len(scan.infos) if is_calibrated(fields) else -1
            scan.infos.extend([] if number < 0 else [fields])
            self._info_numbers[message.data[12:]] = number
            self._record_info(message, number)
        elif kind == IMU:
            if float(fields.linear_acceleration_covariance[0]) < 0:  # the IMU has no accelerometer
                return
            imus = scan.parts[-1].imus
            imus.setdefault(frame_name(fields.header.frame_id), Accelerations()).add(
                bag.stamp_ns(message),
                vector_row(fields.linear_acceleration),
                vector_row(fields.angular_velocity),
            )
        elif kind == ODOMETRY:
            parent, child = frame_name(fields.header.frame_id), frame_name(fields.child_frame_id)
            stamp = bag.stamp_ns(message)
            poses = self._part_at(message.topic, stamp).odometry.setdefault(message.topic, [])
            if parent and child and len(poses) < MOST_SAMPLES:
                poses.append(_Odometry(parent, child, stamp, pose_row(fields.pose.pose)))
        else:
            self._record_transforms(message, fields)

    def _record_info(self, message: RawMessage, number: int) -> None:
        stamp = self._bag.stamp_ns(message)
        part = self._part_at(message.topic, stamp)
        if number >= 0:
            part.info_stamps_ns.append(stamp)
            part.infos.append(number)

    def _record_transforms(self, message: RawMessage, fields: Any) -> None:
        fixed = message.topic.rpartition("/")[2] == "tf_static"
        for transform in fields.transforms:
            parent, child = str(transform.header.frame_id), str(transform.child_frame_id)
            row, stamp = transform_row(transform.transform), stamp_of(transform.header)
            if not fixed:
                part = self._part_at(f"{message.topic} ({parent} -> {child})", stamp)
                part.tree.add(parent, child, stamp, row, fixed=False)
                continue
            rows = self._scan.fixed.setdefault((frame_name(parent), frame_name(child)), [])
            if row not in rows and len(rows) < _MOST_FIXED:
                rows.append(row)


def _add_fixed(tree: TransformTree, fixed: dict[tuple[str, str], list[list[float]]]) -> None:
    """Add the static transforms, except those with values that contradict each other or tf."""
    for (parent, child), rows in fixed.items():
        moving = tree.samples(parent, child)
        accepted = [
            tree.samples(parent, child)
            for row in rows
            if tree.add(parent, child, 0, row, fixed=True)
        ]
        if not accepted:
            continue
        apart = motion(np.vstack([moving, *accepted]), accepted[-1])
        if apart.max() > _FIXED:
            tree.remove(parent, child)
            reason = f"it is static, but has values that differ by {apart.max():.2g} m or rad"
            tree.pass_over(parent, child, reason)


def _add_odometry(part: BagPart) -> None:
    """Add odometry for edges without transforms, from the topic with the most messages."""
    topics: dict[tuple[str, str], list[str]] = {}
    for topic in sorted(part.odometry, key=lambda name: len(part.odometry[name])):
        for pose in part.odometry[topic][:1]:
            topics.setdefault((pose.parent, pose.child), []).append(topic)
    for (parent, child), (*ignored, used) in topics.items():
        if part.tree.has_edge(parent, child):
            continue
        part.ignored_odometry += [
            f"{topic} is ignored, because the poses of {child} are from {used}" for topic in ignored
        ]
        for pose in part.odometry[used]:
            if (pose.parent, pose.child) == (parent, child):
                part.tree.add(parent, child, pose.stamp_ns, pose.sample, fixed=False)
