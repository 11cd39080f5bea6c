"""Tests of the promotion of an asynchronous standby, which loses only what it had not received."""

import asyncio
import threading

import pytest

from sceneprint.errors import StoreAway, UnknownFrame
from sceneprint.settings import Settings
from sceneprint.store.events import EventFilter
from sceneprint_client.api import JobState, NewMap, Query
from service.event_stream import Feed
from tests.whole_engine import Engine

ASKED = Query(k=5, candidates=5, keep=False)


@pytest.fixture
def engine(pair, tmp_path):
    hosts = "&".join(f"host=127.0.0.1:{server.port}" for server in pair)
    url = f"postgresql://postgres@/fleet?{hosts}&target_session_attrs=read-write"
    with Engine(Settings.model_validate({"database_url": url, "data_dir": tmp_path})) as opened:
        yield opened


def index(engine, frame):
    added, _ = engine.add_frame("hall", *frame)
    work = engine.claim("w")
    assert engine.run(work) == JobState.SUCCEEDED
    return added.frame_id


def matches_of(engine, frame):
    answer = engine.queries.upload(["hall"], *frame, ASKED)
    return sorted(match.frame_id for match in answer.matches)


@pytest.fixture
def events(engine):
    """What a stream of events tells, from the first on."""
    results = []
    ended = threading.Event()
    thread = threading.Thread(target=_follow, args=(engine.store.database, results, ended))
    thread.start()
    yield results
    ended.set()
    thread.join()


def _follow(database, seen_events, ended):
    async def follow():
        feed = Feed(database, most=1, retained=1000)
        feed.join()
        reading = asyncio.ensure_future(_gather(feed, seen_events))
        while not ended.is_set():
            await asyncio.sleep(0.02)
        feed.close()
        await reading
        feed.leave()

    asyncio.run(follow())


async def _gather(feed, seen_events):
    async for events, _ in feed.batches(EventFilter(), 0, lambda: True):
        seen_events += events


def test_what_it_lacked_is_gone_and_no_memory_of_it_hides_what_comes_then(
    engine, pair, small, until, events
):
    primary, standby = pair
    engine.create_map(NewMap(name="hall", model="depth"))
    ids = [index(engine, frame) for frame in small[:2]]
    written = "SELECT pg_current_wal_lsn()::text"
    (at,) = primary.execute(written)[0]
    until(lambda: standby.execute(f"SELECT pg_last_wal_replay_lsn() >= '{at}'")[0][0])
    standby.execute("ALTER SYSTEM SET primary_conninfo = ''")
    standby.execute("SELECT pg_reload_conf()")
    until(lambda: primary.execute("SELECT count(*) FROM pg_stat_replication")[0] == (0,))
    before = engine.store.database.history
    lost = index(engine, small[2])
    assert matches_of(engine, small[2]) == sorted([*ids, lost])  # held in memory from now on
    until(lambda: events and (events[-1].kind, events[-1].frame_id) == ("frame.indexed", lost))
    primary.kill()
    with pytest.raises(StoreAway):
        engine.get_map("hall")
    standby.promote()
    # whoever follows learns that what it was told may not be so, and then goes on
    until(lambda: events and events[-1].kind == "events.missed")
    assert engine.get_map("hall").frames == {"indexed": 2}
    assert engine.store.database.history != before
    with pytest.raises(UnknownFrame):
        engine.get_frame("hall", lost)
    other = index(engine, small[3])  # which is given the number and the revision of the lost one
    assert engine.get_map("hall").frames == {"indexed": 3}
    assert matches_of(engine, small[3]) == sorted([*ids, other])
    until(lambda: events and (events[-1].kind, events[-1].frame_id) == ("frame.indexed", other))
    assert [event.kind for event in events].count("events.missed") == 1
    again = index(engine, small[2])  # as by a robot that keeps its frames for a while
    assert matches_of(engine, small[2]) == sorted([*ids, other, again])
