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
    output = run_process("robot_loop.py", "--data", tmp_path / "robot")
    room, _, cabinet = output.partition("beside a cabinet that looks the same from behind:")
    assert re.search(r"found, [2-9] of \d views vote for one pose, .*, decided by matches", room)
    alone, _, again = cabinet.partition("queried again with a prior from odometry")
    assert (alone.count("do not drive: "), "found" in alone) == (2, False)
    assert "decided by prior" in again
    errors = [float(text) for text in re.findall(r"position error ([\d.]+) cm", output)]
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
        added = [client.upload("office", frame, meta_of(frame, **meta)) for frame in mapping.frames]
        client.wait([frame.job_id for frame in added])
    lines = example(
        "live_from_bag.py", "office", drives / "later", "--truth", drives / "later.tum",
        "--data", tmp_path,
    ).splitlines()  # fmt: skip
    live = [line for line in lines if "tracking  mapping/map <- odom:" in line]
    assert len(live) >= 7
    off = [float(line.rpartition("off by ")[2].removesuffix(" cm")) for line in live]
    assert max(off) < 5


@pytest.mark.thorough
def test_two_recordings_become_one_map(drives, example):
    output = example("join_robots.py", drives / "mapping", drives / "later")
    join = re.search(r"later/odom begins in mapping/map at (\S+) (\S+) (\S+) m", output)
    assert join is not None, output
    # odometry begins where the base does: 10 cm behind the camera and 1.2 m below it
    start = np.loadtxt(drives / "later.tum")[0]
    forward = rotation_of(start[4:])[:2, 2]
    base = start[1:3] - 0.1 * forward / np.linalg.norm(forward)
    assert np.linalg.norm([float(group) for group in join.groups()] - np.array([*base, 0])) < 0.05
    agree = re.search(r"(strong|weak): (\d+) of (\d+) pairs agree", output)
    assert int(agree[2]) >= 0.9 * int(agree[3]) >= 5
