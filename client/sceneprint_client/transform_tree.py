"""Frames of a robot over time: tf, tf_static and odometry.

TransformTree.add ...  --TransformTree.poses-->  T_parent_child at M stamps, or None where unknown

tf calls the outer frame the parent: a transform takes coordinates of the child to the parent's.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sceneprint_client.errors import DatasetError, printable
from sceneprint_client.rotations import Floats, rotation_of
from sceneprint_client.trajectories import SensorTrajectory, interpolate

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
