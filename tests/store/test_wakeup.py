"""Tests of wakeup by FIFOs on SQLite and by NOTIFY on PostgreSQL, whose faults harm no sender."""

import fcntl
import os
import socket
import threading
import time
from contextlib import contextmanager

import pytest
from sqlalchemy import text

from benchmarks.waiting import PATIENCE_S
from sceneprint.store import open_database, wakeup
from sceneprint.store.database import reach_database
from sceneprint.store.wakeup import Notices, Wakeup, process_name

#: Seconds after which nothing rings any more, on the slowest machine.
FOREVER = 60.0
END = text(
    "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = current_database() "
    "AND pid <> pg_backend_pid() AND query LIKE :what"
)


@pytest.fixture
def bells(tmp_path):
    return Wakeup(tmp_path / "bells")


@pytest.fixture
def notices(postgres_url):
    database = open_database(postgres_url)
    opened = Notices(database)
    yield opened
    opened.close()
    database.close()


@pytest.fixture(params=["bells", "notices"])
def ours(request):
    return request.getfixturevalue(request.param)


@contextmanager
def listening(ours):
    with ours.listen() as listener:
        if isinstance(ours, Notices):
            assert listener.wait(FOREVER)  # what was rung before it connected
        yield listener


def fifos(folder):
    return list((folder / "bells").iterdir())


def end(notices, what):
    """End the connections whose last statement was like that; how many there were."""
    with notices._database.read() as connection:
        return len(connection.execute(END, {"what": what}).all())


def test_all_who_wait_are_woken_once(ours):
    with listening(ours) as first, listening(ours) as second:
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
        assert not first.wait(0)


def test_another_descriptor_ends_the_wait_too(ours):
    reader, tell = os.pipe()
    with listening(ours) as listener:
        os.write(tell, b"!")
        assert not listener.wait(FOREVER, -1, reader)
        os.read(reader, 1)
        ours.ring()
        assert listener.wait(FOREVER, reader)
    os.close(reader)
    os.close(tell)


def test_more_rings_than_a_fifo_holds_end_one_wait(bells):
    bells.ring()  # nobody has ever listened
    with bells.listen() as listener:
        assert not listener.wait(0)
        fcntl.fcntl(listener._fifo, fcntl.F_SETPIPE_SZ, 4096)
        for _ in range(5000):
            bells.ring()
        assert listener.wait(FOREVER)
        assert not listener.wait(0)


def test_what_the_dead_left_is_removed_when_it_is_old(bells, tmp_path):
    with bells.listen() as listener:
        (own,) = fifos(tmp_path)
        old, new, file = (tmp_path / "bells" / name for name in ("old", "new", "file"))
        os.mkfifo(old)
        os.mkfifo(new)
        file.write_bytes(b"other")
        ago = time.time() - 2 * wakeup.STALE_S
        for path in (own, old, file):
            os.utime(path, (ago, ago))
        bells.ring()
        assert sorted(fifos(tmp_path)) == sorted([own, new, file])  # somebody reads its own
        assert file.read_bytes() == b"other"
        assert listener.wait(FOREVER)
        assert own.stat().st_mode & 0o777 == 0o600
    assert not own.exists()  # nobody listens


def test_a_listener_shows_that_it_lives_and_mends_its_fifo(bells, tmp_path, monkeypatch):
    monkeypatch.setattr(wakeup, "ALIVE_S", 0.0)
    with bells.listen() as listener:
        (own,) = fifos(tmp_path)
        os.utime(own, (1.0, 1.0))
        listener.wait(0)
        assert own.stat().st_mtime > 1.0
        own.unlink()
        bells.ring()
        assert not listener.wait(0)  # nobody can ring it, and it is made anew
        bells.ring()
        assert listener.wait(FOREVER)


@pytest.mark.parametrize("kind", [Wakeup, Notices])
def test_where_nobody_can_be_woken_nobody_is_harmed(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(wakeup, "AGAIN_S", 0.05)
    (tmp_path / "bells").write_bytes(b"a file")
    away = reach_database("postgresql://nobody@127.0.0.1:1/none")
    ours = kind(tmp_path / "bells" if kind is Wakeup else away)
    with ours.listen() as listener:
        ours.ring()
        assert not listener.wait(1e6)  # it looks again after a moment
    ours.close()
    ours.ring()  # as by a request that ends after the engine
    assert (tmp_path / "bells").read_bytes() == b"a file"


def test_every_process_that_listens_is_known_by_its_name(notices, postgres, postgres_url):
    assert notices.listeners() == []
    with listening(notices) as listener, notices.listen():
        assert notices.listeners() == [process_name()] * 2
        postgres.execute("NOTIFY sceneprint", postgres_url.rpartition("/")[2])
        assert listener.wait(FOREVER)
    assert len(f"{wakeup.LISTENS}{'h' * 44}:4194304") == 63  # of which the server keeps all


def test_connections_that_are_lost_are_made_anew(notices, until):
    with listening(notices) as listener:
        notices.ring()
        assert listener.wait(FOREVER)
        assert end(notices, "LISTEN%") == 1
        assert until(lambda: listener.wait(0.1))  # it may have missed one
        assert end(notices, "NOTIFY%") == 1
        notices.ring()
        assert until(lambda: listener.wait(0.1))


def test_a_server_that_never_answers_holds_up_no_end(monkeypatch):
    monkeypatch.setattr(wakeup, "CLOSING_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        mute = Notices(reach_database(f"postgresql://u@127.0.0.1:{port}/x?connect_timeout=60"))
        mute.ring()
        connection, _ = silent.accept()
        ringer = mute._ringer
        mute.close()
        assert ringer.is_alive()
        connection.close()
    ringer.join(FOREVER)
    assert not ringer.is_alive()
