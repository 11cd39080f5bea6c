"""Tests of geometry artifacts: content, precision and damage."""

import struct
import tracemalloc
import zlib

import numpy as np
import pytest

from sceneprint.errors import UnreadableGeometry
from sceneprint.formats.artifact import (
    MAGIC,
    SCHEMA_VERSION,
    read_geometry,
    write_geometry,
)
from sceneprint.models import read_model
from sceneprint.pipeline import geometry_of
from sceneprint.signing import see
from sceneprint.types import Geometry, Intrinsics, Patches, Surface

#: Bytes of magic, schema and checksum; and of sizes, camera, scale and model id.
HEAD, BODY = 11, 8 + 5 * 8 + 32


@pytest.fixture(scope="module")
def paper():
    return read_model("paper")


@pytest.fixture(scope="module")
def geometries(paper, room_frames):
    return [geometry_of(see(frame, paper.parameters), paper) for frame in room_frames]


@pytest.fixture(scope="module")
def data(geometries):
    return write_geometry(geometries[0])


def artifact_geometry(height, width, patches, depth=2.0, length=16):
    """An artifact of a flat wall, or of nothing seen."""
    k = Intrinsics(width, height, 60.0, 60.0, width / 2, height / 2)
    y, x = np.mgrid[:height, :width]
    rays = np.dstack([(x - k.cx) / k.fx, (y - k.cy) / k.fy, np.ones((height, width))])
    valid = np.full((height, width), depth > 0)
    normals = np.zeros((height, width, 3), np.float32)
    normals[valid, 2] = -1.0
    areas = np.full((height, width), depth**2 / 3600, np.float32)
    surface = Surface((rays * depth).astype(np.float32), normals, valid, areas, k)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(patches, 3))
    rows = Patches(
        rng.normal(size=(patches, 3)),
        directions / np.linalg.norm(directions, axis=1, keepdims=True),
        rng.random(patches),
        np.arange(patches, dtype=np.int32),
        rng.random(patches),
    )
    descriptors = rng.integers(0, 256, (patches, length), np.uint8)
    return Geometry(surface, rows, descriptors, "5a" * 32)


def sealed(data, at, field):
    """The artifact with a field of its body changed, and the checksum that fits."""
    body = bytearray(data[HEAD:])
    body[at : at + len(field)] = field
    return data[: HEAD - 4] + struct.pack("<I", zlib.crc32(body)) + bytes(body)


def assert_equal_patches(a, b):
    for name in ("means", "normals", "areas", "coherences"):
        one, other = getattr(a, name), getattr(b, name)
        assert one.dtype == other.dtype == np.float64
        np.testing.assert_array_equal(one, other.astype(np.float32))
    assert a.sizes.dtype == np.int32
    np.testing.assert_array_equal(a.sizes, b.sizes)


def test_round_trip(geometries):
    for geometry in geometries:
        read, was = read_geometry(write_geometry(geometry)), geometry.surface
        seen, valid = read.surface, was.valid
        assert seen.camera == was.camera
        assert read.model_id == geometry.model_id
        np.testing.assert_array_equal(seen.valid, valid)
        assert valid.mean() > 0.4
        # inverse depth is in steps of 1/65535 of the nearest sample's
        z, nearest = was.points[valid][:, 2].astype(float), was.points[valid][:, 2].min()
        half_a_step = z**2 / (2 * 65535 * nearest) * (1 + 1e-3) + 1e-6
        assert (np.abs(seen.points[valid][:, 2] - z) <= half_a_step).all()
        gap = np.linalg.norm(seen.points[valid] - was.points[valid], axis=1)
        assert (gap <= half_a_step * np.linalg.norm(was.points[valid], axis=1) / z).all()
        # at 3 m a tenth of a millimetre where the nearest sample is at 0.7 m or farther
        assert nearest < 0.7 or gap[z < 3.0].max(initial=0) < 1.2e-4
        turn = np.linalg.norm(seen.normals[valid] - was.normals[valid], axis=1)
        assert np.degrees(turn.max()) < 0.005
        np.testing.assert_allclose(np.linalg.norm(seen.normals[valid], axis=1), 1.0, atol=1e-6)
        np.testing.assert_allclose(seen.areas[valid], was.areas[valid], rtol=1e-3)
        for array in (seen.points, seen.normals, seen.areas):
            assert array.dtype == np.float32
            assert not array[~valid].any()
        np.testing.assert_array_equal(read.descriptors, geometry.descriptors)
        assert_equal_patches(read.patches, geometry.patches)


def test_normals_of_every_direction_come_back():
    geometry = artifact_geometry(60, 80, 1)
    normals = np.random.default_rng(1).normal(size=(60, 80, 3))
    normals[0, :6] = [[0, 0, -1], [0, 0, 1], [1, 0, 0], [0, -1, 0], [1, 1, 0], [-1, 1, 1e-9]]
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    geometry.surface.normals[:] = normals
    read = read_geometry(write_geometry(geometry)).surface
    off = np.linalg.norm(read.normals - normals, axis=2)
    assert np.degrees(off.max()) < 0.005


def test_reading_and_writing_again_changes_no_byte(geometries):
    for geometry in geometries[:2]:
        once = write_geometry(geometry)
        assert write_geometry(read_geometry(once)) == once
        assert len(once) <= 262_144


def test_the_layout_is_what_its_schema_says():
    assert (MAGIC, SCHEMA_VERSION) == (b"SPGEO", 1)
    geometry = artifact_geometry(2, 3, 1, length=4)
    geometry.surface.valid[0, 0] = False
    geometry.surface.points[0, 0] = geometry.surface.normals[0, 0] = 0.0
    geometry.surface.points[1, 2, 2] = 4.0
    data = write_geometry(geometry)
    assert data[:7] == b"SPGEO\1\0"
    assert data[7:11] == struct.pack("<I", zlib.crc32(data[11:]))
    assert struct.unpack("<HHHH", data[11:19]) == (3, 2, 1, 4)
    assert struct.unpack("<5d", data[19:59]) == (60.0, 60.0, 1.5, 1.0, 1 / (2.0 * 65535))
    assert data[59:91] == b"\x5a" * 32
    packed = np.frombuffer(data[91 : 91 + 36], "<u2").reshape(2, 3, 3)
    # 4 m is half of 65535, to the even one; -z is the middle of the square, between two numbers
    assert packed[..., 0].tolist() == [[0, 65535, 65535], [65535, 65535, 32768]]
    assert packed[0].tolist() == [[0, 0, 0], [65535, 32768, 32768], [65535, 32768, 32768]]
    patches = geometry.patches
    row = np.float32(np.r_[patches.means[0], patches.normals[0], patches.areas[0]])
    assert data[127:155] == row.tobytes()
    assert data[-4:] == geometry.descriptors.tobytes()


def test_where_nothing_was_seen():
    geometry = artifact_geometry(3, 4, 2, 0.0)
    read = read_geometry(write_geometry(geometry))
    assert read.surface.valid.shape == (3, 4)
    for array in (read.surface.valid, read.surface.points, read.surface.normals):
        assert not array.any()
    assert (len(read.patches), read.descriptors.shape) == (2, (2, 16))


def test_depths_far_apart_do_not_become_missing():
    # a sample 100,000 times as far as the nearest: less than one step, but still seen
    geometry = artifact_geometry(2, 2, 0, 0.3)
    geometry.surface.points[0, 0, 2] = 30_000.0
    read = read_geometry(write_geometry(geometry)).surface
    assert read.valid.all()
    assert read.points[0, 0, 2] == pytest.approx(0.3 * 65535, rel=1e-6)
    np.testing.assert_allclose(read.points[1], geometry.surface.points[1], rtol=1e-6)


def test_every_damaged_byte_is_noticed(data):
    rng = np.random.default_rng(2)
    some = rng.integers(HEAD + BODY, len(data), 60).tolist()
    for at in [*range(HEAD + BODY), *some, len(data) - 1]:
        damaged = bytearray(data)
        damaged[at] ^= 1 << int(rng.integers(8))
        with pytest.raises(UnreadableGeometry):
            read_geometry(bytes(damaged))


def test_what_is_no_artifact(data):
    for message, file in (
        ("bytes are not a geometry artifact", b""),
        ("bytes are not a geometry artifact", data[: HEAD + BODY - 1]),
        ("bytes are not a geometry artifact", b"spgeo" + data[5:]),
        ("has schema 4; this version reads 1 to 3", data[:5] + b"\4\0" + data[7:]),
        ("is damaged", data[: HEAD + BODY]),
        ("is damaged", data[:-1]),
        ("is damaged", data + b"\0"),
    ):
        with pytest.raises(UnreadableGeometry, match=f"{message}.*Sign the frame again"):
            read_geometry(file)


def test_sizes_that_the_bytes_do_not_hold(data):
    tracemalloc.start()
    try:
        for at in (0, 2, 4, 6):  # width, height, patches, bytes of a descriptor
            for size in (0, 1, 65535):
                with pytest.raises(UnreadableGeometry, match="is damaged"):
                    read_geometry(sealed(data, at, struct.pack("<H", size)))
        all_at_once = sealed(data, 0, struct.pack("<HHHH", 65535, 65535, 65535, 65535))
        with pytest.raises(UnreadableGeometry, match="is damaged"):
            read_geometry(all_at_once)
        assert tracemalloc.get_traced_memory()[1] < 4 * len(data)
    finally:
        tracemalloc.stop()


def test_a_camera_and_a_scale_that_are_none():
    data = write_geometry(artifact_geometry(2, 3, 0, length=0))
    for at, value in ((8, 0.0), (8, float("nan")), (16, -1.0), (24, float("inf")), (32, 1e9)):
        with pytest.raises(UnreadableGeometry, match="has an invalid camera"):
            read_geometry(sealed(data, at, struct.pack("<d", value)))
    for scale in (0.0, -1.0, float("nan"), float("inf"), 1e-12, 1e3):
        with pytest.raises(UnreadableGeometry, match="invalid depth scale"):
            read_geometry(sealed(data, 40, struct.pack("<d", scale)))


@pytest.mark.parametrize("at", [0, 3, 6, 7])  # mean, normal, area, coherence
def test_patches_that_are_none(at, data):
    """A checksum can be made by anybody; what validation would make NaN of is refused."""
    first = BODY + 6 * 160 * 120
    allowed = {3: [], 6: [0.0, 1.0], 7: [0.0, 1.0]}.get(at, [0.0, 1.0, -1.0])
    for value in (0.0, 1.0, -1.0, float("nan"), float("inf"), -float("inf"), 3e38, 1e-30):
        hostile = sealed(data, first + 36 * 5 + 4 * at, struct.pack("<f", value))
        if value in allowed or (value == 1e-30 and at != 3):
            assert len(read_geometry(hostile).patches) > 300
        else:
            with pytest.raises(UnreadableGeometry, match="invalid or exceed the limits"):
                read_geometry(hostile)
    signalling = sealed(data, first + 4 * at, struct.pack("<I", 0x7FA00000))
    with pytest.raises(UnreadableGeometry, match="invalid or exceed the limits"):
        read_geometry(signalling)


def test_more_than_a_model_makes():
    most = write_geometry(artifact_geometry(2, 3, 4096, length=1))
    assert len(read_geometry(most).patches) == 4096
    for patches, length in ((4097, 1), (1, 1025)):
        with pytest.raises(UnreadableGeometry, match="invalid or exceed the limits"):
            read_geometry(write_geometry(artifact_geometry(2, 3, patches, length=length)))
