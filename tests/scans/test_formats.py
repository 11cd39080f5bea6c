"""Tests that all formats give the same points, and are recognised by their first bytes."""

import numpy as np
import pytest

from sceneprint.errors import UnreadableCloud
from sceneprint.formats.points.cloud import decode_cloud, decode_scan
from sceneprint_client.formats import format_of

FORMS = {
    "ply": ("ascii", "binary_little_endian", "binary_big_endian"),
    "pcd": ("ascii", "binary", "binary_compressed"),
}


@pytest.mark.parametrize(("name", "form"), [(n, f) for n, fs in FORMS.items() for f in fs])
def test_forms(request, points, name, form):
    data = request.getfixturevalue(name)(form=form)
    scan = decode_scan(data, name="here")
    np.testing.assert_array_equal(scan.cloud.points, points)
    assert scan.cloud.points.dtype == np.float32
    assert scan.cloud.points.flags.writeable
    assert (scan.file_format, scan.file_points, scan.viewpoint) == (name, 12, (0, 0, 0))
    assert (scan.cloud.name, scan.cloud.note, scan.cloud.has_viewpoint) == ("here", "", True)
    assert format_of(data) == name


def test_kitti_has_to_be_said(kitti, points, ply):
    assert format_of(kitti()) is None
    np.testing.assert_array_equal(decode_cloud(kitti(), file_format="kitti").points, points)
    with pytest.raises(UnreadableCloud, match=r"its first bytes.*specify the format kitti"):
        decode_cloud(kitti())
    with pytest.raises(UnreadableCloud, match="has 191 bytes, but each point"):
        decode_cloud(kitti()[:-1], file_format="kitti")
    with pytest.raises(UnreadableCloud, match="starts like a PLY file"):
        decode_cloud(ply(), file_format="kitti")


def scan_rows(values):
    """What a scanner 1.8 m above the floor of a hall sees, with so many values a row."""
    rng = np.random.default_rng(4)
    turn, tilt = rng.uniform(-np.pi, np.pi, 6000), rng.uniform(-0.4, 0.2, 6000)
    reach = np.minimum(12.0 / np.maximum(np.abs(np.sin(turn)), np.abs(np.cos(turn))), 40.0)
    reach = np.where(tilt < 0, np.minimum(reach, 1.8 / np.maximum(-np.tan(tilt), 1e-3)), reach)
    xyz = np.stack([reach * np.cos(turn), reach * np.sin(turn), reach * np.tan(tilt)])
    more = [rng.integers(0, 255, 6000), rng.integers(0, 64, 6000), rng.random(6000), reach]
    return np.stack([*xyz, *more, *more])[:values].T.astype("<f4")


@pytest.mark.parametrize("values", [3, 5, 6, 7, 8])
@pytest.mark.parametrize("rows", [6000, 300])  # a spinning scanner, and a radar
def test_rows_of_another_length_are_no_kitti(rows, values):
    data = scan_rows(values)[:rows].tobytes()
    with pytest.raises(UnreadableCloud, match=rf"file has {values} numbers .*--row x,y,z"):
        decode_cloud(data, file_format="kitti")


@pytest.mark.parametrize("values", [3, 4])
def test_float64_is_no_kitti(values):
    data = scan_rows(values).astype(np.float64).tobytes()
    with pytest.raises(UnreadableCloud, match=r"also if the numbers are float64|so the type, byte"):
        decode_cloud(data, file_format="kitti")


def test_rows_of_four_are_kitti():
    rows = scan_rows(4)
    for scale in (1.0, 1 / 255, 0.0):
        rows[:, 3] *= scale
        for order in (slice(None), np.lexsort(rows.T)):
            cloud = decode_cloud(rows[order].tobytes(), file_format="kitti")
            np.testing.assert_array_equal(cloud.points, rows[order, :3])


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_axes_in_capitals(pcd, ply, points, form):
    data = pcd(form=form).replace(b" x y z", b" X Y Z")
    np.testing.assert_array_equal(decode_cloud(data).points, points)
    data = ply(form="ascii" if form == "ascii" else "binary_little_endian")
    for axis in (b"x", b"y", b"z"):
        data = data.replace(b" " + axis + b"\n", b" " + axis.upper() + b"\n")
    assert b" X\n" in data
    np.testing.assert_array_equal(decode_cloud(data).points, points)


@pytest.mark.parametrize("dtype", ["<f4", ">f8", "<f2"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_npy(npy, points, dtype, order):
    wide = np.concatenate([points, np.full((12, 1), np.nan)], axis=1)  # intensity may be anything
    for array in (points, wide):
        data = npy(np.asarray(array, dtype=dtype, order=order))
        assert format_of(data) == "npy"
        np.testing.assert_array_equal(decode_cloud(data).points, points)


def test_npy_of_another_shape_or_type(npy):
    depth = npy(np.ones((12, 16), np.float32))
    assert format_of(depth) is None  # an image
    with pytest.raises(UnreadableCloud, match=r"shape of points, \(N, 3\)"):
        decode_cloud(depth, file_format="npy")
    with pytest.raises(UnreadableCloud, match=r"holds .<i8., and points must be float32"):
        decode_cloud(npy(np.ones((12, 3), np.int64)), file_format="npy")
    with pytest.raises(UnreadableCloud, match="143 of 144 bytes"):
        decode_cloud(npy(np.ones((12, 3), np.float32))[:-1])


def test_nothing_known(ply):
    for data, message in ((b"", "empty"), (b"hello", "none of PLY, PCD"), (b"plywood", "none of")):
        with pytest.raises(UnreadableCloud, match=message):
            decode_cloud(data)
    with pytest.raises(UnreadableCloud, match="not a PCD file"):
        decode_cloud(ply(), file_format="pcd")
    with pytest.raises(UnreadableCloud, match="not a point cloud format"):
        decode_cloud(ply(), file_format="stl")
