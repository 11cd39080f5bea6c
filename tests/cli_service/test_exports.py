"""Tests of uploads of files from other systems on the command line."""

import sqlite3
import struct
from contextlib import closing

import numpy as np
import pytest

from sceneprint.formats.depth_file import encode_png
from sceneprint_client import Client

#: Optical axes to the base of a robot, 0.3 m above the floor.
LOCAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0.3], [0, 0, 0, 1]])


@pytest.fixture(scope="module")
def database(room_frames, tmp_path_factory):
    """Three views of a room as RTAB-Map 0.21 stores them, without optimised poses."""
    path = tmp_path_factory.mktemp("rtabmap") / "flat.db"
    with closing(sqlite3.connect(path)) as opened, opened:
        opened.executescript(
            "CREATE TABLE Node (id INTEGER PRIMARY KEY, map_id INTEGER, stamp FLOAT, pose BLOB);"
            "CREATE TABLE Data (id INTEGER PRIMARY KEY, image BLOB, depth BLOB, calibration BLOB);"
            "CREATE TABLE Link (from_id INTEGER, to_id INTEGER);"
            "CREATE TABLE Admin (version TEXT); INSERT INTO Admin VALUES ('0.21.4');"
        )
        for number, frame in enumerate(room_frames[:3], start=1):
            lens, pose = frame.intrinsics, frame.pose
            K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
            head = struct.pack("<11i", 0, 21, 4, 0, lens.width, lens.height, 9, 0, 0, 0, 12)
            calibration = head + K.tobytes() + LOCAL[:3].astype("<f4").tobytes()
            depth = encode_png(np.rint(frame.depth * 1000).astype(np.uint16))
            base = (pose @ np.linalg.inv(LOCAL))[:3].astype("<f4").tobytes()
            opened.execute("INSERT INTO Node VALUES (?, 0, 1.7e9, ?)", (number, base))
            opened.execute("INSERT INTO Data VALUES (?, NULL, ?, ?)", (number, depth, calibration))
    return path


def test_a_database_of_rtabmap_is_uploaded_with_its_poses(
    sceneprint, service_url, database, room_frames
):
    done = sceneprint("upload", "flat", database, "--model", "depth")
    assert done.stdout.splitlines()[1].startswith("3 frames: 3 received, 0 already there; 3 inde")
    assert "flat.db: 3 frames taken, odometry poses" in done.stderr
    with Client(service_url) as client:
        frames = sorted(client.frames("flat"), key=lambda one: one.sequence or 0)
        client.delete_map("flat")
    assert [one.sequence for one in frames] == [1, 2, 3]
    assert {one.session for one in frames} == {"flat"}
    for one, frame in zip(frames, room_frames, strict=False):
        assert one.pose.parent_frame == "flat"
        at = one.pose.translation
        assert (at.x, at.y, at.z) == pytest.approx(frame.pose[:3, 3], abs=1e-5)
    assert {one.base_frame for one in frames} == {"base_link"}
