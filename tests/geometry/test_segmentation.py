"""Tests of the segmentation of exact scenes, and of sums over patches."""

import numpy as np
import pytest

from sceneprint.geometry.signature import segmentation as module
from sceneprint.geometry.signature.segmentation import (
    SegmentationParameters,
    extract_patches,
    segment,
)
from tests.geometry import scenes


def parameters(n_patches=120, minimum_size=0.15, minimum_pixels=4):
    return SegmentationParameters(
        n_patches=n_patches,
        iterations=5,
        normal_weight=6.0,
        minimum_size=minimum_size,
        minimum_pixels=minimum_pixels,
    )


def wall(distance=2.0):
    towards = np.array([0.0, 0.0, -1.0])
    q = scenes.plane(scenes.CAMERA, towards, np.array([0.0, 0.0, distance]))
    return scenes.lifted(scenes.CAMERA, q, np.broadcast_to(towards, (*q.shape, 3)))


def test_no_patch_mixes_two_planes():
    seen, plane_of = scenes.corner()
    assert [int((plane_of == k).sum()) > 300 for k in range(3)] == [True] * 3
    labels = segment(seen, parameters())
    patches = extract_patches(seen, labels)
    at = labels >= 0
    off = scenes.degrees_between(seen.normals[at].astype(float), patches.normals[labels[at]])
    assert off.max() < 0.1  # the planes are at right angles
    for k in range(len(patches)):
        assert len(set(plane_of[labels == k])) == 1


def test_every_pixel_is_in_a_patch_or_in_a_dropped_one():
    seen, _ = scenes.corner()
    seen.valid[20:30, 15:40] = False
    every = segment(seen, parameters(minimum_size=0.0, minimum_pixels=1))
    np.testing.assert_array_equal(every >= 0, seen.valid)
    some = segment(seen, parameters(minimum_size=0.79))
    smallest = 0.79 * 80 * 60 / 120
    sizes = np.bincount(every[every >= 0])
    dropped = (every >= 0) & (sizes[every] < smallest)
    assert 0 < dropped.sum() < 0.2 * seen.valid.sum()
    np.testing.assert_array_equal(some >= 0, seen.valid & ~dropped)
    assert np.bincount(some[some >= 0]).min() >= smallest
    # the other limit, in pixels
    few = segment(seen, parameters(minimum_size=0.0, minimum_pixels=15))
    np.testing.assert_array_equal(few >= 0, seen.valid & (sizes[every] >= 15))


def test_labels_have_no_gaps_and_follow_the_image():
    seen = wall()
    labels = segment(seen, parameters(n_patches=48))
    assert labels.dtype == np.int32
    # 48 cells of 10 x 10 pixels: 6 rows of 8, left to right and top to bottom
    np.testing.assert_array_equal(np.unique(labels), np.arange(48))
    for k in range(48):
        y, x = np.nonzero(labels == k)
        assert (y.mean() // 10, x.mean() // 10) == divmod(k, 8)
    corner, _ = scenes.corner()
    corner.valid[:, 30:50] = False
    labels = segment(corner, parameters())
    np.testing.assert_array_equal(np.unique(labels), np.arange(-1, labels.max() + 1))


def test_patches_respect_depth_edges():
    # one wall half a metre before the other, with the same normal: only position tells them apart
    towards = np.array([0.0, 0.0, -1.0])
    q = np.full((60, 80), 1 / 2.0)
    q[:, :37] = 1 / 1.5
    seen = scenes.lifted(scenes.CAMERA, q, np.broadcast_to(towards, (60, 80, 3)))
    labels = segment(seen, parameters())
    assert not set(labels[:, :37].ravel()) & set(labels[:, 37:].ravel())


def test_patches_of_equals_the_loop():
    rng = np.random.default_rng(1)
    seen, _ = scenes.corner()
    labels = rng.integers(-1, 7, seen.valid.shape).astype(np.int32)
    labels[~seen.valid] = -1
    patches = extract_patches(seen, labels)
    assert len(patches) == 7
    for k in range(7):
        mean, normal, area, size = np.zeros(3), np.zeros(3), 0.0, 0
        for y, x in np.argwhere(labels == k):
            w = float(seen.areas[y, x])
            mean += w * seen.points[y, x]
            normal += w * seen.normals[y, x]
            area += w
            size += 1
        np.testing.assert_allclose(patches.means[k], mean / area, rtol=1e-6)
        np.testing.assert_allclose(patches.normals[k], normal / np.linalg.norm(normal), atol=1e-6)
        assert patches.areas[k] == pytest.approx(area, rel=1e-6)
        assert patches.sizes[k] == size


def naive_assignment(pixels, centres, spacing, weight, columns):
    """The nearest of nine centres of each pixel, one after the other, the first of equals."""
    _, height, width = pixels.shape
    rows = len(centres) // columns
    labels = np.full((height, width), -1, np.int32)
    for y, x in np.ndindex(height, width):
        px, py, pz, nx, ny, nz = pixels[:, y, x]
        nearest = np.float32(np.inf)
        for n in range(9):
            row = min(int(y / spacing), rows - 1) + n // 3 - 1
            column = min(int(x / spacing), columns - 1) + n % 3 - 1
            if not (0 <= row < rows and 0 <= column < columns):
                continue
            cx, cy, cz, mx, my, mz, scale = centres[row * columns + column]
            dx, dy, dz = px - cx, py - cy, pz - cz
            cosine = nx * mx + ny * my + nz * mz
            cost = (dx * dx + dy * dy + dz * dz) * scale + weight * (np.float32(1) - cosine)
            if scale > 0 and cost < nearest:
                labels[y, x], nearest = row * columns + column, cost
    return labels


@pytest.mark.parametrize(("height", "width", "spacing"), [(31, 23, 4.3), (9, 40, 9.0), (20, 20, 1)])
def test_pixels_get_the_nearest_of_nine_centres(height, width, spacing):
    rng = np.random.default_rng(height)
    rows, columns = max(round(height / spacing), 1), max(round(width / spacing), 1)
    pixels = rng.normal(size=(6, height, width)).astype(np.float32)
    centres = rng.normal(size=(rows * columns, 7)).astype(np.float32)
    centres[:, 6] = rng.uniform(0.5, 2, len(centres)) * (rng.random(len(centres)) < 0.8)
    valid = rng.random((height, width)) < 0.9
    labels, weight = np.zeros((height, width), np.int32), np.float32(6)
    module._assign(pixels, valid, centres, spacing, weight, columns, labels)
    expected = naive_assignment(pixels, centres, spacing, weight, columns)
    np.testing.assert_array_equal(labels, np.where(valid, expected, -1))
    assert len(np.unique(labels)) > 0.4 * len(centres)
