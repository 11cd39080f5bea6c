"""Tests of patch weights: values and purpose."""

import numpy as np

from sceneprint.geometry.signature.segmentation import (
    WeightParameters,
    extract_patches,
    patch_weights,
)
from sceneprint.types import Intrinsics, Patches, Surface

ONES = np.ones((2, 3))


def patches(sizes, coherences):
    return Patches(ONES, ONES, np.ones(2), np.array(sizes, np.int32), np.array(coherences))


def test_by_hand():
    # sqrt(4) * 1^3 = 2 and sqrt(36) * 0.5^3 = 0.75, over their mean of 1.375
    weights = patch_weights(patches([4, 36], [1.0, 0.5]), WeightParameters(0.5, 3.0))
    np.testing.assert_allclose(weights, [2 / 1.375, 0.75 / 1.375], rtol=1e-12)


def test_coherence_is_the_length_of_the_mean_normal():
    """Patch 0 is flat; patch 1 has normals 90 degrees apart, seen over areas of 3 and 1."""
    normals = np.array([[[0, 0, -1], [0, 0, -1], [0, 0, -1], [1, 0, 0]]], np.float32)
    surface = Surface(
        points=np.ones((1, 4, 3), np.float32),
        normals=normals,
        valid=np.ones((1, 4), np.bool_),
        areas=np.array([[1, 1, 3, 1]], np.float32),
        camera=Intrinsics(4, 1, 1.0, 1.0, 0.0, 0.0),
    )
    result = extract_patches(surface, np.array([[0, 0, 1, 1]], np.int32))
    np.testing.assert_allclose(result.coherences, [1.0, np.hypot(3, 1) / 4], rtol=1e-6)
