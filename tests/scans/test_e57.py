"""Tests of E57 files of the reference implementation, and of damaged files."""

import math
import struct
from contextlib import suppress

import numpy as np
import pytest

from sceneprint.errors import UnreadableCloud
from sceneprint.formats.points.e57 import _checksums, read_e57, unpacked, with_viewpoint

pye57 = pytest.importorskip("pye57", reason="pye57 is not installed")
POINTS = np.random.default_rng(7).uniform((-9, -4, 0), (9, 4, 3), (200_003, 3))


def points_of(scan):
    with np.errstate(all="ignore"):
        points = np.concatenate(list(scan.points().blocks))
    return points[np.isfinite(points).all(axis=1)]


def written(path, fields, columns, **header):
    """A file with one scan whose fields are packed as they are here; by libE57."""
    lib, n = pye57.libe57, len(next(iter(columns.values())))
    with pye57.E57(str(path), "w") as file:
        imf = file.image_file
        scan, prototype = lib.StructureNode(imf), lib.StructureNode(imf)
        for name, node in fields.items():
            prototype.set(name, node(lib, imf))
        for name, text in header.items():
            scan.set(name, lib.StringNode(imf, text))
        points = lib.CompressedVectorNode(imf, prototype, lib.VectorNode(imf, True))
        scan.set("points", points)
        file.data3d.append(scan)
        arrays = [np.ascontiguousarray(column) for column in columns.values()]
        buffers = lib.VectorSourceDestBuffer()
        for name, array in zip(columns, arrays, strict=True):
            buffers.append(lib.SourceDestBuffer(imf, name, array, n, True, True))
        writer = points.writer(buffers)
        writer.write(n)
        writer.close()
    return path.read_bytes()


def simple(path, points=POINTS, **more):
    """A file of one scan as pye57 writes it by default: float32."""
    with pye57.E57(str(path), "w") as file:
        columns = {f"cartesian{axis}": points[:, k].copy() for k, axis in enumerate("XYZ")}
        file.write_scan_raw(columns | more.pop("columns", {}), **more)
    return path.read_bytes()


def scaled(low, high, scale, offset):
    return lambda lib, imf: lib.ScaledIntegerNode(imf, 0, low, high, scale, offset)


def real(*, single):
    return lambda lib, imf: lib.FloatNode(imf, 0.0, lib.E57_SINGLE if single else lib.E57_DOUBLE)


def test_float_points_and_the_pose_are_read_back(tmp_path):
    turn = np.array([math.cos(0.35), 0.0, 0.0, math.sin(0.35)])
    data = simple(
        tmp_path / "a.e57", rotation=turn, translation=np.array([500_000.25, 2.0, 3.0]), name="hall"
    )
    [scan] = read_e57(data)
    assert (scan.name, scan.count, scan.has_pose) == ("hall", len(POINTS), True)
    assert not scan.is_structured
    assert np.abs(points_of(scan) - POINTS).max() < 1e-6
    c, s = math.cos(0.7), math.sin(0.7)
    expected = [[c, -s, 0, 500_000.25], [s, c, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    assert scan.T_world_scan == pytest.approx(np.array(expected), abs=1e-12)
    with pye57.E57(str(tmp_path / "a.e57")) as file:  # the poses mean the same to both
        theirs = file.read_scan(0, ignore_missing_fields=True)
    ours = points_of(scan) @ scan.T_world_scan[:3, :3].T + scan.T_world_scan[:3, 3]
    assert np.abs(ours[:, 1] - theirs["cartesianY"]).max() < 1e-9


def test_points_that_are_marked_invalid_are_missing_and_a_grid_has_a_viewpoint(tmp_path):
    points, places = POINTS[:5000], np.arange(5000)
    invalid = places % 3 == 0
    columns = {
        "cartesianInvalidState": invalid.astype(np.int8),
        "rowIndex": (places // 50).astype(np.uint16),
        "columnIndex": (places % 50).astype(np.uint16),
    }
    scans = read_e57(simple(tmp_path / "a.e57", points, columns=columns))
    assert scans[0].is_structured
    assert with_viewpoint(scans) == [True]
    assert np.abs(points_of(scans[0]) - points[~invalid]).max() < 1e-6


def test_scaled_whole_numbers_of_any_width_are_read_back(tmp_path):
    fields = {
        "cartesianX": scaled(-100_000, 99_999, 1e-4, 0.5),  # 18 bits
        "rowIndex": lambda lib, imf: lib.IntegerNode(imf, 0, 0, 6),  # 3 bits
        "cartesianY": scaled(-(2**40), 2**40, 1e-6, 0.0),  # 42 bits
        "cartesianZ": scaled(-(2**61), 2**61, 1e-9, -1.0),  # 63 bits
    }
    columns = {f"cartesian{axis}": POINTS[:, k].copy() for k, axis in enumerate("XYZ")}
    columns["rowIndex"] = (np.arange(len(POINTS)) % 7).astype(np.float64)
    data = written(tmp_path / "a.e57", fields, columns)
    [scan] = read_e57(data)
    assert (scan.has_pose, scan.is_structured, with_viewpoint((scan,))) == (False, False, [False])
    assert (np.abs(points_of(scan) - POINTS) <= (0.51e-4, 0.51e-6, 0.51e-9)).all()


@pytest.mark.parametrize("single", [True, False])
def test_ranges_and_angles_become_positions(tmp_path, single):
    distance = np.linalg.norm(POINTS, axis=1)
    columns = {
        "sphericalRange": distance,
        "sphericalAzimuth": np.arctan2(POINTS[:, 1], POINTS[:, 0]),
        "sphericalElevation": np.arcsin(POINTS[:, 2] / distance),
        "sphericalInvalidState": np.zeros(len(POINTS), np.int8),
    }
    fields = {name: real(single=single) for name in columns}
    fields["sphericalInvalidState"] = lambda lib, imf: lib.IntegerNode(imf, 0, 0, 2)
    [scan] = read_e57(written(tmp_path / "a.e57", fields, columns, name="turn"))
    assert (scan.is_spherical, with_viewpoint((scan,))) == (True, [True])
    assert np.abs(points_of(scan) - POINTS).max() < (5e-6 if single else 1e-12)


def test_a_merged_cloud_has_no_viewpoint_and_registered_scans_have(tmp_path):
    merged = read_e57(simple(tmp_path / "a.e57", POINTS[:100]))
    assert with_viewpoint(merged) == [False]
    shift, turn = np.array([5e5, 4e6, 0]), np.array([0.8, 0, 0, 0.6])
    shifted = read_e57(simple(tmp_path / "a.e57", POINTS[:100], translation=shift))
    assert with_viewpoint(shifted) == [False]
    turned = read_e57(simple(tmp_path / "a.e57", POINTS[:100], rotation=turn))
    assert with_viewpoint(turned) == [True]
    columns = {f"cartesian{axis}": POINTS[:100, k].copy() for k, axis in enumerate("XYZ")}
    with pye57.E57(str(tmp_path / "b.e57"), "w") as file:
        for x in (0.0, 4.0):
            file.write_scan_raw(columns, translation=np.array([x, 0, 0]))
    scans = read_e57((tmp_path / "b.e57").read_bytes())
    assert with_viewpoint(scans) == [True, True]
    assert [scan.T_world_scan[0, 3] for scan in scans] == [0.0, 4.0]
    assert all(np.abs(points_of(scan) - POINTS[:100]).max() < 1e-6 for scan in scans)


@pytest.mark.parametrize("bits", range(65))
def test_bits_are_unpacked_as_long_division_does(bits):
    rng = np.random.default_rng(bits)
    values = [int(rng.integers(0, 2**63)) * 2 + 1 & (1 << bits) - 1 for _ in range(83)]
    packed = sum(value << (i * bits) for i, value in enumerate(values))
    content = packed.to_bytes(-(-83 * bits // 8), "little")
    assert unpacked(content, bits, 83).tolist() == values


# Files that are damaged or lie.


def changed(data, at, content):
    """A file with other bytes and the checksums that fit them, by a loop over bits."""
    altered = bytearray(data)
    altered[at : at + len(content)] = content
    for start in range(at // 1024 * 1024, at + len(content), 1024):
        crc = 0xFFFFFFFF
        for byte in altered[start : start + 1020]:
            crc ^= byte
            for _ in range(8):
                crc = (crc >> 1) ^ (0x82F63B78 if crc & 1 else 0)
        struct.pack_into(">I", altered, start + 1020, crc ^ 0xFFFFFFFF)
    return bytes(altered)


def reworded(data, old, new):
    """A file whose description says something else, in as many bytes, within one page."""
    at = data.index(old)
    assert len(old) == len(new)
    assert at // 1024 == (at + len(old)) // 1024
    return changed(data, at, new)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return simple(tmp_path_factory.mktemp("e57") / "a.e57", POINTS[:3000])


def everything(data):
    return sum(len(points_of(one)) for one in read_e57(data))


def test_checksums_are_those_of_the_standard(file):
    assert changed(file, 0, file[:1020]) == file


@pytest.mark.parametrize("at", [60, 5000, 20_000])
def test_a_flipped_bit_is_noticed(file, at):
    broken = bytearray(file)
    broken[at] ^= 0x10
    with pytest.raises(UnreadableCloud, match=r"checksum of its page \d+ is wrong.*Copy the file"):
        everything(bytes(broken))


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.99])
def test_a_file_that_ends_early_is_refused(file, share):
    with pytest.raises(UnreadableCloud, match="Copy the file again"):
        everything(file[: int(share * len(file))])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b'recordCount="3000"', b'recordCount="9000"', "they end before point 9000"),
        (b'recordCount="3000"', b'recordCount="3e+3"', "missing or damaged"),
        (b'recordCount="3000"', b"recordCount='-300'", "limit is 200000000"),
        (b'fileOffset="48"', b'fileOffset="49"', "wrong offset for its points"),
        (b"<cartesianX", b"<cartesianW", "damaged"),  # and its end tag stays
        (b"<formatName ", b"<!DOCTYPE a ", "declares entities"),
        (b"<data3D ", b"<data4D ", "damaged"),
    ],
)
def test_a_description_that_lies_is_refused(file, old, new, message):
    with pytest.raises(UnreadableCloud, match=message):
        everything(reworded(file, old, new))


def test_a_later_version_and_huge_pages_are_refused(file):
    with pytest.raises(UnreadableCloud, match=r"version 2 of E57.*Export the scan as PLY"):
        everything(changed(file, 8, struct.pack("<I", 2)))
    with pytest.raises(UnreadableCloud, match="invalid page size of 1125899906842624 bytes"):
        everything(changed(file, 40, struct.pack("<Q", 1 << 50)))
    with pytest.raises(UnreadableCloud, match="not an E57 file"):
        everything(b"ply\n" + file[4:])


def test_random_damage_behind_right_checksums_is_an_error_of_ours(file):
    rng = np.random.default_rng(4)
    pages = np.frombuffer(file, np.uint8).reshape(-1, 1024)
    for _ in range(150):
        broken = pages.copy()
        for _ in range(rng.integers(1, 20)):
            broken[rng.integers(0, len(pages)), rng.integers(0, 1020)] = rng.integers(0, 256)
        broken[:, 1020:] = _checksums(broken[:, :1020].copy()).astype(">u4")[:, None].view(np.uint8)
        with suppress(UnreadableCloud):
            everything(broken.tobytes())
