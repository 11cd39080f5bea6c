"""Tests of wakeup by NOTIFY on all hosts, and of its failures."""

import os
import socket
import threading

import pytest
from sqlalchemy import text

from sceneprint.store import wakeup
from sceneprint.store.database import reach_database
from sceneprint.store.wakeup import Notices, process_name

#: Seconds after which nothing rings any more, on the slowest machine.
FOREVER = 60.0
END = text(
    "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = current_database() "
    "AND pid <> pg_backend_pid() AND query LIKE :what"
)


@pytest.fixture
def ours(server_store):
    opened = Notices(server_store.database)
    yield opened
    opened.close()


def end(database, what):
    """End the connections whose last statement was like that; how many there were."""
    with database.read() as connection:
        return len(connection.execute(END, {"what": what}).all())


def test_who_waits_is_woken_by_another_process_and_by_nothing_else(ours, postgres, postgres_url):
    told, tell = os.pipe()
    with ours.listen() as listener:
        assert listener.wait(FOREVER)  # what was rung before it connected
        assert not listener.wait(0)
        os.write(tell, b"!")
        assert not listener.wait(FOREVER, -1, told)
        os.read(told, 1)
        postgres.execute("NOTIFY sceneprint", postgres_url.rpartition("/")[2])
        assert listener.wait(FOREVER, told)
        ours.ring()
        assert listener.wait(FOREVER, told)
    os.close(told)
    os.close(tell)


def test_a_crowd_of_rings_is_one_connection_and_few_notices(ours, server_store):
    with ours.listen() as first, ours.listen() as second:
        for listener in (first, second):
            assert listener.wait(FOREVER)
        for _ in range(2000):
            ours.ring()
        for listener in (first, second):
            assert listener.wait(FOREVER)
        assert threading.active_count() < 20
        with server_store.database.read() as connection:
            asked = (
                "SELECT count(*) FROM pg_stat_activity WHERE query LIKE 'NOTIFY%' "
                "AND datname = current_database()"
            )
            assert connection.execute(text(asked)).scalar_one() == 1


def test_every_process_that_listens_is_known_by_its_name(ours):
    assert ours.listeners() == []
    with ours.listen(), ours.listen():
        assert ours.listeners() == [process_name()] * 2
    assert len(f"{wakeup.LISTENS}{'h' * 44}:4194304") == 63  # of which the server keeps all


def test_the_name_of_a_host_is_cut_at_its_beginning(monkeypatch):
    monkeypatch.setattr("socket.gethostname", lambda: "a" * 20 + "b" * 44)
    assert process_name() == f"{'b' * 44}:{os.getpid()}"


def test_connections_that_are_lost_are_made_anew(ours, server_store, until):
    with ours.listen() as listener:
        assert listener.wait(FOREVER)
        ours.ring()
        assert listener.wait(FOREVER)
        assert end(server_store.database, "LISTEN%") == 1
        assert until(lambda: listener.wait(0.1))  # it may have missed one
        assert end(server_store.database, "NOTIFY%") == 1
        ours.ring()
        assert until(lambda: listener.wait(0.1))


def test_where_the_server_is_away_nobody_is_harmed(postgres, monkeypatch):
    monkeypatch.setattr(wakeup, "AGAIN_S", 0.05)
    away = Notices(reach_database("postgresql://nobody@127.0.0.1:1/none"))
    with away.listen() as listener:
        for _ in range(3):
            away.ring()
            assert not listener.wait(1e6)  # it looks again after a moment
    away.close()
    away.close()
    away.ring()  # as by a request that ends after the engine
    assert away._ringer is None


def test_a_server_that_never_answers_holds_up_no_end(monkeypatch):
    monkeypatch.setattr(wakeup, "CLOSING_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        mute = Notices(reach_database(f"postgresql://u@127.0.0.1:{port}/x?connect_timeout=60"))
        mute.ring()
        asked, _ = silent.accept()
        ringer = mute._ringer
        mute.close()
        assert ringer.is_alive()
        asked.close()
    ringer.join(FOREVER)
    assert not ringer.is_alive()
