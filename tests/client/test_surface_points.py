"""Tests of the decoder of points from the service."""

import struct

import numpy as np
import pytest

from sceneprint.errors import Refused
from sceneprint.formats.export import encode_points
from sceneprint_client.surface_encoding import decode_points

#: All of these are numbers of 32 bits, so corners of a box of them are told exactly.
CORNERS = np.array([[x, y, z] for x in (-1.5, 2.25) for y in (0.0, 8.0) for z in (0.125, 0.5)])


def test_points_are_read_as_they_were_encoded():
    rng = np.random.default_rng(1)
    points = np.concatenate([CORNERS, rng.uniform(CORNERS.min(0), CORNERS.max(0), (200, 3))])
    plain = decode_points(encode_points(points, total=900))
    np.testing.assert_array_equal(plain.points[: len(CORNERS)], CORNERS)
    half = np.ptp(CORNERS, axis=0) / 65535 / 2
    assert (abs(plain.points - points) <= half * (1 + 1e-9)).all()
    assert (plain.total, plain.tolerance_m) == (900, 0.0)
    assert plain.normals is plain.patches is plain.residuals is None
    normals = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0.6, 0.8]])
    patches, residuals = np.array([4, -1, 0], np.int32), np.array([1, 250, 254], np.uint8)
    whole = decode_points(encode_points(np.eye(3), normals, patches, residuals, scale=0.25))
    np.testing.assert_allclose(whole.normals, normals, atol=0.5 / 127)
    assert (whole.patches.tolist(), whole.tolerance_m) == ([4, -1, 0], 0.25)
    assert whole.residuals.tolist() == [1, 250, 254]
    assert len(decode_points(encode_points(np.zeros((0, 3)))).points) == 0


def test_bytes_that_are_no_points_are_refused():
    data = encode_points(CORNERS)
    for bad, why in (
        (b"", "header is wrong"),
        (b"PNG!" + data[4:], "header is wrong"),
        (data[:47], "header is wrong"),
        (data[:-1], "143 bytes do not hold 8 points"),
        (data + b"\0", "145 bytes do not hold 8 points"),
        (data[:8] + struct.pack("<I", 2**32 - 1) + data[12:], "hold 4294967295 points"),
        (data[:4] + b"\2\0" + data[6:], "version is 2"),
        (data[:12] + b"\x10" + data[13:], "16 bytes per point"),
    ):
        with pytest.raises(Refused, match=why):
            decode_points(bad)
