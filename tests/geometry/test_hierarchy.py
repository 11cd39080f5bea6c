"""Tests of hierarchy levels: counts, unions and invariants of coarsening."""

import numpy as np
import pytest

from sceneprint.geometry.signature import segmentation as module
from sceneprint.geometry.signature.segmentation import (
    HierarchyParameters,
    SegmentationParameters,
    hierarchy,
    segment,
)
from tests.geometry import scenes


def parameters(n_levels=4, factor=2.0):
    return HierarchyParameters(n_levels=n_levels, factor=factor, iterations=4, normal_weight=3.0)


def corner():
    seen, _ = scenes.corner()
    seen.valid[5:12, 60:70] = False
    finest = segment(
        seen,
        SegmentationParameters(
            n_patches=160, iterations=5, normal_weight=6.0, minimum_size=0.15, minimum_pixels=4
        ),
    )
    return seen, finest


@pytest.mark.parametrize("factor", [1.5, 4.0])
def test_counts_fall_by_the_factor(factor):
    seen, finest = corner()
    n = int(finest.max()) + 1
    assert n > 100
    result = hierarchy(seen, finest, parameters(4, factor))
    assert len(result.levels) == len(result.labels) == 4
    for h, (level, labels) in enumerate(zip(result.levels, result.labels, strict=True)):
        # K-Means may leave a cluster empty, and never makes one more
        assert 0.9 * round(n / factor**h) <= len(level) <= round(n / factor**h)
        np.testing.assert_array_equal(np.unique(labels[labels >= 0]), np.arange(len(level)))
        assert level.sizes.sum() == (finest >= 0).sum()
    assert len(result.levels[0]) == n
    np.testing.assert_array_equal(result.labels[0], finest)


def naive_k_means(patches, areas, n_clusters, scale, weight, iterations):
    """Every patch with every centre, in the order of operations that the kernel has."""
    x, y, z, nx, ny, nz = patches
    n = len(areas)

    def distances(c):
        dx, dy, dz = x - c[0], y - c[1], z - c[2]
        cosine = nx * c[3] + ny * c[4] + nz * c[5]
        return (dx * dx + dy * dy + dz * dz) * scale + weight * (1.0 - cosine)

    def assigned(centres):
        nearest, labels = np.full(n, np.inf), np.zeros(n, np.int32)
        for c, centre in enumerate(centres):
            own = distances(centre)
            labels[own < nearest] = c
            nearest = np.minimum(own, nearest)
        return labels

    centres = [patches[:, areas.argmax()].copy()]
    for _ in range(n_clusters - 1):
        worst = np.min([distances(c) for c in centres], axis=0).argmax()
        centres.append(patches[:, worst].copy())
    labels = assigned(centres)
    for _ in range(iterations):
        for c, centre in enumerate(centres):
            total, sums = 0.0, np.zeros(6)
            for k in np.flatnonzero(labels == c):
                sums += areas[k] * patches[:, k]
                total += areas[k]
            if total > 0:
                length = np.sqrt(sums[3] ** 2 + sums[4] ** 2 + sums[5] ** 2)
                centre[:3] = sums[:3] / total
                centre[3:] = sums[3:] / length if length > 1e-9 else centre[3:]
        labels = assigned(centres)
    return labels


@pytest.mark.parametrize(
    ("n", "n_clusters", "weight", "copies"),
    [(1, 1, 3.0, 1), (8, 3, 3.0, 1), (131, 90, 3.0, 1), (131, 90, 0.0, 1), (200, 20, 0.3, 1),
     (96, 40, 3.0, 3), (96, 60, 3.0, 3)],
)  # fmt: skip
def test_patches_passed_over_are_those_too_far(n, n_clusters, weight, copies):
    """All comparisons give the same clusters; with equal distances, and centres without patches."""
    rng = np.random.default_rng(n + n_clusters)
    steps = rng.normal(0, 0.3, (n // copies, 3))
    means = np.cumsum(steps, axis=0)  # neighbours in the order of the patches, as in an image
    normals = rng.normal([0, 0, 2], 1, (n // copies, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    patches = np.tile(np.concatenate([means, normals], axis=1).T, copies)
    areas = rng.uniform(0.5, 1, n)
    scale = n_clusters / 30.0
    labels = module._k_means(np.ascontiguousarray(patches), areas, n_clusters, scale, weight, 4)
    expected = naive_k_means(patches, areas, n_clusters, scale, weight, 4)
    np.testing.assert_array_equal(labels, expected)
    assert len(np.unique(labels)) <= min(n_clusters, n // copies)
