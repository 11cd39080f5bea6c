"""Which associations of two runs to believe: those that close loops with their neighbours.

edges, poses of both runs  --verdicts-->  agree, disagree, alone

A wrong transform may look perfect to both frames that it joins. But a robot that took both frames
took others beside them, and knows how it moved from one to the next: two edges a short way apart
are a loop, from a frame over one edge, along the other run, back over the other edge and along the
first run. Where it does not close, one of the edges is wrong. Odometry is believed over short ways
only, so poses that drift do no harm, and no run need know where the other began (pairwise
consistency: Mangelson et al., ICRA 2018, with odometry's doubt as a tolerance).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.pose.rigid import rotation_angle
from sceneprint.types import Floats

# Votes: what associations of two runs say of how the runs lie to each other.


@dataclass(frozen=True, eq=False)
class Votes:
    """What associations say of two parent frames.

    Parameters
    ----------
    transforms : (n, 4, 4) T_a_b
    places : (n, 3) metres, where the frame of each was, in b
    source, target : (n,) its frames in b and in a
    weights : (n,) positive
    """

    transforms: Floats
    places: Floats
    source: NDArray[np.int64]
    target: NDArray[np.int64]
    weights: Floats


def votes_of(
    transforms: Floats, source_poses: Floats, target_poses: Floats,
    source: NDArray[np.int64], target: NDArray[np.int64], weights: Floats,
) -> Votes:  # fmt: skip
    """Associations as votes.

    Parameters
    ----------
    transforms : (n, 4, 4) T_target_source
    source_poses, target_poses : (n, 4, 4) T_b_source, T_a_target
    source, target, weights : as in Votes
    """
    R = source_poses[:, :3, :3].transpose(0, 2, 1)
    whole = np.zeros_like(transforms)
    there = target_poses @ transforms
    whole[:, :3, :3] = there[:, :3, :3] @ R
    places = source_poses[:, :3, 3]
    whole[:, :3, 3] = there[:, :3, 3] - np.einsum("nij,nj->ni", whole[:, :3, :3], places)
    whole[:, 3, 3] = 1.0
    return Votes(whole, places, source, target, weights)


# Runs: where a robot was, frame by frame, and how far it went from one to the next.

Ints64 = NDArray[np.int64]

#: The way across a gap in odometry, metres: no loop reaches over it.
_BROKEN = 1e6


@dataclass(frozen=True, eq=False)
class RobotPath:
    """Where a robot was, frame by frame.

    Parameters
    ----------
    poses : (m, 4, 4) T_parent_sensor; NaN where not known
    metres, radians : (m,) way up to each frame; very long across a gap in odometry, NaN without a
        pose
    """

    poses: Floats
    metres: Floats
    radians: Floats


def run_of(poses: Floats, parents: Ints64) -> RobotPath:
    """A run from the poses of its frames, in the order in which they were taken.

    Parameters
    ----------
    poses : (m, 4, 4) T_parent_sensor; NaN where not known
    parents : (m,) which parent frame each is given in; odometry is broken where it changes
    """
    known = np.isfinite(poses).all(axis=(1, 2))
    metres, radians = np.zeros(len(poses)), np.zeros(len(poses))
    last, far_m, far_rad = -1, 0.0, 0.0
    for i in np.flatnonzero(known).tolist():
        if last >= 0 and parents[i] == parents[last]:
            far_m += float(np.linalg.norm(poses[i, :3, 3] - poses[last, :3, 3]))
            far_rad += rotation_angle(poses[i, :3, :3] @ poses[last, :3, :3].T)
        elif last >= 0:
            far_m += _BROKEN
        metres[i], radians[i], last = far_m, far_rad, i
    metres[~known] = np.nan
    return RobotPath(poses, metres, radians)


@dataclass(frozen=True)
class CycleParameters:
    """When a loop of two edges closes."""

    close_m: float = 0.07  #: what may be left of a loop without a way, metres
    close_rad: float = math.radians(4.0)
    drift: float = 0.05  #: of a way: metres a metre, and radians a radian
    reach_m: float = 1.0  #: longest way along either run, metres; past it odometry says nothing
    reach_rad: float = math.radians(60.0)
    most_loops: int = 4_000_000  #: that are held; the reach is shortened until there are no more


@dataclass(frozen=True, eq=False)
class LoopEdges:
    """Associations of frames of one run with frames of another, or of the same.

    Parameters
    ----------
    source, target : (n,) places of the frames in their runs
    transforms : (n, 4, 4) T_target_source
    weights : (n,) how far each is believed, positive
    """

    source: Ints64
    target: Ints64
    transforms: Floats
    weights: Floats

    def __len__(self) -> int:
        return len(self.source)


@dataclass(frozen=True, eq=False)
class Verdicts:
    """What the loops say of each edge.

    Parameters
    ----------
    kept : (n,) not outvoted
    loops : (n,) loops with edges that were kept
    closed : (n,) how many of them close; an edge without any was checked by nothing
    """

    kept: NDArray[np.bool_]
    loops: Ints64
    closed: Ints64


def verdicts(
    edges: LoopEdges, source: RobotPath, target: RobotPath, p: CycleParameters | None = None
) -> Verdicts:
    """Take edges out, the most outvoted first, until none is outvoted.

    Parameters
    ----------
    edges : see Edges
    source, target : the runs of their frames; the same one twice for loop closures
    p : see CycleParameters
    """
    p = p or CycleParameters()
    firsts, seconds, closing = _loops(edges, source, target, p)
    n = len(edges)
    both = np.concatenate([firsts, seconds])
    others = np.concatenate([seconds, firsts])
    twice = np.concatenate([closing, closing])
    order = np.argsort(both, kind="stable")
    starts = np.searchsorted(both[order], np.arange(n + 1))
    kept = np.ones(n, np.bool_)
    _outvote(starts, others[order], twice[order], edges.weights, kept)
    loops = np.bincount(both, kept[others], n).astype(np.int64)
    closed = np.bincount(both, kept[others] & twice, n).astype(np.int64)
    return Verdicts(kept, loops, closed)


def _loops(
    edges: LoopEdges, source: RobotPath, target: RobotPath, p: CycleParameters
) -> tuple[Ints64, Ints64, NDArray[np.bool_]]:
    """Pairs of edges near each other on both runs, and which of them close."""
    ways = np.stack(
        [
            source.metres[edges.source], source.radians[edges.source],
            target.metres[edges.target], target.radians[edges.target],
        ],
        axis=1,
    )  # fmt: skip
    shorter = 1.0
    while True:
        limits = np.array([p.reach_m, p.reach_rad]) * shorter
        count = _near(ways, limits)
        if count <= p.most_loops:
            break
        shorter /= 2.0
    firsts, seconds = np.empty(count, np.int64), np.empty(count, np.int64)
    closing = np.empty(count, np.bool_)
    here = np.ascontiguousarray(source.poses[edges.source])
    there = np.ascontiguousarray(target.poses[edges.target])
    numbers = np.array([p.close_m, p.close_rad, p.drift])
    _close(
        ways, limits, here, there, np.ascontiguousarray(edges.transforms), numbers,
        firsts, seconds, closing,
    )  # fmt: skip
    return firsts, seconds, closing


@kernel
def _are_near(ways: Floats, i: int, j: int, limits: Floats) -> bool:
    # false for NaN as well: frames without a pose make no loops
    near: bool = (
        abs(ways[i, 0] - ways[j, 0]) <= limits[0]
        and abs(ways[i, 1] - ways[j, 1]) <= limits[1]
        and abs(ways[i, 2] - ways[j, 2]) <= limits[0]
        and abs(ways[i, 3] - ways[j, 3]) <= limits[1]
    )
    return near


@kernel
def _near(ways: Floats, limits: Floats) -> int:
    count = 0
    for i in range(len(ways)):
        for j in range(i + 1, len(ways)):
            count += _are_near(ways, i, j, limits)
    return count


@kernel
def _left(here: Floats, there: Floats, transforms: Floats, i: int, j: int) -> tuple[float, float]:
    """Metres and radians that are left of the loop over edges i and j, at the source of j."""
    # T_parent_parent of i, applied to the source of j; and the same of j
    R, t = np.zeros((2, 3, 3)), np.zeros((2, 3))
    for k in range(2):
        e = i if k == 0 else j
        # T_there T_target_source
        M, m = np.zeros((3, 3)), np.zeros(3)
        for a in range(3):
            m[a] = there[e, a, 3]
            for b in range(3):
                m[a] += there[e, a, b] * transforms[e, b, 3]
                for c in range(3):
                    M[a, b] += there[e, a, c] * transforms[e, c, b]
        # then T_source_parent
        for a in range(3):
            for b in range(3):
                for c in range(3):
                    R[k, a, b] += M[a, c] * here[e, b, c]
        # where it puts the source of j
        for a in range(3):
            t[k, a] = m[a]
            for b in range(3):
                t[k, a] += R[k, a, b] * (here[j, b, 3] - here[e, b, 3])
    square, trace = 0.0, -1.0
    D = np.zeros((3, 3))
    for a in range(3):
        square += (t[0, a] - t[1, a]) ** 2
        for b in range(3):
            for c in range(3):
                D[a, b] += R[0, a, c] * R[1, b, c]
        trace += D[a, a]
    sines = (D[2, 1] - D[1, 2]) ** 2 + (D[0, 2] - D[2, 0]) ** 2 + (D[1, 0] - D[0, 1]) ** 2
    return np.sqrt(square), np.arctan2(np.sqrt(sines), trace)


@kernel
def _close(
    ways: Floats, limits: Floats, here: Floats, there: Floats, transforms: Floats,
    numbers: Floats, firsts: Ints64, seconds: Ints64, closing: NDArray[np.bool_],
) -> None:  # fmt: skip
    at = 0
    for i in range(len(ways)):
        for j in range(i + 1, len(ways)):
            if not _are_near(ways, i, j, limits):
                continue
            metres = abs(ways[i, 0] - ways[j, 0]) + abs(ways[i, 2] - ways[j, 2])
            radians = abs(ways[i, 1] - ways[j, 1]) + abs(ways[i, 3] - ways[j, 3])
            left_m, left_rad = _left(here, there, transforms, i, j)
            back_m, _ = _left(here, there, transforms, j, i)
            firsts[at], seconds[at] = i, j
            closing[at] = (
                max(left_m, back_m) <= numbers[0] + numbers[2] * metres
                and left_rad <= numbers[1] + numbers[2] * radians
            )
            at += 1


@kernel
def _outvote(
    starts: Ints64, others: Ints64, closing: NDArray[np.bool_], weights: Floats,
    kept: NDArray[np.bool_],
) -> None:  # fmt: skip
    """While the votes against an edge outweigh those for it, take the worst edge out."""
    n = len(kept)
    against = np.zeros(n)
    for i in range(n):
        for k in range(starts[i], starts[i + 1]):
            against[i] += -weights[others[k]] if closing[k] else weights[others[k]]
    while True:
        worst, most = -1, 0.0
        for i in range(n):
            if kept[i] and against[i] > most:
                worst, most = i, against[i]
        if worst < 0:
            return
        kept[worst] = False
        for k in range(starts[worst], starts[worst + 1]):
            against[others[k]] -= -weights[worst] if closing[k] else weights[worst]
