"""Tests of Eq. (2), its normalisation and its storage."""

import math

import numpy as np

from sceneprint.geometry.signature.fisher_vector import (
    fisher_vector,
    normalise,
    quantise,
    statistics_of_counts,
    statistics_of_features,
)
from sceneprint.geometry.signature.mixture import Mixture, posteriors
from sceneprint.geometry.signature.pair_features import LEADING, PairCounts, pack_table


def random_mixture(rng, n, spread=1.0):
    weights = rng.uniform(0.2, 1, n)
    return Mixture(
        weights / weights.sum(), rng.normal(0, spread, (n, 12)), rng.uniform(0.3, 2, (n, 12))
    )


def eq2(features, mixture):
    """Eq. (2a-c) as printed, with readings R2, R3 and R4: loops over g, pairs and dimensions."""
    n, phi = len(features), []
    pi = posteriors(features, mixture)
    for g in range(len(mixture)):
        p, nu, variance = mixture.weights[g], mixture.means[g], mixture.variances[g]
        m0, m1, m2 = 0.0, [0.0] * 12, [0.0] * 12
        for j in range(n):
            m0 += pi[j, g] - p
            for d in range(12):
                deviation = features[j, d] - nu[d]
                m1[d] += pi[j, g] * deviation / math.sqrt(variance[d])
                m2[d] += pi[j, g] * (deviation * deviation / variance[d] - 1)
        phi.append(m0 / (n * math.sqrt(p)))
        phi.extend(m / (n * math.sqrt(p)) for m in m1)
        phi.extend(m / (n * math.sqrt(2 * p)) for m in m2)
    return phi


def phi_of(features, mixture):
    return fisher_vector(statistics_of_features(features, np.ones(len(features)), mixture), mixture)


def test_equals_the_loop():
    rng = np.random.default_rng(0)
    mixture, features = random_mixture(rng, 3), rng.normal(size=(7, 12))
    np.testing.assert_allclose(
        phi_of(features, mixture), eq2(features, mixture), rtol=0, atol=1e-12
    )


def test_normalised_by_hand():
    # roots 2, -3, 0, 6: of length 7
    np.testing.assert_allclose(
        normalise(np.array([4.0, -9.0, 0.0, 36.0])), [2 / 7, -3 / 7, 0, 6 / 7], rtol=1e-12
    )
    assert normalise(np.zeros(5)).tolist() == [0.0] * 5


def table_of(features, mixture):
    pi = posteriors(features, mixture)
    order = np.argsort(-pi, axis=1)[:, :LEADING]
    shares = np.zeros((len(features), LEADING), np.float32)
    shares[:, : order.shape[1]] = np.take_along_axis(pi, order, axis=1)
    components = np.zeros((len(features), LEADING), np.int16)
    components[:, : order.shape[1]] = order
    return pack_table(features.astype(np.float32), shares, components)


def counted(counts):
    n = int(counts.sum())
    return PairCounts(counts.astype(np.float32), n, float(n))


def test_statistics_of_counts_equal_those_of_the_pairs():
    # wide components, so that no share is so small that it is left out
    rng = np.random.default_rng(3)
    mixture = random_mixture(rng, 5, 0.3)
    wide = Mixture(mixture.weights, mixture.means, mixture.variances + 4)
    bins = rng.normal(size=(40, 12)).astype(np.float32).astype(float)
    assert posteriors(bins, wide).min() > 2e-3
    counts = rng.integers(0, 4, 40).astype(np.int32)
    n = int(counts.sum())
    result = statistics_of_counts(counted(counts), table_of(bins, wide), 5)
    exact = statistics_of_features(np.repeat(bins, counts, axis=0), np.ones(n), wide)
    assert result.n_pairs == exact.n_pairs == result.total == exact.total == n
    weighted = statistics_of_features(bins, counts.astype(float), wide)
    np.testing.assert_allclose(weighted.second, exact.second, rtol=1e-12, atol=1e-12)
    assert (weighted.n_pairs, weighted.total) == (40, n)
    for a, b in ((result.zeroth, exact.zeroth), (result.first, exact.first)):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(result.second, exact.second, rtol=1e-5, atol=1e-5)


def test_quantise_by_hand():
    psi = np.array([0.0, 0.1, -0.1, 0.26, 12.6, 12.7, 99.0, -12.8, -12.9, -99.0])
    expected = [128, 129, 127, 131, 254, 255, 255, 0, 0, 0]
    stored = quantise(psi, 0.1)
    assert stored.dtype == np.uint8
    assert stored.tolist() == expected
