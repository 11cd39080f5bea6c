"""Tests of hierarchy levels: counts, unions and invariants of coarsening."""

import numpy as np
import pytest

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
