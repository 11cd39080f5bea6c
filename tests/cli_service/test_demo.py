"""Tests of `sceneprint demo`, which removes its data however it ends."""

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from benchmarks.waiting import PATIENCE_S
from sceneprint.cli.options import ended_by_signals
from sceneprint.errors import ServiceError, Unreachable
from sceneprint.formats.dataset import read_pose, write_pose
from sceneprint_client import Client
from sceneprint_client.api import JobState
from sceneprint_lab.cli import demo as served
from sceneprint_lab.cli.demo import choose_frames, fill, serving
from tests.cli_service.conftest import write_rooms


@pytest.fixture(scope="module")
def rooms(room_views, tmp_path_factory):
    """The rooms with all samples: their third frames have no accepted match."""
    frames = [frame for i in range(2) for frame in room_views(21, i, 3).frames]
    return write_rooms(tmp_path_factory.mktemp("whole"), frames)


@pytest.fixture
def demo(tmp_path):
    """Starts the demo with a temporary folder of its own, its signals as a terminal leaves them."""
    (tmp_path / "tmp").mkdir()
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # these tests may run under `nohup`

    def start(*arguments):
        return subprocess.Popen(
            [sys.executable, "-m", "sceneprint", "demo", "--workers", "1",
             "--out", str(tmp_path / "out"), *map(str, arguments)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env={**os.environ, "TMPDIR": str(tmp_path / "tmp"), "PYTHONUNBUFFERED": "1"},
        )  # fmt: skip

    yield start
    signal.signal(signal.SIGHUP, before)


def environment_of(process):
    try:
        return (process / "environ").read_bytes()
    except OSError:  # gone, or another user's
        return b""


def processes_with(temporary):
    """Processes that were started with that temporary folder."""
    mark = f"TMPDIR={temporary}".encode()
    return [p for p in Path("/proc").glob("[0-9]*") if mark in environment_of(p)]


def leaves_nothing(temporary):
    deadline = time.monotonic() + PATIENCE_S  # a resource tracker ends after its parent
    while (left := processes_with(temporary)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert left == []
    assert list(temporary.iterdir()) == []


def test_demo_goes_the_whole_way_and_leaves_nothing(run_command, tmp_path, rooms, monkeypatch):
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    monkeypatch.setattr(tempfile, "tempdir", None)  # so that TMPDIR is read again
    arguments = ("--dataset", rooms, "--workers", 1, "--out", tmp_path / "out")
    out = run_command("demo", *arguments).stdout
    service, uploaded, sent, queries, head, *lines = out.splitlines()
    assert re.match(r"service: http://127\.0\.0\.1:\d+, empty data folder, 1 worker", service)
    assert uploaded.startswith("map: 4 of 4 frames uploaded, signed and indexed in ")
    assert re.fullmatch(r"sent: 4 queries over HTTP in \d+\.\d s", sent)
    assert queries.startswith("queries: 2: ")
    assert re.fullmatch(r"whole demo: \d+\.\d s", lines[-2])
    assert head.split()[:4] == ["first", "answer", "within", "5cm/5deg"]
    assert [line.split()[0] for line in lines[:5]] == ["R", "VR", "DR", "VDR", "pose"]
    assert lines[-1].startswith("next: `sceneprint serve`")
    assert lines[-3] == "no picture: no match was accepted"  # these frames hardly overlap
    leaves_nothing(tmp_path / "tmp")


@pytest.mark.thorough
def test_demo_draws_a_match_of_its_building(demo, tmp_path):
    process = demo("--rooms", 1)
    out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, err
    assert f"picture: {tmp_path / 'out' / 'overlay.png'}" in out.splitlines()
    with Image.open(tmp_path / "out" / "overlay.png") as picture:
        assert (picture.format, picture.width) == ("PNG", 992)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("stage", "number"),
    [
        pytest.param("building", signal.SIGHUP, marks=pytest.mark.thorough),
        ("serving", signal.SIGTERM),
    ],
)
def test_demo_that_is_stopped_leaves_nothing(demo, tmp_path, rooms, stage, number):
    temporary = tmp_path / "tmp"
    process = demo(*(("--dataset", rooms) if stage == "serving" else ("--rooms", 2)))
    if stage == "serving":
        assert process.stdout.readline().startswith("service: ")
    else:
        deadline = time.monotonic() + PATIENCE_S
        while not any(temporary.glob("sceneprint-demo-*/building/*")):
            assert time.monotonic() < deadline, "no building is begun"
            time.sleep(0.01)
    process.send_signal(number)
    process.send_signal(number)  # as `make` does: it passes on what the terminal has sent before
    _, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, err) == (130, "sceneprint demo: stopped\n")
    leaves_nothing(temporary)


def test_demo_needs_frames_for_the_map_and_to_look_up(run_command, rooms):
    one = rooms / "room-0/seq-01/frame-000000.depth.png"
    err = run_command("demo", "--dataset", one, expect=2).stderr
    assert len(err.splitlines()) == 1
    assert "(found: 1)" in err
    assert "(found: 0)" in err


@pytest.fixture
def twice(rooms, tmp_path):
    """A sequence whose first depth frame comes twice, with two poses; 5 frames, 3 of the map."""
    folder = tmp_path / "twice"
    shutil.copytree(rooms / "room-0" / "seq-01", folder)
    for ours, of in ((1, 0), (3, 1), (4, 2)):
        for end in ("depth.png", "pose.txt"):
            source = rooms / "room-0" / "seq-01" / f"frame-{of:06d}.{end}"
            shutil.copy(source, folder / f"frame-{ours:06d}.{end}")
    pose = read_pose(folder / "frame-000000.pose.txt")
    pose[0, 3] += 1.0
    write_pose(folder / "frame-000001.pose.txt", np.asarray(pose))
    return folder


def test_what_comes_twice_is_left_out_once(twice, tmp_path, capsys):
    choice = choose_frames(twice)
    assert len(choice.database) == 3
    with Client.embedded(tmp_path / "data") as client:
        known = fill(client, "depth", choice)
    assert len(known) == 2
    said = capsys.readouterr()
    assert re.search(r"skipped: .*frame-00000[01]: Frame \w+ has the same content", said.out)
    assert "map: 2 of 3 frames uploaded" in said.out


def test_frames_that_are_not_signed_in_time_end_it(rooms, tmp_path, monkeypatch):
    waited = [SimpleNamespace(state=one) for one in (JobState.SUCCEEDED, JobState.RUNNING)]
    monkeypatch.setattr(Client, "wait", lambda *_, **__: waited)
    with (
        Client.embedded(tmp_path) as client,
        pytest.raises(ServiceError, match="1 of 2 map frames"),
    ):
        fill(client, "depth", choose_frames(rooms))


def test_signals_that_are_ignored_stay_so_and_others_are_given_back():
    before = [signal.getsignal(one) for one in (signal.SIGTERM, signal.SIGHUP)]
    try:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as `nohup` does
        with ended_by_signals():
            signal.raise_signal(signal.SIGHUP)
        with pytest.raises(KeyboardInterrupt), ended_by_signals():
            signal.raise_signal(signal.SIGTERM)
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        for number, handler in zip((signal.SIGTERM, signal.SIGHUP), before, strict=True):
            signal.signal(number, handler)


def test_a_service_that_says_nothing_is_not_waited_for(tmp_path, monkeypatch):
    """In place of Python, something that never says that it serves, nor ends."""
    silent = tmp_path / "silent"
    silent.write_text(f"#!/bin/sh\necho $$ >{tmp_path}/pid\nprintf 'sceneprint: '\nexec sleep 99\n")
    silent.chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(silent))
    monkeypatch.setattr(served, "START_S", 0.5)
    with pytest.raises(Unreachable, match=r"did not start within 0\.5 s"), serving(tmp_path, 1):
        pass
    assert not Path("/proc", (tmp_path / "pid").read_text().strip()).exists()
