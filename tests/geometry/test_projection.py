"""Tests of the learnt subspace: whitening, signs and independence."""

import numpy as np

from sceneprint.geometry.signature.pair_features import fit_projection, project

RNG_SEED = 11


def correlated(n=3000):
    """13 properties of very different scales, far from zero, that depend on one another."""
    rng = np.random.default_rng(RNG_SEED)
    mixing = rng.normal(size=(13, 13))
    return rng.normal(size=(n, 13)) @ mixing * np.logspace(-2, 2, 13) + rng.normal(size=13) * 10


def test_pca_equals_an_eigendecomposition():
    properties = correlated()
    projection = fit_projection(properties, "pca")
    values, vectors = np.linalg.eigh(np.corrcoef(properties.T))
    scale = properties.std(axis=0)
    # np.corrcoef is of the standardised properties; the smallest of 13 directions is left out
    n = len(properties)
    expected = (vectors / np.sqrt(values * n / (n - 1))).T[:0:-1] / scale
    np.testing.assert_allclose(
        np.abs(projection.matrix * scale), np.abs(expected * scale), rtol=1e-6, atol=1e-9
    )
    np.testing.assert_allclose(projection.mean, properties.mean(axis=0), rtol=1e-12)


def independent(n=4000):
    """13 mixtures of 12 independent sources, and the sources: uniform ones and peaked ones."""
    rng = np.random.default_rng(RNG_SEED)
    sources = np.column_stack([rng.uniform(-1, 1, (n, 6)), rng.laplace(size=(n, 6))])
    return sources @ rng.normal(size=(12, 13)) + 4, sources


def test_ica_finds_independent_sources():
    properties, sources = independent()
    correlation = {}
    for method in ("pca", "ica"):
        f = project(properties, fit_projection(properties, "pca" if method == "pca" else "ica"))
        np.testing.assert_allclose(np.cov(f.T), np.eye(12), atol=2e-3)
        np.testing.assert_allclose(f.mean(axis=0), 0, atol=1e-9)
        correlation[method] = np.abs(np.corrcoef(sources.T, f.T)[:12, 12:])
    # every source has its own component, of which PCA knows nothing
    assert sorted(correlation["ica"].argmax(axis=1)) == list(range(12))
    assert correlation["ica"].max(axis=1).min() > 0.95
    assert correlation["pca"].max(axis=1).min() < 0.8
