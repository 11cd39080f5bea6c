"""Covariance of a transform: what the last refinement knows, scaled to the errors that are made.

    Refined there, Refined back, T  --pair_covariance-->  covariance (6, 6)
    covariance  --free_directions-->  Free: along what the surfaces can slide
    covariance, R, lever  --transported-->  covariance told in another frame

The error of T_parent_child is (x, y, z, rx, ry, rz): what must be added to its translation,
metres along the parent's axes, and the rotation vector, radians about the parent's axes, that
must be put before its rotation, T_true = [exp(r) R, t + x]. It is what ROS means in
PoseWithCovariance. Errors are small: what is of second order in them is left out.

The inverse of Gauss-Newton's information alone is no covariance: neighbouring pixels err
together, so thousands of them say no more than a few. How many: docs/uncertainty.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sceneprint.geometry.registration.icp import Refined
from sceneprint.geometry.rigid import PoseAverage, rotation_angle
from sceneprint.types import Floats

Method = Literal["information-scaled", "votes-and-spread"]
#: What made a pair's covariance, and what a place's.
PAIR_METHOD: Method = "information-scaled"
PLACE_METHOD: Method = "votes-and-spread"

#: Of turn, then shift, as refinement orders them, to shift, then turn.
_SHIFT_FIRST = [3, 4, 5, 0, 1, 2]


@dataclass(frozen=True)
class CovarianceParameters:
    """The numbers of covariances; how they were chosen: docs/uncertainty.md."""

    independent: float = 5.3  #: points per direction that err independently, however many there are
    least_square: float = 1e-7  #: of the mean weighted square: no sensor is surer
    most: float = 10.0  #: deviation of what nothing holds, metres and radians
    lever: float = 1.0  #: a radian counts as much as this many metres
    free: float = 30.0  #: times the least deviation, from which on a direction is free


@dataclass(frozen=True, eq=False)
class Free:
    """A direction along which a transform is hardly held.

    Parameters
    ----------
    translation, rotation : (3,) each, together of length 1: the error, metres and radians,
        along this direction
    deviation : standard deviation along it, metres where it shifts, radians where it turns
    """

    translation: Floats
    rotation: Floats
    deviation: float


def crossing(v: Floats) -> Floats:
    """[v]x (3, 3): crossing(v) @ u = v x u."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def adjoint(R: Floats, lever: Floats) -> Floats:
    """How an error (x, r) is told elsewhere: (6, 6).

    Parameters
    ----------
    R : (3, 3) old parent's axes in the new one's
    lever : (3,) from the old child's origin to the new one's, along the new axes
    """
    result = np.zeros((6, 6))
    result[:3, :3], result[3:, 3:] = R, R
    result[:3, 3:] = -crossing(lever) @ R  # what turns moves all that is away from the origin
    return result


def transported(covariance: Floats, R: Floats, lever: Floats) -> Floats:
    """A covariance told in other axes and of another point of the same body: A S A^T.

    Of T_a_b with rotation R and translation t, and transforms without error beside it:

    * T_c_a T_a_b: (R_c_a, 0)
    * T_a_b T_b_d, as of a robot's base: (identity, R t_b_d)
    * the inverse T_b_a: (R^T, -R^T t)

    Parameters
    ----------
    covariance : (6, 6)
    R, lever : see `adjoint`
    """
    A = adjoint(R, lever)
    moved: Floats = A @ covariance @ A.T
    return (moved + moved.T) / 2


def pair_covariance(
    there: Refined | None, back: Refined | None, T: Floats, p: CovarianceParameters | None = None
) -> Floats | None:
    """Covariance of a transform that lies halfway between two refinements: Sec. III-E.

    Parameters
    ----------
    there, back : the last refinement of each direction, or None where it was lost
    T : (4, 4) T_match_query
    p : see CovarianceParameters

    Returns
    -------
    (6, 6) of T, or None where both were lost
    """
    p = p or CovarianceParameters()
    information, squares = [], []
    if there is not None:  # its error is of the match's origin, which is not where the query is
        informed = there.information[np.ix_(_SHIFT_FIRST, _SHIFT_FIRST)]
        onward = adjoint(np.eye(3), -T[:3, 3])
        information.append(onward.T @ informed @ onward)
        squares.append(there.mean_square)
    if back is not None:  # told in the query's axes; that it is the inverse's changes the sign
        informed = back.information[np.ix_(_SHIFT_FIRST, _SHIFT_FIRST)]
        onward = adjoint(T[:3, :3].T, np.zeros(3))
        information.append(onward.T @ informed @ onward)
        squares.append(back.mean_square)
    if not information:
        return None
    noise = max(float(np.mean(squares)), p.least_square) / p.independent
    scale = _scale(p)
    held = np.mean(information, axis=0) * np.outer(1 / scale, 1 / scale) / noise
    values, vectors = np.linalg.eigh((held + held.T) / 2)
    variances = 1 / np.maximum(values, 1 / p.most**2)
    result: Floats = (vectors * variances) @ vectors.T * np.outer(1 / scale, 1 / scale)
    return (result + result.T) / 2


def free_directions(covariance: Floats, p: CovarianceParameters | None = None) -> tuple[Free, ...]:
    """Directions whose deviation is far above the least one, the freest first.

    A lone plane has three: two shifts within it, and the turn about its normal; a corridor has
    one, along it; a corner none.

    Parameters
    ----------
    covariance : (6, 6)
    p : see CovarianceParameters
    """
    p = p or CovarianceParameters()
    scale = _scale(p)
    values, vectors = np.linalg.eigh(covariance * np.outer(scale, scale))
    deviations = np.sqrt(np.maximum(values, 0.0))
    found = []
    for i in range(5, 0, -1):
        if deviations[i] > p.free * deviations[0]:
            towards = vectors[:, i] / scale
            length = float(np.linalg.norm(towards))
            towards = towards / length * np.sign(towards[np.abs(towards).argmax()])
            found.append(Free(towards[:3], towards[3:], float(deviations[i]) * length))
    return tuple(found)


def place_covariance(average: PoseAverage, poses: Floats, covariances: Floats) -> Floats:
    """Covariance of an averaged pose, from its votes' covariances and how far they lie apart.

    Two frames make each vote, and one of them, the query, is the same for all: half of the mean
    of their covariances is kept whole, the other half divided by their number, as is what they
    differ by, which holds the errors of the map's poses.

    Parameters
    ----------
    average : of `average_poses`
    poses : (n, 4, 4) that were averaged
    covariances : (n, 6, 6) of each
    """
    own: Floats = covariances[average.members].mean(axis=0)
    n = len(average.members)
    if n == 1:
        return own
    apart = np.array([error_of(average.T, one) for one in poses[average.members]])
    result: Floats = own * (0.5 + 0.5 / n) + apart.T @ apart / (n * (n - 1))
    return result


def error_of(T: Floats, true: Floats) -> Floats:
    """(x, y, z, rx, ry, rz) by which a transform (4, 4) is off; see the module."""
    turn = true[:3, :3] @ T[:3, :3].T
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    sine = float(np.linalg.norm(axis))  # twice that of the angle
    angle = rotation_angle(turn)
    rotation = axis / 2 if sine < 1e-9 else axis / sine * angle
    return np.concatenate([true[:3, 3] - T[:3, 3], rotation])


def _scale(p: CovarianceParameters) -> Floats:
    """What makes metres of an error's six numbers."""
    return np.array([1.0, 1.0, 1.0, p.lever, p.lever, p.lever])
