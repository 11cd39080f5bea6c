"""`sceneprint spool`, and the example that keeps frames of an offline robot."""

from __future__ import annotations

import json
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sceneprint_client import Client

ROOT = Path(__file__).resolve().parents[2]


def test_frames_are_spooled_and_uploaded(
    sceneprint: Callable[..., Any], service_url: str, rooms: Path, tmp_path: Path
) -> None:
    spool, bare = tmp_path / "robot.spool", tmp_path / "bare"
    said = sceneprint("spool", "status", spool, expect=2)
    assert "There is no spool here" in said.stderr
    assert not spool.exists()
    added = sceneprint("spool", "add", spool, rooms, "--robot", "cart", "--most-bytes", 10**8)
    assert added.stdout == ("6 frames: 6 added, 0 already there, 0 refused; 6 wait, 0 thinned\n")
    again = sceneprint("spool", "add", spool, rooms / "room-0", "--robot", "cart")
    assert again.stdout == ("3 frames: 0 added, 3 already there, 0 refused; 6 wait, 0 thinned\n")
    bare.mkdir()
    (bare / "clouds.json").write_text("{}")
    (bare / "broken.ply").write_bytes(b"ply\nno cloud")
    sceneprint("spool", "add", spool, bare)
    said = sceneprint("spool", "sync", spool, "spool-nowhere", expect=2)
    assert said.stdout == "0 frames uploaded; 0 refused, 7 wait\n"
    assert "spool-nowhere" in said.stderr
    with Client(service_url) as client:
        client.create_map("spooled", model="depth")
        said = sceneprint("spool", "sync", spool, "spooled", "--priority", 1, expect=2)
        assert said.stdout == "6 frames uploaded; 1 refused, 0 wait\n"
        assert said.stderr.startswith("broken.ply: ")
        found = list(client.frames("spooled"))
    assert len(found) == 6
    assert {one.robot for one in found} == {"cart"}
    assert {one.pose.parent_frame for one in found if one.pose} == {"cart/room-0", "cart/room-1"}
    lines = sceneprint("spool", "status", spool).stdout.splitlines()
    assert lines[0] == "0 frames wait; 0.0 of 100.0 MB"
    assert lines[1] == "6 uploaded, 1 refused, 0 thinned, 0 refused and discarded"
    assert lines[2].startswith("  broken.ply: ")
    told = json.loads(sceneprint("spool", "status", spool, "--json").stdout)
    assert (told["uploaded"], told["oldest"], told["bytes"]) == (6, None, 8192)
    assert told["refusals"][0]["name"] == "broken.ply"
    said = sceneprint("spool", "sync", spool, "spooled", "--retry-refused", expect=2)
    assert said.stdout == "0 frames uploaded; 1 refused, 0 wait\n"


def test_the_example_goes_on_while_it_is_offline(
    service_url: str, rooms: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    def example(url: str) -> list[str]:
        given = [rooms, "offline-example", "--spool", tmp_path / "spool", "--url", url]
        monkeypatch.setattr(sys, "argv", ["offline_robot.py", *map(str, given)])
        capsys.readouterr()
        runpy.run_path(str(ROOT / "examples" / "offline_robot.py"), run_name="__main__")
        return capsys.readouterr().out.splitlines()

    told = example("http://127.0.0.1:9")
    assert told[0].startswith("offline, 6 frames wait: http://127.0.0.1:9 cannot be reached")
    assert told[1] == "0 uploaded, 6 wait, 0 thinned"
    with Client(service_url) as client:
        client.create_map("offline-example", model="depth")
        assert example(service_url) == [
            "uploaded 6, already there 0, refused 0", "6 uploaded, 0 wait, 0 thinned",
        ]  # fmt: skip
        assert example(service_url)[0] == "uploaded 0, already there 6, refused 0"
        assert len(list(client.frames("offline-example"))) == 6
