"""Tests of correspondences against a full sort."""

import numpy as np
import pytest

from sceneprint.geometry.registration.patch_descriptors import MatchingParameters, correspondences


def oracle(source, target, drawn, n_nearest):
    """The pairs by a stable sort of all squared distances."""
    pairs = []
    for i in drawn.tolist():
        squares = ((source[i].astype(int) - target.astype(int)) ** 2).sum(axis=1)
        pairs += [[i, int(j)] for j in np.argsort(squares, kind="stable")[:n_nearest]]
    return pairs


@pytest.mark.parametrize("levels", [256, 2])
def test_equals_the_oracle(levels):
    # of two levels in four bytes there are 16 descriptors: nearly all distances are ties
    rng = np.random.default_rng(levels)
    for length in (1, 4, 128):
        source = rng.integers(0, levels, (40, length), np.uint8) * (255 // (levels - 1))
        target = rng.integers(0, levels, (70, length), np.uint8) * (255 // (levels - 1))
        pairs = correspondences(source, target, rng, MatchingParameters(25, 4))
        assert (pairs.shape, pairs.dtype) == ((100, 2), np.int32)
        drawn = pairs[::4, 0]
        assert (np.diff(drawn) > 0).all()
        assert pairs.tolist() == oracle(source, target, drawn, 4)


def test_distances_do_not_wrap():
    # 1024 bytes, each 255 apart: the largest there is; 200 apart would be nearer modulo 2^16
    source = np.zeros((1, 1024), np.uint8)
    target = np.array([[255] * 1024, [200] * 1024, [201] * 1024, [1] * 1024], np.uint8)
    pairs = correspondences(source, target, np.random.default_rng(0), MatchingParameters(1, 4))
    assert pairs[:, 1].tolist() == [3, 1, 2, 0]


def test_each_source_is_drawn_once_at_random():
    descriptors = np.arange(50, dtype=np.uint8)[:, None]
    p = MatchingParameters(10, 1)
    draws = [
        correspondences(descriptors, descriptors, np.random.default_rng(s), p) for s in (1, 1, 2)
    ]
    np.testing.assert_array_equal(draws[0], draws[1])
    assert draws[0].tolist() != draws[2].tolist()
    for pairs in draws:
        assert len(set(pairs[:, 0].tolist())) == 10
        np.testing.assert_array_equal(pairs[:, 0], pairs[:, 1])


def test_fewer_patches_than_wanted():
    rng = np.random.default_rng(4)
    source, target = rng.integers(0, 256, (5, 8), np.uint8), rng.integers(0, 256, (2, 8), np.uint8)
    pairs = correspondences(source, target, rng, MatchingParameters(100, 3))
    assert pairs.tolist() == oracle(source, target, np.arange(5, dtype=np.int32), 2)
    none = np.empty((0, 8), np.uint8)
    assert correspondences(none, target, rng, MatchingParameters()).shape == (0, 2)
    assert correspondences(source, none, rng, MatchingParameters()).shape == (0, 2)
