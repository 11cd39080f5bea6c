"""How two runs lie to each other: the transform that most of their associations agree on.

votes T_a_b, each at its place  --join-->  Join

Each association of a frame of run b with a frame of run a is a vote for the transform between
their parent frames. Votes are compared where their frames are, never at the origin of b: a degree
is nothing there, and metres at an origin far away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.pose.loop_consistency import Votes
from sceneprint.geometry.pose.rigid import nearest_rotation
from sceneprint.types import Floats

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
    p : see JoiningParameters

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
