"""Transforms between a robot's frames over time: tf, tf_static and odometry.

TransformTree.add ...  --TransformTree.lookup-->  T_parent_child at M stamps, or UnknownTransform
stamps (N,), samples (N, 7)  --contradictions-->  samples that cannot belong to one motion

As in tf, a transform converts coordinates of the child frame to those of its parent.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sceneprint_client.errors import DatasetError, printable
from sceneprint_client.poses import Floats, SensorTrajectory, first_since, interpolate, rotation_of

#: Longest interval between two samples in which to interpolate, seconds.
LONGEST_GAP_S = 0.5
#: Longest extrapolation before the first and after the last sample, seconds.
TOLERANCE_S = 0.02
#: Maximum number of samples of moving transforms: hours of odometry.
MOST_SAMPLES = 5_000_000
#: Deviation of a quaternion's length from 1 from which the normalisation is reported, and from
#: which the sample is ignored.
_UNIT, _NEAR_UNIT = 1e-2, 0.1
#: Longest plausible translation, metres.
_FARTHEST_M = 1e7
#: Names of a robot's base frame in REP 105 and in practice, in order of preference.
BASES = ("base_link", "base_footprint", "base")
#: Names of parent frames of poses in REP 105, in order of preference.
WORLDS = ("map", "odom", "world")


#: Maximum speed, metres or radians per second. Samples that imply more contradict each other.
FASTEST = 50.0
#: Tolerance for the distance between two samples, metres or radians.
_JITTER = 0.1
#: Maximum jump (metres or radians) and acceleration (the same per second^2) of one motion, and
#: maximum seconds between a jump and its reversal that indicate two publishers.
_JUMP, _HARDEST, _BACK_S = 0.5, 10.0, 2.0


class UnknownTransform(NamedTuple):
    """Reason why a transform is unknown at a time.

    Parameters
    ----------
    transform : name such as "odom -> base_link"
    nearest_s : seconds to the nearest sample; None if the samples contradict each other
    """

    transform: str
    nearest_s: float | None


@dataclass(eq=False)
class _Edge:
    """Samples of one transform; a fixed transform has one sample and no stamp."""

    fixed: bool
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    #: Rows of 7: position x y z, quaternion x y z w.
    samples: array[float] = field(default_factory=lambda: array("d"))

    @property
    def is_constant(self) -> bool:
        """Return whether the transform never moved, such as a fixed joint published repeatedly."""
        rows = np.frombuffer(self.samples, np.float64).reshape(-1, 7)
        return self.fixed or bool((np.ptp(rows, axis=0) < 1e-9).all())


class TransformTree:
    """Transforms between named frames over time."""

    def __init__(self) -> None:
        self._edges: dict[str, dict[str, _Edge]] = {}  # edges by child, then by parent
        self._count = 0
        self._origin_ns: int | None = None
        #: Reason and number of ignored samples, by (parent, child).
        self.passed_over: dict[tuple[str, str], tuple[str, int]] = {}
        #: Length of the last normalised quaternion, by (parent, child).
        self.normalised: dict[tuple[str, str], float] = {}
        #: Longest step above `FASTEST` that `lookup` used, metres or radians, by (parent, child).
        self.jumps: dict[tuple[str, str], float] = {}

    def add(
        self, parent: str, child: str, stamp_ns: int, sample: Sequence[float], *, fixed: bool
    ) -> bool:
        """Add a sample of a transform; a sample that is not rigid is ignored and recorded.

        Parameters
        ----------
        parent, child : names of the frames; a leading slash of ROS 1 is removed
        stamp_ns : stamp, nanoseconds; ignored for a fixed transform
        sample : T_parent_child as x y z, metres, and a unit quaternion x y z w
        fixed : whether the transform holds at all times; the last sample counts

        Returns
        -------
        added : False if the sample was ignored

        Raises
        ------
        DatasetError : If there are more than 5 million samples; `forget` removes old samples.
        """
        parent, child = frame_name(parent), frame_name(child)
        row = np.asarray(sample, np.float64)
        length = math.hypot(*row[3:])  # `hypot` does not overflow
        far = float(np.abs(row[:3]).max())
        if parent == child:
            return False
        if not (abs(length - 1.0) < _NEAR_UNIT and far < _FARTHEST_M):
            self.pass_over(
                parent, child,
                f"its quaternion has the length {length:.3g}" if far < _FARTHEST_M
                else f"its translation is {far:.3g} m",
            )  # fmt: skip
            return False
        if abs(length - 1.0) >= _UNIT:
            self.normalised[parent, child] = length
        self._count += 1
        if self._count > MOST_SAMPLES:
            raise DatasetError(
                f"There are more than {MOST_SAMPLES} transforms. Split the recording."
            )
        row[3:] /= length
        edges = self._edges.setdefault(child, {})
        edge = edges.get(parent)
        if edge is None or (fixed and not edge.fixed):
            edge = edges[parent] = _Edge(fixed)
        if edge.fixed:
            edge.samples = array("d", row)
            return True
        edge.stamps_ns.append(stamp_ns)
        edge.samples.extend(row)
        if self._origin_ns is None:
            self._origin_ns = stamp_ns
        return True

    def pass_over(self, parent: str, child: str, reason: str) -> None:
        """Record a sample that was ignored, with the reason."""
        _, count = self.passed_over.get((parent, child), ("", 0))
        self.passed_over[parent, child] = reason, count + 1

    def remove(self, parent: str, child: str) -> None:
        """Remove a transform."""
        edge = self._edges.get(child, {}).pop(parent, None)
        self._count -= 0 if edge is None else len(edge.stamps_ns)

    def samples(self, parent: str, child: str) -> Floats:
        """Return the samples (N, 7) of a transform in order of arrival."""
        edge = self._edges.get(frame_name(child), {}).get(frame_name(parent))
        rows = np.frombuffer(b"" if edge is None else edge.samples.tobytes(), np.float64)
        return rows.reshape(-1, 7)

    def forget_moving(self) -> None:
        """Remove all moving transforms, as after a jump of the clock."""
        for edges in self._edges.values():
            for parent in [name for name, edge in edges.items() if not edge.fixed]:
                self._count -= len(edges.pop(parent).stamps_ns)
        self._origin_ns = None

    def forget(self, span_ns: int) -> None:
        """Remove samples of moving transforms more than `span_ns` older than the latest one."""
        for edges in self._edges.values():
            for edge in edges.values():
                if not edge.fixed:
                    old = first_since(edge.stamps_ns, span_ns)
                    del edge.stamps_ns[:old], edge.samples[: 7 * old]
                    self._count -= old

    def sorted_paths(self, *paths: tuple[str, str]) -> TransformTree:
        """Return a tree of the transforms on the paths between pairs (ancestor, child).

        Samples of moving transforms are sorted by stamp in both trees, as `excerpt` requires.
        """
        part = TransformTree()
        for ancestor, child in paths:
            for below, above in pairwise(self.path(ancestor, child) or ()):
                edge = self._edges[below][above]
                if self._is_fixed(above, below):
                    edge = _Edge(True, samples=edge.samples[-7:])
                elif (np.diff(edge.stamps_ns) < 0).any():
                    order = np.argsort(edge.stamps_ns, kind="stable")
                    rows = np.frombuffer(edge.samples, np.float64).reshape(-1, 7)[order]
                    edge.samples = array("d", rows.tobytes())
                    edge.stamps_ns = array("q", np.array(edge.stamps_ns)[order].tobytes())
                part._edges.setdefault(below, {})[above] = edge
        return part

    def excerpt(self, first_ns: int, last_ns: int) -> TransformTree:
        """Return a tree for `lookup` at stamps from `first_ns` to `last_ns`, with fewer samples.

        This tree must be a result of `sorted_paths` or of this function.
        """
        part = TransformTree()
        part._origin_ns = first_ns
        margin_ns = round((LONGEST_GAP_S + _BACK_S) * 1e9)
        for child, edges in self._edges.items():
            for parent, edge in edges.items():
                if not edge.fixed:
                    i = bisect_left(edge.stamps_ns, first_ns - margin_ns)
                    j = bisect_right(edge.stamps_ns, last_ns + margin_ns)
                    edge = _Edge(False, edge.stamps_ns[i:j], edge.samples[7 * i : 7 * j])
                part._edges.setdefault(child, {})[parent] = edge
        return part

    def frames(self) -> list[str]:
        """Return the names of all frames."""
        parents = {parent for edges in self._edges.values() for parent in edges}
        return sorted(parents | self._edges.keys())

    def has_edge(self, parent: str, child: str) -> bool:
        """Return whether a frame is a direct child of another."""
        return frame_name(parent) in self._edges.get(frame_name(child), {})

    def ancestors(self, child: str, *, constant: bool = False) -> list[str]:
        """Return a frame and its ancestors, nearest first.

        If a frame has several parents, the parent with the most samples is used.

        Parameters
        ----------
        child : name of the frame
        constant : whether to stop before the first moving transform
        """
        chain = [frame_name(child)]
        while True:
            edges = self._edges.get(chain[-1], {})
            parents = {
                parent: edge
                for parent, edge in edges.items()
                if parent not in chain and (not constant or self._is_fixed(parent, chain[-1]))
            }
            if not parents:
                return chain
            chain.append(max(parents, key=lambda name: (len(parents[name].samples), name)))

    def path(self, ancestor: str, child: str) -> list[str] | None:
        """Return the frames on the path from a child to an ancestor, inclusive, or None."""
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

    def leaves(self, frame: str) -> list[str]:
        """Return the descendants of a frame that have no children."""
        parents = {parent for edges in self._edges.values() for parent in edges}
        return [
            leaf
            for leaf in sorted(self._edges.keys() - parents)
            if self.path(frame, leaf) is not None
        ]

    def moves_below(self, frame: str) -> bool:
        """Return whether a direct child of a frame moves."""
        return any(
            not self._is_fixed(frame, child)
            for child, edges in self._edges.items()
            if frame in edges
        )

    def base_of(self, sensor: str, world: str | None) -> str | None:
        """Return the frame of the robot that carries a sensor; None if it cannot be determined.

        It is an ancestor with a name such as `base_link`, or else the highest ancestor to which
        the sensor is fixed.

        Parameters
        ----------
        sensor : frame of the sensor
        world : parent frame of poses, an ancestor of the base; None if unknown
        """
        up = self.ancestors(sensor) if world is None else self.path(world, sensor) or []
        up = up if world is None else up[:-1]
        for name in BASES:
            for ancestor in up:
                if ancestor.rpartition("/")[2] == name:
                    return ancestor
        if world is None:
            return None
        still = [ancestor for ancestor in self.ancestors(sensor, constant=True) if ancestor in up]
        return still[-1] if still and still[-1] != frame_name(sensor) else None

    def world_of(self, sensor: str) -> str | None:
        """Return the parent frame of a sensor's poses.

        It is the ancestor `map`, else `odom`, else `world`, else the root if a transform moves,
        else None.
        """
        up = self.ancestors(sensor)
        moves = [
            not self._is_fixed(parent, child)
            for child, parent in pairwise(up)
        ]  # fmt: skip
        named: list[str] = []
        for world in WORLDS:
            for frame in self.frames():
                path = self.path(frame, sensor) if frame.rpartition("/")[2] == world else None
                if path is not None and len(path) > 1:
                    named.append(frame)
        if named:
            return named[0]
        return up[-1] if any(moves) else None

    def fixed_transform(self, target: str, source: str) -> Floats | None:
        """Return T_target_source (4, 4) if the frames are fixed to each other, else None."""
        ups = [self.ancestors(frame, constant=True) for frame in (target, source)]
        common = next((frame for frame in ups[1] if frame in ups[0]), None)
        if common is None:
            return None
        (T_common_target,) = self.poses(common, target, [0])
        (T_common_source,) = self.poses(common, source, [0])
        if T_common_target is None or T_common_source is None:
            return None
        transform: Floats = np.linalg.inv(T_common_target) @ T_common_source
        return transform

    def poses(self, parent: str, child: str, stamps_ns: Sequence[int]) -> list[Floats | None]:
        """Return the result of `lookup` with None for unknown transforms."""
        transforms = self.lookup(parent, child, stamps_ns)
        return [None if isinstance(T, UnknownTransform) else T for T in transforms]

    def lookup(
        self, parent: str, child: str, stamps_ns: Sequence[int]
    ) -> list[Floats | UnknownTransform]:
        """Return T_parent_child (4, 4) at each stamp: linear positions, and rotations by slerp.

        Parameters
        ----------
        parent : the child itself or one of its ancestors
        child : name of the frame
        stamps_ns : M stamps in any order, nanoseconds

        Returns
        -------
        transforms : M transforms, or UnknownTransform for the first transform on the path whose
            samples around the stamp contradict each other, or are more than `LONGEST_GAP_S` apart
            with none within `TOLERANCE_S`
        """
        path = self.path(parent, child)
        if path is None:
            nowhere = UnknownTransform(f"{frame_name(parent)} -> {frame_name(child)}", float("inf"))
            return [nowhere] * len(stamps_ns)
        transforms: list[Floats | UnknownTransform] = [np.eye(4) for _ in stamps_ns]
        for below, above in pairwise(path):
            steps = self._samples_at(above, below, stamps_ns)
            transforms = [
                T if isinstance(T, UnknownTransform)
                else step if isinstance(step, UnknownTransform)
                else step @ T
                for T, step in zip(transforms, steps, strict=True)
            ]  # fmt: skip
        return transforms

    def _is_fixed(self, parent: str, child: str) -> bool:
        """Return whether a transform is fixed or constant.

        A constant transform of a base is not fixed, since the robot may merely be at rest.
        """
        edge = self._edges[child][parent]
        names = {parent.rpartition("/")[2], child.rpartition("/")[2]}
        is_of_base = not names.isdisjoint(WORLDS) or child.rpartition("/")[2] in BASES
        return edge.fixed or (edge.is_constant and not is_of_base)

    def _samples_at(
        self, parent: str, child: str, stamps_ns: Sequence[int]
    ) -> Sequence[Floats | UnknownTransform]:
        """Return one transform at the stamps; see `lookup`."""
        edge = self._edges[child][parent]
        rows = np.frombuffer(edge.samples, np.float64).reshape(-1, 7)
        if self._is_fixed(parent, child):
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = rotation_of(rows[-1, 3:]), rows[-1, :3]
            return [T] * len(stamps_ns)
        origin = self._origin_ns or 0
        recorded: NDArray[np.int64] = np.frombuffer(edge.stamps_ns, np.int64)
        order = np.argsort(recorded, kind="stable")
        # Seconds relative to a stamp of the recording are exact to nanoseconds for 100 days.
        times: Floats = (recorded[order] - origin).astype(np.float64) * 1e-9
        rows = rows[order]
        seconds = (np.asarray(stamps_ns, np.int64) - origin) * 1e-9
        before, after = _neighbours(times, seconds)
        distance = np.minimum(np.abs(times[before] - seconds), np.abs(times[after] - seconds))
        too_fast, disputed = contradictions(times, rows)
        doubted = _contradict_around(too_fast, disputed, before, after)
        steps = np.flatnonzero(too_fast & ~disputed[:-1] & ~disputed[1:])
        if len(steps):
            self.jumps[parent, child] = float(motion(rows[steps], rows[steps + 1]).max())

        _, first = np.unique(times, return_index=True)
        trajectory = SensorTrajectory(times[first], rows[first, :3], rows[first, 3:])
        poses = interpolate(
            trajectory, seconds.tolist(), longest_gap=LONGEST_GAP_S, tolerance=TOLERANCE_S
        )
        name = f"{parent} -> {child}"
        return [
            UnknownTransform(name, float(seconds)) if pose is None
            else UnknownTransform(name, None) if doubt
            else pose
            for pose, doubt, seconds in zip(poses, doubted, distance, strict=True)
        ]  # fmt: skip


def contradictions(
    times: Floats, rows: Floats
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:  # fmt: skip
    """Find the samples of a transform that cannot belong to one motion.

    Parameters
    ----------
    times : (N,) non-decreasing times, seconds
    rows : (N, 7) x y z, metres, and unit quaternions x y z w

    Returns
    -------
    too_fast : (N - 1,) whether neighbouring samples imply a speed above `FASTEST`
    disputed : (N,) whether the sample lies between a jump and its reversal, as of two publishers,
        or is too fast from and to all its neighbours
    """
    gap = np.diff(times)
    steps = _steps(rows[:-1], rows[1:])
    reach = motion(rows[:-1], rows[1:])
    too_fast = reach > _JITTER + FASTEST * gap
    ends = np.full(1, len(gap) > 0)
    disputed = np.concatenate([ends, too_fast]) & np.concatenate([too_fast, ends])
    # A jump differs from the motion before and after it.
    rate = steps / np.maximum(gap, 1e-3)[:, None]
    change = np.full(len(gap), np.inf if len(gap) > 1 else 0.0)
    for k, neighbour in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
        off = np.linalg.norm(steps[k] - rate[neighbour] * gap[k, None], axis=1)
        change[k] = np.minimum(change[k], off)
    jumps = np.flatnonzero((reach > _JUMP) & (change > _JUMP + _HARDEST * gap**2)).tolist()
    for out, back in pairwise(jumps):
        rest = np.linalg.norm(steps[out] + steps[back])
        if times[back + 1] - times[out] <= _BACK_S and rest < 0.5 * min(reach[out], reach[back]):
            disputed[out : back + 2] = True
    return too_fast, disputed


def doubtful(trajectory: SensorTrajectory, stamps: Sequence[float]) -> NDArray[np.bool_]:
    """Return whether the poses around each of M stamps, seconds, contradict each other."""
    rows = np.hstack([trajectory.positions, trajectory.quaternions])
    around = _neighbours(trajectory.stamps, np.asarray(stamps, np.float64))
    return _contradict_around(*contradictions(trajectory.stamps, rows), *around)


def _neighbours(
    times: Floats, seconds: NDArray[np.floating]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices of the samples before and after each of M times."""
    before = np.maximum(np.searchsorted(times, seconds, "right") - 1, 0)
    return before, np.minimum(np.searchsorted(times, seconds), len(times) - 1)


def motion(rows: Floats, others: Floats) -> Floats:
    """Return M distances between samples (M, 7), metres; a radian counts as a metre."""
    distances: Floats = np.linalg.norm(_steps(rows, others), axis=1)
    return distances


def _steps(rows: Floats, others: Floats) -> Floats:
    """Return the steps (M, 6) between samples: translations, and rotations in the axes of the first
    sample, as axes times 2 sin(angle / 2).
    """
    x, y, z, w = rows[:, 3:].T * np.array([[-1.0], [-1.0], [-1.0], [1.0]])
    a, b, c, d = others[:, 3:].T
    turn = np.stack(
        [
            w * a + x * d + y * c - z * b,
            w * b - x * c + y * d + z * a,
            w * c + x * b - y * a + z * d,
        ],
        axis=1,
    )
    real = w * d - x * a - y * b - z * c
    turn[real < 0.0] *= -1.0  # q and -q are the same rotation
    return np.hstack([others[:, :3] - rows[:, :3], 2.0 * turn])


def _contradict_around(
    too_fast: NDArray[np.bool_], disputed: NDArray[np.bool_], before: NDArray[np.intp],
    after: NDArray[np.intp],
) -> NDArray[np.bool_]:  # fmt: skip
    """Return whether the samples before and after each of M times contradict each other."""
    low, high = np.minimum(before, after), np.maximum(before, after)
    sums = np.concatenate([[0], np.cumsum(too_fast)])
    conflict: NDArray[np.bool_] = (sums[high] > sums[low]) | disputed[low] | disputed[high]
    return conflict


def frame_name(name: str) -> str:
    """Return a frame's name as one printable line, without the leading slash of ROS 1."""
    return printable(name.lstrip("/"))
