"""Tests of signatures from the table against exact signatures of random rooms."""

import math

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from sceneprint.geometry.signature.fisher_vector import (
    fisher_vector,
    normalise,
    statistics_of_counts,
    statistics_of_features,
)
from sceneprint.geometry.signature.mixture import MixtureParameters, fit_mixture
from sceneprint.geometry.signature.pair_features import (
    PropertyParameters,
    TableLayout,
    compute_bins,
    count_pairs,
    fit_projection,
    neighbour_pairs,
    pair_properties,
    project,
)

LAYOUT = TableLayout(distance_bins=36, angle_bins=25, dihedral_bins=36, distance_exponent=1.3)
P = PropertyParameters(radius=3.0, angular_tolerance=math.radians(10), colinearity=0.9995)
MIXTURE = MixtureParameters(
    n_components=24, iterations=5, variance_floor=1e-2, prior_variance=0.1, prior_count=5.0,
    minimum_weight=1e-6,
)  # fmt: skip


def test_table_distances_follow_exact_ones(scenes):
    def exact_features(room):
        return pair_properties(room, neighbour_pairs(room, P), P)

    def distances_of(sign):
        rooms = (scenes.room(np.random.default_rng(seed)) for seed in range(12))
        phi = [normalise(fisher_vector(sign(room), mixture)) for room in rooms]
        return pdist(phi, "cityblock")

    def by_pairs(room):
        f = project(exact_features(room), projection)
        return statistics_of_features(f, np.ones(len(f)), mixture)

    def by_table(room):
        counts = count_pairs(room.means, room.normals, np.ones(len(room)), LAYOUT, P)
        return statistics_of_counts(counts, table, len(mixture))

    others = [scenes.room(np.random.default_rng(seed)) for seed in range(100, 106)]
    f = np.concatenate([exact_features(room)[::4] for room in others])
    projection = fit_projection(f, "pca")
    *_, mixture = fit_mixture(project(f, projection), MIXTURE, seed=0)
    table = compute_bins(0, LAYOUT.n_bins, LAYOUT, P, projection, mixture)
    exact, looked_up = distances_of(by_pairs), distances_of(by_table)
    assert np.corrcoef(exact, looked_up)[0, 1] >= 0.98
    assert looked_up.mean() == pytest.approx(exact.mean(), rel=0.05)
