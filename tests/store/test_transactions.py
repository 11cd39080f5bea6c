"""Tests of connection settings, and of the guarantees of transactions."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import pytest
from sqlalchemy import insert, select, update

from sceneprint.errors import StoreFull
from sceneprint.store.maps import find_map, next_revision
from sceneprint.store.tables import events, maps

#: One process writes in four threads without a pause; the other counts the commits of the first
#: that it has to wait for.
LINE = """
import threading
from pathlib import Path
from sceneprint.store import open_database
from sceneprint.store.maps import next_revision

def work(i):
    database, number, over = open_database(ARGS[0]), int(ARGS[1]), Path(ARGS[2])
    def revise():
        with database.write() as connection:
            return [next_revision(connection, number) for _ in range(10)][0]
    def go_on():
        while not over.exists():
            revise()
    if i == 0:
        threads = [threading.Thread(target=go_on) for _ in range(4)]
        [one.start() for one in threads]
        [one.join() for one in threads]
        return []
    while revise() < 200:  # the other has begun
        pass
    last, waited = revise(), []
    for _ in range(30):
        found = revise()
        waited.append((found - last) // 10 - 1)
        last = found
    over.touch()
    return waited
"""


@pytest.mark.sqlite_only("its own settings")
def test_every_connection_of_the_pool_is_configured(store):
    with ExitStack() as stack:
        held = [stack.enter_context(store.database.read()) for _ in range(12)]
        held.append(stack.enter_context(store.database.write()))
        for connection in held:
            result = {
                name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
                for name in ("journal_mode", "synchronous", "foreign_keys", "busy_timeout")
            }
            assert result == {
                "journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "busy_timeout": 10_000,
            }  # fmt: skip


@pytest.mark.parametrize("kind", [ValueError, KeyboardInterrupt])
def test_a_transaction_that_raises_leaves_nothing(store, hall, kind):
    def go_half_way(connection):
        assert next_revision(connection, hall.number) == 1
        connection.execute(insert(events).values(at=0.0, kind="x", data={}))
        raise kind("half way")

    with pytest.raises(kind, match="half way"), store.database.write() as connection:
        go_half_way(connection)
    with store.database.write() as connection:  # nor a lock
        assert connection.execute(select(events).where(events.c.kind == "x")).all() == []
        assert next_revision(connection, hall.number) == 1


@pytest.mark.sqlite_only("a file of so many pages")
def test_a_full_disk_is_said_and_leaves_nothing(store, hall):
    def fill(connection):
        next_revision(connection, hall.number)
        pages = connection.exec_driver_sql("PRAGMA page_count").scalar_one()
        connection.exec_driver_sql(f"PRAGMA max_page_count = {pages + 2}")
        for _ in range(9):
            connection.execute(insert(events).values(at=0.0, kind="x", data={"a": "b" * 4000}))

    full = pytest.raises(StoreFull, match=r"disk is full.*Free some space")
    with full, store.database.write() as connection:
        fill(connection)
    with store.database.read() as connection:
        assert find_map(connection, "hall").revision == 0


def test_a_reader_sees_one_state(store, hall):
    with store.database.read() as reading:
        assert find_map(reading, "hall").revision == 0
        with store.database.write() as writing:
            next_revision(writing, hall.number)
        assert find_map(reading, "hall").revision == 0
    with store.database.read() as reading:
        assert find_map(reading, "hall").revision == 1


def test_a_writer_holds_what_it_has_read(store, hall):
    def count():
        for _ in range(40):
            with store.database.write() as connection:
                seen = find_map(connection, "hall").revision
                connection.execute(select(events)).all()
                connection.execute(update(maps).values(revision=seen + 1))

    with ThreadPoolExecutor(3) as pool:
        for future in [pool.submit(count) for _ in range(3)]:
            future.result()
    with store.database.read() as connection:
        assert find_map(connection, "hall").revision == 120


@pytest.mark.sqlite_only("a server has locks of its own")
def test_a_process_that_writes_without_a_pause_keeps_no_other_waiting(url, hall, race, tmp_path):
    _, waited = race(LINE, 2, url, hall.number, tmp_path / "over")
    assert len(waited) == 30
    assert max(waited) <= 2, waited
