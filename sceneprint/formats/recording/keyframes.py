"""Which frames of a recording are taken: far enough from the last one, or long enough after it.

stamps, poses  --keyframes-->  their places
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sceneprint.types import Floats


def keyframes(
    stamps_ns: Sequence[int], poses: Sequence[Floats] | None, metres: float, radians: float,
    seconds: float,
) -> list[int]:  # fmt: skip
    """Return the places of the frames to take; the first is always one.

    Parameters
    ----------
    stamps_ns : N times, in order
    poses : N times T_parent_sensor (4, 4); None where they are not known
    metres, radians : a frame is taken that lies as far from the last one taken, or is turned by
        as much; 0 takes every frame
    seconds : without poses a frame is taken that came as long after the last one taken
    """
    taken: list[int] = []
    for place, stamp in enumerate(stamps_ns):
        if not taken:
            taken.append(place)
        elif poses is None:
            if stamp - stamps_ns[taken[-1]] >= round(seconds * 1e9):
                taken.append(place)
        else:
            distance, angle = _motion(poses[taken[-1]], poses[place])
            if distance >= metres or angle >= radians:
                taken.append(place)
    return taken


def _motion(a: Floats, b: Floats) -> tuple[float, float]:
    """Metres and radians between two poses."""
    turn = a[:3, :3].T @ b[:3, :3]
    cosine = (float(np.trace(turn)) - 1.0) / 2.0
    sine = math.hypot(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]) / 2
    return float(np.linalg.norm(b[:3, 3] - a[:3, 3])), math.atan2(sine, cosine)
