"""Tests of wakeup by FIFOs, whose faults do not affect the sender."""

import fcntl
import os
import threading
import time

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.store import wakeup
from sceneprint.store.wakeup import Wakeup

#: Seconds after which nothing rings any more, on the slowest machine.
FOREVER = 60.0


def fifos(folder):
    return list((folder / "bells").iterdir())


@pytest.fixture
def ours(tmp_path):
    return Wakeup(tmp_path / "bells")


def test_all_who_wait_are_woken(ours):
    with ours.listen() as first, ours.listen() as second:
        rung = []
        threads = [
            threading.Thread(target=lambda each=each: rung.append(each.wait(FOREVER)), daemon=True)
            for each in (first, second)
        ]
        for thread in threads:
            thread.start()
        ours.ring()
        for thread in threads:
            thread.join(PATIENCE_S)
        assert rung == [True, True]


def test_what_is_rung_before_the_wait_ends_it_once(ours):
    ours.ring()  # nobody has ever listened
    with ours.listen() as listener:
        assert not listener.wait(0)
        fcntl.fcntl(listener._fifo, fcntl.F_SETPIPE_SZ, 4096)
        for _ in range(5000):  # more than it holds
            ours.ring()
        assert listener.wait(FOREVER)
        assert not listener.wait(0)


def test_another_descriptor_ends_the_wait_too(ours):
    told, tell = os.pipe()
    with ours.listen() as listener:
        os.write(tell, b"!")
        assert not listener.wait(FOREVER, -1, told)
    os.close(told)
    os.close(tell)


def test_who_listens_no_more_leaves_nothing(ours, tmp_path):
    with ours.listen():
        (fifo,) = fifos(tmp_path)
        assert fifo.is_fifo()
        assert fifo.stat().st_mode & 0o777 == 0o600
    assert fifos(tmp_path) == []


def test_what_the_dead_left_is_removed_when_it_is_old(ours, tmp_path):
    with ours.listen() as listener:
        (own,) = fifos(tmp_path)
        old, new, file = (tmp_path / "bells" / name for name in ("old", "new", "file"))
        os.mkfifo(old)
        os.mkfifo(new)
        file.write_bytes(b"other")
        ago = time.time() - 2 * wakeup.STALE_S
        for path in (own, old, file):
            os.utime(path, (ago, ago))
        ours.ring()
        assert sorted(fifos(tmp_path)) == sorted([own, new, file])  # somebody reads its own
        assert file.read_bytes() == b"other"
        assert listener.wait(FOREVER)


def test_a_listener_shows_that_it_lives_and_mends_its_fifo(ours, tmp_path, monkeypatch):
    monkeypatch.setattr(wakeup, "ALIVE_S", 0.0)
    with ours.listen() as listener:
        (own,) = fifos(tmp_path)
        os.utime(own, (1.0, 1.0))
        listener.wait(0)
        assert own.stat().st_mtime > 1.0
        own.unlink()
        ours.ring()
        assert not listener.wait(0)  # nobody can ring it, and it is made anew
        ours.ring()
        assert listener.wait(FOREVER)


def test_where_there_can_be_no_bell_nobody_is_harmed(tmp_path):
    (tmp_path / "bells").write_bytes(b"a file")
    ours = Wakeup(tmp_path / "bells")
    with ours.listen() as listener:
        ours.ring()
        looking = threading.Thread(target=listener.wait, args=(1e6,), daemon=True)
        looking.start()
        looking.join(FOREVER)
        assert not looking.is_alive()  # it looks again after a moment
    assert (tmp_path / "bells").read_bytes() == b"a file"
