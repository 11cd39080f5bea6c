"""Tests of units, viewpoints, missing points, limits and thinning of clouds."""

import struct

import numpy as np
import pytest

from sceneprint.errors import InvalidPose, UnreadableCloud, UselessFrame
from sceneprint.formats.points import cloud as reading
from sceneprint.formats.points.cloud import decode_cloud, decode_scan, thinned


def test_millimetres(las, kitti, points):
    scan = decode_scan(
        kitti(1000 * points), file_format="kitti", units_per_metre=1000, viewpoint=(1.0, 2.0, 3.0)
    )
    np.testing.assert_array_equal(scan.cloud.points, points - (1.0, 2.0, 3.0))
    for units in (0.0, -1.0, np.nan, np.inf, 1e-9):
        with pytest.raises(UnreadableCloud, match=r"units per metre .* 1000 for"):
            decode_cloud(las(), units_per_metre=units)


def test_viewpoint(kitti, points):
    cloud = decode_cloud(kitti(), file_format="kitti", viewpoint=None)
    assert not cloud.has_viewpoint
    np.testing.assert_array_equal(cloud.points, points)
    for wrong in ((np.nan, 0.0, 0.0), (0.0, np.inf, 0.0), (1e9, 0.0, 0.0)):
        with pytest.raises(UnreadableCloud, match="The viewpoint"):
            decode_cloud(kitti(), file_format="kitti", viewpoint=wrong)


def test_coordinates_of_a_map(las, points):
    """UTM in float64: with the viewpoint to the millimetre, without it an error that tells."""
    east = np.array([512_345.25, 5_412_345.5, 210.0])
    data = las(points + east, (512_000.0, 5_412_000.0, 0.0))
    cloud = decode_cloud(data, viewpoint=(512_345.25, 5_412_345.5, 210.0))
    np.testing.assert_allclose(cloud.points, points, atol=1e-6)
    with pytest.raises(UnreadableCloud, match=r"5\.41235e\+06 m .*units_per_metre.*UTM"):
        decode_cloud(data)


def test_a_scale_beyond_all_numbers(las):
    data = bytearray(las())
    data[131:139] = struct.pack("<d", 1e308)
    with pytest.raises(UselessFrame, match="0 of 12 points are valid"):
        decode_cloud(bytes(data))


def test_ten_kilometres(npy, points):
    points[3] = (0.0, -10_000.0, 10_000.0)
    np.testing.assert_array_equal(decode_cloud(npy(points)).points, points)
    points[3, 1] = -10_000.1
    with pytest.raises(UnreadableCloud, match="the limit is 10000 m"):
        decode_cloud(npy(points))


def test_missing_points(pcd, npy, points):
    points[[2, 7], [0, 2]] = np.nan, np.inf
    for form in ("ascii", "binary", "binary_compressed"):
        scan = decode_scan(pcd(points, form))
        np.testing.assert_array_equal(scan.cloud.points, np.delete(points, [2, 7], axis=0))
        assert (scan.file_points, scan.cloud.note) == (12, "2 missing points skipped")
    points[0] = 1e300  # a number, and yet none a float32 holds: far, not missing
    with pytest.raises(UnreadableCloud, match=r"1e\+300 m, so the type"):
        decode_cloud(npy(points))
    points[:3] = np.nan
    with pytest.raises(UselessFrame, match="8 of 12 points are valid"):
        decode_cloud(npy(points))
    with pytest.raises(UselessFrame, match="0 of 12 points are valid"):
        decode_cloud(npy(np.full((12, 3), np.nan)))
    with pytest.raises(UselessFrame, match="0 of 0 points are valid"):
        decode_cloud(npy(np.empty((0, 3))))


def test_pose(npy):
    rough = np.eye(4)
    rough[0, 1] = 1e-3
    pose = decode_cloud(npy(), pose=rough).pose
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    with pytest.raises(InvalidPose, match=r"^scan: The rotation"):
        decode_cloud(npy(), pose=np.diag([2.0, 2.0, 2.0, 1.0]), name="scan")


def test_thinned_as_one_would_by_hand():
    rng = np.random.default_rng(4)
    points = rng.uniform(-0.2, 0.2, (3000, 3)).astype(np.float32)
    points[rng.integers(0, 3000, 500)] = points[7]
    points[0] = (-10_000.0, 10_000.0, 10_000.0)
    for most in (8, 60, 700, 2400):
        actual, edge = thinned(points, most)
        firsts = {}
        for i, voxel in enumerate(np.floor(points.astype(float) * (1.0 / edge)).astype(int)):
            firsts.setdefault(tuple(voxel.tolist()), i)
        np.testing.assert_array_equal(actual, points[sorted(firsts.values())])
        assert len(actual) <= most
        if edge > 0.01:  # and with the voxels before it, there would have been too many
            finer = np.floor(points.astype(float) * (np.sqrt(2.0) / edge))
            assert len(np.unique(finer, axis=0)) > most


def test_nothing_of_more_than_five_million_is_left(monkeypatch):
    """All in one place: as useless as so few points that were sent."""
    rows = np.full((100, 4), 2.0, "<f4")
    assert len(decode_scan(rows.tobytes(), file_format="kitti").cloud.points) == 100
    monkeypatch.setattr(reading, "MOST_POINTS", 99)
    with pytest.raises(UselessFrame, match="100 points occupy 1 voxels"):
        decode_scan(rows.tobytes(), file_format="kitti")
