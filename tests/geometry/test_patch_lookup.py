"""Tests of the patch of a point against a linear search and a segmentation."""

import numpy as np

from sceneprint.geometry.validation.inspection import patches_at
from sceneprint.types import Patches


def unit(rows):
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_it_is_the_nearest_that_fits():
    rng = np.random.default_rng(3)
    n, m = 40, 200
    areas = rng.uniform(0.01, 0.05, n)
    means, normals = rng.uniform(-1, 1, (n, 3)), unit(rng.normal(size=(n, 3)))
    patches = Patches(means, normals, areas, np.ones(n, np.int32), np.ones(n))
    at = np.hstack([rng.uniform(-1, 1, (m, 3)), unit(rng.normal(size=(m, 3)))]).astype(np.float32)
    found = patches_at(at, patches)
    for row, one in zip(at.astype(float), found.tolist(), strict=True):
        best, index = np.inf, -1
        for j in range(n):
            apart = float(np.linalg.norm(row[:3] - means[j]))
            alike = float(row[3:] @ normals[j]) > 0.5
            if alike and apart < best and apart <= 4 * np.sqrt(areas[j] / np.pi):
                best, index = apart, j
        assert one == index
    assert 0 < (found < 0).sum() < m


def test_no_patches_hold_no_points():
    none = np.zeros((0, 3))
    patches = Patches(none, none, np.zeros(0), np.zeros(0, np.int32), np.zeros(0))
    assert patches_at(np.ones((3, 6), np.float32), patches).tolist() == [-1, -1, -1]
