"""Tests of writers of single maps: their locks, and the numbers of their events."""

import threading
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from random import Random

import pytest
from sqlalchemy import insert, select, text

from benchmarks.waiting import PATIENCE_S
from sceneprint.engine.admin.operations import next_events
from sceneprint.engine.ingest.write_groups import Grouping
from sceneprint.errors import IdempotencyConflict, StoreLocked
from sceneprint.store import open_store
from sceneprint.store.events import (
    EventFilter,
    EventRow,
    anchor_number,
    anchor_of_now,
    events_table,
    holds_anchor,
    list_events,
    number_events,
    record_event,
)
from sceneprint.store.keys import IdempotentRequest, Overtaken
from sceneprint.store.maps import add_map, next_revision, store_model
from sceneprint.store.postgres.connection import EVENTS, LOCKS
from sceneprint.store.tables import event_values, events, pending_events

MODEL = "ab" * 32
MAPS, WRITERS, EACH = 8, 12, 40
_WAITING = text(
    "SELECT count(*) FROM pg_locks WHERE locktype = 'advisory' AND NOT granted "
    "AND database = (SELECT oid FROM pg_database WHERE datname = current_database())"
)


@pytest.fixture
def rows(server_store):
    """Some maps."""
    with server_store.database.write() as connection:
        store_model(connection, MODEL, "toy", b"a model")
        return [add_map(connection, f"map-{i}", None, MODEL) for i in range(MAPS)]


def waiting(store):
    with store.database.read() as connection:
        return int(connection.execute(_WAITING).scalar_one())


def told(store):
    """All events that a reader finds."""
    return next_events(store.database, EventFilter(), 0, 10_000).events


def others_write(database_url, of, folder):
    """A writer of another process, begun; tells whether it is done."""
    done = threading.Event()

    def write():
        other = open_store(database_url, folder)
        try:
            with other.database.write(map_number=of) as connection:
                record_event(connection, "other", None)
        finally:
            other.database.close()
        done.set()

    threading.Thread(target=write).start()
    return done.is_set


@pytest.mark.parametrize(
    ("held", "wanted", "waits"), [(0, 1, False), (0, 0, True), (0, None, True), (None, 0, True)]
)
def test_writers_of_different_maps_do_not_wait_for_each_other(
    server_store, rows, postgres_url, tmp_path, until, held, wanted, waits
):
    numbers = {None: None, **{i: row.number for i, row in enumerate(rows)}}
    with server_store.database.write(map_number=numbers[held]):
        done = others_write(postgres_url, numbers[wanted], tmp_path / "other")
        until((lambda: waiting(server_store) == 1) if waits else done)
        assert done() is not waits
    until(done)


def test_readers_miss_no_event_and_see_those_of_a_map_in_its_order(server_store, rows):
    """Writers commit in any order, some of all maps among them, while others read on."""
    database, written = server_store.database, defaultdict[str, list[int]](list)
    over, found = threading.Event(), [list[EventRow](), list[EventRow]()]

    def write(seed):
        chance = Random(seed)
        for _ in range(EACH):
            row = chance.choice(rows)
            of_map = row.number if chance.random() < 0.9 else None
            with database.write(map_number=of_map) as connection:
                # the map's next revision says in which order its writers commit
                revision = next_revision(connection, row.number)
                record_event(connection, "x", row.name, revision=revision)
                connection.execute(text("SELECT pg_sleep(:s)"), {"s": chance.random() / 200})
            with guard:
                written[row.name].append(revision)

    def read(into):
        place, last = 0, False
        while not last:
            last = over.is_set()
            slice_ = next_events(database, EventFilter(kinds=("x",)), place, 50)
            into += slice_.events
            last, place = last and not slice_.events, slice_.place

    guard = threading.Lock()
    readers = [threading.Thread(target=read, args=[one]) for one in found]
    for reader in readers:
        reader.start()
    with ThreadPoolExecutor(WRITERS) as pool:
        list(pool.map(write, range(WRITERS)))
    over.set()
    for reader in readers:
        reader.join(PATIENCE_S)
    for seen in found:
        by_map = defaultdict(list)
        for event in seen:
            by_map[event.map].append(event.data["revision"])
        assert by_map == {name: sorted(numbers) for name, numbers in written.items()}
        assert sum(map(len, by_map.values())) == WRITERS * EACH
    assert found[0] == found[1]


def test_numbers_of_the_version_before_follow_those_that_are_pending(server_store, rows):
    """It knows nothing of them, and holds the turn alone when it tells something."""
    database, (row, *_) = server_store.database, rows
    with database.write(map_number=row.number) as connection:
        assert events_table(connection) is pending_events
        record_event(connection, "first", row.name)
    with database.write() as connection:
        assert events_table(connection) is events
        connection.execute(insert(events).values(event_values("then", row.name, None, None, {})))
    with database.read() as connection:  # and nobody numbered any
        kinds = [one.kind for one in list_events(connection, EventFilter(frozenset([row.name])))]
        assert kinds == ["map.created", "first", "then"]
        assert connection.execute(select(pending_events)).all() == []


def test_an_event_of_a_transaction_that_failed_is_never_told(server_store, rows):
    database = server_store.database
    with suppress(KeyError), database.write(map_number=rows[0].number) as connection:
        record_event(connection, "lost", rows[0].name)
        raise KeyError
    with database.write(map_number=rows[0].number) as connection:
        record_event(connection, "kept", rows[0].name)
    assert [one.kind for one in told(server_store)][MAPS:] == ["kept"]


def test_what_cannot_be_numbered_now_comes_later_and_marks_no_state(
    server_store, rows, monkeypatch
):
    database, name = server_store.database, rows[0].name
    monkeypatch.setattr("sceneprint.store.events.NUMBERING_S", 0.05)
    with database.write(map_number=rows[0].number) as connection:
        record_event(connection, "late", name)
    with database._engine.begin() as other:  # as a long transaction that told something
        other.exec_driver_sql(f"SELECT pg_advisory_xact_lock({LOCKS}, {EVENTS})")
        assert [one.kind for one in told(server_store)] == ["map.created"] * MAPS
        with pytest.raises(StoreLocked):
            anchor_of_now(database, name)
    assert [one.kind for one in told(server_store)][MAPS:] == ["late"]


def test_an_anchor_marks_what_was_pending(server_store, rows):
    database, (row, *_) = server_store.database, rows
    with database.write(map_number=row.number) as connection:
        record_event(connection, "frame.indexed", row.name, "a")
    anchor = anchor_of_now(database, row.name)
    with database.read() as connection:
        assert holds_anchor(connection, anchor)
        assert anchor_number(anchor) == told(server_store)[-1].number == MAPS + 1
        assert anchor_of_now(database, rows[1].name) != anchor


def test_of_two_requests_with_one_key_for_two_maps_only_the_first_takes_effect(server_store, rows):
    """Neither saw the other when it looked; the second finds out when it is stored."""
    database = server_store.database
    first, second = (IdempotentRequest("robot", "key", mark * 64) for mark in "ab")
    looked, stored, tries = threading.Event(), threading.Event(), list[int]()

    def keep_first(connection):
        assert looked.wait(PATIENCE_S)
        assert first.stored_result(connection) is None
        first.store(connection, {"of": "first"})

    def keep_second(connection):
        tries.append(1)
        assert second.stored_result(connection) is None
        looked.set()
        assert stored.wait(PATIENCE_S)
        record_event(connection, "second", rows[1].name)
        second.store(connection, {"of": "second"})

    def run_first():
        Grouping(database, rows[0].number).run(keep_first)
        stored.set()

    other = threading.Thread(target=run_first)
    other.start()
    writes = Grouping(database, rows[1].number)
    with pytest.raises(Overtaken):
        writes.run(keep_second)
    with pytest.raises(IdempotencyConflict):  # as uploads do then
        writes.run(keep_second)
    other.join(PATIENCE_S)
    assert len(tries) == 2
    assert "second" not in [one.kind for one in told(server_store)]
    with database.read() as connection:
        assert first.stored_result(connection) == {"of": "first"}


def test_nothing_is_pending_where_nobody_reads_once_somebody_numbers(server_store, rows):
    for row in rows:
        with server_store.database.write(map_number=row.number) as connection:
            record_event(connection, "x", row.name)
    number_events(server_store.database)
    with server_store.database.read() as connection:
        assert connection.execute(select(pending_events)).all() == []
        assert [one.map for one in list_events(connection, EventFilter(kinds=("x",)))] == [
            row.name for row in rows
        ]
