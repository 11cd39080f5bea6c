"""Tests that images other than depth are rejected with advice, and depth is accepted."""

import numpy as np
import pytest

from sceneprint.errors import InvalidIntrinsics, UnreadableFrame
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
    "of 2 % noise without holes": (
        2000.0 * (1.0 + 0.02 * RANDOM.standard_normal((480, 640)))
    ).astype(np.uint16),
    "of waves and 2.8 % noise without holes": (
        2000.0
        * (1.0 + 0.025 * np.sin(2 * np.pi * np.arange(640) / 64))
        * (1.0 + 0.028 * RANDOM.standard_normal((480, 640)))
    ).astype(np.uint16),
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


def infrared(texture, width=640, height=480):
    """A smooth image (H, W) without noise or holes: a lit wall with sinusoidal reflectance, whose
    waves are a tenth of the width long.
    """
    v, u = np.mgrid[:height, :width] / width
    waves = np.sin(20 * np.pi * (u + 0.3 * v)) * np.sin(20 * np.pi * (v - 0.2 * u))
    return 2000.0 / (1.0 + u) ** 2 * (1.0 + texture * waves)


@pytest.mark.parametrize("kind", [np.uint16, np.float32])
def test_smooth_infrared_with_texture_is_refused_if_it_has_no_holes(kind):
    image = infrared(0.3) / (1.0 if kind is np.uint16 else 1000.0)
    image[:, :13] = 0.0  # 2.03 % of the samples
    assert (decode(image.astype(kind)) > 0).mean() == 627 / 640
    image[:, 0] = image[:, 13]
    with pytest.raises(UnreadableFrame, match=r"not seem to be depth: .*infrared"):
        decode(image.astype(kind))


def test_the_limits_of_texture():
    assert decode(infrared(0.05).astype(np.uint16)).all()
    with pytest.raises(UnreadableFrame, match="infrared"):
        decode(infrared(0.07).astype(np.uint16))


def test_images_of_8_bits_are_refused_unless_their_scale_is_coarse():
    samples = (infrared(0.0) / 8).astype(np.uint16)
    assert samples.max() == 250
    with pytest.raises(UnreadableFrame, match=r"255 at most.* 8 bits.* --trust-depth"):
        decode(samples)
    samples[240, 320] = 256
    assert decode(samples).max() == np.float32(0.256)
    assert decode(samples // 2, depth_scale=50.0).max() == np.float32(2.56)


@pytest.mark.parametrize("limit", [1023, 2047, 8191, 32767])
def test_images_with_many_samples_at_a_limit_of_bits_are_refused(limit):
    samples = np.minimum(room(0.0), limit - 1)
    samples[room(0.0) == 0] = 0
    few = 5  # of 240 sampled columns and rows: 5 of 240 columns are 2.1 %
    samples[:, :7] = limit
    with pytest.raises(UnreadableFrame, match=f"Many samples are {limit}, the maximum of"):
        decode(samples)
    samples[:, few:7] = 0
    assert decode(samples).max() == np.float32(limit / 1000)


def test_cameras_with_rays_across_the_optical_axis_are_refused():
    data = encode_png(room())
    for fx, cx in ((8.0, 160.0), (300.0, -5680.0)):
        assert decode_frame(data, Intrinsics(320, 240, fx, 300.0, cx, 120.0)).depth.any()
    for fx, cx in ((7.9, 160.0), (0.9, 0.5), (300.0, -5681.5), (300.0, 6000.5)):
        with pytest.raises(InvalidIntrinsics, match="implausible for 320 pixels"):
            decode_frame(data, Intrinsics(320, 240, fx, 300.0, cx, 120.0))
    with pytest.raises(InvalidIntrinsics, match="implausible for 240 pixels"):
        decode_frame(data, Intrinsics(320, 240, 300.0, 5.9, 160.0, 120.0))
    odd = Intrinsics(320, 240, 0.9, 1.2, 0.5, 0.5)
    assert decode_frame(data, odd, trust_depth=True).intrinsics == odd
