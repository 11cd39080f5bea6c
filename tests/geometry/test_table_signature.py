"""Tests of signatures from the table against exact signatures of random rooms."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType

import numpy as np
import pytest
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from sceneprint.geometry.signature.fisher_vector import (
    fisher_vector,
    normalise,
    statistics_of_counts,
    statistics_of_features,
)
from sceneprint.geometry.signature.mixture import Mixture, MixtureParameters, fit_mixture
from sceneprint.geometry.signature.pair_features import (
    PairTable,
    Projection,
    PropertyParameters,
    TableLayout,
    compute_bins,
    count_pairs,
    fit_projection,
    neighbour_pairs,
    pair_properties,
    project,
)
from sceneprint.types import Floats, Patches

LAYOUT = TableLayout(distance_bins=36, angle_bins=25, dihedral_bins=36, distance_exponent=1.3)
P = PropertyParameters(radius=3.0, angular_tolerance=math.radians(10), colinearity=0.9995)
MIXTURE = MixtureParameters(
    n_components=24, iterations=5, variance_floor=1e-2, prior_variance=0.1, prior_count=5.0,
    minimum_weight=1e-6,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Signatures:
    """A small model and the two ways to sign with it."""

    projection: Projection
    mixture: Mixture
    table: PairTable

    def exact(self, patches: Patches) -> Floats:
        f = project(pair_properties(patches, neighbour_pairs(patches, P), P), self.projection)
        s = statistics_of_features(f, np.ones(len(f)), self.mixture)
        return normalise(fisher_vector(s, self.mixture))

    def looked_up(self, patches: Patches) -> Floats:
        weights = np.ones(len(patches))
        counts = count_pairs(patches.means, patches.normals, weights, LAYOUT, P)
        s = statistics_of_counts(counts, self.table, len(self.mixture))
        return normalise(fisher_vector(s, self.mixture))


@pytest.fixture(scope="module")
def rooms(scenes: ModuleType) -> list[Patches]:
    return [scenes.room(np.random.default_rng(seed)) for seed in range(12)]


@pytest.fixture(scope="module")
def signatures(scenes: ModuleType) -> Signatures:
    others = [scenes.room(np.random.default_rng(seed)) for seed in range(100, 106)]
    f = np.concatenate([pair_properties(x, neighbour_pairs(x, P), P)[::4] for x in others])
    projection = fit_projection(f, "pca")
    *_, mixture = fit_mixture(project(f, projection), MIXTURE, seed=0)
    return Signatures(
        projection, mixture, compute_bins(0, LAYOUT.n_bins, LAYOUT, P, projection, mixture)
    )


def test_table_distances_follow_exact_ones(rooms: list[Patches], signatures: Signatures) -> None:
    exact = pdist([signatures.exact(room) for room in rooms], "cityblock")
    looked_up = pdist([signatures.looked_up(room) for room in rooms], "cityblock")
    assert np.corrcoef(exact, looked_up)[0, 1] >= 0.98
    assert looked_up.mean() == pytest.approx(exact.mean(), rel=0.05)


def test_a_room_is_nearest_to_itself(rooms: list[Patches], signatures: Signatures) -> None:
    exact = np.array([signatures.exact(room) for room in rooms])
    for k, room in enumerate(rooms):
        distance = np.abs(signatures.looked_up(room) - exact).sum(axis=1)
        assert int(distance.argmin()) == k


def test_no_rigid_motion_changes_a_signature(
    scenes: ModuleType, rooms: list[Patches], signatures: Signatures
) -> None:
    rng = np.random.default_rng(1)
    for room in rooms[:3]:
        moved = scenes.moved(room, Rotation.random(rng=rng), rng.uniform(-20, 20, 3))
        for sign in (signatures.exact, signatures.looked_up):
            np.testing.assert_allclose(sign(moved), sign(room), rtol=0, atol=1e-6)
    assert np.abs(signatures.exact(rooms[0]) - signatures.exact(rooms[1])).max() > 0.01


def test_order_of_patches_does_not_matter(rooms: list[Patches], signatures: Signatures) -> None:
    room, order = rooms[0], np.random.default_rng(2).permutation(len(rooms[0]))
    shuffled = Patches(
        room.means[order], room.normals[order], room.areas[order],
        room.sizes[order], room.coherences[order],
    )  # fmt: skip
    np.testing.assert_array_equal(signatures.looked_up(shuffled), signatures.looked_up(room))
    np.testing.assert_allclose(signatures.exact(shuffled), signatures.exact(room), atol=1e-6)
