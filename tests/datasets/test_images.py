"""Tests of the decoding of depth images, and of its errors."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from sceneprint.errors import InvalidIntrinsics, UnreadableFrame, UselessFrame
from sceneprint.formats import depth_file
from sceneprint.formats.dataset import decode_png, make_frame, read_frame, write_depth_png
from sceneprint.types import Intrinsics

CAMERA = Intrinsics(4, 3, 5.0, 5.0, 1.5, 1.0)
SAMPLES = np.array([[0, 1, 1000, 65535], [1234, 65534, 2, 3], [500, 501, 502, 503]], np.uint16)
METRES = np.array([[0, 0.001, 1, 0], [1.234, 65.534, 0.002, 0.003], [0.5, 0.501, 0.502, 0.503]])


def test_stored_units_become_metres():
    frame = make_frame(SAMPLES, CAMERA, name="a")
    assert frame.depth.dtype == np.float32
    np.testing.assert_array_equal(frame.depth, METRES.astype(np.float32))
    assert (frame.intrinsics, frame.name, frame.pose) == (CAMERA, "a", None)
    half = make_frame(SAMPLES, CAMERA, depth_scale=2000)
    np.testing.assert_array_equal(half.depth, (METRES / 2).astype(np.float32))
    assert SAMPLES[0, 3] == 65535  # the caller's array is as it was


@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<f8", "<f2", ">f8"])
def test_floats_are_metres_whatever_the_scale(dtype):
    values = np.array([[0.5, 0, -1, np.nan], [np.inf, -np.inf, -0.0, 2.0], [1, 2, 3, 65.5]])
    frame = make_frame(values.astype(dtype), CAMERA, depth_scale=5000)
    assert frame.depth.tolist() == [[0.5, 0, 0, 0], [0, 0, 0, 2], [1, 2, 3, 65.5]]
    assert frame.depth.dtype == np.float32
    assert not np.signbit(frame.depth).any()


def test_range_and_lens_are_removed():
    # f = 4, c = (1, 0): directions -1/4, 0, 1/4 and 1/2; the lens shows 1/2 at
    # 1/2 (1 + 1/4 k1) = 1/4 for k1 = -2, but there 1 + 3 k1/4 < 0: beyond the fold
    camera = Intrinsics(4, 1, 4.0, 4.0, 1.0, 0.0, (-2.0, 0.0, 0.0, 0.0))
    frame = make_frame(np.full((1, 4), 1000, np.uint16), camera, along_ray=True)
    assert frame.intrinsics == dataclasses.replace(camera, distortion=())
    # x = +-1/4 is seen at 1/4 (1 - 1/8) = 0.21875, u = 1 +- 0.875, so it takes pixels 0 and 2.
    # Pixel 2 looks along x with x - 2 x^3 = 1/4: x = 0.29956
    x = next(r.real for r in np.roots([-2, 0, 1, -0.25]) if 0 < r.real < 0.4)
    cosine = 1 / np.hypot(1, x)
    np.testing.assert_allclose(frame.depth, [[cosine, 1, cosine, 0]], rtol=1e-6)


def test_read_frame_by_content(tmp_path):
    write_depth_png(tmp_path / "a.png", METRES.astype(np.float32), 1000)
    np.save(tmp_path / "b.npy", METRES)
    os.link(tmp_path / "a.png", tmp_path / "c.npy")
    for name in ("a.png", "b.npy", "c.npy"):
        frame = read_frame(tmp_path / name, CAMERA, name="x/y")
        np.testing.assert_array_equal(frame.depth, METRES.astype(np.float32))
        assert frame.name == "x/y"


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "empty"),
        (depth_file.PNG_SIGNATURE, "is truncated"),
        (b"\x93NUMPY", "header"),
        (b"P5", "none of PNG"),
    ],
)
def test_errors_of_a_file_name_it_on_one_line(data, message, tmp_path):
    path = tmp_path / "seven.png"
    path.write_bytes(data)
    with pytest.raises(UnreadableFrame, match=r"seven\.png: .*" + message) as caught:
        read_frame(path, CAMERA, name="seven")
    assert "\n" not in str(caught.value)


def test_what_is_no_file(tmp_path, monkeypatch):
    with pytest.raises(UnreadableFrame, match=r"absent\.png: .*No such file"):
        read_frame(tmp_path / "absent.png", CAMERA)
    with pytest.raises(UnreadableFrame, match="not a regular file"):
        read_frame(tmp_path, CAMERA)
    os.mkfifo(tmp_path / "pipe.png")  # opening it would wait for a writer
    with pytest.raises(UnreadableFrame, match="not a regular file"):
        read_frame(tmp_path / "pipe.png", CAMERA)
    with pytest.raises(UnreadableFrame, match="cannot be read"):
        read_frame(Path("nul\0.png"), CAMERA)
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8\xff\xe0JFIF")
    with pytest.raises(UnreadableFrame, match=r"a\.jpg: .*none of PNG, NPY"):
        read_frame(tmp_path / "a.jpg", CAMERA)
    with (tmp_path / "huge.png").open("wb") as file:
        file.truncate(10**12)  # sparse
    monkeypatch.setattr(depth_file, "MAXIMUM_IMAGE_BYTES", 1000)
    with pytest.raises(UnreadableFrame, match="more than 1000 bytes"):
        read_frame(tmp_path / "huge.png", CAMERA)
    with pytest.raises(UnreadableFrame, match="1001 bytes; the limit is 1000"):
        decode_png(b"\0" * 1001)


@pytest.mark.parametrize(
    ("samples", "scale", "error", "message"),
    [
        (SAMPLES, 0, InvalidIntrinsics, r"depth scale .* positive"),
        (SAMPLES, float("nan"), InvalidIntrinsics, r"depth scale .* positive"),
        (METRES, float("inf"), InvalidIntrinsics, r"depth scale .* positive"),
        (np.full((3, 4), 65535, np.uint16), 1000, UselessFrame, "f: All 12 samples are missing"),
        (np.full((3, 4), np.nan), 1000, UselessFrame, "f: All 12 samples are missing"),
        (np.full((3, 4), -2.0), 1000, UselessFrame, "f: All 12 samples are missing"),
        (np.ones((3, 4, 1), np.float32), 1000, UnreadableFrame, "two dimensions"),
        (np.ones((0, 4), np.float32), 1000, UnreadableFrame, "two dimensions"),
        (np.ones((3, 4), np.int16), 1000, UnreadableFrame, "Convert them"),
        (np.ones((3, 4), object), 1000, UnreadableFrame, "Convert them"),
        (SAMPLES.T, 1000, InvalidIntrinsics, "3 x 4 pixels, but the intrinsics are for 4 x 3"),
    ],
)
def test_arrays_that_are_no_depth(samples, scale, error, message):
    with pytest.raises(error, match=message):
        make_frame(samples, CAMERA, depth_scale=scale, name="f")


@pytest.mark.parametrize("scale", [1000.0, 5000.0, 1e-34, 3.7])
def test_a_large_image_has_the_metres_of_its_samples_one_by_one(scale):
    samples = np.random.default_rng(3).integers(0, 65536, (260, 256)).astype(np.uint16)
    samples[0, :3] = (0, 1, 65535)
    large = make_frame(samples, Intrinsics(256, 260, 9.0, 9.0, 1.0, 1.0), depth_scale=scale).depth
    small = [
        make_frame(row[None], Intrinsics(256, 1, 9.0, 9.0, 1.0, 1.0), depth_scale=scale).depth
        for row in samples
        if np.any((row > 0) & (row < 65535))
    ]
    np.testing.assert_array_equal(large, np.concatenate(small))
    fortran = make_frame(
        np.asfortranarray(samples), Intrinsics(256, 260, 9.0, 9.0, 1.0, 1.0), depth_scale=scale
    )
    np.testing.assert_array_equal(fortran.depth, large)
    assert fortran.depth.flags.c_contiguous
