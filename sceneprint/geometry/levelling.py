"""Which way is up in a frame, from the surfaces it sees.

normals (N, 3)  --levelling-->  R_level_camera (3, 3)
"""

from __future__ import annotations

import math

import numpy as np

from sceneprint.types import Floats


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
