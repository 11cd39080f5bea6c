"""Tests of the order and the removal of events."""

import itertools

from sqlalchemy import insert, select, update

from sceneprint.store.deletion import remove_map
from sceneprint.store.events import EventFilter, list_events, newest_selected, removal_floor
from sceneprint.store.maps import add_map, find_map, store_model
from sceneprint.store.store_counts import count_events
from sceneprint.store.tables import events

KEPT = ("frame.received", "frame.indexed", "map.created", "key.created")

#: Each process commits events one by one, some transactions of several and some given up.
WRITE = """
from sceneprint.store import open_store
from sceneprint.store.events import record_event
from pathlib import Path

def work(i):
    store = open_store(ARGS[0], Path(ARGS[1]))
    for n in range(18):
        try:
            # writers of two maps, and one of all maps
            with store.database.write(map_number=(1, 2, None)[i]) as connection:
                for part in range(1 + n % 3):
                    record_event(connection, "frame.received", "hall", f"{i}-{n}-{part}")
                if n % 7 == 3:
                    raise KeyError
        except KeyError:
            pass
"""
READ = """
from sceneprint.store.events import EventFilter
from sceneprint.engine.admin.operations import next_events
import time

def read(store):
    seen, place = [], 0
    while len(seen) < int(ARGS[2]):
        found, place, _ = next_events(store.database, EventFilter(), place, 5)
        seen += [(one.number, one.frame_id) for one in found]
    return seen

writes = work
def work(i):
    return read(open_store(ARGS[0], Path(ARGS[1]))) if i == 3 else writes(i)
"""


def fill(store, count):
    with store.database.write() as connection:
        store_model(connection, "m" * 64, "small", b"")
        for name in ("hall", "shop"):
            add_map(connection, name, None, "m" * 64)
        for i in range(count):
            name = ("hall", "shop", None)[i % 3]
            connection.execute(
                insert(events).values(at=1000.0 + i, kind=KEPT[i % 4], map=name, data={})
            )


def test_who_reads_on_misses_nothing_of_several_writers(race, url, store, tmp_path):
    blobs = tmp_path / "blobs"
    sure = sum(1 + n % 3 for n in range(18) if n % 7 != 3) * 3
    *_, seen = race(WRITE + READ, 4, url, blobs, sure)
    with store.database.read() as connection:
        query = select(events.c.number, events.c.frame_id).order_by(events.c.number)
        rows = connection.execute(query).all()
    assert [list(row) for row in rows] == seen
    assert len(seen) == sure
    for i in range(3):  # each writer's own in its order
        own = [frame for _, frame in seen if frame.startswith(f"{i}-")]
        assert own == [f"{i}-{n}-{k}" for n in range(18) if n % 7 != 3 for k in range(1 + n % 3)]


def test_the_database_and_the_stream_pick_the_same(store):
    fill(store, 60)
    maps = (None, frozenset(("hall",)), frozenset(("hall", "shop")), frozenset())
    kinds = ((), ("frame.",), ("frame.i", "key."), ("frame_",), ("map.created",))
    with store.database.read() as connection:
        every = list_events(connection, EventFilter())
        assert [event.number for event in every] == list(range(1, 63))
        for named, begun, of_maps in itertools.product(maps, kinds, (False, True)):
            wanted = EventFilter(named, begun, of_maps)
            assert list_events(connection, wanted) == [event for event in every if wanted(event)]
            seen = [event.number for event in every if wanted.sees(event)]
            assert newest_selected(connection, wanted) == max(seen, default=0)
        newest = list_events(connection, EventFilter(), before=50, limit=7, newest_first=True)
        assert [event.number for event in newest] == list(range(49, 42, -1))


def test_events_are_counted_by_interval(store):
    fill(store, 60)
    with store.database.read() as connection:
        every = [event for event in list_events(connection, EventFilter()) if event.at < 2000]
        for start, width, name in (
            (1000.0, 10.0, None),
            (1007.5, 4.0, "hall"),
            (1059.5, 1.0, None),
        ):
            counted = count_events(connection, KEPT, start, width, name)
            naive = {}
            for event in every:
                if event.at >= start and name in (None, event.map):
                    place = (int((event.at - start) // width), event.kind)
                    naive[place] = naive.get(place, 0) + 1
            recent = {key: n for key, n in counted.items() if key[0] < 1e6}  # not of the maps
            assert recent == naive


def test_a_later_key_is_told_nothing_of_a_former_map_of_the_name(store):
    """A key created at `since` gets no events of a map that had been deleted by then."""

    def changes(since, *names):
        wanted = EventFilter(frozenset(names), since=since)
        with store.database.read() as connection:
            result = [(event.kind, event.map) for event in list_events(connection, wanted)]
            newest = newest_selected(connection, wanted)
            lost = removal_floor(connection, wanted, 1, 0)
            numbers = connection.execute(select(events.c.number, events.c.kind, events.c.map))
            last = [row.number for row in numbers if (row.kind, row.map) in result]
        assert newest == max(last, default=0)
        assert result or lost == 0
        return result

    def at(seconds):
        """When what has happened since the last time was."""
        with store.database.write() as connection:
            new = events.c.at > 10_000
            connection.execute(update(events).where(new).values(at=seconds))

    def begin(*names):
        with store.database.write() as connection:
            for name in names:
                add_map(connection, name, None, "m" * 64)

    def end(*names):
        with store.database.write() as connection:
            for name in names:
                remove_map(connection, find_map(connection, name))

    with store.database.write() as connection:
        store_model(connection, "m" * 64, "small", b"")
    begin("hall", "shop")
    at(100)
    end("hall", "shop")
    at(200)
    begin("hall", "yard")
    at(300)
    created, gone = ("map.created", "hall"), ("map.deleted", "hall")
    assert changes(None, "hall") == changes(150, "hall") == [created, gone, created]
    assert changes(250, "hall") == changes(900, "hall") == [created]
    assert changes(250, "shop") == changes(250, "attic") == []
    assert changes(150, "shop") == [("map.created", "shop"), ("map.deleted", "shop")]
    assert changes(250, "hall", "shop", "yard") == [created, ("map.created", "yard")]
    end("hall")  # events before its creation stay hidden
    at(400)
    assert changes(250, "hall") == [created, gone]
    assert changes(500, "hall") == []
    begin("hall")
    at(600)
    assert changes(250, "hall") == [created, gone, created]
    assert changes(500, "hall") == [created]
