"""Tests of retention: of frames that are too old, and of rows of frames that have ended."""

import time

import pytest
from sqlalchemy import insert, select, update

from sceneprint.engine.maps.map_lifecycle import edit_map
from sceneprint.engine.maps.tombstones import Tombstones
from sceneprint.engine.search.local_index import index_folder
from sceneprint.engine.upkeep import purge
from sceneprint.engine.upkeep.purge import Retention
from sceneprint.errors import UnknownFrame, UnknownJob
from sceneprint.index.index_manifest import manifests, read_manifest
from sceneprint.store.deletion import DAY_S
from sceneprint.store.events import EventFilter, list_events, number_events
from sceneprint.store.tables import frames, jobs, maps, signatures, surface_frames
from sceneprint_client.api import FrameState, NewMap, Query

DAYS = 7.0
ALL = Query(stages=("retrieve",), k=50)
pytestmark = pytest.mark.usefixtures("_always_look")


def after(engine, days):
    return Retention(engine.store, DAYS).run(time.time() + DAY_S * days)


def rows(engine):
    result = engine.fetch(select(frames.c.id, frames.c.state).order_by(frames.c.number))
    return [(item[0], item[1]) for item in result]


def matches_of(engine, uploads):
    answer = engine.ask(uploads[2], ALL)
    return sorted(match.frame_id for match in answer.matches)


def ended_ago(engine, state):
    """How many seconds ago frames in a state ended."""
    of = select(frames.c.ended_at).where(frames.c.state == state)
    ended = engine.fetch(of).scalars().all()
    return [None if at is None else time.time() - at for at in ended]


def test_rows_of_deleted_frames_go_with_their_jobs_once_their_days_are_over(full):
    full.tombstones = Tombstones(full.store, 0.0, full.bell.ring)
    names, use = full.ids(), full.get_map("hall").used_frames
    of = select(jobs.c.id).join(frames, frames.c.number == jobs.c.frame_number)
    job = full.fetch(of.where(frames.c.id == names[1])).scalar_one()
    for name in names[1:3]:
        full.delete_frame("hall", name)
    revision = full.get_map("hall").revision
    assert [0.0 <= (ago or -1.0) < 60.0 for ago in ended_ago(full, FrameState.DELETED)] == [
        True
    ] * 2
    assert after(full, DAYS - 0.01) == 0
    assert len(rows(full)) == 12
    assert after(full, DAYS + 0.01) == 2
    assert rows(full) == [(name, "indexed") for name in names if name not in names[1:3]]
    assert full.row("hall").pruned_revision == revision
    assert full.get_map("hall").used_frames == use - 2
    for missing in names[1:3]:
        with pytest.raises(UnknownFrame):
            full.get_frame("hall", missing)
    with pytest.raises(UnknownJob):
        full.get_job(job)
    assert after(full, 1000) == 0  # the living stay


@pytest.mark.parametrize("needed", ["job", "surface"])
def test_a_row_that_is_needed_stays(full, needed):
    full.tombstones = Tombstones(full.store, 0.0, full.bell.ring)
    full.delete_frame("hall", full.ids()[0])
    with full.store.database.write() as connection:
        number = connection.execute(
            select(frames.c.number).where(frames.c.state == "deleted")
        ).scalar_one()
        if needed == "job":
            own = jobs.c.frame_number == number
            connection.execute(update(jobs).where(own).values(state="running"))
        else:
            of_map = connection.execute(select(maps.c.number)).scalar_one()
            there = {"frame_number": number, "map_number": of_map, "parent": "a", "changed": True}
            connection.execute(insert(surface_frames).values(**there))
    assert after(full, 2 * DAYS) == 0
    assert len(rows(full)) == 12
    assert full.row("hall").pruned_revision == 0


def test_a_redundant_frame_goes_and_is_judged_anew_when_it_comes_again(full, uploads):
    camera = uploads[0].meta.intrinsics.model_copy(update={"cx": uploads[0].meta.intrinsics.cx + 1})
    meta = uploads[0].meta.model_copy(update={"intrinsics": camera})
    first, _ = full.add_frame("hall", uploads[0].data, meta, if_novel=0.9)
    full.work_off()
    assert full.get_frame("hall", first.frame_id).state == FrameState.REDUNDANT
    (ago,) = ended_ago(full, FrameState.REDUNDANT)
    assert 0.0 <= ago < 60.0
    assert after(full, DAYS + 0.01) == 1
    assert full.row("hall").pruned_revision == 0  # nobody searched it
    second, new = full.add_frame("hall", uploads[0].data, meta)
    assert new
    assert second.frame_id != first.frame_id


@pytest.mark.parametrize("tail_frames", [3, 100], ids=["index", "no index"])
def test_a_reader_that_missed_deletions_begins_anew(data, make_engine, uploads, tail_frames):
    reader, builder = (make_engine(data, unindexed_frames=tail_frames) for _ in range(2))
    assert builder.publish_due() == (tail_frames == 3)
    names = builder.ids()
    assert matches_of(reader, uploads) == sorted(names)
    builder.tombstones = Tombstones(builder.store, 0.0, builder.bell.ring)
    for name in names[4:6]:
        builder.delete_frame("hall", name)
    assert after(builder, DAYS + 1) == 2
    left = sorted(set(names) - set(names[4:6]))
    for engine in (reader, make_engine(data, unindexed_frames=tail_frames)):
        assert matches_of(engine, uploads) == left
        assert engine.view("hall")[2].size == 10


def test_purging_leaves_no_byte_of_a_frame_whose_row_is_gone(data, make_engine):
    """On a node that was off meanwhile: its index is built anew, as nobody knows what went."""
    engine = make_engine(data, unindexed_frames=11)
    assert engine.publish_due() == 1
    engine.tombstones = Tombstones(engine.store, 0.0, engine.bell.ring)
    for name in engine.ids()[:6]:
        engine.delete_frame("hall", name)
    assert after(engine, DAYS + 1) == 6
    folder = index_folder(engine.settings.indexes, engine.row("hall"))
    before = {path.name for path in folder.glob("*.faiss")}
    assert engine.purging.now().indexes == 1
    ((number, path),) = manifests(folder)
    assert (number, read_manifest(path).frames) == (2, 6)
    assert before.isdisjoint(path.name for path in folder.glob("*.faiss"))
    assert engine.purging.now().indexes == 0


#: Longer than any test goes on: rows are those of test_ended_rows.
ROWS_DAYS = 1000.0


@pytest.fixture
def aged(full):
    """Twelve frames of `hall`, received one a day: the first twelve days ago; and a map of none."""
    with full.store.database.write() as connection:
        for i, name in enumerate(full.ids()):
            when = {"received_at": time.time() - DAY_S * (12 - i) + 3600}
            connection.execute(update(frames).where(frames.c.id == name).values(when))
    full.create_map(NewMap(name="attic", model="depth"))
    return full


def test_what_is_too_old_goes_with_its_bytes(aged, uploads, monkeypatch):
    monkeypatch.setattr(purge, "AT_ONCE", 2)
    names, revision = aged.ids(), aged.get_map("hall").revision
    query = select(signatures.c.geometry).order_by(signatures.c.frame_number).limit(5)
    first = list(aged.fetch(query).scalars())
    assert aged.get_map("hall").overdue is None
    assert Retention(aged.store, ROWS_DAYS).run() == 0  # nobody has said how long
    result = edit_map(aged.store, "hall", {"retention_days": 7.0})
    assert result.overdue == 5
    assert aged.publish_due() == 0  # workers look after it
    assert aged.ids() == names[5:]
    result = aged.get_map("hall")
    assert (result.frames, result.used_frames, result.overdue) == (
        {"deleted": 5, "indexed": 7},
        7,
        0,
    )
    assert result.revision == revision + 5
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


def test_time_goes_on_and_keeping_all_stops_it(aged):
    names, worker = aged.ids(), Retention(aged.store, ROWS_DAYS)
    edit_map(aged.store, "hall", {"retention_days": 20})
    now = time.time()
    assert worker.run(now) == 0
    assert worker.run(now + 100 * DAY_S) == 0  # it has just looked
    assert Retention(aged.store, ROWS_DAYS).run(now + 9 * DAY_S) == 1
    edit_map(aged.store, "hall", {"retention_days": None})
    assert Retention(aged.store, ROWS_DAYS).run(now + 100 * DAY_S) == 0
    assert aged.ids() == names[1:]


def test_a_host_whose_clock_is_wrong_deletes_nothing(make_engine, postgres_url, uploads, tmp_path):
    (tmp_path / "data" / "blobs").mkdir(parents=True)
    engine = make_engine(tmp_path / "data", database_url=postgres_url)
    engine.create_map(NewMap(name="hall", model="depth", retention_days=1))
    right, one = time.time, uploads[0]
    with pytest.MonkeyPatch.context() as patch:  # a robot that has not been told the time yet
        patch.setattr(time, "time", lambda: right() - 30 * DAY_S)
        added, _ = engine.add(one)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(time, "time", lambda: right() + 30 * DAY_S)
        assert Retention(engine.store, ROWS_DAYS).run() == 0
    assert engine.get_frame("hall", added.frame_id).state == "received"
    assert Retention(engine.store, ROWS_DAYS).run(right() + 30 * DAY_S) == 1
