"""Tests of 16-bit greyscale PNG: samples of valid files, and errors of invalid ones."""

import io
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from sceneprint.errors import UnreadableFrame
from sceneprint.formats.dataset import decode_frame, decode_png
from sceneprint.formats.depth_file import PNG_SIGNATURE, encode_png, size_of
from sceneprint.types import Intrinsics
from tests.datasets.shared import frame_or_error, mutations

CAMERA = Intrinsics(4, 3, 5.0, 5.0, 1.5, 1.0)
SAMPLES = np.array([[0, 1, 1000, 65535], [1234, 65534, 2, 3], [500, 501, 502, 503]], np.uint16)


def pillow_png(samples, **options):
    buffer = io.BytesIO()
    Image.fromarray(samples).save(buffer, "PNG", **options)
    return buffer.getvalue()


def chunk(kind, content=b""):
    crc = zlib.crc32(kind + content)
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", crc)


def raw_png(width, height, rows, *, bits=16, colour=0, interlace=0, before=b"", after=b""):
    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, interlace)
    return b"".join([
        PNG_SIGNATURE, chunk(b"IHDR", header), before, chunk(b"IDAT", zlib.compress(rows)), after,
        chunk(b"IEND"),
    ])  # fmt: skip


def rows_of(samples):
    return b"".join(b"\0" + row.astype(">u2").tobytes() for row in samples)


GOOD_PNG = pillow_png(SAMPLES)


def test_png_by_pillow_and_by_hand():
    np.testing.assert_array_equal(decode_png(GOOD_PNG), SAMPLES)
    np.testing.assert_array_equal(decode_png(raw_png(4, 3, rows_of(SAMPLES))), SAMPLES)
    assert decode_png(GOOD_PNG).dtype == np.uint16
    big = np.random.default_rng(0).integers(0, 65536, (480, 640), dtype=np.uint16)
    np.testing.assert_array_equal(decode_png(pillow_png(big)), big)
    smooth = np.add.outer(np.arange(480) * 60, np.arange(640) * 50).astype(np.uint16)
    np.testing.assert_array_equal(decode_png(pillow_png(smooth)), smooth)  # filters at work


def test_png_of_many_data_chunks_and_trailing_bytes():
    data = zlib.compress(rows_of(SAMPLES))
    header = struct.pack(">IIBBBBB", 4, 3, 16, 0, 0, 0, 0)
    pieces = b"".join(chunk(b"IDAT", data[i : i + 1]) for i in range(len(data)))
    file = PNG_SIGNATURE + chunk(b"IHDR", header) + pieces + chunk(b"IDAT") + chunk(b"IEND")
    np.testing.assert_array_equal(decode_png(file + bytes(9)), SAMPLES)


@pytest.mark.parametrize("shape", [(1, 1), (3, 4), (5, 2), (8, 8), (13, 21)])
def test_interlaced_png(shape):
    samples = np.random.default_rng(1).integers(0, 65536, shape, dtype=np.uint16)
    rows = b""
    for column, row, across, down in ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4),
                                      (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)):  # fmt: skip
        if samples[row::down, column::across].size:
            rows += rows_of(samples[row::down, column::across])
    decoded = decode_png(raw_png(shape[1], shape[0], rows, interlace=1))
    np.testing.assert_array_equal(decoded, samples)


def test_text_and_profiles_are_not_even_unpacked():
    bomb = zlib.compress(b"\0" * 50_000_000, 9)
    before = (
        chunk(b"zTXt", b"Comment\0\0" + bomb)
        + chunk(b"iCCP", b"icc\0\0" + bomb)
        + chunk(b"tEXt", b"a\0" + b"x" * 1_000_000)
        + chunk(b"tRNS", b"\x03\xe8")  # makes 1000 transparent, for display
        + chunk(b"gAMA", b"bad")
        + chunk(b"eXIf", b"\xff" * 30)
    )
    data = raw_png(4, 3, rows_of(SAMPLES), before=before, after=chunk(b"iTXt", b"\xff\xff"))
    np.testing.assert_array_equal(decode_png(data), SAMPLES)


BAD_PNG = {
    "empty": (b"", "empty"),
    "two images": (GOOD_PNG * 2, f"{len(GOOD_PNG)} bytes follow after the end"),
    "no PNG": (b"\xff\xd8\xff\xe0JFIF" * 9, "not a PNG"),
    "only the signature": (PNG_SIGNATURE, "truncated"),
    "truncated in the data": (GOOD_PNG[:-20], "truncated"),
    "damaged": (GOOD_PNG[:45] + bytes([GOOD_PNG[45] ^ 1]) + GOOD_PNG[46:], "checksum"),
    "8 bit": (pillow_png(SAMPLES.astype(np.uint8)), "greyscale with 8 bits"),
    "animated": (
        raw_png(4, 3, rows_of(SAMPLES), before=chunk(b"acTL", struct.pack(">II", 2, 0))),
        "animated",
    ),
    "bomb by its header": (raw_png(65_535, 65_535, b"\0" * 99), "65535 x 65535"),
    "just over the limit": (raw_png(4096, 4097, b"\0" * 99), "4096 x 4097"),
    "fewer rows than declared": (raw_png(4, 4, rows_of(SAMPLES)), "contains fewer"),
    "more rows than declared": (raw_png(4, 2, rows_of(SAMPLES)), "contains more"),
    "bomb in the data": (raw_png(4, 3, b"\0" * 30_000_000), "contains more"),
    "no zlib": (
        PNG_SIGNATURE + GOOD_PNG[8:33] + chunk(b"IDAT", b"hello world") + chunk(b"IEND"),
        "do not decompress",
    ),
    "endless chunks": (
        PNG_SIGNATURE + GOOD_PNG[8:33] + chunk(b"tEXt") * 65_536, "more than 65536 chunks",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_PNG)
def test_bad_png(case):
    data, message = BAD_PNG[case]
    with pytest.raises(UnreadableFrame, match=message):
        decode_png(data)


def repaired(data):
    """The same PNG with right checksums, so that damage reaches what lies behind them."""
    out, position = data[:8], 8
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        content = data[position + 8 : position + 8 + length]
        out += chunk(data[position + 4 : position + 8], content)
        position += 12 + length
    return out


def test_mutations():
    frames = errors = 0
    text = raw_png(4, 3, rows_of(SAMPLES), before=chunk(b"tEXt", b"a\0b"))
    for data in (GOOD_PNG, text):
        for mutated in mutations(data, 1000):
            both = [mutated]
            if mutated.startswith(PNG_SIGNATURE):
                both.append(repaired(mutated))
            outcomes = [frame_or_error(decode_png, one, CAMERA) for one in both]
            frames += sum(outcome is not None for outcome in outcomes)
            errors += sum(outcome is None for outcome in outcomes)
    assert min(frames, errors) > 50  # both ends were reached


def test_a_compressed_depth_message_of_ros():
    """Size and samples are read from a PNG behind a header of 12 bytes."""
    samples = np.arange(1, 49, dtype=np.uint16).reshape(6, 8)
    camera = Intrinsics(8, 6, 10, 10, 4, 3)
    for unset in (bytes(8), struct.pack("<ff", 4.5e-41, 0.0), struct.pack("<ff", 1.0, 0.0)):
        data = bytes(4) + unset + encode_png(samples)
        assert size_of(data[:64]) == (8, 6)
        frame = decode_frame(data, camera)
        np.testing.assert_array_equal(frame.depth, (samples / 1000).astype(np.float32))
    # 32FC1 with the transport's defaults: q = 100, at most 10 m
    inverse = struct.pack("<iff", 0, 10100.0, -1009.0) + encode_png(samples)
    frame = decode_frame(inverse, camera)
    np.testing.assert_allclose(frame.depth, 10100.0 / (samples + 1009.0), rtol=1e-6)
    nothing = struct.pack("<iff", 0, 10100.0, -1009.0) + encode_png(samples - 1)
    assert decode_frame(nothing, camera).depth[0, 0] == 0  # 0 is missing
    for a, b in ((10100.0, 1009.0), (10100.0, -2.0), (1e-2, -1.0), (2e8, -1e8)):
        odd = struct.pack("<iff", 0, a, b) + encode_png(samples)
        with pytest.raises(UnreadableFrame, match="neither that of a 16UC1 nor of a 32FC1"):
            decode_frame(odd, camera)
    with pytest.raises(UnreadableFrame, match="truncated"):
        decode_frame(bytes(12) + encode_png(samples)[:-5], camera)
