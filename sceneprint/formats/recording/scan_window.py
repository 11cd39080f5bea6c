"""Joining of a frame with the preceding scans of a bag.

poses of all scans, keyframes  --scan_windows-->  ScanWindow of each keyframe
Bag  --ScanWindow.cloud-->  joined points (N, 3)
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from sceneprint.errors import SceneprintError, UnreadableCloud
from sceneprint.formats.recording.bag import Bag, BagTopic, RawMessage
from sceneprint.formats.recording.scan import BagScan
from sceneprint.types import Floats, Floats32
from sceneprint_client.joiner import MOST_SCANS, Joiner, window_start
from sceneprint_client.ros_messages import timed_points
from sceneprint_client.transforms import TransformTree

#: Maximum number of messages that are read to determine the duration of a scan.
_MOST_SKIPPED = 50


@dataclass(frozen=True, eq=False)
class ScanWindow:
    """The scans of a bag that are joined to a frame.

    Parameters
    ----------
    scans : stamp of each scan in order, nanoseconds, and its entry of `BagScan.places`
    metres : length of the path whose scans are joined
    tree : transforms with sorted samples; the windows of a recording share them
    world, sensor, frame : parent frame of the odometry, frame of the sensor, and frame of the
        points
    """

    scans: Sequence[tuple[int, tuple[int, int]]]
    metres: float
    tree: TransformTree
    world: str
    sensor: str
    frame: str

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "tree": self._near_tree()}

    def _near_tree(self) -> TransformTree:
        """Return the transforms within the time of the scans."""
        return self.tree.excerpt(self.scans[0][0], self.scans[-1][0])

    def cloud(self, bag: Bag, topic: BagTopic) -> Floats32:
        """Join the scans; return points (N, 3), metres, in the axes of the newest scan.

        Raise UnreadableCloud if the newest scan is damaged, or the odometry does not cover it.
        Raise DatasetError if the bag is damaged.
        """
        tree = self._near_tree()
        joiner = Joiner(partial(tree.poses, self.world, self.sensor), self.metres)
        is_newest_joined = False
        for stamp_ns, place in self.scans:
            message = bag.at(topic.name, *place)
            is_newest_joined = self._add_scan(joiner, tree, stamp_ns, bag, topic, message)
        if not is_newest_joined:
            raise UnreadableCloud(
                "The scan is damaged, or the odometry has a gap or a jump at the time of the scan. "
                "Upload the scan without --join-m, or omit it."
            )
        return joiner.cloud()

    def _add_scan(
        self, joiner: Joiner, tree: TransformTree, stamp_ns: int, bag: Bag, topic: BagTopic,
        message: RawMessage,
    ) -> bool:  # fmt: skip
        """Add a scan to a joiner; return False if the scan is omitted."""
        try:
            points, seconds = timed_points(bag.decode(message, topic.type))
        except SceneprintError:
            return False
        if self.frame != self.sensor:
            (T,) = tree.poses(self.frame, self.sensor, [stamp_ns])
            if T is None:
                return False
            # the publisher has corrected points in a world frame for motion
            points, seconds = (points - T[:3, 3]) @ T[:3, :3], None
        return joiner.add(stamp_ns, points, seconds)


def scan_windows(
    scan: BagScan, tree: TransformTree, poses: Mapping[int, Floats], keyframes: Iterable[int],
    names: tuple[str, str, str], metres: float,
) -> dict[int, ScanWindow]:  # fmt: skip
    """Return the scans that are joined to each keyframe, by index of the keyframe.

    Parameters
    ----------
    scan : stamps and places of all scans
    tree : transforms of this part of the bag
    poses : T_world_sensor (4, 4) of the scans with a pose, by index
    keyframes : indices of the keyframes; they have poses
    names : parent frame of the odometry, frame of the sensor, and frame of the points
    metres : length of the path whose scans are joined
    """
    stamps = scan.stamps_ns
    order = sorted(poses, key=lambda place: stamps[place])
    rank = {place: i for i, place in enumerate(order)}
    positions = np.array([poses[place][:3, 3] for place in order])
    _, sensor, frame = names
    paths = tree.sorted_paths(names[:2], (frame, sensor))
    windows = {}
    for place in keyframes:
        end = rank[place] + 1
        first = max(0, end - MOST_SCANS)
        first += window_start(positions[first:end], metres)
        scans = [(stamps[index], scan.places[index]) for index in order[first:end]]
        windows[place] = ScanWindow(scans, metres, paths, *names)
    return windows


def scan_seconds(bag: Bag, topic: BagTopic, scan: BagScan) -> float | None:
    """Return the seconds from the stamp of a scan to its last point; None if unknown.

    Empty and damaged messages at the start of a recording are skipped.
    """
    for place in scan.places[:_MOST_SKIPPED]:
        with suppress(SceneprintError):
            points, seconds = timed_points(bag.decode(bag.at(topic.name, *place), topic.type))
            if len(points):
                return None if seconds is None else max(float(seconds.max()), 0.0)
    return None
