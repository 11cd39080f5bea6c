"""Tests of LAS against its description, and of LAZ against another library."""

import io
import struct

import numpy as np
import pytest

from sceneprint.errors import UnreadableCloud
from sceneprint.formats.points.cloud import decode_cloud, decode_scan
from sceneprint_client.formats import format_of

N = 60_000  #: two chunks


def test_las(las, points):
    scan = decode_scan(las())
    assert (scan.file_format, scan.file_points, format_of(las())) == ("las", 12, "las")
    np.testing.assert_allclose(scan.cloud.points, points, atol=1e-6)
    # what follows the points, such as waveforms, is passed over
    np.testing.assert_array_equal(decode_cloud(las() + b"more").points, scan.cloud.points)


def changed(data, at, form, value):
    copy = bytearray(data)
    struct.pack_into(f"<{form}", copy, at, value)
    return bytes(copy)


@pytest.mark.parametrize(
    ("at", "form", "value", "message"),
    [
        (107, "I", 50_000_000, "declares 50000000 points"),
        (105, "H", 27, "records of 27 bytes"),
        (104, "B", 11, "point format 11"),
        (96, "I", 2**32 - 1, "points from byte 4294967295"),
        (131, "d", 0.0, "scale"),
        (155, "d", np.inf, "scale"),
        (104, "B", 0x81, "how its points are compressed"),
    ],
)
def test_lies(las, at, form, value, message):
    if value == 0x81:
        pytest.importorskip("lazrs", reason="lazrs is not installed")
    with pytest.raises(UnreadableCloud, match=message):
        decode_cloud(changed(las(), at, form, value))


@pytest.fixture(scope="module")
def laz():
    laspy = pytest.importorskip("laspy", reason="laspy is not installed")
    pytest.importorskip("lazrs", reason="lazrs is not installed")

    def write(form, n=N, extra=False, packed=True):
        header = laspy.LasHeader(point_format=form, version="1.4" if form > 5 else "1.2")
        header.scales, header.offsets = [0.001] * 3, [1.0, 2.0, 3.0]
        if extra:
            header.add_extra_dim(laspy.ExtraBytesParams("quality", "float32"))
        record = laspy.LasData(header)
        record.x, record.y, record.z = path(n).T
        record.intensity = np.arange(n) % 60_000
        file = io.BytesIO()
        record.write(file, do_compress=packed)
        return file.getvalue()

    return write


def path(n):
    rng = np.random.default_rng(0)
    return np.round(np.cumsum(rng.normal(0, 0.05, (n, 3)), axis=0), 3)


@pytest.mark.parametrize("extra", [False, True])
@pytest.mark.parametrize("form", [0, 3, 6, 8])
def test_another_writer(laz, form, extra):
    for packed in (False, True):
        data = laz(form, extra=extra, packed=packed)
        np.testing.assert_allclose(decode_cloud(data).points, path(N), atol=2e-6)


@pytest.mark.parametrize("form", [1, 7])
def test_packed_lies(laz, form):
    data, whole = laz(form, 500), laz(form, 500, packed=False)
    (start,) = struct.unpack_from("<I", data, 96)
    (table,) = struct.unpack_from("<q", data, start)
    vlr = data.index(b"laszip encoded") + 52
    count = 247 if form > 5 else 107
    wide = "Q" if form > 5 else "I"
    length = struct.unpack_from("<H", whole, 105)[0]
    lies = [
        (count, wide, 20_000_000, "exceeds 250 times the size"),
        (count, wide, 50_001, "chunk table of the LAZ file"),
        (105, "H", length + 1, "a combination that is not supported"),
        (vlr, "H", 1, "a combination that is not supported"),  # compressor
        (vlr + 12, "I", 0, "how its points are compressed"),  # chunk size
        (vlr + 32, "H", 65_535, "how its points are compressed"),  # values
        (100, "I", 0, "how its points are compressed"),  # records before the points
        (start, "q", 2**62, "chunk table of the LAZ file"),
        (table + 4, "I", 2**31, "chunk table of the LAZ file"),
    ]
    if form == 7:  # layers of the first chunk, behind its first point and its count
        lies += [(start + 8 + length + 4, "I", 2**32 - 1, "chunk table of the LAZ file")]
    for at, kind, value, message in lies:
        with pytest.raises(UnreadableCloud, match=message):
            decode_cloud(changed(data, at, kind, value))
    for end in (start + 4, start + 20, len(data) // 2, len(data) - 1):
        with pytest.raises(UnreadableCloud):
            decode_cloud(data[:end])
