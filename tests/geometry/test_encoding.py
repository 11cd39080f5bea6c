"""Tests of Eq. (2), its normalisation and its storage."""

from __future__ import annotations

import math
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sceneprint.geometry.signature import fisher_vector as module
from sceneprint.geometry.signature.fisher_vector import (
    LevelStatistics,
    fisher_vector,
    normalise,
    quantise,
    signature,
    statistics_of_counts,
    statistics_of_features,
)
from sceneprint.geometry.signature.mixture import Mixture, posteriors
from sceneprint.geometry.signature.pair_features import LEADING, PairCounts, PairTable, pack_table
from sceneprint.types import Floats, Floats32, Ints32


def random_mixture(rng: np.random.Generator, n: int, spread: float = 1.0) -> Mixture:
    weights = rng.uniform(0.2, 1, n)
    return Mixture(
        weights / weights.sum(),
        rng.normal(0, spread, (n, 12)),
        rng.uniform(0.3, 2, (n, 12)),
    )


def eq2(features: Floats, mixture: Mixture) -> list[float]:
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


def phi_of(features: Floats, mixture: Mixture) -> Floats:
    return fisher_vector(statistics_of_features(features, np.ones(len(features)), mixture), mixture)


def test_golden(goldens: ModuleType) -> None:
    goldens.check_eq2(module)


def test_equals_the_loop() -> None:
    rng = np.random.default_rng(0)
    mixture, features = random_mixture(rng, 3), rng.normal(size=(7, 12))
    np.testing.assert_allclose(
        phi_of(features, mixture), eq2(features, mixture), rtol=0, atol=1e-12
    )


def test_gradient_is_zero_under_the_mixture_itself() -> None:
    # the score has mean 0 and, divided by its Fisher information, at most unit variance
    rng = np.random.default_rng(1)
    mixture, n = random_mixture(rng, 4), 40_000
    g = rng.choice(4, n, p=mixture.weights)
    features = mixture.means[g] + rng.normal(size=(n, 12)) * np.sqrt(mixture.variances[g])
    error = 1 / math.sqrt(n)
    assert np.abs(phi_of(features, mixture)).max() < 4.5 * error
    assert np.abs(phi_of(features + 0.1, mixture)).max() > 10 * error


def test_order_and_repetition_do_not_matter() -> None:
    rng = np.random.default_rng(2)
    mixture, features = random_mixture(rng, 3), rng.normal(size=(50, 12))
    expected = phi_of(features, mixture)
    np.testing.assert_allclose(phi_of(rng.permutation(features), mixture), expected, atol=1e-12)
    np.testing.assert_allclose(phi_of(np.tile(features, (3, 1)), mixture), expected, atol=1e-12)


def test_normalised_by_hand() -> None:
    # roots 2, -3, 0, 6: of length 7
    np.testing.assert_allclose(
        normalise(np.array([4.0, -9.0, 0.0, 36.0])), [2 / 7, -3 / 7, 0, 6 / 7], rtol=1e-12
    )
    assert normalise(np.zeros(5)).tolist() == [0.0] * 5


FLOATS = hnp.arrays(
    float,
    st.integers(1, 40),
    elements=st.floats(-1e3, 1e3).filter(lambda x: x == 0 or abs(x) > 1e-6),
)


@settings(max_examples=50)
@given(FLOATS)
def test_normalised_has_unit_norm_and_the_same_signs(phi: Floats) -> None:
    result = normalise(phi)
    assert np.linalg.norm(result) == pytest.approx(1.0 if phi.any() else 0.0, abs=1e-12)
    np.testing.assert_array_equal(np.sign(result), np.sign(phi))
    np.testing.assert_allclose(result**2 * np.abs(phi).sum(), np.abs(phi), rtol=1e-9)


def test_signature_is_its_levels_end_to_end() -> None:
    fine, coarse = np.array([4.0, -9.0, 0.0, 36.0]), np.array([0.0, -0.25, 0.0, 0.0])
    expected = [2 / 7, -3 / 7, 0, 6 / 7, 0, -1, 0, 0]
    np.testing.assert_allclose(signature([fine, coarse]), expected, rtol=1e-12)


def table_of(features: Floats, mixture: Mixture) -> PairTable:
    pi = posteriors(features, mixture)
    order = np.argsort(-pi, axis=1)[:, :LEADING]
    shares = np.zeros((len(features), LEADING), np.float32)
    shares[:, : order.shape[1]] = np.take_along_axis(pi, order, axis=1)
    components = np.zeros((len(features), LEADING), np.int16)
    components[:, : order.shape[1]] = order
    return pack_table(features.astype(np.float32), shares, components)


def counted(counts: Ints32) -> PairCounts:
    n = int(counts.sum())
    return PairCounts(counts.astype(np.float32), n, float(n))


def test_statistics_of_counts_equal_those_of_the_pairs() -> None:
    # wide components, so that no share is so small that it is left out
    rng = np.random.default_rng(3)
    mixture = random_mixture(rng, 5, 0.3)
    wide = Mixture(mixture.weights, mixture.means, mixture.variances + 4)
    bins = rng.normal(size=(40, 12)).astype(np.float32).astype(float)
    assert posteriors(bins, wide).min() > 2e-3
    counts = rng.integers(0, 4, 40).astype(np.int32)
    n = int(counts.sum())
    found = statistics_of_counts(counted(counts), table_of(bins, wide), 5)
    exact = statistics_of_features(np.repeat(bins, counts, axis=0), np.ones(n), wide)
    assert found.n_pairs == exact.n_pairs == found.total == exact.total == n
    weighted = statistics_of_features(bins, counts.astype(float), wide)
    np.testing.assert_allclose(weighted.second, exact.second, rtol=1e-12, atol=1e-12)
    assert (weighted.n_pairs, weighted.total) == (40, n)
    for a, b in ((found.zeroth, exact.zeroth), (found.first, exact.first)):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found.second, exact.second, rtol=1e-5, atol=1e-5)


def test_statistics_of_counts_by_hand() -> None:
    table = pack_table(
        np.full((3, 12), 2.0, np.float32),
        np.array([[0.75, 0.25, 5e-3] + [0] * 5, [1, 0, 0.5] + [0] * 5, [1] + [0] * 7], np.float32),
        np.array([[1, 0, 2] + [0] * 5, [0, 1] + [0] * 6, [1] * 8], np.int16),
    )
    s = statistics_of_counts(counted(np.array([4, 3, 0])), table, 3)
    # four pairs shared 3 : 1, with a trace of component 2; three of component 0, whose list
    # ends at the first share of 0; the last bin is empty
    zeroth = np.array([4.0, 3.0, 0.02])
    np.testing.assert_allclose(s.zeroth, zeroth, rtol=1e-6)
    np.testing.assert_allclose(s.first, np.outer(2 * zeroth, np.ones(12)), rtol=1e-6)
    np.testing.assert_allclose(s.second, np.outer(4 * zeroth, np.ones(12)), rtol=1e-6)


def naive_sums(counts: Floats32, table: PairTable, n: int) -> Floats:
    """Bin after bin, share after share, as the definition has it."""
    sums = np.zeros((n, 32))
    for b in np.flatnonzero(counts):
        f = table.features[b].astype(float)
        for k in range(LEADING):
            share = table.posteriors[b, k]
            if share == 0:
                break
            weight = float(counts[b] * share)  # rounded to single precision
            row = np.concatenate([f, f * f, [1.0], np.zeros(7)])
            sums[table.components[b, k]] += weight * row
    return sums


@pytest.mark.parametrize("filled", [0, 1, 16, 17, 400])
def test_sums_over_the_table_are_the_same_to_the_bit(filled: int) -> None:
    # fewer bins than are asked for ahead, and more; compiled, and without a compiler
    rng, n = np.random.default_rng(filled), 5
    shares = rng.uniform(0.01, 1, (400, LEADING)).astype(np.float32)
    shares[np.arange(LEADING) > rng.integers(0, LEADING, 400)[:, None]] = 0  # one at least
    table = pack_table(
        rng.normal(size=(400, 12)).astype(np.float32),
        shares,
        rng.integers(0, n, (400, LEADING)).astype(np.int16),
    )
    counts = np.zeros(400, np.float32)
    counts[rng.choice(400, filled, replace=False)] = rng.uniform(0.01, 99, filled)
    expected = naive_sums(counts, table, n)
    assert bool(expected.any()) == (filled > 0)
    for accumulate in (module._accumulate, module._accumulate.function):
        sums = np.zeros((n, 32))
        accumulate(counts, table.packed, table.packed.view(np.int16), sums)
        assert sums.tobytes() == expected.tobytes()


def test_quantise_by_hand() -> None:
    psi = np.array([0.0, 0.1, -0.1, 0.26, 12.6, 12.7, 99.0, -12.8, -12.9, -99.0])
    expected = [128, 129, 127, 131, 254, 255, 255, 0, 0, 0]
    stored = quantise(psi, 0.1)
    assert stored.dtype == np.uint8
    assert stored.tolist() == expected


@settings(max_examples=50)
@given(st.integers(0, 10**6), st.integers(1, 400), st.floats(1e-4, 1e-2))
def test_bytes_stand_for_the_signature(seed: int, n: int, step: float) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-127 * step, 127 * step, (2, n))
    stored = [(quantise(psi, step).astype(float) - 128) * step for psi in (a, b)]
    for psi, back in zip((a, b), stored, strict=True):
        assert np.abs(psi - back).max() <= step / 2 * (1 + 1e-9)
    of_bytes, exact = np.abs(stored[0] - stored[1]).sum(), np.abs(a - b).sum()
    # at most a step for each component, and far less where the errors even out
    assert abs(of_bytes - exact) <= n * step * (1 + 1e-9)
    assert abs(of_bytes - exact) <= 5 * step * math.sqrt(n)


def test_one_pair_is_enough() -> None:
    mixture = random_mixture(np.random.default_rng(4), 2)
    f = mixture.means[:1]
    pi = posteriors(f, mixture)[0]
    phi = fisher_vector(
        LevelStatistics(pi, np.outer(pi, f[0]), np.outer(pi, f[0] ** 2), 1, 1.0), mixture
    )
    np.testing.assert_allclose(phi, eq2(f, mixture), rtol=0, atol=1e-12)
    # at its own mean a component has no first-order term
    assert np.abs(phi[1:13]).max() < 1e-12
