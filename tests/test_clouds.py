"""Tests of PLY files, byte by byte and with a separate reader."""

import struct

import numpy as np
import pytest

from sceneprint.formats.export import points_of, write_ply
from sceneprint.types import Intrinsics, Surface

_CODES = {"float": "f", "uchar": "B", "int": "i"}


def read(data):
    """Elements and comments of a PLY file, one value at a time, as its header says."""
    head, body = data.split(b"end_header\n", 1)
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    shape = []
    comments = []
    for line in lines[2:]:
        word, rest = line.split(" ", 1)
        if word == "comment":
            comments.append(rest)
        elif word == "element":
            name, many = rest.split()
            shape.append((name, int(many), []))
        else:
            assert word == "property"
            shape[-1][2].append(rest.split())
    found = {}
    place = 0

    def take(kind):
        nonlocal place
        (value,) = struct.unpack_from("<" + _CODES[kind], body, place)
        place += struct.calcsize("<" + _CODES[kind])
        return value

    for name, count, properties in shape:
        found[name] = []
        for _ in range(count):
            row = {}
            for p in properties:
                if p[0] == "list":
                    row[p[3]] = [take(p[2]) for _ in range(take(p[1]))]
                else:
                    row[p[1]] = take(p[0])
            found[name].append(row)
    assert place == len(body)
    return found, comments


def test_the_bytes_of_one_coloured_point():
    data = write_ply(
        np.array([[1.0, -2.0, 0.5]]),
        np.array([[0.0, 0.0, -1.0]]),
        np.array([[255, 0, 7]], np.uint8),
        comments=["frame a.optical"],
    )
    assert data == (
        b"ply\nformat binary_little_endian 1.0\ncomment frame a.optical\nelement vertex 1\n"
        b"property float x\nproperty float y\nproperty float z\n"
        b"property float nx\nproperty float ny\nproperty float nz\n"
        b"property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
        b"\x00\x00\x80\x3f\x00\x00\x00\xc0\x00\x00\x00\x3f"
        b"\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x80\xbf\xff\x00\x07"
    )


def test_a_mesh_with_edges_is_read_back():
    rng = np.random.default_rng(3)
    points = rng.normal(size=(5, 3)).astype(np.float32)
    faces, edges = np.array([[0, 1, 2], [4, 3, 2]]), np.array([[0, 4]])
    found, comments = read(write_ply(points, faces=faces, edges=edges))
    assert [[v["x"], v["y"], v["z"]] for v in found["vertex"]] == points.tolist()
    assert [f["vertex_indices"] for f in found["face"]] == faces.tolist()
    assert found["edge"] == [{"vertex1": 0, "vertex2": 4}]
    assert comments == []


def test_a_comment_stays_in_its_line():
    data = write_ply(np.zeros((1, 3)), comments=["haus\nelement vertex 9", "Flur, OG \u00fc"])
    found, comments = read(data)
    assert len(found["vertex"]) == 1
    assert comments == [r"haus\nelement vertex 9", r"Flur, OG \xfc"]


@pytest.mark.parametrize(
    "wrong",
    [
        {"normals": np.zeros((1, 3))},
        {"colours": np.zeros((2, 4), np.uint8)},
        {"faces": np.array([[0, 1, 2]])},
        {"edges": np.array([[-1, 0]])},
        {"edges": np.array([[0, 1, 1]])},
    ],
)
def test_what_does_not_fit_is_refused(wrong):
    with pytest.raises(ValueError, match=r"not \(|for 2 points"):
        write_ply(np.zeros((2, 3)), **wrong)


def test_a_surface_is_its_valid_pixels():
    points = np.arange(12, dtype=np.float32).reshape(2, 2, 3)
    valid = np.array([[True, False], [False, True]])
    surface = Surface(
        points, -points, valid, np.ones((2, 2), np.float32), Intrinsics(2, 2, 1, 1, 0, 0)
    )
    found, normals = points_of(surface)
    assert found.tolist() == [[0, 1, 2], [9, 10, 11]]
    assert (normals == -found).all()
