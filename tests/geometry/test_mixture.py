"""Tests of the Gaussian mixture against SciPy, scikit-learn and the theorem of EM."""

import math
import warnings

import numpy as np
import pytest
from scipy.special import logsumexp

from sceneprint.geometry.signature.mixture import (
    Mixture,
    MixtureParameters,
    em_step,
    log_densities,
    posteriors,
)


def parameters(n, *, floor=0.0, prior_count=0.0, iterations=10):
    return MixtureParameters(
        n_components=n, iterations=iterations, variance_floor=floor, prior_variance=0.02,
        prior_count=prior_count, minimum_weight=0.0,
    )  # fmt: skip


def random_mixture(rng, n, dimension=12):
    weights = rng.uniform(0.2, 1, n)
    return Mixture(
        weights / weights.sum(),
        rng.normal(size=(n, dimension)),
        rng.uniform(0.1, 2, (n, dimension)),
    )


def drawn(rng, mixture, n):
    g = rng.choice(len(mixture), n, p=mixture.weights)
    noise = rng.normal(size=(n, mixture.means.shape[1]))
    return mixture.means[g] + noise * np.sqrt(mixture.variances[g])


def naive(features, mixture):
    """log p_g + log N, one normal density at a time."""
    from scipy.stats import norm  # slow to import

    result = np.zeros((len(features), len(mixture)))
    for i, f in enumerate(features):
        for g in range(len(mixture)):
            result[i, g] = math.log(mixture.weights[g])
            for d in range(len(f)):
                deviation = math.sqrt(mixture.variances[g, d])
                result[i, g] += norm.logpdf(f[d], mixture.means[g, d], deviation)
    return result


def test_densities_and_posteriors_equal_scipy():
    rng = np.random.default_rng(0)
    mixture, features = random_mixture(rng, 5), rng.normal(0, 1.5, (30, 12))
    expected = naive(features, mixture)
    np.testing.assert_allclose(log_densities(features, mixture), expected, rtol=0, atol=1e-10)
    shares = np.exp(expected - logsumexp(expected, axis=1, keepdims=True))
    np.testing.assert_allclose(posteriors(features, mixture), shares, rtol=0, atol=1e-10)


def test_em_step_equals_scikit_learn():
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.mixture import GaussianMixture

    rng = np.random.default_rng(4)
    features, start = drawn(rng, random_mixture(rng, 6), 800), random_mixture(rng, 6)
    step = em_step(features, start, parameters(6, floor=1e-3))
    oracle = GaussianMixture(
        6, covariance_type="diag", reg_covar=1e-3, max_iter=1, weights_init=start.weights,
        means_init=start.means, precisions_init=1 / start.variances, random_state=0,
    )  # fmt: skip
    with warnings.catch_warnings():  # one step is no convergence, and is what is asked for
        warnings.simplefilter("ignore", ConvergenceWarning)
        oracle.fit(features)
    np.testing.assert_allclose(step.weights, oracle.weights_, rtol=0, atol=1e-6)
    np.testing.assert_allclose(step.means, oracle.means_, rtol=0, atol=1e-6)
    np.testing.assert_allclose(step.variances, oracle.covariances_, rtol=0, atol=1e-6)
    assert np.abs(step.means - start.means).max() > 0.1


def test_prior_and_floors_by_hand():
    # two samples, at 0 and 2, of one component: mean 1, variance 1 + floor
    features = np.array([[0.0], [2.0]])
    start = Mixture(np.array([0.5, 0.5]), np.array([[1.0], [1000.0]]), np.ones((2, 1)))
    p = MixtureParameters(
        n_components=2, iterations=1, variance_floor=0.1, prior_variance=0.5, prior_count=2.0,
        minimum_weight=0.01,
    )  # fmt: skip
    step = em_step(features, start, p)
    # drawn half-way, 2 samples against a count of 2, from 1.1 to 0.5
    assert step.means[0, 0] == pytest.approx(1.0)
    assert step.variances[0, 0] == pytest.approx((2 * 1.1 + 2 * 0.5) / 4)
    # the other saw nothing: it keeps the prior, and the least weight before normalisation
    assert step.variances[1, 0] == pytest.approx(0.5)
    np.testing.assert_allclose(step.weights, [1 / 1.01, 0.01 / 1.01])
