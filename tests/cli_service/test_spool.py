"""Tests of `sceneprint spool`, and of the example of an offline robot."""

import json
import runpy
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import pytest

from sceneprint_client import Client

ROOT = Path(__file__).resolve().parents[2]


def test_what_was_not_tried_is_not_told_to_be_there(sceneprint, rooms, tmp_path):
    path = tmp_path / "robot.spool"
    sceneprint("spool", path, rooms / "room-0", "--every", 3)
    with closing(sqlite3.connect(path)) as database:  # as a disk that is full after two more
        database.execute(
            "CREATE TRIGGER stop BEFORE INSERT ON frames "
            "WHEN (SELECT count(*) FROM frames) = 3 BEGIN SELECT RAISE(ABORT, 'full'); END"
        )
    said = sceneprint("spool", path, rooms, expect=2)
    counts = "6 frames: 2 added, 1 already there, 0 refused, 3 not added"
    assert said.stdout == f"{counts}; 3 wait, 0 thinned\n"
    assert "The disk has no room for the spool" in said.stderr


def test_frames_are_spooled_and_uploaded(sceneprint, service_url, rooms, tmp_path):
    spool, bare = tmp_path / "robot.spool", tmp_path / "bare"
    assert "there is no spool here" in sceneprint("spool", spool, expect=2).stderr
    assert not spool.exists()
    added = sceneprint("spool", spool, rooms, "--robot", "cart", "--most-bytes", 10**8)
    assert added.stdout == "6 frames: 6 added, 0 already there, 0 refused; 6 wait, 0 thinned\n"
    bare.mkdir()
    (bare / "clouds.json").write_text("{}")
    (bare / "broken.ply").write_bytes(b"ply\nno cloud")
    sceneprint("spool", spool, bare)
    said = sceneprint("spool", spool, "--to", "spool-nowhere", expect=2)
    assert said.stdout == "0 frames uploaded; 0 refused, 7 wait\n"
    with Client(service_url) as client:
        client.create_map("spooled", model="depth")
        said = sceneprint("spool", spool, "--to", "spooled", "--priority", 1, expect=2)
        counts, summary = said.stdout.splitlines()
        assert counts == "6 frames uploaded; 1 refused, 0 wait"
        assert summary.startswith("poses of 6 of 7 frames; depth ")
        assert said.stderr.startswith("broken.ply: ")
        frames = list(client.frames("spooled"))
    assert [frame.robot for frame in frames] == ["cart"] * 6
    assert {f.pose.parent_frame for f in frames if f.pose} == {"cart/room-0", "cart/room-1"}
    lines = sceneprint("spool", spool).stdout.splitlines()
    assert lines[0] == "0 frames wait; 0.0 of 100.0 MB"
    assert lines[1] == "6 uploaded, 1 refused, 0 thinned, 0 refused and discarded"
    assert lines[2].startswith("  broken.ply: ")
    report = json.loads(sceneprint("spool", spool, "--json").stdout)
    assert (report["uploaded"], report["refusals"][0]["name"]) == (6, "broken.ply")
    said = sceneprint("spool", spool, "--to", "spooled", "--retry-refused", expect=2)
    assert said.stdout.startswith("0 frames uploaded; 1 refused, 0 wait\nposes of 0 of 1 frames")


@pytest.fixture
def example(rooms, tmp_path, monkeypatch, capsys):
    def run(url, *more):
        arguments = [rooms, "offline-example", "--spool", tmp_path / "spool", "--url", url, *more]
        monkeypatch.setattr(sys, "argv", ["offline_robot.py", *map(str, arguments)])
        capsys.readouterr()
        runpy.run_path(str(ROOT / "examples" / "offline_robot.py"), run_name="__main__")
        return capsys.readouterr().out.splitlines()

    return run


def test_the_example_goes_on_while_it_is_offline(service_url, example):
    lines = example("http://127.0.0.1:9")
    assert lines[0].startswith("offline, 6 frames wait: http://127.0.0.1:9 cannot be reached")
    assert lines[1] == "0 uploaded, 6 wait, 0 thinned"
    with Client(service_url) as client:
        client.create_map("offline-example", model="depth")
        assert example(service_url) == [
            "uploaded 6, already there 0, refused 0", "6 uploaded, 0 wait, 0 thinned",
        ]  # fmt: skip
        assert example(service_url)[0] == "uploaded 0, already there 6, refused 0"
        assert len(list(client.frames("offline-example"))) == 6
