"""Tests of retention: expired frames are deleted in blocks, and no others."""

import time

import pytest
from sqlalchemy import select, update

from sceneprint.engine.maps.map_lifecycle import edit_map
from sceneprint.engine.upkeep import purge
from sceneprint.engine.upkeep.purge import Retention
from sceneprint.errors import InvalidRequest
from sceneprint.store.deletion import DAY_S
from sceneprint.store.events import EventFilter, list_events, number_events
from sceneprint.store.tables import frames, signatures
from sceneprint_client.api import NewMap

#: Longer than any test goes on: rows are those of test_ended_rows.
ROWS_DAYS = 1000.0


@pytest.fixture
def aged(full, ids):
    """Twelve frames of `hall`, received one a day: the first twelve days ago; and a map of none."""
    with full.store.database.write() as connection:
        for i, name in enumerate(ids(full)):
            when = {"received_at": time.time() - DAY_S * (12 - i) + 3600}
            connection.execute(update(frames).where(frames.c.id == name).values(when))
    full.create_map(NewMap(name="attic", model="depth"))
    return full


def test_what_is_too_old_goes_with_its_bytes(aged, ids, uploads, monkeypatch):
    monkeypatch.setattr(purge, "AT_ONCE", 2)
    names, revision = ids(aged), aged.get_map("hall").revision
    with aged.store.database.read() as connection:
        made = select(signatures.c.geometry).order_by(signatures.c.frame_number).limit(5)
        first = list(connection.execute(made).scalars())
    assert aged.get_map("hall").overdue is None
    assert Retention(aged.store, ROWS_DAYS).run() == 0  # nobody has said how long
    told = edit_map(aged.store, "hall", {"retention_days": 7.0})
    assert told.overdue == 5
    assert aged.publish_due() == 0  # workers look after it
    assert ids(aged) == names[5:]
    told = aged.get_map("hall")
    assert (told.frames, told.used_frames, told.overdue) == ({"deleted": 5, "indexed": 7}, 7, 0)
    assert told.revision == revision + 5
    assert aged.view("hall")[2].size == 7
    number_events(aged.store.database)
    with aged.store.database.read() as connection:
        last = list_events(connection, EventFilter(), after=0, newest_first=True, limit=5)
        assert [(one.kind, one.frame_id, one.data) for one in reversed(last)] == [
            ("frame.deleted", name, {"reason": "retention"}) for name in names[:5]
        ]
        gone = select(frames).where(frames.c.state == "deleted").order_by(frames.c.number)
        rows = connection.execute(gone).mappings().all()
        assert [row["revision"] for row in rows] == list(range(revision + 1, revision + 6))
        assert all(row[name] is None for row in rows for name in ("pose", "pose_parent", "session"))
    blobs = set(aged.store.blobs.digests())
    assert not blobs & {row["blob"] for row in rows}
    assert not blobs & set(first)
    assert len(blobs) == 14


def test_time_goes_on_and_keeping_all_stops_it(aged, ids):
    names, worker = ids(aged), Retention(aged.store, ROWS_DAYS)
    edit_map(aged.store, "hall", {"retention_days": 20})
    now = time.time()
    assert worker.run(now) == 0
    assert worker.run(now + 100 * DAY_S) == 0  # it has just looked
    assert Retention(aged.store, ROWS_DAYS).run(now + 9 * DAY_S) == 1
    edit_map(aged.store, "hall", {"retention_days": None})
    assert Retention(aged.store, ROWS_DAYS).run(now + 100 * DAY_S) == 0
    assert ids(aged) == names[1:]


def test_what_it_would_do_is_told_and_not_done(aged, ids):
    before, etag = ids(aged), aged.get_map("hall").etag
    told = edit_map(aged.store, "hall", {"retention_days": 3}, dry_run=True)
    assert (told.retention_days, told.overdue) == (3.0, 9)
    assert (aged.get_map("hall").etag, aged.get_map("hall").retention_days) == (etag, None)
    assert Retention(aged.store, ROWS_DAYS).run() == 0
    assert ids(aged) == before
    with pytest.raises(InvalidRequest):
        edit_map(aged.store, "hall", {"retention_days": -3}, dry_run=True)


def test_a_host_whose_clock_is_wrong_deletes_nothing(make_engine, postgres_url, uploads, tmp_path):
    (tmp_path / "data" / "blobs").mkdir(parents=True)
    engine = make_engine(tmp_path / "data", database_url=postgres_url)
    engine.create_map(NewMap(name="hall", model="depth", retention_days=1))
    right, one = time.time, uploads[0]
    with pytest.MonkeyPatch.context() as patch:  # a robot that has not been told the time yet
        patch.setattr(time, "time", lambda: right() - 30 * DAY_S)
        added, _ = engine.add_frame("hall", one.data, one.meta)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(time, "time", lambda: right() + 30 * DAY_S)
        assert Retention(engine.store, ROWS_DAYS).run() == 0
    assert engine.get_frame("hall", added.frame_id).state == "received"
    assert Retention(engine.store, ROWS_DAYS).run(right() + 30 * DAY_S) == 1
