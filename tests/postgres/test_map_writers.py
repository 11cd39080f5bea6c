"""Tests of writers of single maps: their locks, and the numbers of their events."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import pytest
from sqlalchemy import select

from sceneprint.engine.admin.operations import next_events
from sceneprint.engine.ingest.write_groups import Grouping
from sceneprint.errors import IdempotencyConflict, StoreLocked
from sceneprint.store import open_store
from sceneprint.store.events import (
    EventFilter,
    anchor_number,
    anchor_of_now,
    holds_anchor,
    list_events,
    number_events,
    record_event,
)
from sceneprint.store.keys import IdempotentRequest, Overtaken
from sceneprint.store.postgres.connection import EVENTS, LOCKS
from sceneprint.store.tables import pending_events

MAPS = 3


def events_of(store):
    return next_events(store.database, EventFilter(), 0, 10_000).events


@pytest.mark.parametrize(
    ("held", "wanted", "waits"), [(0, 1, False), (0, 0, True), (0, None, True), (None, 0, True)]
)
def test_writers_of_different_maps_do_not_wait_for_each_other(
    server_store, rows, postgres_url, tmp_path, until, waiting, held, wanted, waits
):
    numbers = {None: None, **{i: row.number for i, row in enumerate(rows)}}

    def write():  # as another process
        with (
            closing(open_store(postgres_url, tmp_path / "other")) as other,
            other.database.write(map_number=numbers[wanted]) as connection,
        ):
            record_event(connection, "other", None)

    with ThreadPoolExecutor(1) as pool, server_store.database.write(map_number=numbers[held]):
        writer = pool.submit(write)
        until((lambda: waiting(server_store) == 1) if waits else writer.done)
        assert writer.done() is not waits
    writer.result()


def test_what_cannot_be_numbered_now_comes_later_and_marks_no_state(
    server_store, rows, monkeypatch
):
    database, name = server_store.database, rows[0].name
    monkeypatch.setattr("sceneprint.store.events.NUMBERING_S", 0.05)
    with database.write(map_number=rows[0].number) as connection:
        record_event(connection, "late", name)
    with database._engine.begin() as other:  # as a long transaction that told something
        other.exec_driver_sql(f"SELECT pg_advisory_xact_lock({LOCKS}, {EVENTS})")
        assert [event.kind for event in events_of(server_store)] == ["map.created"] * MAPS
        with pytest.raises(StoreLocked):
            anchor_of_now(database, name)
    assert [event.kind for event in events_of(server_store)][MAPS:] == ["late"]


def test_an_anchor_marks_what_was_pending(server_store, rows):
    database, (row, *_) = server_store.database, rows
    with database.write(map_number=row.number) as connection:
        record_event(connection, "frame.indexed", row.name, "a")
    anchor = anchor_of_now(database, row.name)
    with database.read() as connection:
        assert holds_anchor(connection, anchor)
        assert anchor_number(anchor) == events_of(server_store)[-1].number == MAPS + 1
        assert anchor_of_now(database, rows[1].name) != anchor


def test_of_two_requests_with_one_key_for_two_maps_only_the_first_takes_effect(server_store, rows):
    """Neither saw the other when it looked; the second finds out when it is stored."""
    database, tries = server_store.database, list[int]()
    first, second = (IdempotentRequest("robot", "key", mark * 64) for mark in "ab")

    def keep_second(connection):
        tries.append(1)
        assert second.stored_result(connection) is None
        Grouping(database, rows[0].number).run(lambda one: first.store(one, {"of": "first"}))
        record_event(connection, "second", rows[1].name)
        second.store(connection, {"of": "second"})

    writes = Grouping(database, rows[1].number)
    with pytest.raises(Overtaken):
        writes.run(keep_second)
    with pytest.raises(IdempotencyConflict):  # as uploads do then
        writes.run(keep_second)
    assert len(tries) == 2
    assert "second" not in [event.kind for event in events_of(server_store)]
    with database.read() as connection:
        assert first.stored_result(connection) == {"of": "first"}


def test_nothing_is_pending_where_nobody_reads_once_somebody_numbers(server_store, rows):
    for row in rows:
        with server_store.database.write(map_number=row.number) as connection:
            record_event(connection, "x", row.name)
    number_events(server_store.database)
    with server_store.database.read() as connection:
        assert connection.execute(select(pending_events)).all() == []
        assert [event.map for event in list_events(connection, EventFilter(kinds=("x",)))] == [
            row.name for row in rows
        ]
