"""Which frames show little but one plane: the negatives that fool registration most.

samples  --plane_share-->  share
"""

from __future__ import annotations

import numpy as np

from sceneprint.types import Floats

#: A sample lies in a plane within this, metres.
OFF_PLANE = 0.05
#: A frame is planar where one plane holds at least this share of its samples.
PLANAR = 0.6
#: Planes that are tried, each through three samples.
_TRIES = 200


def plane_share(samples: Floats, off: float = OFF_PLANE) -> float:
    """Share of samples in the plane that holds most; the same each time.

    Found without normals and patches, so that the choice of frames owes nothing to the method
    that is judged on them.

    Parameters
    ----------
    samples : (N, 3) metres, as of `view_of`
    off : how far from its plane a sample may lie, metres
    """
    n = len(samples)
    if n < 3:
        return 0.0
    rng = np.random.default_rng(n)
    corners = samples[rng.integers(0, n, (_TRIES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    fixed = length > off * off  # else the three lie on a line, or are two
    if not fixed.any():
        return 0.0
    normals = normals[fixed] / length[fixed, None]
    offsets = (corners[fixed, 0] * normals).sum(axis=1)
    inside = np.abs(samples @ normals.T - offsets) < off
    best = samples[inside[:, inside.sum(axis=0).argmax()]]
    centre = best.mean(axis=0)  # its own least squares: three noisy samples tilt a plane
    normal = np.linalg.svd(best - centre, full_matrices=False)[2][2]
    fitted = np.abs((samples - centre) @ normal) < off
    return float(max(fitted.mean(), inside.mean(axis=0).max()))
