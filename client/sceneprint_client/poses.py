"""Rigid transforms, quaternions, trajectories, and the up direction from an IMU.

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
    """Return the unit quaternion (4,), x, y, z, w with w >= 0, of a rotation (3, 3).

    Notes
    -----
    4 q q^T is linear in R; its column with the largest diagonal entry is a well-scaled q.
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
    """Return quaternions (M, 4) at the fraction `w` of the shorter arc from `q` to `other`."""
    cosine = np.sum(q * other, axis=1)
    other = np.where(cosine[:, None] < 0.0, -other, other)  # q and -q are the same rotation
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    sine = np.sin(angle)
    small = sine < 1e-6  # linear interpolation avoids 0/0 on a short arc
    safe = np.where(small, 1.0, sine)
    a = np.where(small, 1.0 - w, np.sin((1.0 - w) * angle) / safe)
    b = np.where(small, w, np.sin(w * angle) / safe)
    mixed: Floats = a[:, None] * q + b[:, None] * other
    with np.errstate(invalid="ignore"):  # far beyond both ends
        mixed /= np.linalg.norm(mixed, axis=1, keepdims=True)
    return mixed


# Trajectories and interpolation.


@dataclass(frozen=True, eq=False)
class SensorTrajectory:
    """Poses of a sensor over time.

    Parameters
    ----------
    stamps : (N,) seconds, strictly increasing
    positions : (N, 3) of the sensor in the parent frame, metres
    quaternions : (N, 4) unit quaternions x, y, z, w of T_parent_sensor
    """

    stamps: Floats
    positions: Floats
    quaternions: Floats


def interpolate(
    trajectory: SensorTrajectory, stamps: Sequence[float], *, longest_gap: float = 0.1,
    tolerance: float = 0.0,
) -> list[Floats | None]:  # fmt: skip
    """Return the poses at the stamps: linear positions, and rotations by slerp.

    Parameters
    ----------
    stamps : M stamps in any order, seconds
    longest_gap : longest interval between two poses in which to interpolate, seconds
    tolerance : maximum time to a pose that is used where interpolation is impossible, seconds

    Returns
    -------
    poses : M times T_parent_sensor (4, 4); None before the first pose, after the last, and within a
        longer gap, unless a pose lies within the tolerance
    """
    times = np.asarray(stamps, dtype=np.float64)
    t, last = trajectory.stamps, len(trajectory.stamps) - 1
    after = np.clip(np.searchsorted(t, times), 0, last)  # t[after - 1] < time <= t[after]
    before = np.where(t[after] == times, after, np.maximum(after - 1, 0))
    span = t[after] - t[before]
    is_valid = (t[before] <= times) & (times <= t[after]) & (span <= longest_gap)
    near = np.where(t[after] - times < times - t[before], after, before)
    alone = ~is_valid & (np.abs(t[near] - times) <= tolerance)
    before, after = np.where(alone, near, before), np.where(alone, near, after)
    is_valid, span = is_valid | alone, t[after] - t[before]
    w = np.where(span > 0.0, times - t[before], 0.0) / np.where(span > 0.0, span, 1.0)

    positions = trajectory.positions[before]
    positions = positions + w[:, None] * (trajectory.positions[after] - positions)
    quaternions = slerp(trajectory.quaternions[before], trajectory.quaternions[after], w)
    return [
        _transform(p, q) if ok else None
        for p, q, ok in zip(positions, quaternions, is_valid, strict=True)
    ]


def _transform(position: Floats, quaternion: Floats) -> Floats:
    pose = np.eye(4)
    pose[:3, :3] = rotation_of(quaternion)
    pose[:3, 3] = position
    return pose


def first_since(stamps_ns: array[int], span_ns: int) -> int:
    """Return the index of the first stamp that is at most `span_ns` older than the last stamp."""
    times = np.frombuffer(stamps_ns, np.int64)
    return int(np.argmax(times >= times[-1] - span_ns)) if len(times) else 0


# The up direction from an accelerometer at rest.

#: Half width of the window in which accelerations are averaged, seconds.
WINDOW_S = 0.5
#: Minimum number of samples in the window.
_FEWEST = 10
#: Gravity, and maximum deviation of the mean acceleration from gravity at rest, m/s^2.
_GRAVITY, _OFF = 9.81, 0.3
#: Maximum standard deviation of the acceleration at rest, over all axes, m/s^2.
_SPREAD = 0.25
#: Maximum mean angular velocity at rest, rad/s.
_TURN = 0.05
_MOST_SAMPLES = 10_000_000


class Accelerations:
    """Measurements of an IMU over time."""

    def __init__(self) -> None:
        self._stamps_ns = array("q")
        self._rows = array("d")  # rows of 6: acceleration, angular velocity

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def add(self, stamp_ns: int, acceleration: Sequence[float], turn: Sequence[float]) -> None:
        """Add a measurement, m/s^2 and rad/s in the IMU's axes; ignore one that is not finite.

        Raise DatasetError if there are more than 10 million measurements.
        """
        row = [*acceleration, *turn]
        if not np.isfinite(row).all():
            return
        if len(self._stamps_ns) >= _MOST_SAMPLES:
            raise DatasetError(
                f"The recording has more than {_MOST_SAMPLES} measurements of one IMU. Split it."
            )
        self._stamps_ns.append(stamp_ns)
        self._rows.extend(row)

    def forget(self, span_ns: int) -> None:
        """Drop measurements that are more than `span_ns` older than the latest."""
        old = first_since(self._stamps_ns, span_ns)
        del self._stamps_ns[:old], self._rows[: 6 * old]

    def up_at(self, stamps_ns: Sequence[int]) -> list[Floats | None]:
        """Return up (3,) in the IMU's axes at each stamp; None while the robot was not at rest.

        At rest an accelerometer measures 9.81 m/s^2 upwards. Up is the mean over one second.
        """
        recorded = np.frombuffer(self._stamps_ns, np.int64)
        order = np.argsort(recorded, kind="stable")
        times = recorded[order]
        rows = np.frombuffer(self._rows, np.float64).reshape(-1, 6)[order]
        window = int(WINDOW_S * 1e9)
        directions: list[Floats | None] = []
        for stamp in stamps_ns:
            a, b = np.searchsorted(times, [stamp - window, stamp + window + 1])
            directions.append(_up(rows[a:b]) if b - a >= _FEWEST else None)
        return directions


def _up(rows: Floats) -> Floats | None:
    """Return up for consecutive measurements (N, 6); None if the robot was not at rest."""
    acceleration, turn = rows[:, :3], rows[:, 3:]
    mean = acceleration.mean(axis=0)
    length = float(np.linalg.norm(mean))
    spread = float(np.sqrt(acceleration.var(axis=0).sum()))
    turning = float(np.linalg.norm(turn, axis=1).mean())
    if abs(length - _GRAVITY) > _OFF or spread > _SPREAD or turning > _TURN:
        return None
    up: Floats = mean / length
    return up


TOLERANCE = 1e-2  #: maximum error of a rotation matrix, and of the length of a unit vector


def rigid_transform(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a pose whose rotation is orthonormal to machine precision.

    Parameters
    ----------
    matrix : (4, 4) T_parent_sensor, with a rotation that is orthonormal to 1e-2

    Returns
    -------
    T_parent_sensor : (4, 4) float64, with the nearest rotation

    Raises
    ------
    InvalidPose : If the matrix is not 4 x 4, not finite, or not rigid.
    """
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError) as cause:
        raise InvalidPose("The pose does not consist of numbers. Pass 4 x 4 numbers.") from cause
    if pose.shape != (4, 4):
        raise InvalidPose(f"The pose has shape {pose.shape}. Pass 4 x 4 numbers.")
    if not np.isfinite(pose).all():
        raise InvalidPose(
            "The pose has values that are not finite, as after a loss of tracking. Omit the frame "
            "or its pose."
        )
    if np.abs(pose[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-9:
        raise InvalidPose(
            "The last row of the pose is not 0 0 0 1. Pass the transform from sensor to parent, "
            "row by row."
        )
    rotation = pose[:3, :3]
    # Large entries are excluded first, since their product would overflow.
    rigid = np.abs(rotation).max() < 2.0
    if not rigid or np.abs(rotation.T @ rotation - np.eye(3)).max() > TOLERANCE:
        raise InvalidPose(
            f"The rotation of the pose is not orthonormal to {TOLERANCE}. "
            "Pass a rigid transform without scale."
        )
    if np.linalg.det(rotation) < 0.0:
        raise InvalidPose("The rotation of the pose is a reflection. Use right-handed axes.")
    U, _, V = np.linalg.svd(rotation)
    pose[:3, :3] = U @ V
    pose[3] = (0.0, 0.0, 0.0, 1.0)
    return pose
