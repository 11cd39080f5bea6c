"""Tests of encoded points against a decoder that follows docs/reference.md."""

import struct

import numpy as np
import pytest

from sceneprint.formats.export import encode_points, thinned


def decoded(data):
    """Header and points, by the words of the documentation alone."""
    magic, version, flags, count, stride = struct.unpack_from("<4sHHII", data, 0)
    assert (magic, version, stride) == (b"SPPT", 1, 12)
    origin, extent = struct.unpack_from("<3f", data, 16), struct.unpack_from("<3f", data, 28)
    total, scale = struct.unpack_from("<If", data, 40)
    assert len(data) == 48 + 12 * count
    points = []
    for i in range(count):
        x, y, z, patch, nx, ny, nz, residual = struct.unpack_from("<HHHHbbbB", data, 48 + 12 * i)
        steps = zip(origin, (x, y, z), extent, strict=True)
        points.append(
            {
                "at": [o + v / 65535 * e for o, v, e in steps],
                "patch": patch,
                "normal": [nx / 127, ny / 127, nz / 127],
                "residual": residual,
            }
        )
    head = {"flags": flags, "origin": origin, "extent": extent, "total": total, "scale": scale}
    return head, points


def test_points_are_read_back():
    rng = np.random.default_rng(3)
    points = rng.uniform((-4, -1, 0.5), (3, 2, 9), (300, 3))
    normals = rng.normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    patches = rng.integers(-1, 600, 300).astype(np.int32)
    residuals = rng.integers(0, 256, 300).astype(np.uint8)
    data = encode_points(points, normals, patches, residuals, total=777, scale=0.05)
    head, rows = decoded(data)
    assert (head["flags"], head["total"]) == (7, 777)
    assert head["scale"] == np.float32(0.05)
    assert head["origin"] == pytest.approx(points.min(axis=0), abs=1e-6)
    assert np.add(head["origin"], head["extent"]) == pytest.approx(points.max(axis=0), abs=1e-6)
    half = np.array(head["extent"]) / 65535 / 2 + 1e-6
    assert (abs(np.array([row["at"] for row in rows]) - points) <= half).all()
    assert (abs(np.array([row["normal"] for row in rows]) - normals) <= 0.5 / 127 + 1e-9).all()
    assert [row["patch"] for row in rows] == [65535 if p < 0 else p for p in patches.tolist()]
    assert [row["residual"] for row in rows] == residuals.tolist()


def test_far_from_its_origin_a_cloud_keeps_its_shape():
    points = 4e6 + np.array([[0.0, 0, 0], [1, 2, 0.25], [0.5, 1, 0.25]])
    _, rows = decoded(encode_points(points))
    apart = np.array([row["at"] for row in rows]) - rows[0]["at"]
    assert apart == pytest.approx(points - points[0], abs=1e-4)


def test_thinning_takes_some_of_everywhere():
    for count, limit in ((5, 5), (5, 9), (1000, 1), (0, 3), (19200, 7000)):
        kept = thinned(count, limit)
        assert len(kept) == min(count, limit)
        assert (np.diff(kept) > 0).all()
    rows, columns = np.divmod(kept, 160)  # of an image
    share = 7000 / 19200
    assert np.bincount(rows, minlength=120).min() > 0.6 * share * 160
    assert np.bincount(columns, minlength=160).min() > 0.6 * share * 120
    assert np.bincount(columns, minlength=160).max() < 1.4 * share * 120
    fewer = set(thinned(19200, 2000).tolist())
    assert fewer < set(kept.tolist())  # more of them add, and replace none
