"""Tests of the consensus against NumPy, and among wrong correspondences."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneprint.geometry.registration import alignment as module
from sceneprint.geometry.registration.alignment import ConsensusParameters, consensus
from tests.geometry import scenes
from tests.geometry.scenes import carried, rigid

P = ConsensusParameters()


def with_outliers(rng, n, share):
    """Patch i of the source is patch i of the target, but for a share of them."""
    wrong = rng.random(n) < share
    target = np.where(wrong, rng.integers(0, n, n), np.arange(n))
    return np.stack([np.arange(n), target], axis=1).astype(np.int32)


def graph(a, b, pairs):
    """The compatibility graph as bits and as a matrix."""
    i, j = pairs.T
    bits = np.zeros((len(pairs), (len(pairs) + 63) // 64), np.uint64)
    rows = (a.means[i], a.normals[i], b.means[j], b.normals[j])
    module._build_graph(
        *(np.ascontiguousarray(row.T) for row in rows),
        P.distance_tolerance, P.angle_tolerance, P.minimum_distance, bits,
    )  # fmt: skip
    unpacked = np.unpackbits(bits.view(np.uint8), axis=1, bitorder="little")
    assert not unpacked[:, len(pairs) :].any()
    return bits, unpacked[:, : len(pairs)].astype(bool)


def graph_oracle(a, b, pairs):
    """The same graph from matrices of lengths, heights, angles and volumes."""

    def invariants(x, index):
        p, n = x.means[index], x.normals[index]
        r = p[None] - p[:, None]
        height = np.einsum("ijk,ik->ij", r, n)
        volume = np.einsum("ijk,ijk->ij", r, np.cross(n[:, None], n[None]))
        angle = np.arccos(np.clip(n @ n.T, -1, 1))
        return [np.linalg.norm(r, axis=2), height, height.T, angle, volume]

    one, other = invariants(a, pairs[:, 0]), invariants(b, pairs[:, 1])
    length, height, back, angle, volume = (np.abs(x - y) for x, y in zip(one, other, strict=True))
    near = np.minimum(one[0], other[0]) >= P.minimum_distance
    fits = (length <= 0.12) & (height <= 0.12) & (back <= 0.12) & (angle <= 0.5) & (volume <= 0.24)
    return fits & near


@pytest.mark.parametrize("n", [5, 64, 130])
def test_graph_equals_the_oracle(n):
    rng = np.random.default_rng(n)
    a = scenes.room(rng, n)
    noisy = carried(a, rigid(rng, 3))
    noisy = replace(noisy, means=noisy.means + rng.normal(0, 0.05, (n, 3)))
    pairs = with_outliers(rng, n, 0.5)
    _, matrix = graph(a, noisy, pairs)
    np.testing.assert_array_equal(matrix, matrix.T)
    assert not matrix.diagonal().any()
    np.testing.assert_array_equal(matrix, graph_oracle(a, noisy, pairs))
    assert n < 10 or 0.05 < matrix.mean() < 0.9


@pytest.mark.parametrize("n", [3, 63, 64, 65, 200])
def test_common_neighbours_equal_the_product_of_the_matrix(n):
    rng = np.random.default_rng(n)
    matrix = rng.random((n, n)) < 0.7
    matrix = np.triu(matrix, 1) | np.triu(matrix, 1).T
    bits = np.zeros((n, (n + 63) // 64 * 64), np.uint8)
    bits[:, :n] = matrix
    packed = np.packbits(bits, axis=1, bitorder="little").view(np.uint64)
    common = np.zeros((n, n), np.int32)
    module._count_common(packed, common)
    np.testing.assert_array_equal(common, np.where(matrix, matrix.astype(int) @ matrix, 0))


@pytest.mark.parametrize("most", [1, 16, 40])
def test_largest_are_in_the_order_of_a_stable_sort(most):
    rng = np.random.default_rng(most)
    for _ in range(50):
        row = rng.integers(0, 12, 40).astype(np.int32)
        order = np.empty(most, np.int32)
        module._write_largest(row, order)
        np.testing.assert_array_equal(order, np.argsort(-row, kind="stable")[:most])


def test_fit_equals_scipys():
    rng = np.random.default_rng(1)
    for _ in range(30):
        n = int(rng.integers(3, 40))
        p, q = rng.normal(size=(2, n, 3))
        normals, others = rng.normal(size=(2, n, 3))
        weights = rng.uniform(0.1, 1.0, n)
        T = np.zeros((4, 4))
        columns = [np.ascontiguousarray(one.T) for one in (p, normals, q, others)]
        assert module._fit_transform(*columns, weights, 0.3, np.empty(n, np.int32), T)
        a, b = np.average(p, axis=0, weights=weights), np.average(q, axis=0, weights=weights)
        R = Rotation.align_vectors(
            np.concatenate([q - b, others]),
            np.concatenate([p - a, normals]),
            weights=np.concatenate([weights, 0.3 * weights]),
        )[0].as_matrix()
        np.testing.assert_allclose(T[:3, :3], R, atol=1e-6)
        np.testing.assert_allclose(T[:3, 3], b - R @ a, atol=1e-6)
        assert T[3].tolist() == [0, 0, 0, 1]


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7])
def test_the_motion_is_found_among_outliers(share):
    rng = np.random.default_rng(int(10 * share))
    for _ in range(3):
        a = scenes.random_patches(rng, 150)
        T = rigid(rng, 3)
        b, pairs = carried(a, T), with_outliers(rng, 150, share)
        result = consensus(a, b, pairs, P)
        assert 1 <= len(result) <= P.n_seeds
        np.testing.assert_allclose(result[0], T, atol=1e-6)


def test_too_few_correspondences():
    a = scenes.random_patches(np.random.default_rng(6), 20)
    T = rigid(np.random.default_rng(7), 3)
    pairs = with_outliers(np.random.default_rng(8), 20, 0.0)
    for n in (0, 1, 2):
        assert consensus(a, carried(a, T), pairs[:n], P).shape == (0, 4, 4)
    result = consensus(a, carried(a, T), pairs[:3], P)
    assert len(result) >= 1
    np.testing.assert_allclose(result[0], T, atol=1e-9)
    # one patch again and again: nothing is far enough from it
    assert consensus(a, a, np.zeros((30, 2), np.int32), P).shape == (0, 4, 4)
