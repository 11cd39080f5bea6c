"""The examples do what they say."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def test_the_robot_maps_a_room_and_finds_itself(tmp_path: Path) -> None:
    ran = subprocess.run(
        [sys.executable, ROOT / "examples" / "robot_loop.py", "--data", tmp_path / "robot"],
        capture_output=True, text=True, check=False, env={**os.environ, "TMPDIR": str(tmp_path)},
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    told = ran.stdout
    assert "driving: 12 frames are uploaded" in told
    room, _, cabinet = told.partition("beside a cabinet that looks the same from behind:")
    assert "  do not drive: " in room
    assert re.search(r"found, [2-9] of \d views vote for one pose, decided by matches", room)
    assert room.count("not a place of the map (nothing_alike): explore") == 1
    # both sides are told of each view, half a turn about the cabinet apart, and none is driven on
    alone, _, believed = cabinet.partition("asked again, and odometry says where it is")
    assert alone.count("do not drive: ") == 2
    assert "found" not in alone
    sides = [complex(*map(float, one)) for one in re.findall(r"x (\S+), y (\S+) m: weight", alone)]
    assert len(sides) == 4
    assert max(abs(sides[i] + sides[i + 1]) for i in (0, 2)) < 0.2
    assert "decided by prior" in believed
    errors = [float(one) for one in re.findall(r"([\d.]+) cm from where it truly is", told)]
    assert len(errors) == 2
    assert errors[0] < 5
    assert errors[1] < 10
    assert "the map has {'indexed': 13} frames of the sessions ['afternoon', 'morning']" in told
    assert (tmp_path / "robot" / "sceneprint.db").is_file()


def test_a_robot_tracks_itself_and_notices_that_it_was_carried() -> None:
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
    off = [int(one) for one in re.findall(r"(\d+) cm from the truth", first + "".join(after))]
    assert len(off) > 8
    assert max(off) < 10


def test_every_example_is_listed() -> None:
    listed = (ROOT / "examples" / "README.md").read_text()
    for path in (ROOT / "examples").glob("*.py"):
        assert f"({path.name})" in listed
