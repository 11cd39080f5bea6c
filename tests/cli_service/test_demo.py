"""Tests of `sceneprint demo`, which removes its data however it ends."""

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.cli.options import ended_by_signals
from sceneprint.errors import DatasetError
from sceneprint.formats.dataset import Camera, write_intrinsics
from sceneprint.types import Intrinsics
from sceneprint_lab.cli.demo import choose_frames


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
    mark = f"TMPDIR={temporary}".encode()
    return [p for p in Path("/proc").glob("[0-9]*") if mark in environment_of(p)]


def leaves_nothing(temporary):
    deadline = time.monotonic() + PATIENCE_S  # a resource tracker ends after its parent
    while (left := processes_with(temporary)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert left == []
    assert list(temporary.iterdir()) == []


def test_demo_goes_the_whole_way_and_leaves_nothing(
    run_command, tmp_path, whole_rooms, monkeypatch
):
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    monkeypatch.setattr(tempfile, "tempdir", None)  # so that TMPDIR is read again
    arguments = ("--dataset", whole_rooms, "--workers", 1, "--out", tmp_path / "out")
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
def test_demo_that_is_stopped_leaves_nothing(demo, tmp_path, whole_rooms):
    process = demo("--dataset", whole_rooms)
    assert process.stdout.readline().startswith("service: ")
    process.send_signal(signal.SIGTERM)
    process.send_signal(signal.SIGTERM)  # as `make` does: it passes on what the terminal has sent
    _, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, err) == (130, "sceneprint demo: stopped\n")
    leaves_nothing(tmp_path / "tmp")


def test_signals_that_are_ignored_stay_so_and_others_are_given_back():
    before = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)]
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


# Selection of frames.


def sequence(folder, frames):
    folder.mkdir(parents=True)
    for i in range(frames):
        (folder / f"frame-{i:06d}.depth.png").write_bytes(b"never read")


def test_split_files_decide_where_they_are(tmp_path):
    scene = tmp_path / "scene"
    scene.mkdir()
    write_intrinsics(scene, Camera(Intrinsics(2, 2, 1.0, 1.0, 0.0, 0.0)))
    sequence(scene / "seq-01", 3)
    sequence(scene / "seq-02", 2)
    (scene / "TrainSplit.txt").write_text("sequence2\n")
    (scene / "TestSplit.txt").write_text("sequence1\n")
    choice = choose_frames(scene)
    assert {one.session for one in choice.database} == {"seq-02"}
    assert (len(choice.database), len(choice.queries)) == (2, 3)
    (scene / "TestSplit.txt").unlink()
    with pytest.raises(DatasetError, match=r"\(found: 2\) .* \(found: 0\)"):
        choose_frames(scene)
