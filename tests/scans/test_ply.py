"""Tests of valid and invalid headers of PLY files."""

import struct

import numpy as np
import pytest

from sceneprint.errors import UnreadableCloud
from sceneprint.formats.points.cloud import decode_cloud, decode_scan

XYZ = "property float x\nproperty float y\nproperty float z\n"
BINARY = "ply\nformat binary_little_endian 1.0\n"


@pytest.mark.parametrize(
    ("word", "kind"),
    [("char", "b"), ("uchar", "B"), ("int16", "h"), ("ushort", "H"), ("int", "i"),
     ("uint32", "I"), ("float32", "f"), ("double", "d")],
)  # fmt: skip
@pytest.mark.parametrize("order", ["<", ">"])
def test_types(word, kind, order):
    wanted = np.arange(30).reshape(10, 3)
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    rows = "".join(f"property {word} {name}\n" for name in "xyz")
    header = f"ply\r\nformat {form} 1.0\r\nelement vertex 10\r\n{rows}end_header\r\n"
    body = struct.pack(f"{order}30{kind}", *wanted.ravel())
    np.testing.assert_array_equal(decode_cloud(header.encode() + body).points, wanted)


@pytest.mark.parametrize("order", ["<", ">"])
def test_vertices_with_lists(points, order):
    """Rows of different lengths, the list between the coordinates."""
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    header = (
        f"ply\nformat {form} 1.0\nelement vertex 12\nproperty float x\n"
        "property list uint16 double seen\nproperty float y\nproperty double z\nend_header\n"
    )
    body = b""
    for i, (x, y, z) in enumerate(points):
        body += struct.pack(f"{order}fH{i % 4}dfd", x, i % 4, *[9.0] * (i % 4), y, z)
    np.testing.assert_array_equal(decode_cloud(header.encode() + body).points, points)
    with pytest.raises(UnreadableCloud, match="ends in row 12 of 12"):
        decode_cloud((header.encode() + body)[:-1])

    text = header.replace(form, "ascii")
    for i, (x, y, z) in enumerate(points):
        text += f"{x} {i % 4} {'9 ' * (i % 4)}{y} {z}\n"
    np.testing.assert_array_equal(decode_cloud(text.encode()).points, points)


def test_numbers_written_out():
    """As Python reads them, or as missing where some printf writes a NaN."""
    words = [
        "1", "-1.5", "+.25", "3.", "1e3", "-2.5E-3", "1.7976931348623157e2", "0.1",
        "123456789.123456789e-5", "0.000000000000000000000000125e24", "1000000000000000000000e-18",
        "4.9406564584124654e-324", "1e-400", "-0", "007",
    ]  # fmt: skip
    rows = "".join(f"{word} 0 1\n\n" for word in words)
    header = f"ply\nformat ascii 1.0\nelement vertex {len(words)}\n{XYZ}end_header\n"
    result = decode_cloud((header + rows).encode()).points[:, 0]
    np.testing.assert_array_equal(result, np.array([float(w) for w in words], np.float32))

    missing = ["nan", "-nan", "NaN(ind)", "inf", "-Infinity", "1.#QNAN", "-1.#IND", "1e400"]
    rows += "".join(f"{word} 0 1\n" for word in missing)
    header = header.replace(str(len(words)), str(len(words) + len(missing)))
    scan = decode_scan((header + rows).encode())
    assert len(scan.cloud.points) == len(words)
    assert scan.cloud.note == "8 missing points skipped"


def test_old_line_ends(points):
    rows = "".join(f"{x} {y} {z}\r" for x, y, z in points)
    header = f"ply\nformat ascii 1.0\nelement vertex 12\n{XYZ}end_header\n".replace("\n", "\r")
    np.testing.assert_array_equal(decode_cloud((header + rows).encode()).points, points)


def described(lines, body=b"\0" * 120):
    return f"{BINARY}{lines}end_header\n".encode() + body


LIES = {
    "fifty million": (described(f"element vertex 50000000\n{XYZ}"), "declares 50000000 points"),
    "more than there are": (described(f"element vertex 11\n{XYZ}"), "at least 132 bytes, but 120"),
    "doubles for floats": (
        described(f"element vertex 10\n{XYZ.replace('float', 'double')}"), "240 bytes, but 120",
    ),
    "more before": (
        described(f"element camera 999999999999\nproperty int a\nelement vertex 10\n{XYZ}"),
        "999999999999 rows of 'camera'",
    ),
    "nothing, often": (
        described(f"element camera 999999999999999\nelement vertex 10\n{XYZ}"),
        "without properties",
    ),
    "a list of billions": (
        described(f"element vertex 10\n{XYZ}element face 1\nproperty list uint int a\n",
                  b"\0" * 120 + b"\xff\xff\xff\xff" + b"\0" * 9),
        "row 1 of 1, whose lists",
    ),
    "many properties": (
        described("element vertex 10\n" + "property int a\n" * 1001), "more than 1000 properties",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", LIES)
def test_lies(case):
    data, message = LIES[case]
    with pytest.raises(UnreadableCloud, match=message):
        decode_cloud(data)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("1.00 2.00 3.00\n" * 9, "Row 10 of 10.*file ends before"),
        ("1.0 2.0 3.0\n" * 9 + "1.0 2.0\n", "Row 10 of 10.*fewer values"),
        ("1.0 2.0 3.0\n" * 12, "bytes follow after the rows"),
        ("1.0 2.0 3.0 4.0\n" * 10, "Row 1 of 10.*more values"),
        ("1.0 2.0 3.0\n" * 4 + "1.0 x 3.0\n" * 6, "Row 5 of 10.*not a number"),
    ],
)
def test_rows_that_are_none(rows, message):
    header = f"ply\nformat ascii 1.0\nelement vertex 10\n{XYZ}end_header\n"
    with pytest.raises(UnreadableCloud, match=message):
        decode_cloud((header + rows).encode())
