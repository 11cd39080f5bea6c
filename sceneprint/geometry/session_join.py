"""How two runs lie to each other: the associations to believe, and the transform most agree on.

edges, poses of both runs  --verdicts-->  agree, disagree, alone
votes T_a_b, each at its place  --join-->  Join

A wrong transform may look perfect to both frames that it joins. But a robot that took both frames
took others beside them, and knows how it moved from one to the next: two edges a short way apart
are a loop, from a frame over one edge, along the other run, back over the other edge and along the
first run. Where it does not close, one of the edges is wrong. Odometry is believed over short ways
only, so poses that drift do no harm, and no run need know where the other began (pairwise
consistency: Mangelson et al., ICRA 2018, with odometry's doubt as a tolerance).

Two edges of one viewpoint share their mistakes: what looks like another place from there looks like
it in every frame that a robot takes while it stands still. So an edge counts as supported only
where a loop closes with an edge whose frame was taken from elsewhere, on either run. Nor do all
edges together tell the sides of a symmetric object apart, since all are mistaken by the same turn.
The run itself does: an edge within one run that lies farther from its odometry than any odometry
drifts is not supported.

Each association of a frame of run b with a frame of run a is a vote for the transform between
their parent frames. Votes are compared where their frames are, never at the origin of b: a degree
is nothing there, and metres at an origin far away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.rigid import distinct, nearest_rotation, rotation_angle
from sceneprint.types import Floats


@dataclass(frozen=True, eq=False)
class Votes:
    """What associations say of two parent frames.

    Parameters
    ----------
    transforms : (n, 4, 4) T_a_b
    views : (n, 4, 4) T_b_source, where the frame of each was
    source, target : (n,) its frames in b and in a
    weights : (n,) positive
    """

    transforms: Floats
    views: Floats
    source: NDArray[np.int64]
    target: NDArray[np.int64]
    weights: Floats

    @property
    def places(self) -> Floats:
        """Where the frame of each was, (n, 3) metres in b."""
        places: Floats = self.views[:, :3, 3]
        return places


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
    return Votes(whole, source_poses, source, target, weights)


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
    most_drift: float = 0.2  #: of a way of any length, beyond which its edge is not supported
    reach_m: float = 1.0  #: longest way along either run, metres; past it odometry says nothing
    reach_rad: float = math.radians(60.0)
    view_m: float = 0.1  #: frames of a run that are nearer than this were taken from one viewpoint
    view_rad: float = math.radians(6.0)  #: unless they are turned by more than this
    most_loops: int = 4_000_000  #: that are held; the reach is shortened until there are no more

    def scaled(self, scale: float) -> CycleParameters:
        """Return these numbers with all lengths multiplied by `scale`."""
        lengths = {name: scale * getattr(self, name) for name in ("close_m", "reach_m", "view_m")}
        return replace(self, **lengths)


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
    supported : (n,) kept, one of those that close has an edge of another viewpoint, and the
        odometry of one run does not contradict it
    """

    kept: NDArray[np.bool_]
    loops: Ints64
    closed: Ints64
    supported: NDArray[np.bool_]


def verdicts(
    edges: LoopEdges, source: RobotPath, target: RobotPath, p: CycleParameters | None = None,
    *, within_run: bool = False,
) -> Verdicts:  # fmt: skip
    """Take edges out, the most outvoted first, until none is outvoted.

    Parameters
    ----------
    source, target : the runs of their frames; the same one twice for loop closures
    within_run : whether both are the same run
    """
    p = p or CycleParameters()
    firsts, seconds, closing, elsewhere = _loops(edges, source, target, p)
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
    telling = np.concatenate([closing & elsewhere] * 2)
    supported = kept & (np.bincount(both, kept[others] & telling, n) > 0)
    if within_run:
        supported &= _drifted_so_far(edges, source, p)
    return Verdicts(kept, loops, closed, supported)


def _drifted_so_far(edges: LoopEdges, run: RobotPath, p: CycleParameters) -> NDArray[np.bool_]:
    """Which edges of a run lie as near its odometry as the way between their frames allows."""
    here, there = run.poses[edges.source], run.poses[edges.target]
    # where the run has the source, and where the edge puts it, in the run's frame
    put = there @ edges.transforms
    metres = np.linalg.norm(put[:, :3, 3] - here[:, :3, 3], axis=1)
    cosines = (np.einsum("nij,nij->n", put[:, :3, :3], here[:, :3, :3]) - 1.0) / 2.0
    way = np.abs(run.metres[edges.source] - run.metres[edges.target])
    turn = np.abs(run.radians[edges.source] - run.radians[edges.target])
    most = np.minimum(p.close_rad + p.most_drift * turn, math.pi)
    near = (metres <= p.close_m + p.most_drift * way) & (cosines >= np.cos(most))
    allowed: NDArray[np.bool_] = near | (way >= _BROKEN)
    return allowed


def _loops(
    edges: LoopEdges, source: RobotPath, target: RobotPath, p: CycleParameters
) -> tuple[Ints64, Ints64, NDArray[np.bool_], NDArray[np.bool_]]:
    """Pairs of edges near each other on both runs, which of them close, and which are of two
    viewpoints on either run.
    """
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
    elsewhere = _are_elsewhere(here, firsts, seconds, p) | _are_elsewhere(there, firsts, seconds, p)
    return firsts, seconds, closing, elsewhere


def _are_elsewhere(
    poses: Floats, firsts: Ints64, seconds: Ints64, p: CycleParameters
) -> NDArray[np.bool_]:
    """Which pairs of poses (n, 4, 4) are two viewpoints."""
    a, b = poses[firsts], poses[seconds]
    metres = np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1)
    cosines = (np.einsum("nij,nij->n", a[:, :3, :3], b[:, :3, :3]) - 1.0) / 2.0
    apart: NDArray[np.bool_] = (metres > p.view_m) | (cosines < math.cos(p.view_rad))
    return apart


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


# The transform that most associations of two runs agree on.

Strength = Literal["strong", "weak"]


@dataclass(frozen=True)
class JoiningParameters:
    """Which votes agree, and how many must."""

    agree_m: float = 0.2  #: of a vote's place under the transform, metres
    agree_rad: float = math.radians(6.0)
    sigma_m: float = 0.04  #: of a single vote, metres: what its place counts
    sigma_rad: float = math.radians(1.2)  #: and its rotation
    hypotheses: int = 300  #: votes that are tried as the transform, at most
    rounds: int = 8  #: of fitting again to the votes that agree
    least_votes: int = 3  #: that agree
    least_frames: int = 2  #: of either run, that these are of
    view_m: float = 0.1  #: and they were not all taken within this of one another, metres
    view_rad: float = math.radians(6.0)  #: or they are turned by more than this
    rival: float = 0.5  #: share of the support from which on another transform leaves it open
    strong_votes: int = 10
    strong_frames: int = 5
    strong_share: float = 0.5  #: of all votes
    strong_extent_m: float = 1.0  #: that they reach over: at one place all may be wrong alike


@dataclass(frozen=True, eq=False)
class SessionJoin:
    """The transform that most votes agree on.

    Parameters
    ----------
    T : (4, 4) T_a_b; None where too few agree, or another has nearly as many
    agree : (n,) which votes agree with it, or with the best there is
    spread_m, spread_rad : root mean square of what they differ by, where their frames are
    rival : votes for the best other transform, among those that do not agree
    strength : strong, or weak where few agree; None without a transform
    reason : a short sentence
    """

    T: Floats | None
    agree: NDArray[np.bool_]
    spread_m: float
    spread_rad: float
    rival: int
    strength: Strength | None
    reason: str

    @property
    def support(self) -> int:
        """How many votes agree."""
        return int(self.agree.sum())


def join(votes: Votes, seed: int = 0, p: JoiningParameters | None = None) -> SessionJoin:
    """The transform with the heaviest support, fitted to all votes that agree with it.

    Each vote is tried as the transform (of many, `hypotheses` of them by lot), and the one that
    most agree with is fitted again to these until the rounds are over. Votes of one frame count
    as one between them, so that a frame that was found often does not outweigh the rest.

    Parameters
    ----------
    votes : see Votes; at least one
    seed : of the lot, 0 or more

    Raises
    ------
    ValueError : no votes.
    """
    p = p or JoiningParameters()
    n = len(votes.transforms)
    if n == 0:
        raise ValueError("nothing votes")
    weights = votes.weights / np.bincount(votes.source)[votes.source]
    every = np.ones(n, np.bool_)
    best = _best(votes, weights, _sampled_votes(np.arange(n), seed, p), every, p)
    T, agree = _fitted(votes, weights, votes.transforms[best], p)
    others, rivals = ~agree, np.zeros(n, np.bool_)
    if others.any():
        second = _best(votes, weights, _sampled_votes(np.flatnonzero(others), seed, p), others, p)
        rivals = _agreeing(votes, votes.transforms[second], p) & others
    strength, reason = _belief(votes, weights, agree, rivals, p)
    metres, radians = _apart(votes, T)
    return SessionJoin(
        None if strength is None else T,
        agree,
        math.sqrt(float((metres[agree] ** 2).mean())),
        math.sqrt(float((radians[agree] ** 2).mean())),
        int(rivals.sum()),
        strength,
        reason,
    )


def _belief(
    votes: Votes, weights: Floats, agree: NDArray[np.bool_], rivals: NDArray[np.bool_],
    p: JoiningParameters,
) -> tuple[Strength | None, str]:  # fmt: skip
    """How far to believe what some votes agree on, and why."""
    n, support = len(agree), int(agree.sum())
    frames = min(len(np.unique(each[agree])) for each in (votes.source, votes.target))
    told = f"{support} of {n} associations agree"
    if support < p.least_votes or frames < p.least_frames:
        return None, (
            f"{told}, of {frames} frames: {p.least_votes} of {p.least_frames} frames of either "
            "are needed"
        )
    if len(distinct(votes.views[agree], np.zeros(support), p.view_m, p.view_rad, 2)) < 2:
        return None, f"{told}, all of one viewpoint: nothing from elsewhere supports them"
    if weights[rivals].sum() >= p.rival * weights[agree].sum():
        return None, f"{told}, and {int(rivals.sum())} on another transform"
    if frames < p.strong_frames or support < max(p.strong_votes, p.strong_share * n):
        return "weak", told
    extent = float(np.linalg.norm(np.ptp(votes.places[agree], axis=0)))
    if extent < p.strong_extent_m:
        return "weak", f"{told}, all within {extent:.2f} m"
    return "strong", told


def _sampled_votes(among: NDArray[np.intp], seed: int, p: JoiningParameters) -> NDArray[np.intp]:
    """All of them, or as many by lot as are tried."""
    if len(among) <= p.hypotheses:
        return among
    rng = np.random.default_rng(seed)
    return np.sort(rng.choice(among, p.hypotheses, replace=False))


def _apart(votes: Votes, T: Floats) -> tuple[Floats, Floats]:
    """By how much each vote differs from a transform, at its place."""
    shifts = np.einsum("nij,nj->ni", votes.transforms[:, :3, :3] - T[:3, :3], votes.places)
    shifts += votes.transforms[:, :3, 3] - T[:3, 3]
    return np.linalg.norm(shifts, axis=1), np.linalg.norm(_turns(votes, T), axis=1)


def _turns(votes: Votes, T: Floats) -> Floats:
    """(n, 3) rotation vectors from a transform to each vote, in frame a."""
    D = votes.transforms[:, :3, :3] @ T[:3, :3].T
    axes = np.stack([D[:, 2, 1] - D[:, 1, 2], D[:, 0, 2] - D[:, 2, 0], D[:, 1, 0] - D[:, 0, 1]], 1)
    sines = np.linalg.norm(axes, axis=1)
    angles = np.arctan2(sines, np.trace(D, axis1=1, axis2=2) - 1.0)
    # near a half turn the axis is lost, and nothing that far off is fitted to
    turns: Floats = axes * np.where(sines > 1e-9, angles / np.maximum(sines, 1e-9), 0.5)[:, None]
    half = (sines <= 1e-9) & (angles > 1.0)
    turns[half] = (math.pi, 0.0, 0.0)
    return turns


def _agreeing(votes: Votes, T: Floats, p: JoiningParameters) -> NDArray[np.bool_]:
    metres, radians = _apart(votes, T)
    agree: NDArray[np.bool_] = (metres <= p.agree_m) & (radians <= p.agree_rad)
    return agree


def _best(
    votes: Votes, weights: Floats, chosen: NDArray[np.intp], among: NDArray[np.bool_],
    p: JoiningParameters,
) -> int:  # fmt: skip
    """Of the chosen votes the one that the heaviest others agree with; the first of equals."""
    support = [
        float(weights[_agreeing(votes, votes.transforms[i], p) & among].sum()) for i in chosen
    ]
    return int(chosen[int(np.argmax(np.round(support, 9)))])


def _fitted(
    votes: Votes, weights: Floats, T: Floats, p: JoiningParameters
) -> tuple[Floats, NDArray[np.bool_]]:
    """A transform fitted to the votes that agree with it, and these."""
    agree = _agreeing(votes, T, p)  # at least the vote that it is of
    for _ in range(p.rounds):
        step = _step(votes, weights * agree, T, p)
        now = _agreeing(votes, step, p)
        if not now.any():  # two that hardly agree may leave their mean to none
            break
        T, agree = step, now
    return T, agree


def _step(votes: Votes, weights: Floats, T: Floats, p: JoiningParameters) -> Floats:
    """One Gauss-Newton step on places and rotations, with Cauchy's weights."""
    said = np.einsum("nij,nj->ni", votes.transforms[:, :3, :3], votes.places)
    said += votes.transforms[:, :3, 3]
    put = votes.places @ T[:3, :3].T + T[:3, 3]
    shifts, turns = said - put, _turns(votes, T)
    scaled = (shifts**2).sum(1) / p.sigma_m**2 + (turns**2).sum(1) / p.sigma_rad**2
    w = weights / (1.0 + scaled / 6.0)
    middle = (w[:, None] * put).sum(0) / w.sum()
    # x moves by omega x (x - middle) + tau
    J = np.zeros((len(put), 3, 6))
    x, y, z = (put - middle).T
    J[:, 0, 1], J[:, 0, 2] = z, -y
    J[:, 1, 0], J[:, 1, 2] = -z, x
    J[:, 2, 0], J[:, 2, 1] = y, -x
    J[:, :, 3:] = np.eye(3)
    A = np.einsum("n,nki,nkj->ij", w / p.sigma_m**2, J, J)
    b = np.einsum("n,nki,nk->i", w / p.sigma_m**2, J, shifts)
    A[:3, :3] += np.eye(3) * w.sum() / p.sigma_rad**2
    b[:3] += (w[:, None] * turns).sum(0) / p.sigma_rad**2
    step = np.linalg.solve(A, b)
    result = np.eye(4)
    result[:3, :3] = nearest_rotation((np.eye(3) + _cross(step[:3])) @ T[:3, :3])
    turned = result[:3, :3] @ T[:3, :3].T
    result[:3, 3] = turned @ (T[:3, 3] - middle) + middle + step[3:]
    return result


def _cross(v: Floats) -> Floats:
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
