"""Operations on rigid transforms, as (4, 4) matrices with x_b = T_b_a @ x_a.

Translations are in metres, angles in radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.types import Floats, Ints64


def inverse(T: Floats) -> Floats:
    """Return the inverse (4, 4) of a rigid transform."""
    result, R = np.zeros((4, 4)), T[:3, :3].T
    result[:3, :3] = R
    result[:3, 3] = -R @ T[:3, 3]
    result[3, 3] = 1.0
    return result


def inverses(transforms: Floats) -> Floats:
    """Return the inverses (n, 4, 4) of rigid transforms (n, 4, 4)."""
    result = np.zeros((len(transforms), 4, 4))
    _write_inverses(np.array(transforms, float), result)
    return result


@kernel
def _write_inverses(transforms: Floats, result: Floats) -> None:
    for n in range(len(transforms)):
        for i in range(3):
            for j in range(3):
                result[n, i, j] = transforms[n, j, i]
                result[n, i, 3] -= transforms[n, j, i] * transforms[n, j, 3]
        result[n, 3, 3] = 1.0


def transform_points(T: Floats, points: Floats) -> Floats:
    """Transform points (n, 3) from frame a to frame b; T is T_b_a."""
    result: Floats = points @ T[:3, :3].T + T[:3, 3]
    return result


def rotation_angle(R: Floats) -> float:
    """Return the angle of a rotation (3, 3), in [0, pi] radians."""
    # atan2 is exact for angles near 0, unlike acos
    sine = math.sqrt((R[2, 1] - R[1, 2]) ** 2 + (R[0, 2] - R[2, 0]) ** 2 + (R[1, 0] - R[0, 1]) ** 2)
    return math.atan2(sine, float(R[0, 0] + R[1, 1] + R[2, 2] - 1.0))


def pose_difference(a: Floats, b: Floats) -> tuple[float, float]:
    """Return the difference of two transforms in translation (metres) and rotation (radians)."""
    metres, radians = _pose_differences(a[None], b[None])[0, 0].tolist()
    return metres, radians


def _pose_differences(a: Floats, b: Floats) -> Floats:
    """Return `pose_difference` of all pairs of n and m transforms, (n, m, 2)."""
    apart = np.empty((len(a), len(b), 2))
    _write_differences(np.array(a, float), np.array(b, float), apart)
    return apart


@kernel
def _write_differences(a: Floats, b: Floats, apart: Floats) -> None:
    R = np.empty((3, 3))
    for i in range(len(a)):
        for j in range(len(b)):
            square = 0.0
            for r in range(3):
                square += (a[i, r, 3] - b[j, r, 3]) ** 2
                for c in range(3):
                    R[r, c] = 0.0
                    for k in range(3):
                        R[r, c] += a[i, r, k] * b[j, c, k]
            x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
            sine = np.sqrt(x * x + y * y + z * z)
            apart[i, j, 0] = np.sqrt(square)
            apart[i, j, 1] = math.atan2(sine, R[0, 0] + R[1, 1] + R[2, 2] - 1.0)


def are_near(transforms: Floats, T: Floats, metres: float, radians: float) -> NDArray[np.bool_]:
    """Return a mask (n,) of the transforms (n, 4, 4) within `metres` and `radians` of T."""
    near = np.empty(len(transforms), np.bool_)
    cosine = math.cos(radians)
    # copies, because numba would compile the kernel a second time for read-only arrays
    _mark_near(np.array(transforms, float), np.array(T, float), metres, cosine, near)
    return near


@kernel
def _is_near(T: Floats, U: Floats, metres: float, cosine: float) -> bool:
    """Return whether two transforms are within `metres` and within the angle with this cosine."""
    square, trace = 0.0, 0.0
    for a in range(3):
        square += (T[a, 3] - U[a, 3]) ** 2
        for b in range(3):
            trace += T[a, b] * U[a, b]
    return np.sqrt(square) <= metres and (trace - 1.0) / 2.0 >= cosine


@kernel
def _mark_near(
    transforms: Floats, T: Floats, metres: float, cosine: float, near: NDArray[np.bool_]
) -> None:
    for i in range(len(transforms)):
        near[i] = _is_near(transforms[i], T, metres, cosine)


def select_distinct(
    transforms: Floats, scores: Floats, metres: float, radians: float, most: int
) -> list[int]:
    """Select the best transforms that differ from each other; return their indices, best first.

    Parameters
    ----------
    transforms, scores : (n, 4, 4) and (n,); a higher score is better
    metres, radians : tolerances; a transform within both tolerances of a better one is omitted
    most : maximum number of indices
    """
    order = np.argsort(-scores, kind="stable")
    chosen = np.empty(min(most, len(order)), np.int64)
    count = _select_first(
        np.ascontiguousarray(transforms), order, metres, math.cos(radians), chosen
    )
    indices: list[int] = chosen[:count].tolist()
    return indices


@kernel
def _select_first(
    transforms: Floats, order: Ints64, metres: float, cosine: float, chosen: Ints64
) -> int:  # fmt: skip
    """Write the indices of distinct transforms to `chosen`; return their number."""
    count = 0
    for i in order:
        if count == len(chosen):
            break
        distinct = True
        for k in range(count):
            if _is_near(transforms[i], transforms[chosen[k]], metres, cosine):
                distinct = False
                break
        if distinct:
            chosen[count] = i
            count += 1
    return count


def nearest_rotation(M: Floats) -> Floats:
    """Return the rotation (3, 3) nearest to a matrix in the least-squares sense."""
    result = np.empty((3, 3))
    rotation_of_covariance(np.array(M, float), result)
    return result


@kernel
def rotation_of_covariance(H: Floats, R: Floats) -> None:
    """Write to R the rotation (3, 3) that maximises trace(R H^T), with H = sum b a^T (Horn 1987).

    The quaternion of R is the eigenvector of the largest eigenvalue of a symmetric 4 x 4 matrix,
    computed by cyclic Jacobi rotations.
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
def apply_rotation(R: Floats, omega: Floats, result: Floats) -> None:
    """Write exp([omega]x) R to `result`, by Rodrigues' formula; omega (3,) radians."""
    angle = np.sqrt(omega[0] ** 2 + omega[1] ** 2 + omega[2] ** 2)
    a, b = 1.0, 0.5  # limits of sin(angle) / angle and (1 - cos(angle)) / angle^2 at 0
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
    """Solve A x = b into `x` by Cholesky decomposition; return False if A is not positive definite.

    The symmetric matrix A (n, n) is overwritten.
    """
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


@dataclass(frozen=True)
class AveragingParameters:
    """Tolerances within which a vote agrees with the medoid."""

    agree_m: float = 0.15  #: maximum distance, metres
    agree_rad: float = math.radians(10.0)  #: maximum angle, radians


@dataclass(frozen=True, eq=False)
class PoseAverage:
    """The pose on which most votes agree.

    Parameters
    ----------
    T : (4, 4) T_parent_sensor
    spread_m, spread_rad : root mean square difference between the agreeing votes and T, metres and
        radians
    support : number of votes that agree
    votes : total number of votes
    members : (support,) ascending indices of the votes that agree
    """

    T: Floats
    spread_m: float
    spread_rad: float
    support: int
    votes: int
    members: NDArray[np.intp]


def average_poses(poses: Floats, p: AveragingParameters | None = None) -> PoseAverage:
    """Return the mean of the votes near the medoid.

    The medoid is the vote with the most other votes near it. Ties are resolved by the distances to
    these votes, then by rank.

    Parameters
    ----------
    poses : (n, 4, 4) T_parent_sensor of one sensor in one parent frame, the best pose first

    Raises
    ------
    ValueError : If there are no poses, or they are not (n, 4, 4)
    """
    p = p or AveragingParameters()
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not len(poses):
        raise ValueError(f"poses has shape {poses.shape}. Pass at least one pose, as (n, 4, 4).")
    apart = _pose_differences(poses, poses)
    # dividing by the tolerances makes metres and radians comparable
    scaled = np.hypot(apart[..., 0] / p.agree_m, apart[..., 1] / p.agree_rad)
    near = (apart[..., 0] <= p.agree_m) & (apart[..., 1] <= p.agree_rad)
    cost = np.where(near, scaled, 0.0).sum(axis=1)
    medoid = min(range(len(poses)), key=lambda i: (-int(near[i].sum()), float(cost[i]), i))
    members = poses[near[medoid]]
    T = np.eye(4)
    T[:3, :3] = nearest_rotation(members[:, :3, :3].sum(axis=0))
    T[:3, 3] = members[:, :3, 3].mean(axis=0)
    indices = np.flatnonzero(near[medoid])
    return PoseAverage(T, *pose_spread(T, members), len(members), len(poses), indices)


def pose_spread(T: Floats, poses: Floats) -> tuple[float, float]:
    """Return the root mean square difference of poses (n, 4, 4) from T, metres and radians."""
    differences = _pose_differences(T[None], poses)[0]
    metres, radians = np.sqrt((differences**2).mean(axis=0)).tolist()
    return metres, radians


def mean_direction(directions: Floats, within: float) -> Floats | None:
    """Return the mean (3,), a unit vector, of the largest group of unit vectors that agree.

    Return None if the group does not contain more than half of all vectors.

    Parameters
    ----------
    directions : (n, 3) unit vectors
    within : maximum angle between two vectors that agree, radians
    """
    near = directions @ directions.T >= math.cos(within)
    agree = near.sum(axis=1)
    if not len(directions) or 2 * int(agree.max()) <= len(directions):
        return None
    mean = directions[near[int(np.argmax(agree))]].sum(axis=0)
    result: Floats = mean / np.linalg.norm(mean)
    return result


#: Unit vectors (3,) that point up in the coordinates of source and target; None if unknown.
Ups = tuple[Floats | None, Floats | None]
NO_UPS: Ups = (None, None)


@dataclass(frozen=True)
class GravityParameters:
    """Maximum tilts of transforms against `up`, in radians, with a margin for the noise of `up`."""

    gate: float = math.radians(15.0)  #: maximum difference of two corresponding patches' slopes
    proposed_tilt: float = math.radians(20.0)  #: maximum tilt of an unrefined hypothesis
    refined_tilt: float = math.radians(10.0)  #: maximum tilt of a refined pose
    rival_tilt: float = math.radians(20.0)  #: minimum tilt of a transform that cannot be a rival
    floor_tilt: float = math.radians(30.0)  #: maximum angle between a floor's normal and `up`
    floor_stride: int = 7  #: stride of the pixels that are examined for the floor


def tilts(transforms: Floats, ups: Ups) -> Floats:
    """Return the angles between the transformed `up` of the source and the target's `up`.

    Parameters
    ----------
    transforms : (n, 4, 4) T_target_source
    ups : up vectors of source and target; if one is unknown, all angles are 0

    Returns
    -------
    angles : (n,) radians
    """
    source, target = ups
    if source is None or target is None:
        return np.zeros(len(transforms))
    carried = transforms[:, :3, :3] @ source
    across = np.linalg.norm(np.cross(carried, target), axis=1)
    angles: Floats = np.arctan2(across, carried @ target)  # acos is inaccurate near 0
    return angles


def tilt_of(T: Floats | None, ups: Ups) -> float | None:
    """Return the tilt of a transform, radians; None if T is None or one of `ups` is unknown."""
    if T is None or ups[0] is None or ups[1] is None:
        return None
    return float(tilts(T[None], ups)[0])


def are_level(transforms: Floats, ups: Ups, most: float) -> NDArray[np.bool_]:
    """Return a mask (n,) of the transforms that tilt by at most `most` radians.

    The mask selects all transforms if one of `ups` is unknown.
    """
    level: NDArray[np.bool_] = tilts(transforms, ups) <= most
    return level


def slopes(normals: Floats, up: Floats) -> Floats:
    """Return the angles (n,) in radians between normals (n, 3) and `up`: 0 for floors."""
    angles: Floats = np.arccos(np.clip(normals @ up, -1.0, 1.0))
    return angles
