"""Sec. III-F, hierarchy: the finest patches to H levels, each fewer by a constant factor.

    Surface, labels (h, w)  --hierarchy-->  Hierarchy (H levels)

Agglomerative K-Means over the finest patches in position and normal, weighted by area,
seeded near-uniformly over the surface by farthest-point sampling.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.segmentation import patches_of
from sceneprint.types import Floats, Hierarchy, Ints32, Patches, Surface


@dataclass(frozen=True)
class HierarchyParameters:
    """The numbers of the hierarchy."""

    n_levels: int = 4  #: H
    factor: float = 2.0**0.5  #: each level has fewer patches by this factor
    iterations: int = 4  #: of K-Means
    normal_weight: float = 3.0  #: of 1 - cos(normals), beside squared patch diameters


@kernel
def _nearer(
    patches: Floats, centre: Floats, scale: float, weight: float, c: int,
    distance: Floats, nearest: Floats, labels: Ints32,
) -> None:  # fmt: skip
    """Move to cluster `c` all patches that are nearer to its centre than to their own."""
    x, y, z, nx, ny, nz = (
        patches[0], patches[1], patches[2], patches[3], patches[4], patches[5]
    )  # fmt: skip
    for k in range(len(labels)):
        dx, dy, dz = x[k] - centre[0], y[k] - centre[1], z[k] - centre[2]
        cosine = nx[k] * centre[3] + ny[k] * centre[4] + nz[k] * centre[5]
        distance[k] = (dx * dx + dy * dy + dz * dz) * scale + weight * (1.0 - cosine)
    for k in range(len(labels)):
        labels[k] = c if distance[k] < nearest[k] else labels[k]
    for k in range(len(labels)):
        nearest[k] = min(distance[k], nearest[k])


@kernel
def _k_means(
    patches: Floats, areas: Floats, n_clusters: int, scale: float, weight: float, iterations: int
) -> Ints32:
    """Labels of (6, P) positions and normals; clusters that end empty are numbered still."""
    n = patches.shape[1]
    centres = np.empty((n_clusters, 6))
    distance, nearest = np.empty(n), np.full(n, np.inf)
    labels = np.zeros(n, np.int32)
    chosen = int(np.argmax(areas))
    for c in range(n_clusters):  # farthest-point sampling
        centres[c] = patches[:, chosen]
        _nearer(patches, centres[c], scale, weight, c, distance, nearest, labels)
        chosen = int(np.argmax(nearest))
    for _ in range(iterations):
        sums = np.zeros((n_clusters, 7))
        for k in range(n):
            for d in range(6):
                sums[labels[k], d] += areas[k] * patches[d, k]
            sums[labels[k], 6] += areas[k]
        nearest[:] = np.inf
        for c in range(n_clusters):
            if sums[c, 6] > 0:
                length = np.sqrt(sums[c, 3] ** 2 + sums[c, 4] ** 2 + sums[c, 5] ** 2)
                for d in range(3):
                    centres[c, d] = sums[c, d] / sums[c, 6]
                    if length > 1e-9:
                        centres[c, 3 + d] = sums[c, 3 + d] / length
            _nearer(patches, centres[c], scale, weight, c, distance, nearest, labels)
    return labels


def _coarser(patches: Patches, n_clusters: int, p: HierarchyParameters) -> Ints32:
    """Index of each patch's parent among at most `n_clusters`, numbered without gaps."""
    scale = n_clusters / float(patches.areas.sum())
    joined = np.ascontiguousarray(np.concatenate([patches.means, patches.normals], axis=1).T)
    labels = _k_means(joined, patches.areas, n_clusters, scale, p.normal_weight, p.iterations)
    _, parents = np.unique(labels, return_inverse=True)
    numbered: Ints32 = parents.astype(np.int32)
    return numbered


def hierarchy(surface: Surface, finest: Ints32, p: HierarchyParameters) -> Hierarchy:
    """The levels {X_h}: every level is clustered from the finest patches.

    Parameters
    ----------
    surface : (h, w) points in metres and normals
    finest : (h, w) int32 labels of the finest level
    p : see HierarchyParameters

    Returns
    -------
    hierarchy : `n_levels` levels, finest first; each holds 1 / factor of the patches of the
        one before it, and never fewer than one
    """
    levels, labels = [patches_of(surface, finest)], [finest]
    for h in range(1, p.n_levels):
        n_clusters = max(round(len(levels[0]) / p.factor**h), 1)
        parents = _coarser(levels[0], n_clusters, p)
        coarse = np.where(finest >= 0, parents[finest], -1).astype(np.int32)
        levels.append(patches_of(surface, coarse))
        labels.append(coarse)
    return Hierarchy(tuple(levels), tuple(labels))
