"""Tests that images other than depth are rejected with advice, and depth is accepted."""

import numpy as np
import pytest

from sceneprint.errors import UnreadableFrame
from sceneprint.formats.dataset import decode_frame
from sceneprint.formats.depth_file import encode_npy, encode_png
from sceneprint.types import Intrinsics

RANDOM = np.random.default_rng(11)


def room(noise=0.002, width=320, height=240):
    """A slanted wall behind a ball, with holes: (H, W) millimetres."""
    v, u = np.mgrid[:height, :width] / height
    depth = 1500.0 + 900.0 * u + 400.0 * v
    ball = 0.09 - (u - 0.6) ** 2 - (v - 0.5) ** 2
    depth = np.where(ball > 0, 1200.0 - 600.0 * np.sqrt(np.abs(ball)), depth)
    depth *= 1.0 + noise * RANDOM.standard_normal(depth.shape)
    depth[RANDOM.random(depth.shape) < 0.05] = 0.0
    depth[:, :7] = 65535.0
    return depth.astype(np.uint16)


def rotated_left(samples, bits):
    return (samples << bits) | (samples >> (16 - bits))


def decode(samples, depth_scale=1000.0):
    height, width = samples.shape
    data = encode_png(samples) if samples.dtype == np.uint16 else encode_npy(samples)
    camera = Intrinsics(width, height, 300.0, 300.0, width / 2, height / 2)
    return decode_frame(data, camera, depth_scale=depth_scale).depth


DEPTH = {
    "clean": room(0.0),
    "of a Kinect": room() // 5 * 5,
    "of 2 % noise": room(0.02),
    "of 80 x 60": room(width=80, height=60),
    "of 8 bits": (room(0.0) // 16).astype(np.uint16) << 8,
    "sparse": np.where(RANDOM.random((240, 320)) < 0.1, room(), 0).astype(np.uint16),
    "flat": np.full((240, 320), 2000, np.uint16),
    "in metres": np.where(room() == 65535, np.nan, room() / 1000.0).astype(np.float32),
}


@pytest.mark.parametrize("kind", DEPTH)
def test_depth_is_taken(kind):
    assert (decode(DEPTH[kind]) > 0).mean() > 0.08


@pytest.mark.parametrize("kind", ["clean", "of a Kinect", "of 80 x 60"])
def test_swapped_bytes_are_refused(kind):
    with pytest.raises(UnreadableFrame, match=r"wrong byte order.*samples\.byteswap\(\)"):
        decode(DEPTH[kind].byteswap())
    np.testing.assert_array_equal(decode(DEPTH[kind].byteswap().byteswap()), decode(DEPTH[kind]))


@pytest.mark.parametrize("bits", [3, 5])
def test_bits_rotated_right_are_refused(bits):
    with pytest.raises(UnreadableFrame, match=rf"Write d << {bits} \| d >> {16 - bits} for"):
        decode(rotated_left(room(), 16 - bits))


def test_bits_rotated_left_are_refused_unless_the_scale_is_of_them():
    samples = room()
    with pytest.raises(UnreadableFrame, match=r"d >> 3 \| d << 13 .* set depth_scale to 8000"):
        decode(rotated_left(samples, 3))
    seen = (samples > 0) & (samples < 65535)
    eighths = decode(rotated_left(samples, 3), depth_scale=8000.0)
    np.testing.assert_allclose(eighths[seen], decode(samples)[seen], rtol=1e-6)


def test_infrared_is_refused():
    speckle = 2000.0 * RANDOM.gamma(60.0, 1 / 60.0, (240, 320))  # 13 % of noise
    for samples in (speckle.astype(np.uint16), (speckle / 1000).astype(np.float32)):
        with pytest.raises(
            UnreadableFrame, match=r"not seem to be depth: .*infrared.* --trust-depth"
        ):
            decode(samples)
