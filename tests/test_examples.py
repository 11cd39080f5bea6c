"""Tests of the examples."""

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
    told = run_process("robot_loop.py", "--data", tmp_path / "robot")
    room, _, cabinet = told.partition("beside a cabinet that looks the same from behind:")
    assert re.search(
        r"found, [2-9] of \d views vote for one pose, [\d.]+ % sure, decided by matches", room
    )
    assert room.count("not a place of the map (nothing_alike): explore") == 1
    alone, _, believed = cabinet.partition("queried again with a prior from odometry")
    assert alone.count("do not drive: ") == 2
    assert "found" not in alone
    assert "decided by prior" in believed
    errors = [float(one) for one in re.findall(r"position error ([\d.]+) cm", told)]
    assert max(errors) < 10


@pytest.mark.thorough  # tests/client/test_tracker.py carries a robot off as well
def test_a_robot_tracks_itself_and_notices_that_it_was_carried():
    first, _, second = run_process("tracked_drive.py").partition("in room 1\n")
    assert "  tracking: room-0" in first
    before, _, after = second.partition("lost:")
    assert before.count("tracking") <= 4  # 2 s at most
    assert "tracking: room-1" in after
    assert "tracking: room-0" not in after


def run_process(name, *arguments):
    """Run an example as a process and return what it prints."""
    ran = subprocess.run(
        [sys.executable, ROOT / "examples" / name, *arguments],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


# Recordings, and what is made of them: one pair of drives, one data folder.


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded") / "drives"
    said = run_process("record_drives.py", folder, "--frames", "8")
    assert f"{folder}/later: 8 frames in 3.5 s" in said
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
    agree = re.search(r"(strong|weak): (\d+) of (\d+) pairs agree", told)
    assert int(agree[2]) >= 0.9 * int(agree[3]) >= 5
