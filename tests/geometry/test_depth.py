"""Tests of the masking and halving of depth images against manual results."""

import math

import numpy as np
import pytest

from sceneprint.errors import UselessFrame
from sceneprint.geometry.surface.depth_image import DepthParameters, halvings, inverse_depth
from sceneprint.types import DepthFrame, Intrinsics


def parameters(*, focal_length_px=10.0, maximum_pixels=10**6, minimum_valid=1):
    return DepthParameters(
        minimum_side=1,
        minimum_depth=0.5,
        maximum_depth=8.0,
        same_surface=0.05,
        focal_length_px=focal_length_px,
        maximum_pixels=maximum_pixels,
        minimum_valid=minimum_valid,
    )


KINECT = DepthParameters(focal_length_px=146.0, maximum_pixels=160 * 120 * 4)


def frame(depth, focal_length=10.0):
    height, width = depth.shape
    camera = Intrinsics(width, height, focal_length, focal_length, 0.0, 0.0)
    return DepthFrame(depth, camera, "kitchen/7")


def test_two_by_two_by_hand():
    # one block per case: depth in metres -> what is left of its four samples
    blocks = {
        (2.00, 2.00, 2.00, 2.00): 1 / 2,
        (2.00, 2.05, 2.00, 2.05): (1 / 2 + 1 / 2.05) / 2,  # one surface: the mean of 1/z, not of z
        (2.00, 2.09, 4.00, 4.00): (1 / 2 + 1 / 2.09) / 2,  # 2.09 < 2 * 1.05: still the nearest
        (2.00, 2.11, 4.00, 4.00): 1 / 2,  # 2.11 > 2 * 1.05: background
        (4.00, 1.00, 4.00, 4.00): 1 / 1,  # one near sample wins over three far ones
        (0.00, 0.00, 3.00, 0.00): 1 / 3,  # missing ones have no say
        (0.00, 0.00, 0.00, 0.00): 0.0,
        (math.nan, 9.0, 0.1, -1.0): 0.0,
    }
    depth = np.zeros((2, 2 * len(blocks) + 2), np.float32)
    for k, block in enumerate(blocks):
        depth[:, 2 * k : 2 * k + 2] = np.reshape(block, (2, 2))
    # as high as two rows only: pad to four, the least that is still halved
    q, _ = inverse_depth(
        frame(np.vstack([depth, np.zeros_like(depth)]), 20.0), parameters(focal_length_px=10.0)
    )
    assert q.shape == (2, len(blocks) + 1)
    np.testing.assert_allclose(q[0], [*blocks.values(), 0.0], rtol=1e-6)
    assert not q[1].any()


def test_twice_halved_by_hand():
    # first halving of each 4 x 4 quarter: 1/2, 1/4, missing, 1/2.04; of these the second keeps
    # the nearest surface, 1/2 and 1/2.04 (not the 1/4 behind it)
    quarter = np.repeat(np.repeat([[2.0, 4.0], [0.0, 2.04]], 2, axis=0), 2, axis=1)
    depth = np.zeros((8, 8), np.float32)
    depth[:4, 4:] = quarter
    q, camera = inverse_depth(frame(depth, 40.0), parameters(focal_length_px=10.0))
    np.testing.assert_allclose(q, [[0.0, (1 / 2 + 1 / 2.04) / 2], [0.0, 0.0]], rtol=1e-6)
    # the principal point, 0 at first: (0 - .5) / 2 = -.25; (-.25 - .5) / 2 = -.375
    assert (camera.width, camera.height, camera.fx, camera.cy) == (2, 2, 10.0, -0.375)


@pytest.mark.parametrize(
    ("width", "height", "focal_length", "times"),
    [
        (640, 480, 585.0, 2),  # Kinect, VGA: 160 x 120
        (320, 240, 292.5, 1),
        (160, 120, 146.0, 0),
        (80, 60, 73.0, 0),  # never enlarged
        (640, 480, 250.0, 1),  # wide angle: 250 is nearer to 125 than to 250 in octaves
        (640, 480, 200.0, 1),  # 200 would stay, were it not for 307200 > 76800 pixels
        (1280, 960, 100.0, 2),  # very wide: only the number of pixels halves it
        (1280, 720, 900.0, 3),
        (3, 3, 9000.0, 0),  # nothing below four pixels is halved
    ],
)
def test_number_of_halvings(width, height, focal_length, times):
    camera = Intrinsics(width, height, focal_length, focal_length, width / 2, height / 2)
    assert halvings(camera, KINECT) == times


def test_masked_samples_never_enter():
    bad = [0.0, math.nan, math.inf, -math.inf, -2.0, 0.499, 8.001, 1e30]
    depth = np.array([[*bad, 0.5, 8.0, 2.0]], np.float32)
    q, _ = inverse_depth(frame(depth), parameters())
    assert q[0].tolist() == [0.0] * len(bad) + [2.0, 0.125, 0.5]


def test_odd_edges_fall_off():
    depth = np.full((5, 7), 2.0, np.float32)
    depth[4, :] = depth[:, 6] = 1.0  # the row and column that have no partner
    q, camera = inverse_depth(frame(depth, 20.0), parameters())
    np.testing.assert_array_equal(q, np.full((2, 3), 0.5))
    assert (camera.width, camera.height) == (3, 2)


def test_useless_frames_say_why():
    nothing = np.full((8, 8), np.nan, np.float32)
    nothing[:4] = 0.0
    with pytest.raises(UselessFrame, match=r"^kitchen/7: every depth sample is missing\."):
        inverse_depth(frame(nothing), parameters())
    millimetres = np.full((8, 8), 2000.0, np.float32)
    with pytest.raises(
        UselessFrame, match=r"0 of its 64 .* range of .*median is 2e\+03 m.*depth scale"
    ):
        inverse_depth(frame(millimetres), parameters())


def test_minimum_number_of_valid_pixels():
    depth = np.zeros((8, 8), np.float32)
    depth[0, :5] = 2.0
    assert np.count_nonzero(inverse_depth(frame(depth), parameters(minimum_valid=5))[0]) == 5
    with pytest.raises(UselessFrame):
        inverse_depth(frame(depth), parameters(minimum_valid=6))


@pytest.mark.parametrize("shape", [(1, 2), (7, 400), (400, 7)])
def test_images_too_thin_for_a_surface(shape):
    thin = frame(np.ones(shape, np.float32))
    with pytest.raises(UselessFrame, match=rf"{shape[1]} x {shape[0]} samples.*at least 8 rows"):
        inverse_depth(thin, DepthParameters())
