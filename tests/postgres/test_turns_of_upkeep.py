"""Tests that workers on one map do not block writers of other maps."""

import re
import threading
import time
from collections import Counter
from contextlib import closing, contextmanager

import pytest
from sqlalchemy import event, text

from sceneprint.engine.admin.operations import next_events
from sceneprint.engine.jobs.tasks import SliceResult
from sceneprint.engine.upkeep.purge import Retention
from sceneprint.settings import Settings
from sceneprint.store import open_store
from sceneprint.store.deletion import DAY_S, doom, doomed_blobs
from sceneprint.store.events import EventFilter
from sceneprint.store.postgres.connection import LOCKS, TURN
from sceneprint_client.api import JobState, NewMap
from tests.whole_engine import Engine

_ALL = re.compile(rf"pg_advisory_xact_lock\({LOCKS}, {TURN}\)")
_WAITING = text("SELECT count(*) FROM pg_locks WHERE locktype = 'transactionid' AND NOT granted")
_ONE = "pg_advisory_xact_lock_shared("


@pytest.fixture
def engine(postgres_url, tmp_path):
    (tmp_path / "blobs").mkdir()  # its database is there: it is made by nobody
    values = {"database_url": postgres_url, "data_dir": tmp_path, "decoders": 0}
    with Engine(Settings.model_validate(values)) as opened:
        opened.create_map(NewMap(name="hall", model="depth", retention_days=1.0))
        yield opened


@contextmanager
def turns(engine):
    """Counts how often the turn of all maps, and that of one, is taken."""
    found = Counter()

    def note(_connection, _cursor, statement, *_):
        found["all"] += _ALL.search(statement) is not None
        found["one"] += _ONE in statement

    of = engine.store.database._engine
    event.listen(of, "before_cursor_execute", note)
    try:
        yield found
    finally:
        event.remove(of, "before_cursor_execute", note)


def test_writers_of_two_maps_may_doom_the_same_blobs(engine, postgres_url, tmp_path, until):
    blobs = [f"{number:064x}" for number in range(3)]
    done = threading.Event()

    def doom_elsewhere():
        with (
            closing(open_store(postgres_url, tmp_path / "blobs")) as other,
            other.database.write(map_number=8) as connection,
        ):
            doom(connection, blobs)
        done.set()

    with engine.store.database.write(map_number=7) as connection:
        doom(connection, blobs[:2])
        threading.Thread(target=doom_elsewhere).start()
        until(lambda: waiting(engine))
    until(done.is_set)
    with engine.store.database.read() as connection:
        assert doomed_blobs(connection, 9) == blobs


def waiting(engine):
    """Whether a transaction waits for the end of another."""
    with engine.store.database.read() as connection:
        return bool(connection.execute(_WAITING).scalar_one())


def test_retention_takes_the_turn_of_its_map(engine, small):
    for frame in small[:3]:
        engine.add_frame("hall", *frame)
    with turns(engine) as taken:
        assert Retention(engine.store, 7.0).run(time.time() + 2 * DAY_S) == 3
    assert taken == {"one": 1, "all": 1}  # of the sweep: its blobs may be those of any map
    assert engine.get_map("hall").frames == {"deleted": 3}
    told = next_events(engine.store.database, EventFilter(), 0, 100).events
    assert [one.kind for one in told].count("frame.deleted") == 3


def test_a_slice_takes_the_turn_of_its_map(engine):
    engine.handle("count", lambda _task, _is_over: SliceResult(True, {}, event="counted"))
    engine.begin_task("count", "hall", {})
    work = engine.claim("w")
    assert work is not None
    with turns(engine) as taken:
        assert engine.run(work) == JobState.SUCCEEDED
    assert taken == {"one": 1, "all": 0}
    told = next_events(engine.store.database, EventFilter(), 0, 100).events
    assert [one.kind for one in told].count("counted") == 1
