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
    assert "it could be several places: drive a metre" in told
    assert "found, " in told
    [error] = re.findall(r"([\d.]+) cm from where it truly is", told)
    assert float(error) < 5
    assert told.count("not a place of the map: explore") == 1
    assert "the map has {'indexed': 13} frames of the sessions ['afternoon', 'morning']" in told
    assert (tmp_path / "robot" / "sceneprint.db").is_file()


def test_every_example_is_listed() -> None:
    listed = (ROOT / "examples" / "README.md").read_text()
    for path in (ROOT / "examples").glob("*.py"):
        assert f"({path.name})" in listed
