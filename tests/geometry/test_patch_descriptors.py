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
from tests.geometry import scenes

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


def test_equals_the_oracle():
    rng = np.random.default_rng(0)
    for patches in (scenes.random_patches(rng, 40, 0.8), scenes.room(rng, 60)):
        np.testing.assert_allclose(patch_descriptors(patches, P), oracle(patches, P), atol=2e-6)


def test_other_parameters_equal_the_oracle():
    p = PatchDescriptorParameters(0.5, 3, 2, 0.9, 1, 4, 1.1, 2, 1)
    patches = scenes.random_patches(np.random.default_rng(1), 40, 0.8)
    np.testing.assert_allclose(patch_descriptors(patches, p), oracle(patches, p), atol=2e-6)


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
