"""Transactions: what every connection is set to, and what reading and writing promise."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import pytest
from sqlalchemy import Connection, insert, select, update
from sqlalchemy.exc import IntegrityError

from sceneprint.errors import StoreFull
from sceneprint.store import Store
from sceneprint.store.maps import find_map, next_revision
from sceneprint.store.tables import MapRow, events, frames, maps

COUNTS = """
from sceneprint.store import open_database
from sceneprint.store.maps import next_revision

def work(i):
    database = open_database(ARGS[0])
    seen = []
    for _ in range(80):
        with database.write() as connection:
            seen.append(next_revision(connection, int(ARGS[1])))
    return seen
"""


@pytest.mark.sqlite_only("its own settings")
def test_every_connection_of_the_pool_is_configured(store: Store) -> None:
    with ExitStack() as stack:
        held = [stack.enter_context(store.database.read()) for _ in range(12)]
        held.append(stack.enter_context(store.database.write()))
        for connection in held:
            found = {
                name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
                for name in ("journal_mode", "synchronous", "foreign_keys", "busy_timeout")
            }
            assert found == {
                "journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "busy_timeout": 10_000,
            }  # fmt: skip


def test_a_row_that_refers_to_nothing_is_refused(
    store: Store, hall: MapRow, received: Callable[..., Any]
) -> None:
    frame = received("a")
    with pytest.raises(IntegrityError), store.database.write() as connection:
        connection.execute(
            update(frames).where(frames.c.number == frame.number).values(map_number=hall.number + 1)
        )


@pytest.mark.parametrize("kind", [ValueError, KeyboardInterrupt])
def test_a_transaction_that_raises_leaves_nothing(
    store: Store, hall: MapRow, kind: type[BaseException]
) -> None:
    def go_half_way(connection: Connection) -> None:
        assert next_revision(connection, hall.number) == 1
        connection.execute(insert(events).values(at=0.0, kind="x", data={}))
        raise kind("half way")

    with pytest.raises(kind, match="half way"), store.database.write() as connection:
        go_half_way(connection)
    with store.database.write() as connection:  # nor a lock
        assert connection.execute(select(events).where(events.c.kind == "x")).all() == []
        assert next_revision(connection, hall.number) == 1


@pytest.mark.sqlite_only("a file of so many pages")
def test_a_full_disk_is_said_and_leaves_nothing(store: Store, hall: MapRow) -> None:
    def fill(connection: Connection) -> None:
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


def test_a_reader_sees_one_state(store: Store, hall: MapRow) -> None:
    with store.database.read() as reading:
        assert find_map(reading, "hall").revision == 0
        with store.database.write() as writing:
            next_revision(writing, hall.number)
        assert find_map(reading, "hall").revision == 0
    with store.database.read() as reading:
        assert find_map(reading, "hall").revision == 1


def test_a_writer_holds_what_it_has_read(store: Store, hall: MapRow) -> None:
    def count() -> None:
        for _ in range(40):
            with store.database.write() as connection:
                seen = find_map(connection, "hall").revision
                connection.execute(select(events)).all()
                connection.execute(update(maps).values(revision=seen + 1))

    threads = [threading.Thread(target=count) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with store.database.read() as connection:
        assert find_map(connection, "hall").revision == 120


def test_no_revision_is_lost_or_given_twice(
    url: str, store: Store, hall: MapRow, race: Callable[..., list[Any]]
) -> None:
    found = race(COUNTS, 2, url, hall.number)
    assert all(isinstance(each, list) for each in found), found  # else what was raised
    assert all(each == sorted(each) for each in found)
    assert sorted(found[0] + found[1]) == list(range(1, 161))
    with store.database.read() as connection:
        assert find_map(connection, "hall").revision == 160
