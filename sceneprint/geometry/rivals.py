"""Sec. III-E, ambiguity: other transforms that would explain the same two frames.

    T, hypotheses, patches  --candidates-->  transforms far from T

A lone box looks the same from its four sides, a corridor the same at every door. Two frames of
such a place agree perfectly under a wrong transform, and nothing in the residual, the overlap or
the free space shows it. What does show is that *another* transform is not refuted either. So
rivals are looked for: the other hypotheses that correspondences voted for, and the transform
found, turned by quarter turns about the normals of the main planes, which is how rooms and what
stands in them repeat.

What a rival agrees on counts by planes, each plane as much as another however large: that a floor
lies on a floor says little, wherever on it one stands.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sceneprint.geometry.rigid import difference
from sceneprint.types import Floats, Floats32, Patches


@dataclass(frozen=True)
class RivalParameters:
    """The numbers of the search for rivals."""

    n_axes: int = 2  #: directions that most surface faces
    n_planes: int = 3  #: planes across each, by area
    same_direction: float = math.radians(12.0)  #: normals this near are parallel
    coplanar: float = math.radians(15.0)  #: normals this near may be of one plane
    same_plane: float = 0.06  #: offsets this near are one plane, metres
    rival_m: float = 0.25  #: a rival differs by this, metres
    rival_rad: float = math.radians(15.0)  #: or by this


def quarter_turns(patches: Patches, p: RivalParameters) -> Floats:
    """Turns by 90, 180 and 270 degrees that leave a main plane of the patches in itself.

    Parameters
    ----------
    patches : P of one frame
    p : see RivalParameters

    Returns
    -------
    (n, 4, 4) with n at most 3 n_axes n_planes; each turns about the middle of its plane
    """
    left = patches.areas.copy()
    turns: list[Floats] = []
    cosines = patches.normals @ patches.normals.T
    parallel = np.abs(cosines) > math.cos(p.same_direction)
    for _ in range(p.n_axes):
        most = int(np.argmax(parallel @ left))
        if left[most] <= 0:
            break
        across = parallel[most]
        signed = np.sign(cosines[most]) * patches.areas * across
        axis = (patches.normals * signed[:, None]).sum(axis=0)
        axis /= np.linalg.norm(axis)
        offsets, area = patches.means @ axis, np.where(across, left, 0.0)
        for _ in range(p.n_planes):
            near = np.abs(offsets[:, None] - offsets[None, :]) < p.same_plane
            best = int(np.argmax(np.where(area > 0, near @ area, 0.0)))
            if area[best] <= 0:
                break
            on_plane = near[best] & (area > 0)
            middle = np.average(patches.means[on_plane], axis=0, weights=area[on_plane])
            turns += [_turn(axis, middle, k) for k in (1, 2, 3)]
            area = np.where(on_plane, 0.0, area)
        left = np.where(across, 0.0, left)
    return np.array(turns).reshape(-1, 4, 4)


def plane_weights(patches: Patches, p: RivalParameters) -> Floats32:
    """Weights of patches by which every plane weighs 1, over all patches that lie in it: (P,)."""
    offsets = patches.normals @ patches.means.T
    apart = np.abs(offsets - np.diag(offsets)[:, None])
    together = (patches.normals @ patches.normals.T > math.cos(p.coplanar)) & (apart < p.same_plane)
    weights: Floats32 = (1.0 / together.sum(axis=1)).astype(np.float32)
    return weights


def patch_points(patches: Patches) -> Floats32:
    """Patches as points to be looked up: (P, 6) float32, means and normals."""
    return np.concatenate([patches.means, patches.normals], axis=1).astype(np.float32)


def _turn(axis: Floats, middle: Floats, quarters: int) -> Floats:
    cosine, sine = (0.0, -1.0, 0.0)[quarters - 1], (1.0, 0.0, -1.0)[quarters - 1]
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    result = np.eye(4)
    result[:3, :3] = cosine * np.eye(3) + sine * cross + (1 - cosine) * np.outer(axis, axis)
    result[:3, 3] = middle - result[:3, :3] @ middle
    return result


def far_from(T: Floats, others: Floats, p: RivalParameters) -> Floats:
    """Those of the others (n, 4, 4) that differ from T enough to be another answer."""
    far = [
        metres > p.rival_m or radians > p.rival_rad
        for metres, radians in (difference(T, other) for other in others)
    ]
    return others[np.array(far, np.bool_)] if len(others) else others
