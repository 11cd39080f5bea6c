"""Sec. III-F backwards: which patch a point of a surface lies on, for who has the patches alone.

points, normals, Patches  --patches_at-->  (N,) indices

Artifacts do not keep which point went into which patch. Of patches of about one size, as those of
validation are, the nearest mean with a like normal is nearly it.
"""

from __future__ import annotations

import numpy as np

from sceneprint.geometry.kernel import kernel
from sceneprint.types import Floats, Floats32, Ints32, Patches

#: Least cosine between the normals of a point and of its patch.
_COSINE = 0.5
#: A point lies at most so many radii of a patch (of a disc of its area) from its mean.
_RADII = 4.0


@kernel
def _nearest(
    points: Floats32, means: Floats, normals: Floats, reaches: Floats, least: float, out: Ints32
) -> None:
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        nx, ny, nz = points[i, 3], points[i, 4], points[i, 5]
        nearest = np.inf
        for j in range(len(means)):
            dx, dy, dz = x - means[j, 0], y - means[j, 1], z - means[j, 2]
            square = dx * dx + dy * dy + dz * dz
            if square >= nearest or square > reaches[j] * reaches[j]:
                continue
            if nx * normals[j, 0] + ny * normals[j, 1] + nz * normals[j, 2] > least:
                nearest = square
                out[i] = j


def patches_at(points: Floats32, patches: Patches) -> Ints32:
    """The patch that each point lies on.

    Parameters
    ----------
    points : (N, 6) float32 of `sampled`, points and normals
    patches : of the same surface

    Returns
    -------
    (N,) the nearest of the patches with a like normal; -1 where none is within reach
    """
    found = np.full(len(points), -1, np.int32)
    reaches = _RADII * np.sqrt(patches.areas / np.pi)
    _nearest(points, patches.means, patches.normals, reaches, _COSINE, found)
    return found
