"""Tests of the decoder of whole maps: equal arrays, isolation, limits and false headers."""

import json
import struct

import numpy as np
import pytest
import trimesh

from sceneprint.decoders.pool import DecoderProcess
from sceneprint.decoders.surface_decoder import read_surface_confined
from sceneprint.errors import DecoderFailure, UnreadableCloud
from sceneprint.formats.depth_file import encode_npy
from sceneprint.formats.surface_file.reading import SurfaceOptions, read_surface

STATED = SurfaceOptions(units_per_metre=2.0, up="-y")


def ball(form):
    data = trimesh.creation.icosphere(subdivisions=2).export(file_type=form)
    return data.encode() if isinstance(data, str) else bytes(data)


def read(path, name, options=None, **limits):
    with path.open("rb") as file:
        return read_surface_confined(file.fileno(), name, options or SurfaceOptions(), **limits)


def rows(n=5000):
    points = np.random.default_rng(2).uniform((-8, -6, 0), (8, 6, 3), (n, 3))
    return encode_npy(points + np.array([500_000.0, 4_000_000.0, 100.0]))


def assert_equal(here, there):
    for a, b in (
        (here.surface.points, there.surface.points),
        (here.surface.triangles, there.surface.triangles),
        (here.surface.offset, there.surface.offset),
    ):
        if a is None or b is None:
            assert a is b
        else:
            assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    # the last bits of products depend on the threads and the memory of a process
    assert there.surface.up == pytest.approx(here.surface.up, abs=1e-12)
    names = ("units", "up_from", "notes", "units_per_metre", "file_points", "voxel")
    assert [getattr(here, name) for name in names] == [getattr(there, name) for name in names]


@pytest.mark.parametrize(
    "name", ["ball.ply", "map.npy", pytest.param("ball.obj", marks=pytest.mark.thorough)]
)
def test_surfaces_are_the_same_as_in_this_process(tmp_path, name):
    data = rows() if name == "map.npy" else ball(name[-3:])
    path, options = tmp_path / "upload", STATED if name == "ball.ply" else None
    path.write_bytes(data)
    there = read(path, name, options)
    assert_equal(read_surface(data, name, options), there)


def test_errors_are_the_same_as_in_this_process(tmp_path):
    path, data = tmp_path / "upload", ball("ply")[:-100]
    path.write_bytes(data)
    with pytest.raises(UnreadableCloud) as here:
        read_surface(data, "ball.ply")
    with pytest.raises(UnreadableCloud, match=r"^ball\.ply: ") as there:
        read(path, "ball.ply")
    assert str(here.value) == str(there.value)


def test_what_is_no_file_of_a_map_starts_no_process(tmp_path):
    (tmp_path / "text").write_text("hello")
    with pytest.raises(UnreadableCloud, match=r"a\.txt: .*the format is none of PCD"):
        read(tmp_path / "text", "a.txt")


def many(tree, copies):
    """A scene that places one part so often, just not too often to be refused."""
    mesh = next(node["mesh"] for node in tree["nodes"] if "mesh" in node)
    tree["nodes"] = [{"mesh": mesh} for _ in range(copies)]
    tree["scenes"], tree["scene"] = [{"nodes": list(range(copies))}], 0
    text = json.dumps(tree).encode()
    return text + b" " * (-len(text) % 4)


def test_memory_and_time_are_limited(tmp_path):
    data = trimesh.creation.icosphere(subdivisions=6).export(file_type="glb")
    length = struct.unpack_from("<I", data, 12)[0]
    text = many(json.loads(data[20 : 20 + length]), 200)
    body = data[20 + length :]
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(body), len(text), 0x4E4F534A)
    path = tmp_path / "upload"
    path.write_bytes(head + text + body)  # a few megabytes that become 8 million vertices
    assert path.stat().st_size < 4 << 20
    with pytest.raises(DecoderFailure, match="more than 256 MiB of memory"):
        read(path, "a.glb", more_bytes=256 << 20, seconds=60.0)
    with pytest.raises(DecoderFailure, match=r"longer than 0\.3 s"):
        read(path, "a.glb", seconds=0.3)


@pytest.mark.parametrize(
    "lie",
    [
        {"points": 0}, {"points": 10**9}, {"points": 2.0}, {"file_points": 1}, {"triangles": 10**9},
        {"triangles": 400}, {"up": [0, 0, 2]}, {"offset": [0, 0, float("nan")]}, {"offset": [1]},
        {"units": "guessed"}, {"units_per_metre": -1}, {"notes": "x" * 30}, {"voxel": -1.0},
    ],
)  # fmt: skip
def test_a_reply_that_lies_is_no_result(tmp_path, lie, monkeypatch):
    truth = {
        "points": 12, "triangles": None, "file_points": 12, "offset": [0, 0, 0], "up": [0, 0, 1],
        "units": "file", "up_from": "file", "notes": [], "units_per_metre": 1.0, "voxel": None,
    }  # fmt: skip
    path = tmp_path / "upload"
    path.write_bytes(rows(20))

    def receive(_, kind, shape):  # of triangles: index 12 is out of range
        return np.full(shape, 12, kind)

    monkeypatch.setattr(DecoderProcess, "await_ready", lambda self: None)
    monkeypatch.setattr(DecoderProcess, "ask", lambda *_: truth | lie)
    monkeypatch.setattr(DecoderProcess, "array_of", receive)
    with pytest.raises(DecoderFailure, match="its reply is invalid"):
        read(path, "map.npy")
