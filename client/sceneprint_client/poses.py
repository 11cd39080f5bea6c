"""Poses, and poses over time: rigid transforms, rotations as quaternions, trajectories, and which
way is up.

q (4,)  --rotation_of-->  R (3, 3)  --quaternion_of-->  q with w >= 0
q, q' (M, 4), shares (M,)  --slerp-->  (M, 4)
Accelerations.add ...  --Accelerations.up_at-->  unit vectors in the IMU's axes
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint_client.errors import DatasetError, InvalidPose

Floats = NDArray[np.float64]


def rotation_of(quaternion: Floats) -> Floats:
    """Return the rotation (3, 3) of a unit quaternion (4,): x, y, z, w."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_of(R: Floats) -> Floats:
    """The unit quaternion (4,) of a rotation (3, 3): x, y, z, w, the one of both with w >= 0.

    Notes
    -----
    4 q q^T is linear in R; its column with the largest diagonal entry is q, scaled well.
    """
    xx, yy, zz = R[0, 0], R[1, 1], R[2, 2]
    outer = np.array(
        [
            [1 + xx - yy - zz, R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[2, 1] - R[1, 2]],
            [R[0, 1] + R[1, 0], 1 - xx + yy - zz, R[1, 2] + R[2, 1], R[0, 2] - R[2, 0]],
            [R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], 1 - xx - yy + zz, R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1 + xx + yy + zz],
        ]
    )
    q: Floats = outer[int(np.argmax(outer.diagonal()))]
    q = q / np.linalg.norm(q)
    return -q if q[3] < 0 else q


def slerp(q: Floats, other: Floats, w: Floats) -> Floats:
    """Quaternions (M, 4) at the share w of the shorter arc from q to the other."""
    cosine = np.sum(q * other, axis=1)
    other = np.where(cosine[:, None] < 0.0, -other, other)  # q and -q are one rotation
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    sine = np.sin(angle)
    small = sine < 1e-6  # the arc is its chord there, and 0/0 is not
    safe = np.where(small, 1.0, sine)
    a = np.where(small, 1.0 - w, np.sin((1.0 - w) * angle) / safe)
    b = np.where(small, w, np.sin(w * angle) / safe)
    mixed: Floats = a[:, None] * q + b[:, None] * other
    mixed /= np.linalg.norm(mixed, axis=1, keepdims=True)
    return mixed


# Poses over time, and between their stamps.


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
    trajectory: SensorTrajectory, stamps: Sequence[float], *, longest_gap: float = 0.1,
    tolerance: float = 0.0,
) -> list[Floats | None]:  # fmt: skip
    """Return the poses at the stamps: positions linear, rotations by slerp.

    Parameters
    ----------
    trajectory : N poses
    stamps : M seconds, in any order
    longest_gap : seconds between two poses beyond which nothing between them is known
    tolerance : seconds from a pose within which it stands where nothing is interpolated

    Returns
    -------
    poses : M times T_parent_sensor (4, 4), or None before the first pose, after the last,
        and within a longer gap, unless a pose is as near as the tolerance
    """
    times = np.asarray(stamps, dtype=np.float64)
    t, last = trajectory.stamps, len(trajectory.stamps) - 1
    after = np.clip(np.searchsorted(t, times), 0, last)  # t[after - 1] < time <= t[after]
    before = np.where(t[after] == times, after, np.maximum(after - 1, 0))
    span = t[after] - t[before]
    known = (t[before] <= times) & (times <= t[after]) & (span <= longest_gap)
    near = np.where(t[after] - times < times - t[before], after, before)
    alone = ~known & (np.abs(t[near] - times) <= tolerance)
    before, after = np.where(alone, near, before), np.where(alone, near, after)
    known, span = known | alone, t[after] - t[before]
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


def first_since(stamps_ns: array[int], span_ns: int) -> int:
    """Place of the first stamp, in the order in which they came, within a span until the last."""
    times = np.frombuffer(stamps_ns, np.int64)
    return int(np.argmax(times >= times[-1] - span_ns)) if len(times) else 0


# Which way is up, of an accelerometer at rest.

#: Seconds before and after a stamp over which accelerations are averaged.
WINDOW_S = 0.5
#: Fewest samples of such a window.
_FEWEST = 10
#: At rest are mean accelerations of this length within this, m/s^2, ...
_GRAVITY, _OFF = 9.81, 0.3
#: ... that vary by less than this (standard deviation of all axes), m/s^2, ...
_SPREAD = 0.25
#: ... while the robot turns by less than this on average, radians per second.
_TURN = 0.05
_MOST_SAMPLES = 10_000_000


class Accelerations:
    """Measurements of an IMU over time."""

    def __init__(self) -> None:
        self._stamps_ns = array("q")
        self._rows = array("d")  # 6 each: acceleration, angular velocity

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def add(self, stamp_ns: int, acceleration: Sequence[float], turn: Sequence[float]) -> None:
        """Take a measurement: m/s^2 and radians per second, along the IMU's axes.

        Raises
        ------
        DatasetError : there are more than 10 million.
        """
        row = [*acceleration, *turn]
        if not np.isfinite(row).all():
            return
        if len(self._stamps_ns) >= _MOST_SAMPLES:
            raise DatasetError(
                f"The recording has more than {_MOST_SAMPLES} measurements of one IMU. Cut it "
                "into parts."
            )
        self._stamps_ns.append(stamp_ns)
        self._rows.extend(row)

    def forget(self, span_ns: int) -> None:
        """Drop measurements that came before those of so long until the latest."""
        old = first_since(self._stamps_ns, span_ns)
        del self._stamps_ns[:old], self._rows[: 6 * old]

    def up_at(self, stamps_ns: Sequence[int]) -> list[Floats | None]:
        """Up (3,) in the IMU's axes at each stamp; None where the robot was not at rest.

        At rest an accelerometer measures 9.81 m/s^2 upwards. The mean is taken over a second.
        """
        recorded = np.frombuffer(self._stamps_ns, np.int64)
        order = np.argsort(recorded, kind="stable")
        times = recorded[order]
        rows = np.frombuffer(self._rows, np.float64).reshape(-1, 6)[order]
        window = int(WINDOW_S * 1e9)
        found: list[Floats | None] = []
        for stamp in stamps_ns:
            a, b = np.searchsorted(times, [stamp - window, stamp + window + 1])
            found.append(_up(rows[a:b]) if b - a >= _FEWEST else None)
        return found


def _up(rows: Floats) -> Floats | None:
    """Up of measurements (N, 6) in a row, or None where they are not of rest."""
    acceleration, turn = rows[:, :3], rows[:, 3:]
    mean = acceleration.mean(axis=0)
    length = float(np.linalg.norm(mean))
    spread = float(np.sqrt(acceleration.var(axis=0).sum()))
    turning = float(np.linalg.norm(turn, axis=1).mean())
    if abs(length - _GRAVITY) > _OFF or spread > _SPREAD or turning > _TURN:
        return None
    up: Floats = mean / length
    return up


TOLERANCE = 1e-2  #: how far a written rotation may be from a true one, or a length from 1


def rigid_transform(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pose with its rotation made orthonormal to machine precision.

    Parameters
    ----------
    matrix : (4, 4) T_parent_sensor, its rotation good to 1e-2

    Returns
    -------
    T_parent_sensor : (4, 4) float64, the rotation nearest to the one given

    Raises
    ------
    InvalidPose : the matrix is not 4 x 4 numbers, not finite, or not rigid.
    """
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError) as cause:
        raise InvalidPose("The pose is not made of numbers. Give 4 x 4 of them.") from cause
    if pose.shape != (4, 4):
        raise InvalidPose(f"The pose has shape {pose.shape}. Give 4 x 4 numbers.")
    if not np.isfinite(pose).all():
        raise InvalidPose(
            "The pose is not finite, as where tracking was lost. Leave the frame or its pose out."
        )
    if np.abs(pose[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-9:
        raise InvalidPose(
            "The last row of the pose is not 0 0 0 1. Give sensor-to-parent, row by row."
        )
    rotation = pose[:3, :3]
    # entries first: the product of large ones overflows
    rigid = np.abs(rotation).max() < 2.0
    if not rigid or np.abs(rotation.T @ rotation - np.eye(3)).max() > TOLERANCE:
        raise InvalidPose(
            f"The rotation of the pose is not orthonormal to {TOLERANCE}. "
            "Give a rigid transform without scale."
        )
    if np.linalg.det(rotation) < 0.0:
        raise InvalidPose("The rotation of the pose mirrors. Give right-handed axes.")
    left, _, right = np.linalg.svd(rotation)
    pose[:3, :3] = left @ right
    pose[3] = (0.0, 0.0, 0.0, 1.0)
    return pose
