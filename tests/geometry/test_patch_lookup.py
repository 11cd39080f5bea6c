"""Tests of the patch of a point against a linear search and a segmentation."""

import numpy as np

from sceneprint.geometry.validation.inspection import patches_at
from tests.geometry.scenes import patches_of


def unit(rows):
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_it_is_the_nearest_that_fits():
    rng = np.random.default_rng(3)
    n, m = 40, 200
    areas = rng.uniform(0.01, 0.05, n)
    means, normals = rng.uniform(-1, 1, (n, 3)), unit(rng.normal(size=(n, 3)))
    patches = patches_of(means, normals, areas)
    at = np.hstack([rng.uniform(-1, 1, (m, 3)), unit(rng.normal(size=(m, 3)))]).astype(np.float32)
    result = patches_at(at, patches)
    for row, one in zip(at.astype(float), result.tolist(), strict=True):
        best, index = np.inf, -1
        for j in range(n):
            apart = float(np.linalg.norm(row[:3] - means[j]))
            alike = float(row[3:] @ normals[j]) > 0.5
            if alike and apart < best and apart <= 4 * np.sqrt(areas[j] / np.pi):
                best, index = apart, j
        assert one == index
    assert 0 < (result < 0).sum() < m


def test_no_patches_hold_no_points():
    assert patches_at(np.ones((3, 6), np.float32), patches_of([], [])).tolist() == [-1, -1, -1]
