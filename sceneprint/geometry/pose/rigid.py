"""Rigid transforms as (4, 4) matrices: to move, to invert, to compare, to fit.

x_b = T_b_a @ x_a. Translations in metres, angles in radians.
"""

from __future__ import annotations

import math

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
