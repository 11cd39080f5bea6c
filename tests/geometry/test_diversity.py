"""Tests of the k-DPP: Eq. (3), greedy steps against determinants, and its purpose."""

import numpy as np
import pytest

from sceneprint.geometry.retrieval.ranking import (
    DiversityParameters,
    diversify,
    kernel_matrix,
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
    result = kernel_matrix(np.array([2.0, 4.0]), np.array([[0, 6.0], [6.0, 0]]), 3.0, 4.0)
    expected = np.exp([[-0.5, -2.75], [-2.75, -1.0]])
    np.testing.assert_allclose(result, expected, rtol=1e-12)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("p", [DiversityParameters(), DiversityParameters(0.3, 0.5)])
def test_greedy_equals_the_determinants(seed, p):
    to_query, among = ranking(seed, 25)
    selection = diversify(to_query, among, 6, p)
    indices, gains = zip(*naive_greedy(to_query, among, 6, p), strict=True)
    assert selection.indices.tolist() == list(indices)
    np.testing.assert_allclose(selection.gains, gains, rtol=1e-9)


def test_exact_duplicates_are_never_taken_twice():
    position = np.array([0.0, 0.0, 0.0, 5.0, 5.0, 9.0])
    selection = diversify(np.arange(6.0), np.abs(position[:, None] - position[None]), 6)
    assert position[selection.indices].tolist() == [0.0, 5.0, 9.0]
    same = diversify(np.full(4, 7.0), np.zeros((4, 4)), 3)
    assert same.indices.tolist() == [0]


def test_empty_and_wrong_input():
    assert len(diversify(np.empty(0), np.empty((0, 0)), 3).indices) == 0
    to_query, among = ranking(0, 5)
    for arguments in ((to_query, among[:4], 2), (to_query[::-1], among, 2)):
        with pytest.raises(ValueError, match="distances"):
            diversify(*arguments)


@pytest.mark.parametrize("k", [1, 3, 6])
def test_what_is_left_is_what_a_determinant_would_gain(k):
    to_query, among = ranking(11, 15)
    p = DiversityParameters(sigma=0.8)
    selection = diversify(to_query, among, k, p).indices
    result = remaining_gains(among, selection, p)
    likeness = np.exp(-among / (0.8 * np.median(among[np.triu_indices(15, 1)])))
    for i in range(15):
        both = [*selection.tolist(), i]
        whole = np.linalg.det(likeness[np.ix_(both, both)])
        gain = whole / np.linalg.det(likeness[np.ix_(selection, selection)])
        assert result[i] == (0.0 if i in selection else pytest.approx(gain, abs=1e-9))
    assert len(set(result.tolist())) == 15 - k + 1
