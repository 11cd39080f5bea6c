"""Several validated views, one pose: the votes of the matches averaged robustly.

poses (n, 4, 4)  --average_poses-->  PoseAverage
directions (n, 3)  --mean_direction-->  (3,)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.pose.rigid import difference, nearest_rotation
from sceneprint.types import Floats


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
    p : see AveragingParameters

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


# Which way is up in a frame, from the surfaces it sees.
#
# normals (N, 3)  --levelling-->  R_level_camera (3, 3)


def levelling(normals: Floats) -> Floats:
    """Rotation that brings most of what looks up, to a camera held upright, to straight up.

    Parameters
    ----------
    normals : (N, 3) unit length, camera axes: y down

    Returns
    -------
    (3, 3), so that floors and tables become level; the identity where nothing looks up
    """
    upward = normals[-normals[:, 1] > 0.5]
    if not len(upward):
        return np.eye(3)
    up = upward.mean(axis=0)
    for _ in range(20):  # from the mean to the direction around which most gather
        up = up / np.linalg.norm(up)
        near = upward[upward @ up > math.cos(math.radians(20))]
        up = near.mean(axis=0) if len(near) else up
    down = -up / np.linalg.norm(up)
    right = np.cross(down, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return np.stack([right, down, np.cross(right, down)])
