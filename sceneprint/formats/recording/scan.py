"""One pass over a bag: transforms, odometry, IMU, the camera, and when each frame was measured.

Bag, topics  --scan_bag-->  BagScan
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from sceneprint.errors import DatasetError, naming
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
from sceneprint_client.poses import MOST_SAMPLES, Accelerations, TransformTree, frame_name
from sceneprint_client.ros_messages import (
    is_calibrated,
    pose_row,
    stamp_of,
    transform_row,
    vector_row,
)

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
