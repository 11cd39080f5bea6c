"""Tests of `sceneprint make mesh` with a service."""

import re

import pytest

from sceneprint_client import Client
from tests.cli_service.conftest import write_rooms
from tests.conftest import halved


@pytest.fixture(scope="module")
def walk(tmp_path_factory, room_views):
    frames = map(halved, room_views(33, 1, 8).frames[:6])
    return write_rooms(tmp_path_factory.mktemp("walk"), frames, views=6) / "room-0" / "seq-01"


def test_a_mesh_and_its_figures(sceneprint, service_url, walk, tmp_path, with_open3d):
    with Client(service_url) as client:
        client.create_map("walk", model="depth")
    first, *rest = sorted(walk.glob("*.png"))
    sceneprint("upload", "walk", *rest)
    mesh = tmp_path / "mesh.ply"
    said = sceneprint("make", "mesh", "walk", first, "--out", mesh, "--voxel", "0.05")
    lines = said.stdout.splitlines()
    total = re.search(r"(\d+) views show ([\d.]+) m2 of surface", lines[1])
    views = [line for line in lines if re.search(r"\+ *[\d.]+ m2", line)]
    assert len(views) == int(total[1])
    assert "the frame itself" in views[0]
    assert float(views[-1].split()[-1]) == pytest.approx(float(total[2]), abs=0.01)
    assert lines[-1] == f"wrote {mesh}"
    assert mesh.read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\n")
    # a stored frame finds the others, and is fused as it was sent
    sceneprint("upload", "walk", first)
    with Client(service_url) as client:
        [*_, frame_id] = [frame.frame_id for frame in client.frames("walk")]
    said = sceneprint("make", "mesh", "walk", frame_id, "--out", mesh, "--cloud", "--voxel", "0.05")
    assert "a cloud" in said.stdout
    assert b"element face" not in mesh.read_bytes()[:1000]


def test_what_cannot_be_reconstructed(sceneprint, service_url, walk):
    with Client(service_url) as client:
        client.create_map("nothing", model="depth")
    first = min(walk.glob("*.png"))
    said = sceneprint("make", "mesh", "nothing", first, expect=1)
    assert said.stdout == f"{first}: not found, so there is nothing to fuse\n"
    said = sceneprint("make", "mesh", "nothing", walk, expect=2)
    assert "6 frames found. Specify a single frame file." in said.stderr
    said = sceneprint("make", "mesh", "nothing", "nobody", expect=2)
    assert "There is no frame 'nobody'" in said.stderr
