"""Join recent scans of a moving scanner into one cloud, corrected for motion.

points (N, 3), seconds (N,)  --Joiner.add-->  Joiner.cloud: points (M, 3) in the newest scan's axes

Scanners with a narrow view or few rings capture too little of a place in one scan. Odometry aligns
the scans and corrects each point for motion between its capture and the stamp of its scan.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint_client.poses import Floats
from sceneprint_client.ros_messages import LONGEST_SCAN_S
from sceneprint_client.transforms import FASTEST

#: Length of the path whose scans are joined, metres.
JOIN_M = 2.0
#: Edge of the voxels in which a joined cloud has one point, metres.
VOXEL_M = 0.1
#: Maximum number of scans in a cloud, for a robot that stands still: 5 s at 10 Hz.
MOST_SCANS = 50
#: Longest interval between two poses of a scan, seconds. Motion is linear within an interval; at
#: 180 degrees per second, the error at a distance of 100 m is 0.5 mm.
_STEP_S = 0.002

#: Function that returns T_odom_sensor (4, 4) at each stamp, nanoseconds; None if unknown.
Odometry = Callable[[Sequence[int]], Sequence[Floats | None]]


@dataclass(frozen=True, eq=False)
class _JoinedScan:
    """Scan in the sensor's axes at its stamp."""

    stamp_ns: int
    points: NDArray[np.float32]
    T_odom_sensor: Floats


class Joiner:
    """Joined scans of the last metres of a drive.

    A point with a known time is corrected for motion between its capture and its scan's stamp. A
    scan is rejected if the odometry does not cover its duration or implies more than 50 m/s. If
    the odometry jumps between two scans, or the stamps decrease, earlier scans are discarded.

    Parameters
    ----------
    odometry : function that returns interpolated poses of the sensor, such as
        `partial(tree.poses, "odom", "lidar")` of a TransformTree
    metres : length of the path whose scans, at most `MOST_SCANS`, are joined
    voxel_m : edge of a voxel, metres; the newest point in each voxel remains
    """

    def __init__(
        self, odometry: Odometry, metres: float = JOIN_M, *, voxel_m: float = VOXEL_M
    ) -> None:
        #: Number of all scans, of rejected scans, of scans without point times (all points count as
        #: measured at the stamp), and of scans at which earlier scans were discarded.
        self.counts = {"scans": 0, "without_odometry": 0, "untimed": 0, "restarts": 0}
        self._odometry, self._metres, self._voxel_m = odometry, metres, voxel_m
        self._scans: list[_JoinedScan] = []

    def __len__(self) -> int:
        """Return the number of scans in the cloud."""
        return len(self._scans)

    def add(self, stamp_ns: int, points: Floats, seconds: Floats | None = None) -> bool:
        """Add the next scan; return False if it is rejected.

        Parameters
        ----------
        stamp_ns : stamp of the scan, nanoseconds
        points : (N, 3) in the sensor's axes at the time of each point, metres
        seconds : (N,) times of the points after the stamp, seconds; None if unknown

        Raises
        ------
        ValueError : If a time is not finite or more than a second from the stamp.
        """
        self.counts["scans"] += 1
        self.counts["untimed"] += seconds is None
        times = np.zeros(1)
        if seconds is not None and len(seconds):
            first, last = min(0.0, float(seconds.min())), max(0.0, float(seconds.max()))
            if not float(np.abs(seconds).max()) <= LONGEST_SCAN_S:
                raise ValueError(
                    f"A point was measured {float(np.abs(seconds).max()):g} s from the stamp of "
                    "its scan. Pass finite seconds after the stamp, at most 1."
                )
            # The multiples of the step include 0, the time of the stamp.
            times = _STEP_S * np.arange(np.floor(first / _STEP_S), np.ceil(last / _STEP_S) + 1)
            times = np.unique(np.clip(times, first, last))
        poses = self._odometry([stamp_ns + round(1e9 * seconds_after) for seconds_after in times])
        valid = [pose for pose in poses if pose is not None]
        if len(valid) < len(times) or _is_jump(np.array(valid)[:, :3, 3], times):
            self.counts["without_odometry"] += 1
            return False
        T_odom_sensor = valid[int(np.argmin(np.abs(times)))]
        if len(times) > 1 and seconds is not None:
            back = np.linalg.inv(T_odom_sensor).astype(np.float64) @ np.array(valid)
            points = _moved_points(points, seconds, times, back)
        if self._scans:
            newest = self._scans[-1]
            ends = np.array([newest.T_odom_sensor[:3, 3], T_odom_sensor[:3, 3]])
            if _is_jump(ends, np.array([0.0, (stamp_ns - newest.stamp_ns) * 1e-9])):
                self.counts["restarts"] += 1
                self._scans.clear()
        thinned = _first_in_voxels(points.astype(np.float32), self._voxel_m)
        self._scans.append(_JoinedScan(stamp_ns, thinned, T_odom_sensor))
        positions = np.array([scan.T_odom_sensor[:3, 3] for scan in self._scans])
        del self._scans[: window_start(positions, self._metres)]
        return True

    def cloud(self) -> NDArray[np.float32]:
        """Return the joined points (M, 3) in the sensor's axes at the stamp of the newest scan."""
        parts = [np.empty((0, 3))]
        for scan in reversed(self._scans):
            T = np.linalg.inv(self._scans[-1].T_odom_sensor) @ scan.T_odom_sensor
            parts.append(scan.points @ T[:3, :3].T + T[:3, 3])
        return _first_in_voxels(np.concatenate(parts).astype(np.float32), self._voxel_m)


def window_start(positions: Floats, metres: float) -> int:
    """Return the index of the earliest of at most `MOST_SCANS` scans to join with the last scan.

    Parameters
    ----------
    positions : (N, 3) positions of the sensor in chronological order, metres
    metres : maximum length of the path to the last position
    """
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    way_to_last = np.append(np.cumsum(steps[::-1])[::-1], 0.0)
    return max(int(np.argmax(way_to_last <= metres)), len(positions) - MOST_SCANS)


def _is_jump(positions: Floats, seconds: Floats) -> bool:
    """Return whether positions (N, 3) imply an impossible speed, or their times decrease."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return bool((steps > FASTEST * np.diff(seconds)).any())


def _moved_points(points: Floats, seconds: Floats, times: Floats, poses: Floats) -> Floats:
    """Return points (N, 3) transformed by the poses at their times, interpolated in (K, 4, 4)."""
    before = np.clip(np.searchsorted(times, seconds, "right") - 1, 0, len(times) - 2)
    share = ((seconds - times[before]) / (times[before + 1] - times[before]))[:, None]
    ends = [
        np.einsum("nij,nj->ni", poses[k, :3, :3], points) + poses[k, :3, 3]
        for k in (before, before + 1)
    ]
    moved: Floats = ends[0] + share * (ends[1] - ends[0])
    return moved


def _first_in_voxels(points: NDArray[np.float32], edge: float) -> NDArray[np.float32]:
    """Return the first point in each voxel of width `edge`, metres, in the order of the points."""
    cells = np.floor(points / edge).astype(np.int64) & 0x1FFFFF
    keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
    _, first = np.unique(keys, return_index=True)
    return points[np.sort(first)]
