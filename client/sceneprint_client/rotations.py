"""Rotations as unit quaternions x, y, z, w, and back; and between two of them.

q (4,)  --rotation_of-->  R (3, 3)  --quaternion_of-->  q with w >= 0
q, q' (M, 4), shares (M,)  --slerp-->  (M, 4)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def rotation_of(quaternion: Floats) -> Floats:
    """The rotation (3, 3) of a unit quaternion (4,): x, y, z, w."""
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
