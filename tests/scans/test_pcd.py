"""Tests of the header, compression and viewpoint of PCD files."""

import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneprint.errors import FrameError, UnreadableCloud
from sceneprint.formats.points.cloud import decode_cloud, decode_scan
from sceneprint.formats.points.pcd import inflate, read_pcd


def test_viewpoint(pcd, points):
    data = pcd(viewpoint="4000 -2000 0 1 0 0 0")
    scan = decode_scan(data)
    assert scan.viewpoint == (4000.0, -2000.0, 0.0)
    np.testing.assert_array_equal(scan.cloud.points, points - (4000.0, -2000.0, 0.0))
    # in the units of the file, while what a caller says is in metres
    assert decode_scan(data, units_per_metre=1000).viewpoint == (4.0, -2.0, 0.0)
    for said in ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), None):
        scan = decode_scan(data, viewpoint=said)
        assert scan.viewpoint == said
        assert scan.cloud.has_viewpoint == (said is not None)
        np.testing.assert_array_equal(scan.cloud.points, points - (said or (0.0, 0.0, 0.0)))
    with pytest.raises(UnreadableCloud, match="VIEWPOINT 'nan 0 0"):
        decode_cloud(pcd(viewpoint="nan 0 0 1 0 0 0"))


def test_headers_of_other_writers(pcd, points):
    """Without the comment, without COUNT, with CRLF, of rows and columns, or of version .5."""
    data = pcd(form="ascii").replace(b"\n0 0 1 ", b"\n")
    data = data.replace(b"normal ", b"").replace(b"SIZE 4 ", b"SIZE ").replace(b"TYPE F", b"TYPE")
    data = data.replace(b"COUNT 3 1 1 1 1\n", b"").split(b"\n", 1)[1]
    for changed in (
        data,
        data.replace(b"\n", b"\r\n"),
        data.replace(b"POINTS 12\n", b"").replace(b"WIDTH 12\nHEIGHT 1\n", b"WIDTH 4\nHEIGHT 3\n"),
        data.replace(b"VERSION 0.7\nFIELDS", b"VERSION .5\nCOLUMNS").replace(b"HEIGHT 1\n", b""),
    ):
        np.testing.assert_array_equal(decode_cloud(changed).points, points)


LIES = {
    "no z": (b"FIELDS normal x y z", b"FIELDS normal x y w", "exactly one field z"),
    "endless values": (b"COUNT 3 1", b"COUNT 99999999999 1", "COUNT 99999999999"),
    "fifty million": (b"12\nHEIGHT 1\n", b"50000000\n", "50000000"),
    "more than there are": (
        b"12\nHEIGHT 1\nV",
        b"1\nHEIGHT 12\nDATA binary\nV",
        "46 bytes follow after the rows",
    ),
    "doubles for floats": (b"SIZE 4 4 4 8 2", b"SIZE 8 4 4 8 2", "360 of 504 bytes follow"),
    "no data": (b"DATA binary", b"# nothing", "no DATA line|has the invalid line"),
}


@pytest.mark.parametrize("case", LIES)
def test_lies(pcd, case):
    old, new, message = LIES[case]
    with pytest.raises(UnreadableCloud, match=message):
        decode_cloud(pcd().replace(old, new).replace(b"POINTS 12", b"POINTS " + (
            b"50000000" if case == "fifty million" else b"12"
        )))  # fmt: skip


@pytest.mark.parametrize("count", [0, 1])
def test_a_header_alone_asks_for_nothing(count):
    """Of a hundred fields, each of as many values as may be."""
    header = (
        f"VERSION 0.7\nFIELDS x y z{' a' * 100}\nSIZE{' 4' * 103}\nTYPE{' F' * 103}\n"
        f"COUNT 1 1 1{' 65536' * 100}\nWIDTH {count}\nHEIGHT 1\nDATA ascii\n1 2 3\n"
    )
    tracemalloc.start()
    try:
        with pytest.raises(FrameError, match=r"6553603 values|0 of 0 points"):
            decode_cloud(header.encode())
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("form", ["binary", "binary_compressed"])
def test_only_zeros_may_follow_the_points(pcd, points, form):
    """Some programs pad their files; PCL reads them as well."""
    for rest in (b"\0", b"\0" * 4096):
        np.testing.assert_array_equal(decode_cloud(pcd(form=form) + rest).points, points)
    with pytest.raises(UnreadableCloud, match="bytes follow after the rows"):
        decode_cloud(pcd(form=form) * 2)


def test_truncated(pcd):
    for form in ("ascii", "binary", "binary_compressed"):
        whole = pcd(form=form)
        start = whole.index(b"DATA")
        for end in (start, start + 8, len(whole) - 5):
            with pytest.raises(UnreadableCloud):
                decode_cloud(whole[:end])


def compressed(count, inflated, packed):
    header = (
        f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {count}\nHEIGHT 1\n"
        f"POINTS {count}\nDATA binary_compressed\n"
    )
    return header.encode() + struct.pack("<II", len(packed), inflated) + packed


def test_bombs():
    zeros = bytes([0, 0]) + bytes([7 << 5, 255, 0]) * 1000  # 1 + 264,000 bytes of 3,002
    assert inflate(np.frombuffer(zeros, np.uint8), 264_001).sum() == 0
    with pytest.raises(UnreadableCloud, match=r"declares 240000000 bytes compressed to 3002"):
        decode_cloud(compressed(20_000_000, 240_000_000, zeros))
    with pytest.raises(
        UnreadableCloud, match=r"240000000 bytes of points, but the body states 264001"
    ):
        decode_cloud(compressed(20_000_000, 264_001, zeros))
    with pytest.raises(
        UnreadableCloud, match="do not expand to 120 bytes"
    ):  # and no more than these
        decode_cloud(compressed(10, 120, zeros))
    with pytest.raises(UnreadableCloud, match="do not expand to 132000 bytes"):
        decode_cloud(compressed(11_000, 132_000, zeros[:1502] + b"\0"))
    wide = compressed(20_000_000, 2**32 - 1, zeros).replace(b"SIZE 4 4 4", b"SIZE 8 8 8")
    with pytest.raises(
        UnreadableCloud, match="480000000 bytes of points, but the body states 4294967295"
    ):
        decode_cloud(wide)
    wide = compressed(10, 240, zeros).replace(b"SIZE 4 4 4", b"SIZE 8 8 8")
    with pytest.raises(UnreadableCloud, match="have 240 bytes; the limit is 200"):
        read_pcd(wide, 10)


def unpacked(packed):
    """By the description of the format, one byte after the other."""
    out, left = bytearray(), list(packed)
    while left:
        control = left.pop(0)
        if control < 32:
            taken = [left.pop(0) for _ in range(control + 1)]
            out += bytes(taken)
            continue
        length = (control >> 5) + (left.pop(0) if control >> 5 == 7 else 0) + 2
        distance = ((control & 31) << 8) + left.pop(0) + 1
        if distance > len(out):
            raise IndexError
        for _ in range(length):
            out.append(out[-distance])
    return bytes(out)


@settings(max_examples=150)
@given(st.binary(max_size=60), st.integers(0, 5))
def test_any_bytes_inflate_as_the_format_says(packed, beyond):
    try:
        expected = unpacked(packed)
    except IndexError:
        expected = None
    size = (len(expected) if expected is not None else 20) + beyond
    if expected is None or beyond or size > 88 * len(packed):
        with pytest.raises(UnreadableCloud):
            inflate(np.frombuffer(packed, np.uint8), size + 1)
    else:
        assert inflate(np.frombuffer(packed, np.uint8), size).tobytes() == expected
