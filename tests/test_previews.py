"""Tests of pictures of frames: pixels, and common properties."""

import io

import numpy as np
import pytest
from PIL import Image

from sceneprint.pictures import (
    MATCH_COLOUR,
    MOST_ROWS,
    QUERY_COLOUR,
    UNKNOWN,
    depth_view,
    normals_view,
    overlay_picture,
    patches_view,
    picture,
)
from sceneprint.types import Intrinsics, Surface


def surface(z, normals=None):
    depth = np.array(z, np.float32)
    points = np.zeros((*depth.shape, 3), np.float32)
    points[..., 2] = depth
    if normals is None:
        normals = np.zeros_like(points)
        normals[..., 2] = -1
    camera = Intrinsics(depth.shape[1], depth.shape[0], 100.0, 100.0, 0.0, 0.0)
    return Surface(points, normals, depth > 0, np.ones_like(depth), camera)


def test_depth_by_hand():
    colours, text = depth_view(surface([[1.0, 2.0, 3.0, 0.0, 1.5]]))
    # viridis of matplotlib at 1, 1/2, 0 and 3/4; percentiles 1 and 99 of 1, 1.5, 2, 3
    near, far = np.percentile([1.0, 1.5, 2.0, 3.0], (1, 99))
    assert colours[0, 0].tolist() == [253, 231, 37]
    assert colours[0, 2].tolist() == [68, 1, 84]
    assert colours[0, 3].tolist() == [UNKNOWN] * 3
    assert (text["near_m"], text["far_m"]) == (f"{near:.4f}", f"{far:.4f}")
    two, _ = depth_view(surface([[1.0] * 50 + [2.0, 3.0] + [3.0] * 49]))
    assert two[0, 50].tolist() == [33, 145, 140]  # half way


def test_normals_by_hand():
    normals = np.array([[[0, 0, -1], [1, 0, 0], [0, -1, 0], [0, 0.6, -0.8]]], np.float32)
    colours, _ = normals_view(surface([[1.0, 1.0, 1.0, 0.0]], normals))
    assert colours[0].tolist() == [[128, 128, 0], [255, 128, 128], [128, 0, 128], [UNKNOWN] * 3]


def test_patches_have_colours_of_their_own_unlike_their_neighbours():
    """900 patches in a grid of 30 x 30, some of them torn in two, with holes between."""
    rng = np.random.default_rng(3)
    labels = np.kron(np.arange(900).reshape(30, 30), np.ones((4, 4), int)).astype(np.int32)
    labels[rng.random(labels.shape) < 0.05] = -1
    colours, text = patches_view(labels)
    assert text["patches"] == "900"
    assert (colours[labels < 0] == UNKNOWN).all()
    first = np.array([colours[labels == i][0] for i in range(900)], int)
    assert all((colours[labels == i] == first[i]).all() for i in range(900))
    assert len(np.unique(first, axis=0)) == 900
    grid = first.reshape(30, 30, 3)
    for beside in (np.abs(np.diff(grid, axis=0)), np.abs(np.diff(grid, axis=1))):
        assert beside.max(axis=2).min() >= 40  # of 255, in the channel that differs most


def test_a_picture_repeats_pixels_and_keeps_its_text():
    colours = np.arange(2 * 64 * 3).reshape(2, 64, 3).astype(np.uint8)
    data = picture(colours, 128, {"near_m": "0.5", "Description": "é"})
    with Image.open(io.BytesIO(data)) as image:
        assert (image.size, image.mode) == ((128, 4), "RGB")
        assert image.text == {"near_m": "0.5", "Description": "é"}
        large = np.asarray(image)
    assert np.array_equal(large, colours.repeat(2, axis=0).repeat(2, axis=1))
    with Image.open(io.BytesIO(picture(large, 64, {}))) as image:
        assert np.array_equal(np.asarray(image), colours)


def test_no_picture_is_larger_than_it_may_be():
    for shape in ((200_000, 1), (5000, 40)):
        with Image.open(io.BytesIO(picture(np.zeros((*shape, 3), np.uint8), 1280, {}))) as image:
            assert image.size[1] == MOST_ROWS
    with Image.open(io.BytesIO(picture(np.zeros((1, 65535, 3), np.uint8), 64, {}))) as image:
        assert image.size == (64, 1)
    for width in (63, 1281):
        with pytest.raises(ValueError, match="in the range 64 to 1280"):
            picture(np.zeros((2, 2, 3), np.uint8), width, {})


def test_an_overlay_by_hand():
    """Two points 4 m apart in x and z, seen from 2 m to the right: 479 pixels stand for 6 m."""
    match = surface([[1.0] * 50, [1.0] * 50])
    match.points[:] = 0.0
    match.points[1, :, 0] = match.points[1, :, 2] = 4.0
    query = surface([[1.0] * 50, [1.0] * 50])
    query.points[:] = match.points - np.float32([2, 0, 0])
    transform = np.eye(4)
    transform[0, 3] = 2.0
    with Image.open(io.BytesIO(overlay_picture(query, match, transform, "hall"))) as image:
        pixels = np.asarray(image)
    before, after = pixels[44:, 8:488], pixels[44:, 504:984]
    assert before[1, 479].tolist() == list(MATCH_COLOUR)
    assert before[1, 319].tolist() == list(QUERY_COLOUR)  # at x = 2
    assert after[1, 319].tolist() == [255, 255, 255]
    assert after[1, 479].tolist() == [37, 50, 30]  # the product of both
