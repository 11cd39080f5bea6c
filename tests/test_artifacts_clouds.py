"""Tests of geometry artifacts of clouds: content, precision and errors."""

import math
import struct
from dataclasses import replace

import numpy as np
import pytest

from sceneprint.errors import UnreadableGeometry
from sceneprint.formats.artifact import MAXIMUM_POINTS, read_geometry, write_geometry
from sceneprint.geometry.surface.range_image import directions
from sceneprint.types import Geometry, Patches, Sphere, Surface
from tests.test_artifacts import artifact_geometry, sealed

#: Bytes of magic, schema and checksum; and of sizes, camera, step and model id.
HEAD, BODY = 11, 10 + 4 * 8 + 32
SPHERE = Sphere(90, 40, math.radians(4.0), 0.3, math.radians(80.0), 1)


def unit(v):
    return (v / np.linalg.norm(v, axis=-1, keepdims=True)).astype(np.float32)


def holding(points, valid, camera, patches=3):
    """An artifact of these points, with normals of every direction."""
    rng = np.random.default_rng(1)
    shown = valid[..., None]
    normals = np.where(shown, unit(rng.normal(size=points.shape)), 0.0).astype(np.float32)
    seen = np.where(shown, points, 0.0).astype(np.float32)
    surface = Surface(seen, normals, valid, valid.astype(np.float32), camera)
    rows = Patches(
        rng.normal(size=(patches, 3)), unit(rng.normal(size=(patches, 3))).astype(float),
        rng.random(patches), np.arange(patches, dtype=np.int32), rng.random(patches),
    )  # fmt: skip
    return Geometry(surface, rows, rng.integers(0, 256, (patches, 16), np.uint8), "5a" * 32)


def scan(camera=SPHERE, nearest=0.5, farthest=80.0):
    """An artifact of a sphere whose ranges are spread evenly over their magnitudes."""
    rng = np.random.default_rng(2)
    shape = camera.height, camera.width
    r = np.exp(rng.uniform(math.log(nearest), math.log(farthest), shape))
    return holding(directions(camera) * r[..., None], rng.random(shape) < 0.8, camera)


def spinning(count=200):
    """A scan that keeps points spread over what it shows as well."""
    was = scan()
    shown = was.surface
    some = np.random.default_rng(7).choice(np.flatnonzero(shown.valid.ravel()), count, False)
    points, normals = (x.reshape(-1, 3)[some][None] for x in (shown.points, shown.normals))
    one = np.ones((1, count), np.bool_)
    spread = Surface(points, normals, one, one.astype(np.float32), None)
    return replace(was, surface=replace(shown, spread=spread))


def fused(count, span=20.0, far=0.0):
    points = np.random.default_rng(3).uniform(-span / 2, span / 2, (1, count, 3)) + far
    return holding(points, np.ones((1, count), np.bool_), None)


def assert_same(read, was, half_a_step):
    """What is not of the surface is the same, and normals are to 0.005 degrees."""
    np.testing.assert_array_equal(read.surface.valid, was.surface.valid)
    gap = np.abs(read.surface.points - was.surface.points).max()
    assert gap <= half_a_step
    turn = np.linalg.norm(read.surface.normals - was.surface.normals, axis=2)
    assert np.degrees(turn.max()) < 0.005
    assert (read.surface.camera, read.model_id) == (was.surface.camera, was.model_id)
    np.testing.assert_array_equal(read.descriptors, was.descriptors)
    np.testing.assert_array_equal(read.patches.means, was.patches.means.astype(np.float32))
    assert read.surface.points.dtype == read.surface.normals.dtype == np.float32
    assert not read.surface.points[~read.surface.valid].any()


@pytest.mark.parametrize("pole", [0, 1, 2])
def test_a_scan_comes_back(pole):
    was = scan(Sphere(90, 40, math.radians(4.0), 0.3, math.radians(80.0), pole))
    data = write_geometry(was)
    read = read_geometry(data)
    # steps of range are the power of two of which 65535 reach 80 m: 1/512 m
    assert_same(read, was, 1 / 1024 + 1e-5)
    ranges = [np.linalg.norm(g.surface.points[was.surface.valid], axis=1) for g in (read, was)]
    assert np.abs(ranges[0] - ranges[1]).max() <= 1 / 1024 + 1e-5
    assert data[5:7] == b"\2\0"
    assert len(data) == HEAD + BODY + 6 * 90 * 40 + 3 * (36 + 16)
    assert write_geometry(read) == data


def test_a_scan_comes_back_with_its_points():
    was = spinning()
    data = write_geometry(was)
    assert data[5:7] == b"\3\0"
    # 4 bytes a pixel, 8 a point, 34 for their number, corner and step
    assert len(data) == HEAD + BODY + 34 + 4 * 90 * 40 + 8 * 200 + 3 * (36 + 16)
    read = read_geometry(data)
    assert write_geometry(read) == data
    assert read.surface.fitted is read.surface.spread
    np.testing.assert_array_equal(read.surface.valid, was.surface.valid)
    assert was.surface.spread is not None
    for response, had in ((read.surface, was.surface), (read.surface.spread, was.surface.spread)):
        # 160 m in 65535 steps of a power of two: 1/256 m
        assert np.abs(response.points - had.points).max() <= 1 / 512 + 1e-5
        turn = np.linalg.norm(response.normals - had.normals, axis=2)
        assert np.degrees(turn.max()) < 1.0
    assert read.surface.spread.camera is None


def test_areas_of_a_scan():
    """Of a sphere seen from its middle they add up to its own, but for the caps left out."""
    camera = Sphere(180, 89, math.radians(2.0), 0.0, math.radians(88.0))
    geometry = holding(directions(camera) * 3.0, np.ones((89, 180), np.bool_), camera)
    geometry.surface.normals[:] = -directions(camera)
    read = read_geometry(write_geometry(geometry))
    band = 4 * math.pi * 9 * math.sin(math.radians(89.0))
    assert float(read.surface.areas.sum()) == pytest.approx(band, rel=1e-3)


def test_points_in_no_order_come_back():
    for count, span, far in ((1, 1.0, 0.0), (500, 60.0, 5000.0)):
        was = fused(count, span, far)
        data = write_geometry(was)
        # 20 m in steps of a power of two; far from the origin 32 bits tell half a millimetre
        assert_same(read_geometry(data), was, max(span / 65535, abs(far) * 2.0**-22) + 1e-6)
        assert read_geometry(data).surface.camera is None
        assert len(data) == HEAD + BODY + 10 * count + 3 * (36 + 16)
        assert write_geometry(read_geometry(data)) == data


def test_no_more_points_than_pixels_are_kept():
    rng = np.random.default_rng(4)
    flat = np.concatenate([rng.uniform(-9, 9, (1, 60_000, 2)), np.zeros((1, 60_000, 1))], axis=2)
    data = write_geometry(holding(flat, np.ones((1, 60_000), np.bool_), None))
    kept = read_geometry(data).surface.points[0]
    assert 15_000 < len(kept) <= MAXIMUM_POINTS
    assert len(data) <= 262_144
    # spread over all of it: nowhere a square of half a metre is empty
    filled, _, _ = np.histogram2d(kept[:, 0], kept[:, 1], bins=36, range=[(-9, 9), (-9, 9)])
    assert filled.min() > 5


def test_numbers_that_no_cloud_has():
    nan, endless = math.nan, math.inf
    of_scan, of_points = write_geometry(scan()), write_geometry(fused(300))
    of_both = write_geometry(spinning())
    steps, points = (nan, 0.0, 17.0), r"invalid unordered points|range step"
    spread = r"invalid spread points|offset step"
    for data, at, values, match in (
        (of_scan, 10, (0.0, -1.0, nan, endless, 4.0), "invalid camera"),  # step of the sphere
        (of_scan, 18, (nan, endless), "invalid camera"),
        (of_scan, 26, (nan, -endless), "invalid camera"),
        (of_scan, 34, (*steps, -1.0, endless, 1e-13), "range step"),
        (of_points, 10, (nan, endless, 1e7), points), (of_points, 26, (nan,), points),
        (of_points, 34, steps, points), (of_both, BODY + 2, (nan, endless, 1e7), spread),
        (of_both, BODY + 18, (nan, -endless), spread), (of_both, BODY + 26, steps, spread),
    ):  # fmt: skip
        for value in values:
            with pytest.raises(UnreadableGeometry, match=match):
                read_geometry(sealed(data, at, struct.pack("<d", value)))
    # kinds and poles that do not exist; points in no order have none beside them
    for data, field in (
        (of_scan, (0, 0)), (of_scan, (3, 0)), (of_scan, (1, 3)), (of_scan, (1, 255)),
        (of_points, (2, 1)), (of_both, (2, 0)),
    ):  # fmt: skip
        with pytest.raises(UnreadableGeometry):
            read_geometry(sealed(data, 8, bytes(field)))
    # points in no order have one row
    with pytest.raises(UnreadableGeometry, match="invalid unordered points"):
        read_geometry(sealed(of_points, 0, struct.pack("<HH", 150, 2)))


def test_sizes_that_the_bytes_do_not_hold():
    for data in (write_geometry(geometry) for geometry in (scan(), fused(300), spinning())):
        for at, size in ((0, 0), (0, 65535), (2, 65535), (4, 65535), (6, 0), (6, 65535)):
            with pytest.raises(UnreadableGeometry, match="is damaged"):
                read_geometry(sealed(data, at, struct.pack("<H", size)))
    for count in (0, 199):  # of the points beside a scan
        with pytest.raises(UnreadableGeometry, match="is damaged"):
            read_geometry(sealed(data, BODY, struct.pack("<H", count)))


def test_any_numbers_make_finite_points():
    """What is read, whatever its bytes, can be validated with."""
    rng = np.random.default_rng(6)
    read = 0
    for data in map(write_geometry, (scan(), fused(300), spinning(), artifact_geometry(4, 5, 2))):
        for _ in range(150):
            at = int(rng.integers(8, BODY - 32))
            field = rng.integers(0, 256, int(rng.integers(1, 9)), np.uint8).tobytes()
            hostile = sealed(data, at, field[: BODY - 32 - at])
            try:
                surface = read_geometry(hostile).surface
            except UnreadableGeometry:
                continue
            read += 1
            for array in (surface.points, surface.normals, surface.areas):
                assert np.isfinite(array).all()
    assert read > 20
