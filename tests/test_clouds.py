"""Tests of PLY files, byte by byte and as trimesh reads them."""

import io
import struct

import numpy as np
import pytest
import trimesh

from sceneprint.formats.export import points_of, write_ply
from sceneprint.types import Intrinsics, Surface


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


def test_a_mesh_is_read_by_trimesh_and_ends_with_its_edges():
    points = np.random.default_rng(3).normal(size=(5, 3)).astype(np.float32)
    faces, edges = np.array([[0, 1, 2], [4, 3, 2]]), np.array([[0, 4]])
    data = write_ply(points, faces=faces, edges=edges)
    mesh = trimesh.load(io.BytesIO(data), "ply", process=False)
    assert (mesh.vertices.tolist(), mesh.faces.tolist()) == (points.tolist(), faces.tolist())
    assert b"element edge 1\nproperty int vertex1\nproperty int vertex2\n" in data
    assert data.endswith(struct.pack("<ii", 0, 4))


def test_a_comment_stays_in_its_line():
    data = write_ply(np.zeros((1, 3)), comments=["haus\nelement vertex 9", "Flur, OG \u00fc"])
    lines = data.partition(b"end_header")[0].decode("ascii").splitlines()
    assert lines[2:4] == [r"comment haus\nelement vertex 9", r"comment Flur, OG \xfc"]


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
    visible, normals = points_of(surface)
    assert visible.tolist() == [[0, 1, 2], [9, 10, 11]]
    assert (normals == -visible).all()
