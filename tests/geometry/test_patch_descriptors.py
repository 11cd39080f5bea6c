"""Tests of patch descriptors against another formula, and of their invariances."""

from dataclasses import replace

import numpy as np
import pytest

from sceneprint.geometry.registration.patch_descriptors import (
    ANGLES,
    RANGE,
    Compression,
    PatchDescriptorParameters,
    compress,
    fit_compression,
    patch_descriptors,
)
from sceneprint.types import Patches

P = PatchDescriptorParameters()


def oracle(patches, p):
    """The same histograms by hat functions on clipped coordinates, pair after pair."""

    def hats(at, count):
        return np.maximum(0.0, 1.0 - np.abs(np.clip(at, 0, count - 1) - np.arange(count)))

    rows = []
    for i in range(len(patches)):
        row = []
        for radius, n_flat, n_high in p.scales:
            h = np.zeros((int(n_flat), int(n_high), ANGLES, ANGLES))
            for j in range(len(patches)):
                off = patches.means[j] - patches.means[i]
                if i == j or np.linalg.norm(off) >= radius:
                    continue
                n, m = patches.normals[i], patches.normals[j]
                flat = off - (off @ n) * n
                towards = flat / np.linalg.norm(flat) if np.linalg.norm(flat) > 1e-3 else 0 * flat
                h += patches.areas[j] * np.einsum(
                    "a,b,c,d->abcd",
                    hats(np.linalg.norm(flat) / radius * n_flat - 0.5, int(n_flat)),
                    hats((off @ n / radius + 1) / 2 * n_high - 0.5, int(n_high)),
                    hats((m @ n + 1) / 2 * ANGLES - 0.5, ANGLES),
                    hats((m @ towards + 1) / 2 * ANGLES - 0.5, ANGLES),
                )
            root = np.sqrt(h.ravel())
            row.append(root / max(np.linalg.norm(root), 1e-300) / np.sqrt(len(p.scales)))
        rows.append(np.concatenate(row))
    return np.array(rows)


def test_sizes():
    assert P.dimension == (4 * 5 + 5 * 7 + 6 * 8) * 9
    none = Patches(
        np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0, np.int32), np.empty(0)
    )
    found = patch_descriptors(none, P)
    assert (found.shape, found.dtype) == ((0, P.dimension), np.float32)


def test_equals_the_oracle(scenes):
    rng = np.random.default_rng(0)
    for patches in (scenes.random_patches(rng, 40, 0.8), scenes.room(rng, 60)):
        np.testing.assert_allclose(patch_descriptors(patches, P), oracle(patches, P), atol=2e-6)


def test_other_parameters_equal_the_oracle(scenes):
    p = PatchDescriptorParameters(0.5, 3, 2, 0.9, 1, 4, 1.1, 2, 1)
    patches = scenes.random_patches(np.random.default_rng(1), 40, 0.8)
    np.testing.assert_allclose(patch_descriptors(patches, p), oracle(patches, p), atol=2e-6)


def random_compression(rng, d, bins):
    axes = np.linalg.qr(rng.normal(size=(bins, d)))[0].T
    return Compression(np.full(bins, 0.01, np.float32), axes.astype(np.float32))


def test_compression_of_nothing_is_128():
    by = random_compression(np.random.default_rng(5), 16, 30)
    mean = np.repeat(by.mean[None], 2, axis=0)
    stored = compress(mean, by)
    assert (stored.shape, stored.dtype) == ((2, 16), np.uint8)
    # what rounding leaves of it is not blown up
    assert np.abs(stored.astype(int) - 128).max() <= 2


def test_compression_by_hand():
    # two of three axes kept; less the mean the row is (3, 4, 9) / 10: (.6, .8), beyond RANGE
    by = Compression(np.array([0.1, 0.1, 0.1], np.float32), np.eye(3, dtype=np.float32)[:2])
    assert by.offset.tolist() == pytest.approx([0.1, 0.1])
    assert RANGE == 0.25
    (row,) = compress(np.array([[0.4, 0.5, 1.0]], np.float32), by)
    assert row.tolist() == [255, 255]
    # (.3, -.4) has length .5; but a histogram has no negative bins
    by = replace(by, mean=np.array([0.1, 0.9, 0.1], np.float32))
    (row,) = compress(np.array([[0.4, 0.5, 1.0]], np.float32), by)
    assert row.tolist() == [255, 0]
    # 1 of 64 equal components is .125: half of 127
    by = Compression(np.zeros(64, np.float32), np.eye(64, dtype=np.float32))
    (row,) = compress(np.ones((1, 64), np.float32), by)
    assert row.tolist() == [192] * 64


def test_principal_components_equal_those_of_the_svd():
    rng = np.random.default_rng(7)
    scales = np.linspace(3, 0.2, 12)
    rows = (rng.normal(size=(400, 12)) * scales + 0.3).astype(np.float32)
    by = fit_compression(rows, 5)
    assert (by.mean.dtype, by.matrix.dtype) == (np.float32, np.float32)
    np.testing.assert_allclose(by.mean, rows.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(by.matrix @ by.matrix.T, np.eye(5), atol=1e-6)
    _, _, vt = np.linalg.svd(rows.astype(float) - rows.mean(axis=0, dtype=float))
    np.testing.assert_allclose(np.abs((by.matrix * vt[:5]).sum(axis=1)), 1.0, atol=1e-5)
    # of the two signs the one that makes the largest entry positive
    assert (by.matrix[np.arange(5), np.abs(by.matrix).argmax(axis=1)] > 0).all()


def test_components_that_cannot_be_learnt():
    rows = np.ones((13, 12), np.float32)
    for count, dimension in ((12, 3), (13, 0), (13, 13), (0, 1)):
        with pytest.raises(ValueError, match=f"determine {dimension} components"):
            fit_compression(rows[:count], dimension)
    assert fit_compression(rows, 12).matrix.shape == (12, 12)
