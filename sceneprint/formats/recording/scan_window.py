"""Join the scans of a bag that precede a frame.

poses of all scans, keyframes  --scan_windows-->  ScanWindow of each keyframe
Bag  --ScanWindow.cloud-->  joined points (N, 3)
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from sceneprint.errors import SceneprintError, UnreadableCloud
from sceneprint.formats.recording.bag import Bag, BagTopic, RawMessage
from sceneprint.formats.recording.scan import BagScan
from sceneprint.types import Floats, Floats32
from sceneprint_client.joiner import MOST_SCANS, Joiner, window_start
from sceneprint_client.ros_messages import timed_points
from sceneprint_client.transforms import TransformTree


@dataclass(frozen=True, eq=False)
class ScanWindow:
    """Scans of a bag that are joined to one frame.

    Parameters
    ----------
    stamp_ns : stamp of the newest scan, nanoseconds
    first_log_ns : time of recording of the first message
    metres : length of the way whose scans are joined
    tree : transforms around the scans
    world, sensor, frame : parent frame of the odometry, sensor, and frame of the points
    scans : number of scans
    """

    stamp_ns: int
    first_log_ns: int
    metres: float
    tree: TransformTree
    world: str
    sensor: str
    frame: str
    scans: int

    def cloud(self, bag: Bag, topic: BagTopic, log_ns: int) -> Floats32:
        """Return the joined points (N, 3) in the axes of the newest scan, recorded at `log_ns`.

        Raises
        ------
        UnreadableCloud : If the newest scan is damaged, or the odometry does not cover it.
        DatasetError : If the bag is damaged.
        """
        joiner = Joiner(partial(self.tree.poses, self.world, self.sensor), self.metres)
        scans = [
            (bag.stamp_ns(message), message)
            for message in bag.messages([topic.name], self.first_log_ns, log_ns + 1)
        ]
        is_newest_joined = False
        for stamp_ns, message in sorted(scans, key=lambda scan: scan[0]):
            if stamp_ns <= self.stamp_ns:
                is_newest_joined = self._add(joiner, bag, topic, stamp_ns, message)
        if not is_newest_joined:
            raise UnreadableCloud(
                "The scan is damaged, or its odometry has a gap or a jump. Upload it without "
                "--join-m, or leave it out."
            )
        return joiner.cloud()

    def _add(
        self, joiner: Joiner, bag: Bag, topic: BagTopic, stamp_ns: int, message: RawMessage
    ) -> bool:
        """Add a scan to a joiner; return False if it is left out."""
        try:
            points, seconds = timed_points(bag.decode(message, topic.type))
        except SceneprintError:
            return False
        if self.frame != self.sensor:
            (T,) = self.tree.poses(self.frame, self.sensor, [stamp_ns])
            if T is None:
                return False
            # points in a world frame have already been corrected for motion
            points, seconds = (points - T[:3, 3]) @ T[:3, :3], None
        return joiner.add(stamp_ns, points, seconds)


def scan_windows(
    scan: BagScan, tree: TransformTree, poses: Mapping[int, Floats], keyframes: Iterable[int],
    names: tuple[str, str, str], metres: float,
) -> dict[int, ScanWindow]:  # fmt: skip
    """Return the scans that are joined to each keyframe, by the index of the keyframe.

    Parameters
    ----------
    scan : stamps and places of all scans
    tree : transforms of the part of the bag
    poses : T_world_sensor (4, 4) of the scans with a pose, by their index
    keyframes : indices of the keyframes, which have poses
    names : frames of the odometry, of the sensor, and of the points
    metres : length of the way whose scans are joined
    """
    stamps = scan.stamps_ns
    order = sorted(poses, key=lambda place: stamps[place])
    rank = {place: i for i, place in enumerate(order)}
    positions = np.array([poses[place][:3, 3] for place in order])
    windows = {}
    for place in keyframes:
        end = rank[place] + 1
        first = max(0, end - MOST_SCANS)
        window = order[first + window_start(positions[first:end], metres) : end]
        windows[place] = ScanWindow(
            stamps[place], min(scan.places[one][0] for one in window), metres,
            tree.excerpt(stamps[window[0]], stamps[place]), *names, len(window),
        )  # fmt: skip
    return windows


def scan_seconds(bag: Bag, topic: BagTopic) -> float | None:
    """Return the time from the stamp of a scan to its last point, or None if unknown."""
    message = bag.first(topic.name)
    if message is None:
        return None
    _, seconds = timed_points(bag.decode(message, topic.type))
    return None if seconds is None else max(float(seconds.max()), 0.0)
