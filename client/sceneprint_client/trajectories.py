"""Poses over time, and between their stamps.

SensorTrajectory, stamps (M,)  --interpolate-->  M poses or None
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneprint_client.rotations import Floats, rotation_of, slerp


@dataclass(frozen=True, eq=False)
class SensorTrajectory:
    """Poses of a sensor over time.

    Parameters
    ----------
    stamps : (N,) seconds, strictly increasing
    positions : (N, 3) metres, of the sensor in the parent frame
    quaternions : (N, 4) x, y, z, w of unit length, sensor to parent
    """

    stamps: Floats
    positions: Floats
    quaternions: Floats


def interpolate(
    trajectory: SensorTrajectory, stamps: Sequence[float], *, longest_gap: float = 0.1
) -> list[Floats | None]:
    """Return the poses at the stamps: positions linear, rotations by slerp.

    Parameters
    ----------
    trajectory : N poses
    stamps : M seconds, in any order
    longest_gap : seconds between two poses beyond which nothing between them is known

    Returns
    -------
    poses : M times T_parent_sensor (4, 4), or None before the first pose, after the last,
        and within a longer gap
    """
    times = np.asarray(stamps, dtype=np.float64)
    t, last = trajectory.stamps, len(trajectory.stamps) - 1
    after = np.clip(np.searchsorted(t, times), 0, last)  # t[after - 1] < time <= t[after]
    before = np.where(t[after] == times, after, np.maximum(after - 1, 0))
    span = t[after] - t[before]
    known = (t[before] <= times) & (times <= t[after]) & (span <= longest_gap)
    w = np.where(span > 0.0, times - t[before], 0.0) / np.where(span > 0.0, span, 1.0)

    positions = trajectory.positions[before]
    positions = positions + w[:, None] * (trajectory.positions[after] - positions)
    quaternions = slerp(trajectory.quaternions[before], trajectory.quaternions[after], w)
    return [
        _transform(p, q) if ok else None
        for p, q, ok in zip(positions, quaternions, known, strict=True)
    ]


def _transform(position: Floats, quaternion: Floats) -> Floats:
    pose = np.eye(4)
    pose[:3, :3] = rotation_of(quaternion)
    pose[:3, 3] = position
    return pose
