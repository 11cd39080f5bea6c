"""Tests of point clouds on the command line, in a map that also has depth images."""

import json

import numpy as np
import pytest

from sceneprint.formats.dataset import write_pose
from sceneprint.formats.export import write_ply


@pytest.fixture(scope="module")
def scans(room_frames, tmp_path_factory):
    """What two depth images see, as a KITTI scan and a PLY, with their poses; and one that is
    none.
    """
    folder = tmp_path_factory.mktemp("scans") / "walk"
    folder.mkdir()
    for i, frame in enumerate(room_frames[:2]):
        k, depth = frame.intrinsics, frame.depth.astype(float)
        y, x = np.nonzero(depth)
        z = depth[y, x]
        points = np.stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z], axis=1)
        if i:
            (folder / "1.ply").write_bytes(write_ply(points))
        else:
            rows = np.c_[points, np.zeros(len(points))].astype("<f4")
            (folder / "0.bin").write_bytes(rows.tobytes())
        assert frame.pose is not None
        write_pose(folder / f"{i}.pose.txt", frame.pose)
    (folder / "2.ply").write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    return folder


def test_a_folder_of_scans_is_uploaded_and_found(sceneprint, scans, rooms):
    done = sceneprint("upload", "scanned", scans, "--model", "depth", expect=2)
    assert "3 frames: 2 received, 0 already there, 1 refused; 2 indexed" in done.stdout
    assert "walk/2: " in done.stderr
    images = rooms / "room-0" / "seq-01"
    answer = json.loads(sceneprint("query", "scanned", images, "--frame", 0, "--json").stdout)
    assert answer["status"] == "found"
    assert answer["matches"][0]["session"] == "walk"
    assert answer["matches"][0]["transform"]["child_frame"] == "query.optical"
    own = np.loadtxt(scans / "1.pose.txt")
    there = json.loads(sceneprint("localize", "scanned", scans / "1.ply", "--json").stdout)
    assert there["pose"]["child_frame"] == "query.sensor"
    assert np.allclose(there["pose"]["matrix"], own, atol=0.02)
