"""Tests of event streams: polling, lagging streams, silence and shutdown."""

import asyncio

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.store import open_store
from sceneprint.store.events import EventFilter, record_event, remove_events
from service import event_stream as feeds
from service.event_stream import Feed


@pytest.fixture
def database(tmp_path):
    store = open_store(f"sqlite:///{tmp_path / 'sceneprint.db'}", tmp_path / "blobs")
    yield store.database
    store.close()


@pytest.fixture(autouse=True)
def hasty(monkeypatch):
    monkeypatch.setattr(feeds, "POLL_S", 0.01)


def write(database, *names):
    for name in names:
        with database.write() as connection:
            record_event(connection, "frame.received", name, name)


def ids(batch):
    return [event.number for event in batch[0]]


async def gather(batches, count):
    """The numbers of so many events, as they come."""
    results = []
    while len(results) < count:
        batch = await asyncio.wait_for(anext(batches), PATIENCE_S)
        assert not batch[0] or batch[1] >= batch[0][-1].number
        results += ids(batch)
    return results


def always():
    return True


def test_streams_far_behind_and_near_are_told_all_once(database, monkeypatch):
    monkeypatch.setattr(feeds, "HELD", 8)
    monkeypatch.setattr(feeds, "MOST", 3)
    write(database, *("hall" for _ in range(20)))

    async def run():
        feed = Feed(database, most=9, retained=1000)
        streams = [(EventFilter(), 0), (EventFilter(), 13), (EventFilter(frozenset(("shop",))), 0)]
        begun = [feed.batches(wanted, after, always) for wanted, after in streams]
        for _ in begun:
            feed.join()
        assert await gather(begun[0], 20) == list(range(1, 21))
        write(database, *("hall" if i % 2 else "shop" for i in range(40)))  # 21 to 60
        assert await gather(begun[1], 47) == list(range(14, 61))  # beyond what is held
        assert await gather(begun[0], 40) == list(range(21, 61))
        assert await gather(begun[2], 20) == list(range(21, 61, 2))
        write(database, "shop", "hall")
        for stream in begun[:2]:
            assert await gather(stream, 2) == [61, 62]
        assert await gather(begun[2], 1) == [61]
        for _ in begun:
            feed.leave()

    asyncio.run(run())


def test_what_is_gone_is_said_to_be(database):
    """And what is left of it is told."""
    write(database, *("hall" for _ in range(12)))
    with database.write() as connection:
        remove_events(connection, [1, 3])

    async def run():
        feed = Feed(database, most=9, retained=9)
        for after, place in ((1, 1), (99, 12)):
            stream = feed.batches(EventFilter(), after, always)
            first, position = await anext(stream)
            assert [(row.number, row.kind) for row in first] == [(place, "events.missed")]
            assert position == place
            if place < 12:
                assert await gather(stream, 10) == [2, *range(4, 13)]
        assert await anext(feed.batches(EventFilter(), 3, always)) == ([], 3)

    asyncio.run(run())
