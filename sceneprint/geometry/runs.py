"""Runs: where a robot was, frame by frame, and how far it went from one to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.rigid import rotation_angle
from sceneprint.types import Floats

Ints64 = NDArray[np.int64]

#: The way across a gap in odometry, metres: no loop reaches over it.
_BROKEN = 1e6


@dataclass(frozen=True, eq=False)
class Run:
    """Where a robot was, frame by frame.

    Parameters
    ----------
    poses : (m, 4, 4) T_parent_sensor; NaN where not known
    metres, radians : (m,) way up to each frame; very long across a gap in odometry, NaN without a
        pose
    """

    poses: Floats
    metres: Floats
    radians: Floats


def run_of(poses: Floats, parents: Ints64) -> Run:
    """A run from the poses of its frames, in the order in which they were taken.

    Parameters
    ----------
    poses : (m, 4, 4) T_parent_sensor; NaN where not known
    parents : (m,) which parent frame each is given in; odometry is broken where it changes
    """
    known = np.isfinite(poses).all(axis=(1, 2))
    metres, radians = np.zeros(len(poses)), np.zeros(len(poses))
    last, far_m, far_rad = -1, 0.0, 0.0
    for i in np.flatnonzero(known).tolist():
        if last >= 0 and parents[i] == parents[last]:
            far_m += float(np.linalg.norm(poses[i, :3, 3] - poses[last, :3, 3]))
            far_rad += rotation_angle(poses[i, :3, :3] @ poses[last, :3, :3].T)
        elif last >= 0:
            far_m += _BROKEN
        metres[i], radians[i], last = far_m, far_rad, i
    metres[~known] = np.nan
    return Run(poses, metres, radians)
