"""Tests of damaged files of every format, which raise frame errors in bounded memory."""

import io
import random
import tracemalloc

import numpy as np
import pytest

from sceneprint.errors import FrameError
from sceneprint.formats.points.cloud import decode_scan
from tests.scans.conftest import LAYOUTS, rows_of

TRIES = 400  #: of each file
#: Bytes at once: files here have less than 2000, of which LZF makes 88 times as much.
MOST = 1 << 20

#: What bytes of a header are likely to break something.
WORDS = (
    b"0", b"-1", b"nan", b"1e9", b"99999999999999999999", b"4294967295", b"65536", b"\n", b"\r",
    b" ", b"\0", b"end_header\n", b"list uchar ", b"double", b"char", b"#", b"binary", b"DATA ",
    b"\xff\xff\xff\xff", b"\x00\x00\x00\x80", b"(", b"{", b"'<f8'", b"vertex", b"2",
)  # fmt: skip


def damaged(data, rng):
    copy = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 12))):
        # headers are short, and all depends on them
        at = rng.randrange(min(len(copy), rng.choice((60, 400, 10_000))) or 1)
        kind = rng.randrange(6)
        if kind == 0 and copy:
            at = min(at, len(copy) - 1)
            copy[at] = rng.choice((0, 255, 128, 32, 57, rng.randrange(256)))
        elif kind == 1:
            word = rng.choice(WORDS)
            copy[at : at + rng.choice((0, len(word)))] = word
        elif kind == 2:
            del copy[at : at + rng.choice((1, 2, 8, 100))]
        elif kind == 3:
            copy[at:at] = copy[at : at + rng.choice((1, 4, 40))]
        elif kind == 4:
            del copy[rng.randrange(len(copy) + 1) :]
        else:
            digits = [i for i, byte in enumerate(copy[:400]) if 48 <= byte <= 57]
            if digits:
                copy[rng.choice(digits)] = rng.choice(b"0123456789-")
    return bytes(copy)


def tried(files, told, most, tries):
    rng, read = random.Random(len(files[0])), 0
    for data in files:
        decode_scan(data, file_format=told)  # and so kernels are compiled
    tracemalloc.start()
    try:
        for data in files:
            for _ in range(tries):
                changed = damaged(data, rng)
                tracemalloc.reset_peak()
                before, _ = tracemalloc.get_traced_memory()
                said = ""
                try:
                    scan = decode_scan(changed, file_format=told)
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


@pytest.mark.parametrize("told", [None, "pointcloud2"])
def test_pointcloud2(serialize, points, told):
    files = [
        serialize(rows_of(points, layout), little=little, height=height)
        for layout in LAYOUTS[:2]
        for little, height in ((True, 1), (False, 3))
    ]
    read, refused = tried(files, told, MOST, TRIES // 2)
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
