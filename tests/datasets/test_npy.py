"""Tests of NPY files of depth: samples of valid files, and errors of invalid ones."""

import io
import struct

import numpy as np
import pytest

from sceneprint.errors import UnreadableFrame
from sceneprint.formats.dataset import decode_npy, make_frame
from sceneprint.types import Intrinsics
from tests.datasets.shared import frame_or_error, mutations

CAMERA = Intrinsics(4, 3, 5.0, 5.0, 1.5, 1.0)
METRES = np.array([[0, 0.001, 1, 0], [1.234, 65.534, 0.002, 0.003], [0.5, 0.501, 0.502, 0.503]])


def npy(array, **options):
    buffer = io.BytesIO()
    np.save(buffer, array, **options)
    return buffer.getvalue()


def npy_with(header, data=b"", version=1):
    text = header.encode()
    size = struct.pack("<H" if version == 1 else "<I", len(text))
    return b"\x93NUMPY" + bytes([version, 0]) + size + text + data


GOOD_NPY = npy(METRES.astype(np.float32))


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<f8", "<f2"])
def test_npy(order, dtype):
    array = np.asarray(np.array([[1.5, np.nan, 2], [0.25, np.inf, 4]]), dtype=dtype, order=order)
    decoded = decode_npy(npy(array))
    np.testing.assert_array_equal(decoded, [[1.5, np.nan, 2], [0.25, np.inf, 4]])
    assert decoded.dtype == np.float32
    assert decoded.flags.c_contiguous
    decoded[:] = 0  # and one's own


@pytest.mark.parametrize("dtype", ["<u2", ">u2"])
def test_npy_of_stored_units_is_read_as_a_png(dtype):
    array = np.array([[0, 1500, 65535], [2000, 1, 4]], dtype)
    decoded = decode_npy(npy(array))
    assert decoded.dtype == np.uint16
    decoded[:] = decoded  # one's own
    camera = Intrinsics(3, 2, 5.0, 5.0, 1.0, 0.5)
    depth = make_frame(decoded, camera, depth_scale=1000.0).depth
    np.testing.assert_allclose(depth, [[0, 1.5, 0], [2, 0.001, 0.004]], rtol=1e-6)


def test_npy_of_later_versions():
    data = np.array([[1, 2]], "<f4").tobytes()
    header = "{'descr': '<f4', 'fortran_order': False, 'shape': (1, 2), }\n"
    for version in (1, 2, 3):
        assert decode_npy(npy_with(header, data, version)).tolist() == [[1, 2]]


BAD_NPY = {
    "empty": (b"", "empty"),
    "not an NPY": (b"PK\x03\x04" * 9, "not an NPY"),
    "truncated": (GOOD_NPY[:-1], "47 of 48 bytes"),
    "more than declared": (GOOD_NPY + b"\0", "49 of 48 bytes"),
    "header beyond the file": (GOOD_NPY[:8] + b"\x10\x27" + GOOD_NPY[10:], "a length of 10000"),
    "endless header": (
        b"\x93NUMPY\x02\x00\xff\xff\xff\xff" + b" " * 99_999, "a length of 4294967295",
    ),
    "signed numbers": (npy(np.ones((3, 4), np.int16)), "'<i2'.* uint16 in stored units"),
    "pickled": (npy(np.array([[{}]], object), allow_pickle=True), "pickled"),
    "flat": (npy(np.ones(12, np.float32)), "two dimensions"),
    "bomb": (
        npy_with("{'descr': '<f4', 'fortran_order': False, 'shape': (99999, 99999), }"),
        "1 to 8388608 samples",
    ),
    "numbers without end": (
        npy_with("{'descr': '<f4', 'fortran_order': False, 'shape': (0x" + "f" * 9000 + ", 1), }"),
        "1 to 8388608",
    ),
    "code": (npy_with("__import__('os').getcwd()"), "cannot be read"),
    "deep brackets": (npy_with("[" * 9000), "cannot be read"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_NPY)
def test_bad_npy(case):
    data, message = BAD_NPY[case]
    with pytest.raises(UnreadableFrame, match=message):
        decode_npy(data)


def test_mutations():
    frames = errors = 0
    for data in (GOOD_NPY, npy(METRES), npy(np.asfortranarray(METRES))):
        for mutated in mutations(data, 700):
            outcome = frame_or_error(decode_npy, mutated, CAMERA)
            frames += outcome is not None
            errors += outcome is None
    assert min(frames, errors) > 50  # both ends were reached
