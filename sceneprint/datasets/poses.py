"""Poses: 4 x 4 text files of one frame each, and trajectories with time stamps.

text  --read_pose-->  T_parent_sensor (4, 4)
text  --read_trajectory-->  Trajectory, stamps (M,)  --interpolate-->  M poses or None
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneprint.datasets.files import data_lines, read_text
from sceneprint.errors import InvalidPose, naming
from sceneprint.geometry.quaternions import rotation_of
from sceneprint.geometry.rigid import rigid_transform
from sceneprint.types import Floats

_TOLERANCE = 1e-2  #: how far a written rotation or quaternion may be from a true one
_MAXIMUM_POSE_BYTES = 65_536
_MAXIMUM_TRAJECTORY_BYTES = 2**26  # an hour at 200 Hz


@dataclass(frozen=True, eq=False)
class Trajectory:
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


def read_pose(path: Path) -> Floats:
    """Return T_parent_sensor (4, 4) of a text file with 16 numbers, row by row.

    Raises
    ------
    InvalidPose : the file cannot be read, or as `rigid_transform`; names the file.
    """
    words = read_text(path, _MAXIMUM_POSE_BYTES, InvalidPose).split()
    with naming(str(path)):
        if len(words) != 16:
            raise InvalidPose(
                f"The file holds {len(words)} words and a pose is 16 numbers. "
                "Write 4 rows of 4, sensor to parent."
            )
        return rigid_transform(np.array(_numbers(words)).reshape(4, 4))


def read_trajectory(path: Path) -> Trajectory:
    """Return the poses of a TUM text file, lines `t tx ty tz qx qy qz qw`, # comments.

    Lines are put in order of time; of equal stamps the first stays.

    Raises
    ------
    InvalidPose : the file cannot be read, has no pose, or a line is not 8 finite numbers
        with a quaternion of unit length to 1e-2; names file and line.
    """
    numbers, rows = [], []
    for number, line in data_lines(read_text(path, _MAXIMUM_TRAJECTORY_BYTES, InvalidPose)):
        words = line.replace(",", " ").split()
        with naming(f"{path}, line {number}"):
            if len(words) != 8:
                raise InvalidPose(f"The line has {len(words)} words. Write t tx ty tz qx qy qz qw.")
            rows.append(_numbers(words))
        numbers.append(number)
    if not rows:
        raise InvalidPose(f"{path}: The file holds no pose. Remove it, or write some.")
    table = np.array(rows)
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(np.linalg.norm(table[:, 4:], axis=1) - 1.0)
    bad = ~np.isfinite(table).all(axis=1) | ~(off < _TOLERANCE)
    if bad.any():
        raise InvalidPose(
            f"{path}, line {numbers[int(np.argmax(bad))]}: The pose is not finite, or its "
            "quaternion not of unit length. Write t tx ty tz qx qy qz qw, or leave the line out."
        )
    stamps, first = np.unique(table[:, 0], return_index=True)
    quaternions = table[first, 4:]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return Trajectory(stamps, table[first, 1:4], quaternions)


def interpolate(
    trajectory: Trajectory, stamps: Sequence[float], *, longest_gap: float = 0.1
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
    quaternions = _slerp(trajectory.quaternions[before], trajectory.quaternions[after], w)
    return [
        _transform(p, q) if ok else None
        for p, q, ok in zip(positions, quaternions, known, strict=True)
    ]


def _slerp(q: Floats, other: Floats, w: Floats) -> Floats:
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


def _transform(position: Floats, quaternion: Floats) -> Floats:
    pose = np.eye(4)
    pose[:3, :3] = rotation_of(quaternion)
    pose[:3, 3] = position
    return pose


def _numbers(words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as cause:
        raise InvalidPose(f"A word is no number ({cause}). Write numbers only.") from cause
