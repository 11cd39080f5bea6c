"""Verification of associations between two runs by loops, and the transform between the runs.

edges, paths of both runs  --judge_edges-->  EdgeVerdicts
votes T_a_b with positions  --join_sessions-->  SessionJoin

An edge is an association of two frames; a wrong one may align them perfectly. Two nearby edges form
a loop with the odometry between their frames; if the loop does not close, one of the edges is
wrong. Loops use odometry over short distances only, so drift is negligible, and the runs need no
common origin (pairwise consistency: Mangelson et al., ICRA 2018, with the odometry's uncertainty as
a tolerance).

Edges from the same viewpoint have the same errors. Therefore, an edge is supported only if it
closes a loop with an edge from another viewpoint in at least one of the runs. Loops cannot
distinguish the sides of a symmetric object, because all wrong edges err by the same rotation.
Therefore, an edge within one run is unsupported if it deviates from the odometry by more than the
maximum drift.

An association of a frame of run b with a frame of run a is a vote for the transform between their
parent frames. Votes are compared at the positions of their frames, because one degree moves a
distant origin by metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.rigid import nearest_rotation, rotation_angle, select_distinct
from sceneprint.types import Floats


@dataclass(frozen=True, eq=False)
class Votes:
    """Votes for the transform between two parent frames, one per association.

    Parameters
    ----------
    transforms : (n, 4, 4) T_a_b
    views : (n, 4, 4) T_b_source, poses of the source frames
    source, target : (n,) identifiers of the frames of b and of a
    weights : (n,) positive weights
    """

    transforms: Floats
    views: Floats
    source: NDArray[np.int64]
    target: NDArray[np.int64]
    weights: Floats

    @property
    def places(self) -> Floats:
        """Return the positions of the source frames, (n, 3) metres in b."""
        places: Floats = self.views[:, :3, 3]
        return places


def association_votes(
    transforms: Floats, source_poses: Floats, target_poses: Floats,
    source: NDArray[np.int64], target: NDArray[np.int64], weights: Floats,
) -> Votes:  # fmt: skip
    """Convert associations to votes.

    Parameters
    ----------
    transforms : (n, 4, 4) T_target_source
    source_poses, target_poses : (n, 4, 4) T_b_source, T_a_target
    source, target, weights : fields of Votes
    """
    R = source_poses[:, :3, :3].transpose(0, 2, 1)
    votes = np.zeros_like(transforms)
    in_a = target_poses @ transforms
    votes[:, :3, :3] = in_a[:, :3, :3] @ R
    places = source_poses[:, :3, 3]
    votes[:, :3, 3] = in_a[:, :3, 3] - np.einsum("nij,nj->ni", votes[:, :3, :3], places)
    votes[:, 3, 3] = 1.0
    return Votes(votes, source_poses, source, target, weights)


Ints64 = NDArray[np.int64]

#: Path length added for a gap in odometry, metres; it is longer than any loop.
_GAP_M = 1e6


@dataclass(frozen=True, eq=False)
class RobotPath:
    """The path of a robot, with a pose per frame.

    Parameters
    ----------
    poses : (m, 4, 4) T_parent_sensor; NaN if unknown
    metres, radians : (m,) path length up to each frame, with _GAP_M added at each gap in odometry;
        `metres` is NaN for frames without a pose
    """

    poses: Floats
    metres: Floats
    radians: Floats


def robot_path(poses: Floats, parents: Ints64) -> RobotPath:
    """Compute the path of a run.

    Parameters
    ----------
    poses : (m, 4, 4) T_parent_sensor in chronological order; NaN if unknown
    parents : (m,) identifiers of the parent frames; odometry has a gap at each change
    """
    posed = np.isfinite(poses).all(axis=(1, 2))
    metres, radians = np.zeros(len(poses)), np.zeros(len(poses))
    last, far_m, far_rad = -1, 0.0, 0.0
    for i in np.flatnonzero(posed).tolist():
        if last >= 0 and parents[i] == parents[last]:
            far_m += float(np.linalg.norm(poses[i, :3, 3] - poses[last, :3, 3]))
            far_rad += rotation_angle(poses[i, :3, :3] @ poses[last, :3, :3].T)
        elif last >= 0:
            far_m += _GAP_M
        metres[i], radians[i], last = far_m, far_rad, i
    metres[~posed] = np.nan
    return RobotPath(poses, metres, radians)


@dataclass(frozen=True)
class CycleParameters:
    """Tolerances within which a loop of two edges closes."""

    close_m: float = 0.07  #: maximum residual of a loop of length zero, metres
    close_rad: float = math.radians(4.0)  #: maximum residual of a loop of length zero, radians
    drift: float = 0.05  #: drift of odometry within a loop, metres per metre, radians per radian
    most_drift: float = 0.2  #: maximum plausible drift between two frames of a run
    reach_m: float = 1.0  #: maximum path length between the edges of a loop, metres
    reach_rad: float = math.radians(60.0)  #: maximum rotation between the edges of a loop, radians
    view_m: float = 0.1  #: maximum distance between two frames of a viewpoint, metres
    view_rad: float = math.radians(6.0)  #: maximum angle between two frames of a viewpoint, radians
    most_loops: int = 4_000_000  #: maximum number of loops; the reach is halved if there are more

    def scaled(self, scale: float) -> CycleParameters:
        """Return these parameters with all lengths multiplied by `scale`."""
        lengths = {name: scale * getattr(self, name) for name in ("close_m", "reach_m", "view_m")}
        return replace(self, **lengths)


@dataclass(frozen=True, eq=False)
class LoopEdges:
    """Associations of the frames of a run with frames of another run, or of the same run.

    Parameters
    ----------
    source, target : (n,) indices of the frames in their runs
    transforms : (n, 4, 4) T_target_source
    weights : (n,) positive weights
    """

    source: Ints64
    target: Ints64
    transforms: Floats
    weights: Floats

    def __len__(self) -> int:
        return len(self.source)


@dataclass(frozen=True, eq=False)
class EdgeVerdicts:
    """The evidence from loops for each edge.

    Parameters
    ----------
    accepted : (n,) mask of the edges that other edges do not outvote
    loops : (n,) number of loops that the edge forms with accepted edges; 0 if it could not be
        checked
    closed : (n,) number of these loops that close
    supported : (n,) mask of the accepted edges that close a loop with an edge from another
        viewpoint and, within one run, agree with its odometry
    """

    accepted: NDArray[np.bool_]
    loops: Ints64
    closed: Ints64
    supported: NDArray[np.bool_]


def judge_edges(
    edges: LoopEdges, source: RobotPath, target: RobotPath, p: CycleParameters | None = None,
    *, within_run: bool = False,
) -> EdgeVerdicts:  # fmt: skip
    """Reject the most outvoted edge until no edge is outvoted; return the verdicts on all edges.

    Parameters
    ----------
    source, target : paths of the runs of the source and target frames; for loop closures, the same
        path twice
    within_run : whether `source` and `target` are the same run
    """
    p = p or CycleParameters()
    firsts, seconds, closing, elsewhere = _loops(edges, source, target, p)
    n = len(edges)
    both = np.concatenate([firsts, seconds])
    others = np.concatenate([seconds, firsts])
    twice = np.concatenate([closing, closing])
    order = np.argsort(both, kind="stable")
    starts = np.searchsorted(both[order], np.arange(n + 1))
    accepted = np.ones(n, np.bool_)
    _outvote(starts, others[order], twice[order], edges.weights, accepted)
    loops = np.bincount(both, accepted[others], n).astype(np.int64)
    closed = np.bincount(both, accepted[others] & twice, n).astype(np.int64)
    independent = np.concatenate([closing & elsewhere] * 2)
    supported = accepted & (np.bincount(both, accepted[others] & independent, n) > 0)
    if within_run:
        supported &= _match_odometry(edges, source, p)
    return EdgeVerdicts(accepted, loops, closed, supported)


def _match_odometry(edges: LoopEdges, run: RobotPath, p: CycleParameters) -> NDArray[np.bool_]:
    """Return a mask (n,) of the edges that the odometry of the run does not contradict."""
    here, there = run.poses[edges.source], run.poses[edges.target]
    predicted = there @ edges.transforms  # pose of the source frame that the edge implies
    metres = np.linalg.norm(predicted[:, :3, 3] - here[:, :3, 3], axis=1)
    cosines = (np.einsum("nij,nij->n", predicted[:, :3, :3], here[:, :3, :3]) - 1.0) / 2.0
    way = np.abs(run.metres[edges.source] - run.metres[edges.target])
    turn = np.abs(run.radians[edges.source] - run.radians[edges.target])
    most = np.minimum(p.close_rad + p.most_drift * turn, math.pi)
    near = (metres <= p.close_m + p.most_drift * way) & (cosines >= np.cos(most))
    allowed: NDArray[np.bool_] = near | (way >= _GAP_M)
    return allowed


def _loops(
    edges: LoopEdges, source: RobotPath, target: RobotPath, p: CycleParameters
) -> tuple[Ints64, Ints64, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return pairs (i, j) of edges that form loops, a mask of the pairs whose loop closes, and a
    mask of the pairs whose viewpoints differ in at least one run. Edges form a loop if they are
    within the reach of `p`, which is halved until there are at most `p.most_loops`.
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
        count = _count_pairs(ways, limits)
        if count <= p.most_loops:
            break
        shorter /= 2.0
    firsts, seconds = np.empty(count, np.int64), np.empty(count, np.int64)
    closing = np.empty(count, np.bool_)
    here = np.ascontiguousarray(source.poses[edges.source])
    there = np.ascontiguousarray(target.poses[edges.target])
    numbers = np.array([p.close_m, p.close_rad, p.drift])
    _write_loops(
        ways, limits, here, there, np.ascontiguousarray(edges.transforms), numbers,
        firsts, seconds, closing,
    )  # fmt: skip
    elsewhere = _are_elsewhere(here, firsts, seconds, p) | _are_elsewhere(there, firsts, seconds, p)
    return firsts, seconds, closing, elsewhere


def _are_elsewhere(
    poses: Floats, firsts: Ints64, seconds: Ints64, p: CycleParameters
) -> NDArray[np.bool_]:
    """Return a mask (M,) of the index pairs of poses (n, 4, 4) with different viewpoints."""
    a, b = poses[firsts], poses[seconds]
    metres = np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1)
    cosines = (np.einsum("nij,nij->n", a[:, :3, :3], b[:, :3, :3]) - 1.0) / 2.0
    apart: NDArray[np.bool_] = (metres > p.view_m) | (cosines < math.cos(p.view_rad))
    return apart


@kernel
def _are_near(ways: Floats, i: int, j: int, limits: Floats) -> bool:
    # NaN fails these comparisons, so frames without a pose form no loops
    near: bool = (
        abs(ways[i, 0] - ways[j, 0]) <= limits[0]
        and abs(ways[i, 1] - ways[j, 1]) <= limits[1]
        and abs(ways[i, 2] - ways[j, 2]) <= limits[0]
        and abs(ways[i, 3] - ways[j, 3]) <= limits[1]
    )
    return near


@kernel
def _count_pairs(ways: Floats, limits: Floats) -> int:
    count = 0
    for i in range(len(ways)):
        for j in range(i + 1, len(ways)):
            count += _are_near(ways, i, j, limits)
    return count


@kernel
def _loop_residual(
    here: Floats, there: Floats, transforms: Floats, i: int, j: int
) -> tuple[float, float]:
    """Return the residual (metres, radians) of the loop of edges i and j at the source of j."""
    # each edge predicts the position of j's source frame in the target's parent frame
    R, t = np.zeros((2, 3, 3)), np.zeros((2, 3))
    for k in range(2):
        e = i if k == 0 else j
        # (M, m) is T_parent_target T_target_source
        M, m = np.zeros((3, 3)), np.zeros(3)
        for a in range(3):
            m[a] = there[e, a, 3]
            for b in range(3):
                m[a] += there[e, a, b] * transforms[e, b, 3]
                for c in range(3):
                    M[a, b] += there[e, a, c] * transforms[e, c, b]
        # R is M times the rotation of T_source_parent
        for a in range(3):
            for b in range(3):
                for c in range(3):
                    R[k, a, b] += M[a, c] * here[e, b, c]
        # t is the predicted position
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
def _write_loops(
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
            left_m, left_rad = _loop_residual(here, there, transforms, i, j)
            back_m, _ = _loop_residual(here, there, transforms, j, i)
            firsts[at], seconds[at] = i, j
            closing[at] = (
                max(left_m, back_m) <= numbers[0] + numbers[2] * metres
                and left_rad <= numbers[1] + numbers[2] * radians
            )
            at += 1


@kernel
def _outvote(
    starts: Ints64, others: Ints64, closing: NDArray[np.bool_], weights: Floats,
    accepted: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Reject the most outvoted edge until no edge has more weight against it than for it."""
    n = len(accepted)
    against = np.zeros(n)
    for i in range(n):
        for k in range(starts[i], starts[i + 1]):
            against[i] += -weights[others[k]] if closing[k] else weights[others[k]]
    while True:
        worst, most = -1, 0.0
        for i in range(n):
            if accepted[i] and against[i] > most:
                worst, most = i, against[i]
        if worst < 0:
            return
        accepted[worst] = False
        for k in range(starts[worst], starts[worst + 1]):
            against[others[k]] -= -weights[worst] if closing[k] else weights[worst]


Strength = Literal["strong", "weak"]


@dataclass(frozen=True)
class JoiningParameters:
    """Tolerances within which votes agree, and the agreement that a join requires."""

    agree_m: float = 0.2  #: maximum difference at a vote's position, metres
    agree_rad: float = math.radians(6.0)  #: maximum difference in rotation, radians
    sigma_m: float = 0.04  #: standard deviation of a vote's position, metres
    sigma_rad: float = math.radians(1.2)  #: standard deviation of a vote's rotation, radians
    hypotheses: int = 300  #: maximum number of votes that are tried as the transform
    rounds: int = 8  #: number of iterations of the fit
    least_votes: int = 3  #: minimum number of agreeing votes
    least_frames: int = 2  #: minimum number of frames of the agreeing votes, in each run
    view_m: float = 0.1  #: maximum distance between two frames of a viewpoint, metres
    view_rad: float = math.radians(6.0)  #: maximum angle between two frames of a viewpoint, radians
    rival: float = 0.5  #: minimum support of a rival that prevents a join, as a share of the best
    strong_votes: int = 10  #: minimum number of agreeing votes of a strong join
    strong_frames: int = 5  #: minimum number of their frames in each run
    strong_share: float = 0.5  #: minimum share of agreeing votes among all votes
    strong_extent_m: float = 1.0  #: minimum extent of their frames: a single place may mislead


@dataclass(frozen=True, eq=False)
class SessionJoin:
    """The transform on which most votes agree.

    Parameters
    ----------
    T : (4, 4) T_a_b; None if too few votes agree or another transform has enough support
    agree : (n,) mask of the votes that agree with the best transform, even if it is rejected
    spread_m, spread_rad : root mean square difference between these votes and the best transform at
        their frames, metres and radians
    rival : number of the other votes that agree on the second-best transform
    strength : strong, or weak if few votes agree; None if there is no transform
    reason : short explanation of the result
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
        """Return the number of votes that agree."""
        return int(self.agree.sum())


def join_sessions(votes: Votes, seed: int = 0, p: JoiningParameters | None = None) -> SessionJoin:
    """Estimate the transform with the largest support, fitted to the votes that agree with it.

    Each vote (or, if there are more than `hypotheses`, each of a random sample of that size) is
    tried as the transform, and the best is refitted to the votes that agree with it. The weight of
    each vote is divided by the number of votes of its frame, so that a frame with many matches does
    not outweigh other frames.

    Parameters
    ----------
    votes : at least one vote
    seed : non-negative seed of the sample

    Raises
    ------
    ValueError : If there are no votes
    """
    p = p or JoiningParameters()
    n = len(votes.transforms)
    if n == 0:
        raise ValueError("There are no votes. Pass at least one vote.")
    weights = votes.weights / np.bincount(votes.source)[votes.source]
    every_vote = np.ones(n, np.bool_)
    best = _best_vote(votes, weights, _sample(np.arange(n), seed, p), every_vote, p)
    T, agree = _fit_transform(votes, weights, votes.transforms[best], p)
    others, rivals = ~agree, np.zeros(n, np.bool_)
    if others.any():
        second = _best_vote(votes, weights, _sample(np.flatnonzero(others), seed, p), others, p)
        rivals = _agreement_mask(votes, votes.transforms[second], p) & others
    strength, reason = _join_strength(votes, weights, agree, rivals, p)
    metres, radians = _differences(votes, T)
    return SessionJoin(
        None if strength is None else T,
        agree,
        math.sqrt(float((metres[agree] ** 2).mean())),
        math.sqrt(float((radians[agree] ** 2).mean())),
        int(rivals.sum()),
        strength,
        reason,
    )


def _join_strength(
    votes: Votes, weights: Floats, agree: NDArray[np.bool_], rivals: NDArray[np.bool_],
    p: JoiningParameters,
) -> tuple[Strength | None, str]:  # fmt: skip
    """Return the strength of a join (None if it is rejected) and the reason."""
    n, support = len(agree), int(agree.sum())
    frames = min(len(np.unique(identifiers[agree])) for identifiers in (votes.source, votes.target))
    reason = f"{support} of {n} associations agree"
    if support < p.least_votes or frames < p.least_frames:
        return None, (
            f"{reason}, from {frames} frames: at least {p.least_votes} from {p.least_frames} "
            "frames of either session are required"
        )
    if len(select_distinct(votes.views[agree], np.zeros(support), p.view_m, p.view_rad, 2)) < 2:
        return None, f"{reason}, all from one viewpoint: another viewpoint must support them"
    if weights[rivals].sum() >= p.rival * weights[agree].sum():
        return None, f"{reason}, and {int(rivals.sum())} on another transform"
    if frames < p.strong_frames or support < max(p.strong_votes, p.strong_share * n):
        return "weak", reason
    extent = float(np.linalg.norm(np.ptp(votes.places[agree], axis=0)))
    if extent < p.strong_extent_m:
        return "weak", f"{reason}, all within {extent:.2f} m"
    return "strong", reason


def _sample(indices: NDArray[np.intp], seed: int, p: JoiningParameters) -> NDArray[np.intp]:
    """Return all indices, or a random sample of `p.hypotheses` of them."""
    if len(indices) <= p.hypotheses:
        return indices
    rng = np.random.default_rng(seed)
    return np.sort(rng.choice(indices, p.hypotheses, replace=False))


def _differences(votes: Votes, T: Floats) -> tuple[Floats, Floats]:
    """Return the differences (metres, radians) of votes from a transform at their positions."""
    shifts = np.einsum("nij,nj->ni", votes.transforms[:, :3, :3] - T[:3, :3], votes.places)
    shifts += votes.transforms[:, :3, 3] - T[:3, 3]
    return np.linalg.norm(shifts, axis=1), np.linalg.norm(_rotation_vectors(votes, T), axis=1)


def _rotation_vectors(votes: Votes, T: Floats) -> Floats:
    """Return the rotation vectors from a transform to each vote, (n, 3) in frame a."""
    D = votes.transforms[:, :3, :3] @ T[:3, :3].T
    axes = np.stack([D[:, 2, 1] - D[:, 1, 2], D[:, 0, 2] - D[:, 2, 0], D[:, 1, 0] - D[:, 0, 1]], 1)
    sines = np.linalg.norm(axes, axis=1)
    angles = np.arctan2(sines, np.trace(D, axis1=1, axis2=2) - 1.0)
    # near a half turn, the axis is undefined, but votes that far away are not fitted
    turns: Floats = axes * np.where(sines > 1e-9, angles / np.maximum(sines, 1e-9), 0.5)[:, None]
    half = (sines <= 1e-9) & (angles > 1.0)
    turns[half] = (math.pi, 0.0, 0.0)
    return turns


def _agreement_mask(votes: Votes, T: Floats, p: JoiningParameters) -> NDArray[np.bool_]:
    metres, radians = _differences(votes, T)
    agree: NDArray[np.bool_] = (metres <= p.agree_m) & (radians <= p.agree_rad)
    return agree


def _best_vote(
    votes: Votes, weights: Floats, chosen: NDArray[np.intp], among: NDArray[np.bool_],
    p: JoiningParameters,
) -> int:  # fmt: skip
    """Return the vote of `chosen` whose agreeing votes have the largest weight; ties by order."""
    support = [
        float(weights[_agreement_mask(votes, votes.transforms[i], p) & among].sum()) for i in chosen
    ]
    return int(chosen[int(np.argmax(np.round(support, 9)))])


def _fit_transform(
    votes: Votes, weights: Floats, T: Floats, p: JoiningParameters
) -> tuple[Floats, NDArray[np.bool_]]:
    """Fit a transform to the votes that agree with it; return the result and their mask."""
    agree = _agreement_mask(votes, T, p)
    for _ in range(p.rounds):
        step = _improve(votes, weights * agree, T, p)
        now = _agreement_mask(votes, step, p)
        if not now.any():  # the mean of two distant votes may agree with no vote
            break
        T, agree = step, now
    return T, agree


def _improve(votes: Votes, weights: Floats, T: Floats, p: JoiningParameters) -> Floats:
    """Improve T by a Gauss-Newton step on positions and rotations, with Cauchy weights."""
    voted = np.einsum("nij,nj->ni", votes.transforms[:, :3, :3], votes.places)
    voted += votes.transforms[:, :3, 3]
    places = votes.places @ T[:3, :3].T + T[:3, 3]
    shifts, turns = voted - places, _rotation_vectors(votes, T)
    scaled = (shifts**2).sum(1) / p.sigma_m**2 + (turns**2).sum(1) / p.sigma_rad**2
    w = weights / (1.0 + scaled / 6.0)
    middle = (w[:, None] * places).sum(0) / w.sum()
    # the step (omega, tau) moves a position x by omega x (x - middle) + tau
    J = np.zeros((len(places), 3, 6))
    x, y, z = (places - middle).T
    J[:, 0, 1], J[:, 0, 2] = z, -y
    J[:, 1, 0], J[:, 1, 2] = -z, x
    J[:, 2, 0], J[:, 2, 1] = y, -x
    J[:, :, 3:] = np.eye(3)
    A = np.einsum("n,nki,nkj->ij", w / p.sigma_m**2, J, J)
    b = np.einsum("n,nki,nk->i", w / p.sigma_m**2, J, shifts)
    A[:3, :3] += np.eye(3) * w.sum() / p.sigma_rad**2
    b[:3] += (w[:, None] * turns).sum(0) / p.sigma_rad**2
    step = np.linalg.solve(A, b)
    a, b, c = step[:3]
    result = np.eye(4)
    cross = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
    result[:3, :3] = nearest_rotation((np.eye(3) + cross) @ T[:3, :3])
    turn = result[:3, :3] @ T[:3, :3].T
    result[:3, 3] = turn @ (T[:3, 3] - middle) + middle + step[3:]
    return result
