"""Rigid transforms as (4, 4) matrices: to move, to invert, to compare, to fit, to average.

poses (n, 4, 4)  --average_poses-->  PoseAverage
directions (n, 3)  --mean_direction-->  (3,)

x_b = T_b_a @ x_a. Translations in metres, angles in radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.types import Floats, Ints64


def inverse(T: Floats) -> Floats:
    """T_a_b of T_b_a, exact for a rigid transform: (4, 4)."""
    result = np.eye(4)
    result[:3, :3] = T[:3, :3].T
    result[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return result


def inverses(transforms: Floats) -> Floats:
    """The inverse of each of (n, 4, 4) rigid transforms."""
    result = np.zeros_like(transforms)
    result[:, :3, :3] = transforms[:, :3, :3].transpose(0, 2, 1)
    result[:, :3, 3] = -np.einsum("nij,nj->ni", result[:, :3, :3], transforms[:, :3, 3])
    result[:, 3, 3] = 1.0
    return result


def moved(T: Floats, points: Floats) -> Floats:
    """Points (n, 3) of frame a, in frame b, by T_b_a."""
    result: Floats = points @ T[:3, :3].T + T[:3, 3]
    return result


def rotation_angle(R: Floats) -> float:
    """||log R||, the angle of a rotation (3, 3), in [0, pi]."""
    # by atan2 rather than acos: exact for angles near 0 as well
    sine = math.sqrt((R[2, 1] - R[1, 2]) ** 2 + (R[0, 2] - R[2, 0]) ** 2 + (R[1, 0] - R[0, 1]) ** 2)
    return math.atan2(sine, float(R[0, 0] + R[1, 1] + R[2, 2] - 1.0))


def difference(a: Floats, b: Floats) -> tuple[float, float]:
    """How far apart two transforms between the same two frames are.

    Returns
    -------
    metres between where they put the origin of the source frame, and radians between their
    rotations
    """
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), rotation_angle(a[:3, :3] @ b[:3, :3].T)


def are_near(transforms: Floats, T: Floats, metres: float, radians: float) -> NDArray[np.bool_]:
    """Which of some transforms (n, 4, 4) are no farther than that from T in both, (n,)."""
    apart = np.linalg.norm(transforms[:, :3, 3] - T[:3, 3], axis=1)
    cosines = (np.einsum("nij,ij->n", transforms[:, :3, :3], T[:3, :3]) - 1.0) / 2.0
    found: NDArray[np.bool_] = (apart <= metres) & (cosines >= math.cos(radians))
    return found


def distinct(
    transforms: Floats, scores: Floats, metres: float, radians: float, most: int
) -> list[int]:
    """Indices of the best few transforms (n, 4, 4) that differ from each other, best first.

    Parameters
    ----------
    transforms, scores : one for one, greater is better
    metres, radians : two that are nearer than both are one
    most : of them
    """
    order = np.argsort(-scores, kind="stable")
    chosen = np.empty(min(most, len(order)), np.int64)
    found = _choose(np.ascontiguousarray(transforms), order, metres, math.cos(radians), chosen)
    kept: list[int] = chosen[:found].tolist()
    return kept


@kernel
def _choose(
    transforms: Floats, order: Ints64, metres: float, cosine: float, chosen: Ints64
) -> int:  # fmt: skip
    """Those in an order that are near none chosen before, as `are_near` has it; how many."""
    found = 0
    for i in order:
        if found == len(chosen):
            break
        T, distinct = transforms[i], True
        for k in range(found):
            U = transforms[chosen[k]]
            square, trace = 0.0, 0.0
            for a in range(3):
                square += (T[a, 3] - U[a, 3]) ** 2
                for b in range(3):
                    trace += T[a, b] * U[a, b]
            if np.sqrt(square) <= metres and (trace - 1.0) / 2.0 >= cosine:
                distinct = False
                break
        if distinct:
            chosen[found] = i
            found += 1
    return found


def nearest_rotation(M: Floats) -> Floats:
    """The rotation (3, 3) nearest to a matrix, in the least-squares sense."""
    u, _, vt = np.linalg.svd(M)
    fix = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))])
    result: Floats = u @ fix @ vt
    return result


@kernel
def rotation_of_covariance(H: Floats, R: Floats) -> None:
    """The rotation R (3, 3) that maximises trace(R H^T), for H = sum of b a^T: Horn 1987.

    The unit quaternion is the eigenvector of the largest eigenvalue of a symmetric 4 x 4 matrix,
    found by cyclic Jacobi rotations.
    """
    N = np.empty((4, 4))
    # H[i, j] = sum b_i a_j; Horn's S_xy = sum a_x b_y = H[y, x]
    N[0, 0] = H[0, 0] + H[1, 1] + H[2, 2]
    N[1, 1] = H[0, 0] - H[1, 1] - H[2, 2]
    N[2, 2] = -H[0, 0] + H[1, 1] - H[2, 2]
    N[3, 3] = -H[0, 0] - H[1, 1] + H[2, 2]
    N[0, 1] = H[2, 1] - H[1, 2]
    N[0, 2] = H[0, 2] - H[2, 0]
    N[0, 3] = H[1, 0] - H[0, 1]
    N[1, 2] = H[1, 0] + H[0, 1]
    N[1, 3] = H[0, 2] + H[2, 0]
    N[2, 3] = H[2, 1] + H[1, 2]
    for i in range(4):
        for j in range(i):
            N[i, j] = N[j, i]
    V = np.eye(4)
    for _ in range(8):
        off = 0.0
        for i in range(3):
            for j in range(i + 1, 4):
                off += N[i, j] * N[i, j]
        if off < 1e-24:
            break
        for i in range(3):
            for j in range(i + 1, 4):
                if abs(N[i, j]) < 1e-18:
                    continue
                theta = 0.5 * (N[j, j] - N[i, i]) / N[i, j]
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                if theta < 0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(4):
                    a, b = N[k, i], N[k, j]
                    N[k, i], N[k, j] = c * a - s * b, s * a + c * b
                for k in range(4):
                    a, b = N[i, k], N[j, k]
                    N[i, k], N[j, k] = c * a - s * b, s * a + c * b
                for k in range(4):
                    a, b = V[k, i], V[k, j]
                    V[k, i], V[k, j] = c * a - s * b, s * a + c * b
    best = 0
    for i in range(1, 4):
        if N[i, i] > N[best, best]:
            best = i
    w, x, y, z = V[0, best], V[1, best], V[2, best], V[3, best]
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@kernel
def turned(R: Floats, omega: Floats, result: Floats) -> None:
    """result = exp([omega]x) R, by Rodrigues' formula; omega (3,) radians."""
    angle = np.sqrt(omega[0] ** 2 + omega[1] ** 2 + omega[2] ** 2)
    a, b = 1.0, 0.5  # sin(angle) / angle and (1 - cos(angle)) / angle^2, at 0
    if angle > 1e-9:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / (angle * angle)
    K = np.zeros((3, 3))
    K[0, 1], K[0, 2], K[1, 2] = -omega[2], omega[1], -omega[0]
    K[1, 0], K[2, 0], K[2, 1] = omega[2], -omega[1], omega[0]
    E = np.eye(3)
    for i in range(3):
        for j in range(3):
            square = 0.0
            for k in range(3):
                square += K[i, k] * K[k, j]
            E[i, j] += a * K[i, j] + b * square
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                total += E[i, k] * R[k, j]
            result[i, j] = total


@kernel
def solve_positive(A: Floats, b: Floats, x: Floats) -> bool:
    """Solve A x = b by Cholesky; A (n, n) symmetric is overwritten. False where not positive."""
    n = len(b)
    for j in range(n):
        diagonal = A[j, j]
        for k in range(j):
            diagonal -= A[j, k] * A[j, k]
        if not diagonal > 1e-12:
            return False
        A[j, j] = np.sqrt(diagonal)
        for i in range(j + 1, n):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            A[i, j] = total / A[j, j]
    for i in range(n):
        total = b[i]
        for k in range(i):
            total -= A[i, k] * x[k]
        x[i] = total / A[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= A[k, i] * x[k]
        x[i] = total / A[i, i]
    return True


# Several poses averaged robustly, as the votes of matches.


@dataclass(frozen=True)
class AveragingParameters:
    """Which votes agree."""

    agree_m: float = 0.15  #: with the medoid, metres
    agree_rad: float = math.radians(10.0)


@dataclass(frozen=True, eq=False)
class PoseAverage:
    """The pose that most votes agree on.

    Parameters
    ----------
    T : (4, 4) T_parent_sensor
    spread_m, spread_rad : root mean square difference of the votes that agree from T; 0 where
        there is one
    support : how many votes agree
    votes : how many there were
    members : (support,) which of them agree, rising
    """

    T: Floats
    spread_m: float
    spread_rad: float
    support: int
    votes: int
    members: NDArray[np.intp]


def average_poses(poses: Floats, p: AveragingParameters | None = None) -> PoseAverage:
    """The mean of the votes near their medoid.

    The medoid is the vote with most others near it, and among those with equally many the one to
    which they are nearest; ties fall to the earlier, which ranked higher.

    Parameters
    ----------
    poses : (n, 4, 4) T_parent_sensor of one sensor in one parent frame, best first

    Raises
    ------
    ValueError : no poses, or not (n, 4, 4).
    """
    p = p or AveragingParameters()
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not len(poses):
        raise ValueError(f"poses of shape {poses.shape}, not (n, 4, 4) with n of 1 or more")
    apart = np.array([[difference(a, b) for b in poses] for a in poses])
    # one measure of both: how many tolerances apart
    scaled = np.hypot(apart[..., 0] / p.agree_m, apart[..., 1] / p.agree_rad)
    near = (apart[..., 0] <= p.agree_m) & (apart[..., 1] <= p.agree_rad)
    cost = np.where(near, scaled, 0.0).sum(axis=1)
    medoid = min(range(len(poses)), key=lambda i: (-int(near[i].sum()), float(cost[i]), i))
    members = poses[near[medoid]]
    T = np.eye(4)
    T[:3, :3] = nearest_rotation(members[:, :3, :3].sum(axis=0))
    T[:3, 3] = members[:, :3, 3].mean(axis=0)
    left = np.array([difference(T, one) for one in members])
    metres, radians = np.sqrt((left**2).mean(axis=0)).tolist()
    which = np.flatnonzero(near[medoid])
    return PoseAverage(T, metres, radians, len(members), len(poses), which)


def mean_direction(directions: Floats, within: float) -> Floats | None:
    """The mean of those unit vectors that most of the others are near: (3,), of length 1.

    Parameters
    ----------
    directions : (n, 3)
    within : radians that two may differ by

    Returns
    -------
    direction : or None where there are none, or no more than half of them agree
    """
    near = directions @ directions.T >= math.cos(within)
    agree = near.sum(axis=1)
    if not len(directions) or 2 * int(agree.max()) <= len(directions):
        return None
    mean = directions[near[int(np.argmax(agree))]].sum(axis=0)
    result: Floats = mean / np.linalg.norm(mean)
    return result


# Gravity: the transforms that are left where both frames know which way is up.

#: Unit vectors (3,), up in the coordinates of source and target; None where it is not known.
Ups = tuple[Floats | None, Floats | None]
NO_UPS: Ups = (None, None)


@dataclass(frozen=True)
class GravityParameters:
    """How far transforms may tilt against `up`; the room is for its noise."""

    gate: float = math.radians(15.0)  #: of two patches that correspond, their angles to up
    proposed_tilt: float = math.radians(20.0)  #: most of a hypothesis that is yet to be refined
    refined_tilt: float = math.radians(10.0)  #: most of one that is refined: beyond, `up` is wrong
    rival_tilt: float = math.radians(20.0)  #: from which on a rival is impossible
    floor_tilt: float = math.radians(30.0)  #: within which of `up` a frame's floor is looked for
    floor_stride: int = 7  #: of the pixels that it is looked for among


def tilts(transforms: Floats, ups: Ups) -> Floats:
    """Angles between up carried over by each transform and up as the target has it: (n,) radians.

    Parameters
    ----------
    transforms : (n, 4, 4) T_target_source
    ups : of source and target; 0 for all where one is not known
    """
    source, target = ups
    if source is None or target is None:
        return np.zeros(len(transforms))
    carried = transforms[:, :3, :3] @ source
    across = np.linalg.norm(np.cross(carried, target), axis=1)
    angles: Floats = np.arctan2(across, carried @ target)  # exact near 0, as acos is not
    return angles


def tilt_of(T: Floats | None, ups: Ups) -> float | None:
    """By how much one transform tilts, radians; None where that cannot be said."""
    if T is None or ups[0] is None or ups[1] is None:
        return None
    return float(tilts(T[None], ups)[0])


def are_level(transforms: Floats, ups: Ups, most: float) -> NDArray[np.bool_]:
    """Which transforms tilt by no more than that: all of them where an up is not known."""
    level: NDArray[np.bool_] = tilts(transforms, ups) <= most
    return level


def slopes(normals: Floats, up: Floats) -> Floats:
    """Angles of normals (n, 3) to up: (n,) radians, 0 for floors and pi/2 for walls."""
    angles: Floats = np.arccos(np.clip(normals @ up, -1.0, 1.0))
    return angles
