"""Fixtures of the scan tests: files of points, written byte by byte as their formats specify."""

import io
import struct

import numpy as np
import pytest

POINTS = np.arange(36, dtype=np.float64).reshape(12, 3) / 4 - 3


@pytest.fixture
def points():
    """Twelve points (12, 3) that every number type represents exactly, even times four."""
    return POINTS.copy()


@pytest.fixture(scope="session")
def ply():
    """A function that returns a PLY file of points, a list of odd lengths, and a triangle."""

    def write(points=POINTS, form="binary_little_endian"):
        header = (
            f"ply\nformat {form} 1.0\ncomment by hand\nelement camera 1\n"
            "property list uchar short marks\nproperty double focal\n"
            f"element vertex {len(points)}\nproperty uchar red\nproperty float x\n"
            "property double z\nproperty float y\nelement face 1\n"
            "property list uchar int vertex_indices\nend_header\n"
        ).encode()
        if form == "ascii":
            rows = "".join(f"7 {x:.9g} {z:.9g} {y:.9g}\n" for x, y, z in points)
            return header + f"2 5 -6 1.5\n{rows}3 0 1 2\n".encode()
        order = "<" if "little" in form else ">"
        body = struct.pack(f"{order}Bhhd", 2, 5, -6, 1.5)
        for x, y, z in points:
            body += struct.pack(f"{order}Bfdf", 7, x, z, y)
        return header + body + struct.pack(f"{order}Biii", 3, 0, 1, 2)

    return write


@pytest.fixture(scope="session")
def pcd():
    """A function that returns a PCD file of points with two more fields, one of three values."""

    def write(points=POINTS, form="binary", viewpoint="0 0 0 1 0 0 0"):
        n = len(points)
        header = (
            "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS normal x y z ring\n"
            "SIZE 4 4 4 8 2\nTYPE F F F F U\nCOUNT 3 1 1 1 1\n"
            f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT {viewpoint}\nPOINTS {n}\nDATA {form}\n"
        ).encode()
        if form == "ascii":
            rows = (f"0 0 1 {x:.9g} {y:.9g} {z:.9g} 5\n" for x, y, z in points)
            return header + "".join(rows).encode()
        if form == "binary":
            return header + b"".join(
                struct.pack("<3fffdH", 0, 0, 1, x, y, z, 5) for x, y, z in points
            )
        x, y, z = points.T
        fields = (
            np.tile(np.array([0, 0, 1], "<f4"), n).tobytes()
            + x.astype("<f4").tobytes()
            + y.astype("<f4").tobytes()
            + z.astype("<f8").tobytes()
            + np.full(n, 5, "<u2").tobytes()
        )
        packed = lzf_of(fields)
        return header + struct.pack("<II", len(packed), len(fields)) + packed

    return write


def lzf_of(data):
    """Return data as literals of LZF, and each repetition of a byte as a reference."""
    out, i = bytearray(), 0
    while i < len(data):
        same = len(data[i : i + 9]) - len(data[i : i + 9].lstrip(data[i : i + 1]))
        out += bytes([0, data[i]])
        if same > 3:  # the byte, and a reference to it of 3 to 8 bytes
            out += bytes([(same - 3) << 5, 0])
        i += same if same > 3 else 1
    return bytes(out)


NAME = "sensor_msgs/msg/PointCloud2"
LAYOUTS = (
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4")],
    [("ring", "<u2"), ("z", "<f8"), ("x", "<f4"), ("intensity", "u1"), ("y", "<i2")],
    [("x", ">f8"), ("rgb", ">u4"), ("y", ">f4"), ("z", ">i4")],
)


def rows_of(points, layout):
    rows = np.zeros(len(points), layout)
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    return rows


@pytest.fixture(scope="session")
def serialize(ros):
    writer = ros.messages()

    def message(rows, *, little=True, **how):
        writer.points(1.5, rows, **how)
        return bytes(writer.types.serialize_cdr(writer.last(), NAME, little_endian=little))

    return message


@pytest.fixture(scope="session")
def kitti():
    def write(points=POINTS):
        return b"".join(struct.pack("<4f", x, y, z, 0.5) for x, y, z in points)

    return write


@pytest.fixture(scope="session")
def npy():
    def write(array=POINTS):
        buffer = io.BytesIO()
        np.save(buffer, array)
        return buffer.getvalue()

    return write


@pytest.fixture(scope="session")
def las():
    """A function that returns a LAS 1.2 file of point format 1, in millimetres from an offset."""

    def write(points=POINTS, offset=(10.0, 20.0, 30.0)):
        header = bytearray(227)
        header[:4], header[24:26] = b"LASF", bytes([1, 2])
        struct.pack_into("<HII", header, 94, 227, 229, 0)
        struct.pack_into("<BHI", header, 104, 1, 30, len(points))
        struct.pack_into("<6d", header, 131, 0.001, 0.001, 0.001, *offset)
        rows = np.round((points - offset) / 0.001).astype(int)
        body = b"".join(struct.pack("<iii18x", *row) for row in rows.tolist())
        return bytes(header) + b"\0\0" + body

    return write
