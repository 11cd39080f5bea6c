"""Tests of damaged files of every format, which raise frame errors in bounded memory."""

import io
import tracemalloc

import numpy as np
import pytest

from sceneprint.errors import FrameError
from sceneprint.formats.points.cloud import decode_scan
from tests.datasets.shared import mutations
from tests.scans.conftest import LAYOUTS, rows_of

TRIES = 400  #: of each file
#: Bytes at once: files here have less than 2000, of which LZF makes 88 times as much.
MOST = 1 << 20


def tried(files, file_format, most, tries):
    read = 0
    for data in files:
        decode_scan(data, file_format=file_format)  # and so kernels are compiled
    tracemalloc.start()
    try:
        for data in files:
            for changed in mutations(data, tries):
                tracemalloc.reset_peak()
                before, _ = tracemalloc.get_traced_memory()
                said = ""
                try:
                    scan = decode_scan(changed, file_format=file_format)
                except FrameError as error:
                    said = str(error)
                else:
                    read += 1
                    assert np.isfinite(scan.cloud.points).all()
                    assert len(scan.cloud.points) <= scan.file_points <= 88 * len(changed)
                assert said.isprintable() or not said
                assert len(said) < 600
                _, peak = tracemalloc.get_traced_memory()
                assert peak - before < most, changed[:200]
    finally:
        tracemalloc.stop()
    return read, tries * len(files) - read


def test_ply(ply):
    forms = ("ascii", "binary_little_endian", "binary_big_endian")
    read, refused = tried([ply(form=form) for form in forms], None, MOST, TRIES)
    assert min(read, refused) > 100


def test_pcd(pcd):
    forms = ("ascii", "binary", "binary_compressed")
    read, refused = tried([pcd(form=form) for form in forms], None, MOST, TRIES)
    assert min(read, refused) > 100


@pytest.mark.parametrize("line", [b"\n", b"#\n", b"ply\n", b"ply\ncomment\n", b"VERSION \n"])
def test_endless_headers(line):
    data = line * 500_000
    tracemalloc.start()
    try:
        with pytest.raises(FrameError):
            decode_scan(data)
        assert tracemalloc.get_traced_memory()[1] < 2 << 20
    finally:
        tracemalloc.stop()


def test_las(las):
    read, refused = tried([las()], None, MOST, TRIES)
    assert min(read, refused) > 30


@pytest.mark.parametrize("file_format", [None, "pointcloud2"])
def test_pointcloud2(serialize, points, file_format):
    files = [
        serialize(rows_of(points, layout), little=little, height=height)
        for layout in LAYOUTS[:2]
        for little, height in ((True, 1), (False, 3))
    ]
    read, refused = tried(files, file_format, MOST, TRIES // 2)
    assert min(read, refused) > 30


def test_arrays(npy, kitti):
    read, refused = tried([npy(), npy(np.ones((12, 4), np.float16))], "npy", MOST, TRIES)
    assert min(read, refused) > 10
    read, refused = tried([kitti()], "kitti", MOST, TRIES)
    assert min(read, refused) > 30


@pytest.mark.parametrize("form", [3, 7])
def test_laz(form, points):
    laspy = pytest.importorskip("laspy", reason="laspy is not installed")
    pytest.importorskip("lazrs", reason="lazrs is not installed")
    header = laspy.LasHeader(point_format=form, version="1.4" if form > 5 else "1.2")
    header.scales = [0.001] * 3
    record, file = laspy.LasData(header), io.BytesIO()
    record.x, record.y, record.z = np.tile(points, (10, 1)).T
    record.write(file, do_compress=True)
    # records of a small file may be 64 MiB before they are compared with it
    read, refused = tried([file.getvalue()], None, 128 << 20, TRIES)
    assert min(read, refused) > 30
