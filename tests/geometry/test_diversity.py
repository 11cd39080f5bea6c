"""Tests of the k-DPP: Eq. (3), greedy steps against determinants, and its purpose."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneprint.geometry.retrieval.ranking import (
    DiversityParameters,
    distances,
    diversify,
    kernel_matrix,
    pairwise_distances,
    rank,
    remaining_gains,
)


def ranking(seed, n, dimension=6):
    """L1 distances of random points, nearest to the origin first."""
    points = np.random.default_rng(seed).exponential(size=(n, dimension)) * 100
    points = points[np.argsort(points.sum(axis=1))]
    return points.sum(axis=1), np.abs(points[:, None] - points[None]).sum(axis=2)


def naive_greedy(to_query, among, k, p):
    """Try every candidate; keep the one with the largest determinant of L_C.

    Return the gains with the members: what each multiplied the determinant by, but for its quality.
    """
    n = len(to_query)
    sigma = p.sigma * np.median(among[np.triu_indices(n, 1)])
    omega = p.omega * (to_query[-1] - to_query[0])
    kernel = kernel_matrix(to_query, among, sigma, omega)
    gains, whole = {}, 1.0
    for _ in range(k):
        rest = [i for i in range(n) if i not in gains]
        values = [np.linalg.det(kernel[np.ix_([*gains, i], [*gains, i])]) for i in rest]
        best = rest[int(np.argmax(values))]
        gains[best], whole = max(values) / whole / kernel[best, best], max(values)
    return sorted(gains.items())


def test_kernel_by_hand():
    # rho = exp(-0.5 * (2, 4) / 4) = exp(-1/4), exp(-1/2); exp(-6 / 3) between the two
    found = kernel_matrix(np.array([2.0, 4.0]), np.array([[0, 6.0], [6.0, 0]]), 3.0, 4.0)
    expected = np.exp([[-0.5, -2.75], [-2.75, -1.0]])
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("p", [DiversityParameters(), DiversityParameters(0.3, 0.5)])
def test_greedy_equals_the_determinants(seed, p):
    to_query, among = ranking(seed, 25)
    found = diversify(to_query, among, 6, p)
    indices, gains = zip(*naive_greedy(to_query, among, 6, p), strict=True)
    assert found.indices.tolist() == list(indices)
    np.testing.assert_allclose(found.gains, gains, rtol=1e-9)


@settings(max_examples=60)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 30), k=st.integers(1, 12))
def test_first_is_top_ranked_and_the_order_is_that_of_the_ranking(seed, n, k):
    found = diversify(*ranking(seed, n), k)
    assert found.indices[0] == 0
    assert found.gains[0] == 1.0
    assert len(found.indices) == min(n, k)
    assert all(a < b for a, b in pairwise(found.indices))
    assert ((found.gains > 0) & (found.gains <= 1)).all()


def test_gain_by_hand():
    # sigma is the one distance there is: the second keeps 1 - exp(-1)^2 of its variance
    found = diversify(np.array([1.0, 2.0]), np.array([[0.0, 3.0], [3.0, 0.0]]), 2)
    np.testing.assert_allclose(found.gains, [1.0, 1 - np.exp(-2)], rtol=1e-12)


@pytest.mark.parametrize("metric", ["l1", "l2"])
def test_distances_of_bytes_as_retrieval_gives_them(metric):
    database = np.random.default_rng(1).integers(0, 256, (60, 400), np.uint8)
    ranked = rank(distances(database[7], database, metric), 40, 1.0)
    among = pairwise_distances(database[ranked.indices], metric)
    found = diversify(ranked.distances, among, 10)
    assert (ranked.indices[0], found.indices[0], len(found.indices)) == (7, 0, 10)
    same = diversify(ranked.distances.astype(float), among.astype(float), 10)
    np.testing.assert_array_equal(found.indices, same.indices)
    np.testing.assert_array_equal(found.gains, same.gains)


def test_scale_does_not_matter():
    to_query, among = ranking(3, 30)
    for scale in (1e-6, 1e9):
        found = diversify(to_query * scale, among * scale, 7)
        np.testing.assert_array_equal(found.indices, diversify(to_query, among, 7).indices)


def test_near_duplicates_make_way():
    """Five copies of one place, a little apart, then two others, farther from the query."""
    position = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 50.0, 100.0])
    to_query, among = 100 + position / 10, np.abs(position[:, None] - position[None])
    assert diversify(to_query, among, 3).indices.tolist() == [0, 5, 6]


def test_exact_duplicates_are_never_taken_twice():
    position = np.array([0.0, 0.0, 0.0, 5.0, 5.0, 9.0])
    found = diversify(np.arange(6.0), np.abs(position[:, None] - position[None]), 6)
    assert position[found.indices].tolist() == [0.0, 5.0, 9.0]
    same = diversify(np.full(4, 7.0), np.zeros((4, 4)), 3)
    assert same.indices.tolist() == [0]


def test_empty_and_wrong_input():
    assert len(diversify(np.empty(0), np.empty((0, 0)), 3).indices) == 0
    to_query, among = ranking(0, 5)
    holed, infinite = to_query.copy(), among.copy()
    holed[2], infinite[1, 3] = np.nan, np.inf
    for arguments in (
        (to_query, among[:4], 2),
        (to_query, among, 0),
        (to_query[::-1], among, 2),
        (to_query[:, None], among, 2),
        (holed, among, 2),
        (to_query, infinite, 2),
    ):
        with pytest.raises(ValueError, match="distances"):
            diversify(*arguments)


@pytest.mark.parametrize("k", [1, 3, 6])
def test_what_is_left_is_what_a_determinant_would_gain(k):
    to_query, among = ranking(11, 15)
    p = DiversityParameters(sigma=0.8)
    taken = diversify(to_query, among, k, p).indices
    found = remaining_gains(among, taken, p)
    likeness = np.exp(-among / (0.8 * np.median(among[np.triu_indices(15, 1)])))
    for i in range(15):
        both = [*taken.tolist(), i]
        whole = np.linalg.det(likeness[np.ix_(both, both)])
        gain = whole / np.linalg.det(likeness[np.ix_(taken, taken)])
        assert found[i] == (0.0 if i in taken else pytest.approx(gain, abs=1e-9))
    assert len(set(found.tolist())) == 15 - k + 1


def test_a_duplicate_has_nothing_left_to_bring():
    among = ranking(3, 5)[1]
    twice = np.ix_([0, 1, 2, 2, 4], [0, 1, 2, 2, 4])
    taken = np.array([0, 2], np.intp)
    found = remaining_gains(among[twice], taken)
    assert found[[0, 2, 3]] == pytest.approx(0.0, abs=1e-12)
    assert (found[[1, 4]] > 0.01).all()
