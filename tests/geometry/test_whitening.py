"""Tests of whitened signatures against NumPy, and of their covariance."""

import numpy as np
import pytest

from sceneprint.geometry.signature.fisher_vector import (
    UNITS,
    WhiteningParameters,
    _products,
    fit_whitening,
    psi_units,
    whiten,
)


def frames(n, length=300, seed=0):
    """(n, length) unit vectors about a mean, with axes of very different spread."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(np.random.default_rng(99).normal(size=(length, length)))[0]
    spread = 1.0 / np.arange(1, length + 1)
    psi = 0.5 * turn[0] + (rng.normal(size=(n, length)) * spread) @ turn
    return psi / np.linalg.norm(psi, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def psi():
    return frames(200)


@pytest.fixture(scope="module")
def fit(psi):
    return fit_whitening(psi_units(psi), (1,), WhiteningParameters(32))


def projected(psi, fit):
    """What `whiten` rounds, in plain numpy."""
    z = fit.scales * (np.rint(psi * UNITS) @ fit.basis.T.astype(float) - fit.offsets)
    return z / np.linalg.norm(z, axis=-1, keepdims=True)


def test_products_are_exact_at_the_ends_of_their_range():
    basis = np.array([[127] * 25_000, [-127] * 25_000], np.int8)
    psi = np.full(25_000, round(UNITS / np.sqrt(25_000)), np.int16)  # of length 1
    result = np.empty(2, np.int32)
    _products(basis, psi, result)
    assert result.tolist() == (basis.astype(np.int64) @ psi.astype(np.int64)).tolist()


def test_the_same_as_numpy(psi, fit):
    wanted = np.clip(np.rint(fit.gain * projected(psi, fit)), -127, 127) + 128
    stored = np.stack([whiten(one, fit) for one in psi])
    assert stored.dtype == np.uint8
    assert np.abs(stored.astype(int) - wanted).max() == 0


def test_axes_are_principal_and_whitened(psi, fit):
    """The training frames spread alike along each axis, and no two axes say the same."""
    units = psi_units(psi).astype(float)
    z = fit.scales * (units @ fit.basis.T.astype(float) - fit.offsets)
    np.testing.assert_allclose(z.mean(axis=0), 0, atol=1e-9)
    covariance = z.T @ z / len(z)
    np.testing.assert_allclose(covariance, np.eye(32), atol=0.03)  # int8 axes: .7 % each
    _, _, axes = np.linalg.svd(units - units.mean(axis=0), full_matrices=False)
    own = fit.basis / np.linalg.norm(fit.basis, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs((own * axes[:32]).sum(axis=1)), 1.0, atol=1e-3)
