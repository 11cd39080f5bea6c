"""Tests of neighbours against all pairs, and of planes against NumPy."""

import numpy as np
import pytest

from sceneprint.geometry.surface.cloud import hash_key
from sceneprint.geometry.surface.voxels import (
    fit_inverse_planes,
    fit_planes,
    least_axis,
    link_points,
)


def of(links):
    return [
        set(links.indices[a:b].tolist())
        for a, b in zip(links.offsets[:-1], links.offsets[1:], strict=True)
    ]


def naive(places, heights):
    near = np.linalg.norm(places[:, None] - places[None], axis=2) < 1
    near &= np.abs(heights[:, None] - heights[None]) < 1
    np.fill_diagonal(near, False)
    return [set(np.flatnonzero(row).tolist()) for row in near]


@pytest.mark.parametrize("spread", [0.5, 3.0, 400_000.0])
def test_links_are_all_pairs_that_are_near(spread):
    rng = np.random.default_rng(3)
    seeds = rng.uniform(-spread, spread, (12, 3))
    places = np.repeat(seeds, 20, axis=0) + rng.normal(size=(240, 3))
    heights = rng.uniform(0, 3, 240)
    assert of(link_points(places, heights)) == naive(places, heights)


def test_cells_that_share_a_slot_do_so_under_one_secret_only():
    """Nobody can know which cells make a table slow; what is found does not depend on it."""
    keys, mask = np.arange(200_000, dtype=np.int64) << 21, (1 << 20) - 1
    same = [int(key) for key in keys if hash_key(key, 5) & mask < 1 << 12]
    assert len(same) > 500
    assert len({hash_key(key, 77) & mask for key in same}) > 0.98 * len(same)


def test_no_points_no_links():
    assert len(link_points(np.empty((0, 3)), np.empty(0)).indices) == 0


def test_links_among_those_kept():
    rng = np.random.default_rng(4)
    places = rng.uniform(-1.5, 1.5, (80, 3))
    links = link_points(places, np.zeros(80))
    keep, held = rng.random(80) < 0.7, rng.random(len(links.indices)) < 0.8
    number = {int(i): k for k, i in enumerate(np.flatnonzero(keep))}
    wanted = [set() for _ in number]
    sources = np.repeat(np.arange(80), np.diff(links.offsets))
    for i, j, is_held in zip(sources.tolist(), links.indices.tolist(), held, strict=True):
        if is_held and i in number and j in number:
            wanted[number[i]].add(number[j])
    assert of(links.select(keep, held)) == wanted


@pytest.mark.parametrize("seed", range(2))
def test_least_axis_is_the_eigenvector_of_the_least(seed):
    half = np.random.default_rng(seed).normal(size=(3, 3)) * [1.0, 0.3, 1e-3]
    m = half @ half.T
    values, vectors = np.linalg.eigh(m)
    result, axis = np.zeros(3), np.zeros(3)
    least_axis(m.copy(), result, axis)
    np.testing.assert_allclose(np.sort(result), values, atol=1e-12)
    assert abs(axis @ vectors[:, 0]) == pytest.approx(1.0, abs=1e-9)


def test_facing_normals_are_numpys_components():
    rng = np.random.default_rng(6)
    places = rng.uniform(-2, 2, (400, 3)) * [1, 1, 0.02] + [0, 0, 5]
    links = link_points(places, np.zeros(400))
    normals, at = np.zeros_like(places), places.copy()
    limits = np.array([5.0, 1e-9])
    fit_planes(places, links.offsets, links.indices, 10.0, limits, normals, at)
    for i, result in enumerate(of(links)):
        group = places[sorted({i, *result})]
        if len(group) < 5:
            assert not normals[i].any()
            continue
        centre = group.mean(axis=0)
        axis = np.linalg.svd(group - centre)[2][2]
        axis = axis if axis @ places[i] < 0 else -axis
        np.testing.assert_allclose(normals[i], axis, atol=1e-7)
        assert (at[i] - centre) @ axis == pytest.approx(0.0, abs=1e-9)
    assert (np.abs(normals[:, 2]) > 0.99).mean() > 0.9


def test_seen_planes_are_exact_beside_a_step():
    y, z = (one.reshape(-1) for one in np.meshgrid(np.arange(-1, 1, 0.05), np.arange(-1, 1, 0.05)))
    left, right = np.array([0.3, 0.02, -0.1]), np.array([0.25, 0.0, 0.0])  # a of a . p = 1
    rays = np.column_stack([np.full(len(y), 3.0), y, z])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    q = np.where(y < 0, rays @ left, rays @ right)
    links = link_points(rays / 0.06, -np.log(q) / 0.05)
    planes = np.zeros_like(rays)
    gates, limits = np.array([0.05, 0.006, 0.006]), np.array([6.0, 0.0])
    fit_inverse_planes(q, rays, links.offsets, links.indices, gates, limits, planes)
    inner = np.abs(z) < 0.9
    for side, a in ((y < 0, left), (y > 0, right)):
        result = planes[side & inner & (np.abs(y) < 0.9)]
        np.testing.assert_allclose(result, np.broadcast_to(a, result.shape), atol=1e-9)
