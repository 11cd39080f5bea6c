"""Poses, and poses over time: rigid transforms, rotations as quaternions, trajectories, frames of a
robot, and which way is up.

q (4,)  --rotation_of-->  R (3, 3)  --quaternion_of-->  q with w >= 0
q, q' (M, 4), shares (M,)  --slerp-->  (M, 4)
TransformTree.add ...  --TransformTree.poses-->  T_parent_child at M stamps, or None where unknown
Accelerations.add ...  --Accelerations.up_at-->  unit vectors in the IMU's axes
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sceneprint_client.errors import DatasetError, InvalidPose, printable

Floats = NDArray[np.float64]


def rotation_of(quaternion: Floats) -> Floats:
    """The rotation (3, 3) of a unit quaternion (4,): x, y, z, w."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_of(R: Floats) -> Floats:
    """The unit quaternion (4,) of a rotation (3, 3): x, y, z, w, the one of both with w >= 0.

    Notes
    -----
    4 q q^T is linear in R; its column with the largest diagonal entry is q, scaled well.
    """
    xx, yy, zz = R[0, 0], R[1, 1], R[2, 2]
    outer = np.array(
        [
            [1 + xx - yy - zz, R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[2, 1] - R[1, 2]],
            [R[0, 1] + R[1, 0], 1 - xx + yy - zz, R[1, 2] + R[2, 1], R[0, 2] - R[2, 0]],
            [R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], 1 - xx - yy + zz, R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1 + xx + yy + zz],
        ]
    )
    q: Floats = outer[int(np.argmax(outer.diagonal()))]
    q = q / np.linalg.norm(q)
    return -q if q[3] < 0 else q


def slerp(q: Floats, other: Floats, w: Floats) -> Floats:
    """Quaternions (M, 4) at the share w of the shorter arc from q to the other."""
    cosine = np.sum(q * other, axis=1)
    other = np.where(cosine[:, None] < 0.0, -other, other)  # q and -q are one rotation
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    sine = np.sin(angle)
    small = sine < 1e-6  # the arc is its chord there, and 0/0 is not
    safe = np.where(small, 1.0, sine)
    a = np.where(small, 1.0 - w, np.sin((1.0 - w) * angle) / safe)
    b = np.where(small, w, np.sin(w * angle) / safe)
    mixed: Floats = a[:, None] * q + b[:, None] * other
    mixed /= np.linalg.norm(mixed, axis=1, keepdims=True)
    return mixed


# Poses over time, and between their stamps.


@dataclass(frozen=True, eq=False)
class SensorTrajectory:
    """Poses of a sensor over time.

    Parameters
    ----------
    stamps : (N,) seconds, strictly increasing
    positions : (N, 3) metres, of the sensor in the parent frame
    quaternions : (N, 4) x, y, z, w of unit length, sensor to parent
    """

    stamps: Floats
    positions: Floats
    quaternions: Floats


def interpolate(
    trajectory: SensorTrajectory, stamps: Sequence[float], *, longest_gap: float = 0.1,
    tolerance: float = 0.0,
) -> list[Floats | None]:  # fmt: skip
    """Return the poses at the stamps: positions linear, rotations by slerp.

    Parameters
    ----------
    trajectory : N poses
    stamps : M seconds, in any order
    longest_gap : seconds between two poses beyond which nothing between them is known
    tolerance : seconds from a pose within which it stands where nothing is interpolated

    Returns
    -------
    poses : M times T_parent_sensor (4, 4), or None before the first pose, after the last,
        and within a longer gap, unless a pose is as near as the tolerance
    """
    times = np.asarray(stamps, dtype=np.float64)
    t, last = trajectory.stamps, len(trajectory.stamps) - 1
    after = np.clip(np.searchsorted(t, times), 0, last)  # t[after - 1] < time <= t[after]
    before = np.where(t[after] == times, after, np.maximum(after - 1, 0))
    span = t[after] - t[before]
    known = (t[before] <= times) & (times <= t[after]) & (span <= longest_gap)
    near = np.where(t[after] - times < times - t[before], after, before)
    alone = ~known & (np.abs(t[near] - times) <= tolerance)
    before, after = np.where(alone, near, before), np.where(alone, near, after)
    known, span = known | alone, t[after] - t[before]
    w = np.where(span > 0.0, times - t[before], 0.0) / np.where(span > 0.0, span, 1.0)

    positions = trajectory.positions[before]
    positions = positions + w[:, None] * (trajectory.positions[after] - positions)
    quaternions = slerp(trajectory.quaternions[before], trajectory.quaternions[after], w)
    return [
        _transform(p, q) if ok else None
        for p, q, ok in zip(positions, quaternions, known, strict=True)
    ]


def _transform(position: Floats, quaternion: Floats) -> Floats:
    pose = np.eye(4)
    pose[:3, :3] = rotation_of(quaternion)
    pose[:3, 3] = position
    return pose


# Frames of a robot over time: tf, tf_static and odometry.
#
# tf calls the outer frame the parent: a transform takes coordinates of the child to the parent's.

#: Seconds between two samples of a transform beyond which nothing between them is known.
LONGEST_GAP_S = 0.5
#: Seconds before the first sample of a transform, or after its last, for which that one stands.
TOLERANCE_S = 0.02
#: Most samples of moving transforms: hours at the rate of any odometry.
MOST_SAMPLES = 5_000_000
#: How far the length of a recorded quaternion may be from 1.
_UNIT = 1e-2
#: Farthest believable translation, metres.
_FARTHEST_M = 1e7
#: Names of a robot's base, as REP 105 and practice have them, the first that is there counts.
BASES = ("base_link", "base_footprint", "base")
#: Names of frames that poses lead to, as REP 105 has them, the first that is there counts.
WORLDS = ("map", "odom", "world")


@dataclass(eq=False)
class _Edge:
    """Samples of one transform; a fixed one has one sample and no stamp."""

    fixed: bool
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    samples: array[float] = field(default_factory=lambda: array("d"))  # 7 each: x y z, x y z w

    @property
    def is_constant(self) -> bool:
        """Whether it never moved, as fixed joints that are published again and again."""
        rows = np.frombuffer(self.samples, np.float64).reshape(-1, 7)
        return self.fixed or bool((np.ptp(rows, axis=0) < 1e-9).all())


class TransformTree:
    """Transforms between named frames over time."""

    def __init__(self) -> None:
        self._edges: dict[str, dict[str, _Edge]] = {}  # by child, then by parent
        self._count = 0
        self._origin_ns: int | None = None

    def add(
        self, parent: str, child: str, stamp_ns: int, sample: Sequence[float], *, fixed: bool
    ) -> None:
        """Take a transform; one that is no rigid transform is passed over.

        Parameters
        ----------
        parent, child : names; a leading slash, as ROS 1 wrote it, is no part of them
        stamp_ns : when; not looked at of a fixed one
        sample : x y z in metres, and a unit quaternion x y z w: T_parent_child
        fixed : whether it holds at all times; the last one counts

        Raises
        ------
        DatasetError : there are more than 5 million; `forget` makes room.
        """
        parent, child = frame_name(parent), frame_name(child)
        row = np.asarray(sample, np.float64)
        length = float(np.linalg.norm(row[3:]))
        far = float(np.abs(row[:3]).max())
        if not (abs(length - 1.0) < _UNIT and far < _FARTHEST_M) or parent == child:
            return
        self._count += 1
        if self._count > MOST_SAMPLES:
            raise DatasetError(
                f"There are more than {MOST_SAMPLES} transforms. Cut the recording into parts."
            )
        row[3:] /= length
        edges = self._edges.setdefault(child, {})
        edge = edges.get(parent)
        if edge is None or (fixed and not edge.fixed):
            edge = edges[parent] = _Edge(fixed)
        if edge.fixed:
            edge.samples = array("d", row)
            return
        edge.stamps_ns.append(stamp_ns)
        edge.samples.extend(row)
        if self._origin_ns is None:
            self._origin_ns = stamp_ns

    def forget_moving(self) -> None:
        """Drop all that may move, as where the clock jumped."""
        for edges in self._edges.values():
            for parent in [name for name, edge in edges.items() if not edge.fixed]:
                self._count -= len(edges.pop(parent).stamps_ns)
        self._origin_ns = None

    def forget(self, span_ns: int) -> None:
        """Drop samples of moving transforms that came before those of so long until the latest."""
        for edges in self._edges.values():
            for edge in edges.values():
                if not edge.fixed:
                    old = first_since(edge.stamps_ns, span_ns)
                    del edge.stamps_ns[:old], edge.samples[: 7 * old]
                    self._count -= old

    def frames(self) -> list[str]:
        """Names of all frames."""
        parents = {one for edges in self._edges.values() for one in edges}
        return sorted(parents | self._edges.keys())

    def has_edge(self, parent: str, child: str) -> bool:
        """Whether a transform between these two is known."""
        return frame_name(parent) in self._edges.get(frame_name(child), {})

    def ancestors(self, child: str, *, constant: bool = False) -> list[str]:
        """Frames above one, nearest first, itself at the beginning.

        Of several parents that with the most samples is taken.

        Parameters
        ----------
        child : the name
        constant : stop below the first transform that moves
        """
        found = [frame_name(child)]
        while True:
            edges = self._edges.get(found[-1], {})
            known = {
                parent: edge
                for parent, edge in edges.items()
                if parent not in found and (not constant or self._holds_still(parent, found[-1]))
            }
            if not known:
                return found
            found.append(max(known, key=lambda name: (len(known[name].samples), name)))

    def path(self, ancestor: str, child: str) -> list[str] | None:
        """Frames from a child up to an ancestor, both included; None where it is none."""
        ancestor, child = frame_name(ancestor), frame_name(child)
        came: dict[str, str] = {child: ""}
        waiting = [child]
        while waiting and ancestor not in came:
            below = waiting.pop(0)
            for parent in sorted(self._edges.get(below, {})):
                if parent not in came:
                    came[parent] = below
                    waiting.append(parent)
        if ancestor not in came:
            return None
        up = [ancestor]
        while up[-1] != child:
            up.append(came[up[-1]])
        return up[::-1]

    def base_of(self, sensor: str, world: str | None) -> str | None:
        """The frame of the robot that carries a sensor; None where nothing tells.

        It is `base_link` or its like above the sensor; else the last frame above it to which the
        sensor does not move.

        Parameters
        ----------
        sensor : its frame
        world : what poses lead to; where given, the base lies below it
        """
        up = self.ancestors(sensor) if world is None else self.path(world, sensor) or []
        up = up if world is None else up[:-1]
        for name in BASES:
            for one in up:
                if one.rpartition("/")[2] == name:
                    return one
        if world is None:
            return None
        still = [one for one in self.ancestors(sensor, constant=True) if one in up]
        return still[-1] if still and still[-1] != frame_name(sensor) else None

    def world_of(self, sensor: str) -> str | None:
        """The frame that poses of a sensor lead to; None where nothing above it moves.

        It is `map`, else `odom`, else the topmost.
        """
        up = self.ancestors(sensor)
        moves = [
            not self._holds_still(parent, child)
            for child, parent in pairwise(up)
        ]  # fmt: skip
        named: list[str] = []
        for world in WORLDS:
            for one in self.frames():
                path = self.path(one, sensor) if one.rpartition("/")[2] == world else None
                if path is not None and len(path) > 1:
                    named.append(one)
        if named:
            return named[0]
        return up[-1] if any(moves) else None

    def fixed_transform(self, target: str, source: str) -> Floats | None:
        """T_target_source (4, 4) between frames that do not move against each other, or None."""
        ups = [self.ancestors(one, constant=True) for one in (target, source)]
        common = next((one for one in ups[1] if one in ups[0]), None)
        if common is None:
            return None
        (T_common_target,) = self.poses(common, target, [0])
        (T_common_source,) = self.poses(common, source, [0])
        if T_common_target is None or T_common_source is None:
            return None
        found: Floats = np.linalg.inv(T_common_target) @ T_common_source
        return found

    def poses(
        self, parent: str, child: str, stamps_ns: Sequence[int]
    ) -> list[Floats | None]:  # fmt: skip
        """T_parent_child (4, 4) at each stamp, positions linear and rotations by slerp.

        Parameters
        ----------
        parent : the child itself, or a frame above it
        child : a frame
        stamps_ns : M times, in any order

        Returns
        -------
        poses : of M stamps; None where a transform on the way is not known at that time
        """
        path = self.path(parent, child)
        if path is None:
            return [None] * len(stamps_ns)
        found: list[Floats | None] = [np.eye(4) for _ in stamps_ns]
        for below, above in pairwise(path):
            steps = self._samples_at(above, below, stamps_ns)
            found = [
                None if T is None or step is None else step @ T
                for T, step in zip(found, steps, strict=True)
            ]
        return found

    def _holds_still(self, parent: str, child: str) -> bool:
        """Whether a transform is fixed: one that never moved counts, but for that of a base, which
        may have stood still.
        """
        edge = self._edges[child][parent]
        names = {parent.rpartition("/")[2], child.rpartition("/")[2]}
        is_of_base = not names.isdisjoint(WORLDS) or child.rpartition("/")[2] in BASES
        return edge.fixed or (edge.is_constant and not is_of_base)

    def _samples_at(
        self, parent: str, child: str, stamps_ns: Sequence[int]
    ) -> Sequence[Floats | None]:
        """One transform at the stamps."""
        edge = self._edges[child][parent]
        rows = np.frombuffer(edge.samples, np.float64).reshape(-1, 7)
        if self._holds_still(parent, child):
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = rotation_of(rows[-1, 3:]), rows[-1, :3]
            return [T] * len(stamps_ns)
        origin = self._origin_ns or 0
        recorded: NDArray[np.int64] = np.frombuffer(edge.stamps_ns, np.int64)
        # seconds since a time of the recording: exact to nanoseconds for a hundred days
        times, first = np.unique((recorded - origin) * 1e-9, return_index=True)
        asked = (np.asarray(stamps_ns, np.int64) - origin) * 1e-9
        near = (asked >= times[0] - TOLERANCE_S) & (asked <= times[-1] + TOLERANCE_S)
        asked = np.where(near, np.clip(asked, times[0], times[-1]), asked)
        trajectory = SensorTrajectory(times, rows[first, :3], rows[first, 3:])
        return interpolate(trajectory, asked.tolist(), longest_gap=LONGEST_GAP_S)


def first_since(stamps_ns: array[int], span_ns: int) -> int:
    """Place of the first stamp, in the order in which they came, within a span until the last."""
    times = np.frombuffer(stamps_ns, np.int64)
    return int(np.argmax(times >= times[-1] - span_ns)) if len(times) else 0


def frame_name(name: str) -> str:
    """A frame's name without the leading slash of ROS 1, in one line of printable characters."""
    return printable(name.lstrip("/"))


# Which way is up, of an accelerometer at rest.

#: Seconds before and after a stamp over which accelerations are averaged.
WINDOW_S = 0.5
#: Fewest samples of such a window.
_FEWEST = 10
#: At rest are mean accelerations of this length within this, m/s^2, ...
_GRAVITY, _OFF = 9.81, 0.3
#: ... that vary by less than this (standard deviation of all axes), m/s^2, ...
_SPREAD = 0.25
#: ... while the robot turns by less than this on average, radians per second.
_TURN = 0.05
_MOST_SAMPLES = 10_000_000


class Accelerations:
    """Measurements of an IMU over time."""

    def __init__(self) -> None:
        self._stamps_ns = array("q")
        self._rows = array("d")  # 6 each: acceleration, angular velocity

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def add(self, stamp_ns: int, acceleration: Sequence[float], turn: Sequence[float]) -> None:
        """Take a measurement: m/s^2 and radians per second, along the IMU's axes.

        Raises
        ------
        DatasetError : there are more than 10 million.
        """
        row = [*acceleration, *turn]
        if not np.isfinite(row).all():
            return
        if len(self._stamps_ns) >= _MOST_SAMPLES:
            raise DatasetError(
                f"The recording has more than {_MOST_SAMPLES} measurements of one IMU. Cut it "
                "into parts."
            )
        self._stamps_ns.append(stamp_ns)
        self._rows.extend(row)

    def forget(self, span_ns: int) -> None:
        """Drop measurements that came before those of so long until the latest."""
        old = first_since(self._stamps_ns, span_ns)
        del self._stamps_ns[:old], self._rows[: 6 * old]

    def up_at(self, stamps_ns: Sequence[int]) -> list[Floats | None]:
        """Up (3,) in the IMU's axes at each stamp; None where the robot was not at rest.

        At rest an accelerometer measures 9.81 m/s^2 upwards. The mean is taken over a second.
        """
        recorded = np.frombuffer(self._stamps_ns, np.int64)
        order = np.argsort(recorded, kind="stable")
        times = recorded[order]
        rows = np.frombuffer(self._rows, np.float64).reshape(-1, 6)[order]
        window = int(WINDOW_S * 1e9)
        found: list[Floats | None] = []
        for stamp in stamps_ns:
            a, b = np.searchsorted(times, [stamp - window, stamp + window + 1])
            found.append(_up(rows[a:b]) if b - a >= _FEWEST else None)
        return found


def _up(rows: Floats) -> Floats | None:
    """Up of measurements (N, 6) in a row, or None where they are not of rest."""
    acceleration, turn = rows[:, :3], rows[:, 3:]
    mean = acceleration.mean(axis=0)
    length = float(np.linalg.norm(mean))
    spread = float(np.sqrt(acceleration.var(axis=0).sum()))
    turning = float(np.linalg.norm(turn, axis=1).mean())
    if abs(length - _GRAVITY) > _OFF or spread > _SPREAD or turning > _TURN:
        return None
    up: Floats = mean / length
    return up


TOLERANCE = 1e-2  #: how far a written rotation may be from a true one, or a length from 1


def rigid_transform(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pose with its rotation made orthonormal to machine precision.

    Parameters
    ----------
    matrix : (4, 4) T_parent_sensor, its rotation good to 1e-2

    Returns
    -------
    T_parent_sensor : (4, 4) float64, the rotation nearest to the one given

    Raises
    ------
    InvalidPose : the matrix is not 4 x 4 numbers, not finite, or not rigid.
    """
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError) as cause:
        raise InvalidPose("The pose is not made of numbers. Give 4 x 4 of them.") from cause
    if pose.shape != (4, 4):
        raise InvalidPose(f"The pose has shape {pose.shape}. Give 4 x 4 numbers.")
    if not np.isfinite(pose).all():
        raise InvalidPose(
            "The pose is not finite, as where tracking was lost. Leave the frame or its pose out."
        )
    if np.abs(pose[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-9:
        raise InvalidPose(
            "The last row of the pose is not 0 0 0 1. Give sensor-to-parent, row by row."
        )
    rotation = pose[:3, :3]
    # entries first: the product of large ones overflows
    rigid = np.abs(rotation).max() < 2.0
    if not rigid or np.abs(rotation.T @ rotation - np.eye(3)).max() > TOLERANCE:
        raise InvalidPose(
            f"The rotation of the pose is not orthonormal to {TOLERANCE}. "
            "Give a rigid transform without scale."
        )
    if np.linalg.det(rotation) < 0.0:
        raise InvalidPose("The rotation of the pose mirrors. Give right-handed axes.")
    left, _, right = np.linalg.svd(rotation)
    pose[:3, :3] = left @ right
    pose[3] = (0.0, 0.0, 0.0, 1.0)
    return pose
