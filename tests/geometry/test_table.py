"""Tests of pair counts in the 4-D table against separate invariants."""

import math

import numpy as np
import pytest

from sceneprint.geometry.signature.mixture import Mixture, posteriors
from sceneprint.geometry.signature.pair_features import (
    LEADING,
    LEAST_POSTERIOR,
    Projection,
    PropertyParameters,
    TableLayout,
    bin_centres,
    compute_bins,
    count_pairs,
    invariants,
    neighbour_pairs,
    project,
    properties,
)
from tests.geometry import scenes

LAYOUT = TableLayout(distance_bins=36, angle_bins=25, dihedral_bins=36, distance_exponent=1.3)
SMALL = TableLayout(distance_bins=7, angle_bins=5, dihedral_bins=8, distance_exponent=1.0)
P = PropertyParameters(radius=3.0, angular_tolerance=math.radians(10), colinearity=0.9995)


def count(patches, layout=LAYOUT):
    counted = count_pairs(patches.means, patches.normals, np.ones(len(patches)), layout, P)
    assert counted.weights.sum() == counted.n_pairs == counted.total
    return counted.weights.astype(np.int32)


def bins_of(invariant, layout):
    """Indices on the four axes, from the angles themselves."""
    d, theta_mu, theta_alpha, phi = invariant.T
    edges = P.radius * (np.arange(layout.distance_bins + 1) / layout.distance_bins) ** (
        layout.distance_exponent
    )
    theta_edges = np.linspace(0, np.pi, layout.angle_bins + 1)
    step = 2 * np.pi / layout.dihedral_bins
    return (
        np.searchsorted(edges, d, side="right") - 1,
        np.searchsorted(theta_edges, theta_mu, side="right") - 1,
        np.searchsorted(theta_edges, theta_alpha, side="right") - 1,
        np.rint(phi / step).astype(int) % layout.dihedral_bins,
    )


def shape(layout):
    return layout.distance_bins, layout.angle_bins, layout.angle_bins, layout.dihedral_bins


@pytest.mark.parametrize("layout", [LAYOUT, SMALL])
@pytest.mark.parametrize("seed", range(2))
def test_counts_equal_those_of_the_invariants(layout, seed):
    rng = np.random.default_rng(seed)
    patches = scenes.room(rng) if seed % 2 else scenes.random_patches(rng, 130)
    pairs = neighbour_pairs(patches, P)
    assert 5000 < len(pairs) < len(patches) * (len(patches) - 1)
    expected = np.zeros(shape(layout), int)
    np.add.at(expected, bins_of(invariants(patches, pairs), layout), 1)
    counts = count(patches, layout)
    assert counts.shape == (layout.n_bins,)
    np.testing.assert_array_equal(counts, expected.ravel())


def test_centres_by_hand():
    # 7 x 5 x 5 x 8: the bin (3, 1, 4, 6) is the ((3 * 5 + 1) * 5 + 4) * 8 + 6 = 678th
    centre = bin_centres(SMALL, 678, 679, P)
    expected = [3.0 * 3.5 / 7, math.radians(54), math.radians(162), math.radians(-90)]
    np.testing.assert_allclose(centre, [expected], rtol=1e-12)
    assert SMALL.n_bins == 7 * 5 * 5 * 8
    every = bin_centres(SMALL, 0, SMALL.n_bins, P)
    np.testing.assert_allclose(every[678:679], centre)
    np.testing.assert_array_equal(
        np.unique(np.round(np.degrees(every[:, 1]))), [18, 54, 90, 126, 162]
    )


def test_a_pair_weighs_the_product_of_its_patches():
    patches = scenes.random_patches(np.random.default_rng(4), 12)
    weights = np.random.default_rng(5).uniform(0.1, 3, 12)
    result = count_pairs(patches.means, patches.normals, weights, SMALL, P)
    expected = np.zeros(SMALL.n_bins)
    pairs = neighbour_pairs(patches, P)
    indices = np.ravel_multi_index(bins_of(invariants(patches, pairs), SMALL), shape(SMALL))
    for index, (mu, alpha) in zip(indices, pairs, strict=True):
        expected[index] += weights[mu] * weights[alpha]
    np.testing.assert_allclose(result.weights, expected, rtol=1e-5, atol=1e-6)
    assert result.total == pytest.approx(expected.sum(), rel=1e-6)
    assert result.n_pairs == len(pairs)


def model(rng, g):
    weights = rng.uniform(0.2, 1, g)
    projection = Projection(rng.normal(size=13), rng.normal(0, 0.5, (12, 13)))
    mixture = Mixture(
        weights / weights.sum(), rng.normal(0, 2, (g, 12)), rng.uniform(0.3, 6.0, (g, 12))
    )
    return projection, mixture


def test_leading_posteriors():
    projection, mixture = model(np.random.default_rng(1), 20)
    first, last = 400_000, 400_600
    table = compute_bins(first, last, LAYOUT, P, projection, mixture)
    features = project(properties(bin_centres(LAYOUT, first, last, P), P), projection)
    np.testing.assert_allclose(table.features, features, rtol=1e-6, atol=1e-6)
    exact = posteriors(features, mixture)
    order = np.argsort(-exact, axis=1)[:, :LEADING]
    leading = np.take_along_axis(exact, order, axis=1)
    expected = leading / leading.sum(axis=1, keepdims=True)
    expected = np.where(expected < LEAST_POSTERIOR, 0.0, expected)
    expected /= expected.sum(axis=1, keepdims=True)
    clear = (np.abs(leading / leading.sum(axis=1, keepdims=True) - LEAST_POSTERIOR) > 1e-5).all(
        axis=1
    )
    assert clear.mean() > 0.9
    np.testing.assert_allclose(table.posteriors[clear], expected[clear], rtol=0, atol=1e-4)
    # float32 may exchange two that are equal; the values at the named components must agree
    named = np.take_along_axis(exact, table.components.astype(int), axis=1)
    np.testing.assert_allclose(named, leading, rtol=0, atol=1e-4)
    assert (np.diff(table.posteriors, axis=1) <= 0).all()
    assert all(len(set(row)) == LEADING for row in table.components.tolist())
    assert (table.components >= 0).all()
    assert (table.components < 20).all()
    np.testing.assert_allclose(table.posteriors.sum(axis=1), 1, atol=1e-6)
