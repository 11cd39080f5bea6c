"""Tests of the examples."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sceneprint.formats.dataset import find_sequences
from sceneprint_client import Client
from sceneprint_client.frame_files import meta_of
from sceneprint_client.poses import rotation_of

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.thorough  # tests/cli_service and tests/engine/test_equal_rooms.py ask all of it
def test_the_robot_maps_a_room_and_finds_itself(tmp_path):
    ran = subprocess.run(
        [sys.executable, ROOT / "examples" / "robot_loop.py", "--data", tmp_path / "robot"],
        capture_output=True, text=True, check=False, env={**os.environ, "TMPDIR": str(tmp_path)},
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    told = ran.stdout
    assert "driving: uploading 12 frames" in told
    room, _, cabinet = told.partition("beside a cabinet that looks the same from behind:")
    assert "  do not drive: " in room
    assert re.search(
        r"found, [2-9] of \d views vote for one pose, [\d.]+ % sure, decided by matches", room
    )
    assert room.count("not a place of the map (nothing_alike): explore") == 1
    # both sides are told of each view, half a turn about the cabinet apart, and none is driven on
    alone, _, believed = cabinet.partition("queried again with a prior from odometry")
    assert alone.count("do not drive: ") == 2
    assert "found" not in alone
    sides = [complex(*map(float, one)) for one in re.findall(r"x (\S+), y (\S+) m, support", alone)]
    assert len(sides) == 4
    assert max(abs(sides[i] + sides[i + 1]) for i in (0, 2)) < 0.2
    assert "decided by prior" in believed
    errors = [float(one) for one in re.findall(r"position error ([\d.]+) cm", told)]
    assert len(errors) == 2
    assert errors[0] < 5
    assert errors[1] < 10
    assert "the map has {'indexed': 13} frames of the sessions ['afternoon', 'morning']" in told
    assert (tmp_path / "robot" / "sceneprint.db").is_file()


@pytest.mark.thorough  # tests/client/test_tracker.py carries a robot off as well
def test_a_robot_tracks_itself_and_notices_that_it_was_carried():
    ran = subprocess.run(
        [sys.executable, ROOT / "examples" / "tracked_drive.py"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    first, _, second = ran.stdout.partition("in room 1\n")
    assert "  tracking: room-0" in first
    statuses = [line.split(":")[0].strip() for line in second.splitlines()]
    assert statuses[0] == "tracking"  # one answer never moves it
    lost = statuses.index("lost")
    assert lost <= 4  # 2 s at most
    after = second.splitlines()[lost + 1 :]
    assert all(line.startswith("  tracking: room-1") for line in after)
    off = [int(one) for one in re.findall(r"error (\d+) cm", first + "".join(after))]
    assert len(off) > 8
    assert max(off) < 10


def test_every_example_is_listed():
    listed = (ROOT / "examples" / "README.md").read_text()
    for path in (ROOT / "examples").glob("*.py"):
        assert f"({path.name})" in listed


# Recordings, and what is made of them: one pair of drives, one data folder.


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded") / "drives"
    ran = subprocess.run(
        [sys.executable, ROOT / "examples" / "record_drives.py", folder, "--frames", "8"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    assert f"{folder}/later: 8 frames in 3.5 s" in ran.stdout
    return folder


@pytest.fixture
def example(capsys, monkeypatch):
    """Runs an example as a command, in this process, which has compiled code loaded already."""

    def run(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        capsys.readouterr()
        runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")
        return capsys.readouterr().out

    return run


@pytest.mark.thorough
def test_a_bag_becomes_live_poses(drives, tmp_path, example):
    (mapping,) = find_sequences(drives / "mapping")
    with Client.embedded(tmp_path) as client:
        client.create_map("office")
        meta = {"parent_frame": mapping.parent_frame}
        added = [client.upload("office", one, meta_of(one, **meta)) for one in mapping.frames]
        client.wait([one.job_id for one in added])
    told = example(
        "live_from_bag.py", "office", drives / "later", "--truth", drives / "later.tum",
        "--data", tmp_path,
    ).splitlines()  # fmt: skip
    assert told[0].startswith("8 of 8 frames of /camera/depth/image_raw taken, poses of 8 of 8")
    live = [line for line in told if "tracking  mapping/map <- odom:" in line]
    assert len(live) >= 7
    off = [float(line.rpartition("off by ")[2].removesuffix(" cm")) for line in live]
    assert max(off) < 5
    assert told[-2].startswith(f"tracking on {len(live)} of 8 frames, first fix after ")
    assert told[-1].endswith(f"at most {max(off)}")


@pytest.mark.thorough
def test_two_recordings_become_one_map(drives, example):
    told = example("join_robots.py", drives / "mapping", drives / "later")
    found = re.search(r"later/odom begins in mapping/map at (\S+) (\S+) (\S+) m", told)
    assert found is not None, told
    # odometry begins where the base does: 10 cm behind the camera and 1.2 m below it
    start = np.loadtxt(drives / "later.tum")[0]
    forward = rotation_of(start[4:])[:2, 2]
    base = start[1:3] - 0.1 * forward / np.linalg.norm(forward)
    assert np.linalg.norm([float(one) for one in found.groups()] - np.array([*base, 0])) < 0.05
    turn = re.search(r"turned by (\S+) deg, tilted by (\S+) deg", told)
    yaw = np.degrees(np.arctan2(forward[1], forward[0]))
    assert abs((float(turn[1]) - yaw + 180) % 360 - 180) < 1.5
    assert float(turn[2]) < 1.5
    agree = re.search(r"(strong|weak): (\d+) of (\d+) pairs agree", told)
    assert int(agree[2]) >= 0.9 * int(agree[3]) >= 5
