"""Tests that rows of deleted and redundant frames are removed after some days."""

import time

import pytest
from sqlalchemy import insert, select, update

from sceneprint.engine.maps.tombstones import Tombstones
from sceneprint.engine.search.local_index import index_folder
from sceneprint.engine.upkeep.purge import Retention
from sceneprint.errors import UnknownFrame, UnknownJob
from sceneprint.index.index_manifest import manifests, read_manifest
from sceneprint.store.deletion import DAY_S
from sceneprint.store.maps import find_map
from sceneprint.store.tables import frames, jobs, maps, surface_frames
from sceneprint_client.api import FrameState, Query

DAYS = 7.0
ALL = Query(stages=("retrieve",), k=50)
pytestmark = pytest.mark.usefixtures("_always_look")


def after(engine, days):
    """What retention removes so many days from now."""
    return Retention(engine.store, DAYS).run(time.time() + DAY_S * days)


def rows(engine):
    """Id and state of all frames that have a row."""
    with engine.store.database.read() as connection:
        found = connection.execute(select(frames.c.id, frames.c.state).order_by(frames.c.number))
        return [(one[0], one[1]) for one in found]


def found(engine, uploads):
    answer = engine.queries.upload(["hall"], uploads[2].data, uploads[2].meta, ALL)
    return sorted(match.frame_id for match in answer.matches)


def pruned(engine):
    with engine.store.database.read() as connection:
        return find_map(connection, "hall").pruned_revision


def ended_ago(engine, state):
    """How many seconds ago frames in a state ended."""
    with engine.store.database.read() as connection:
        of = select(frames.c.ended_at).where(frames.c.state == state)
        ended = connection.execute(of).scalars().all()
    return [None if at is None else time.time() - at for at in ended]


def test_rows_of_deleted_frames_go_with_their_jobs_once_their_days_are_over(full, ids):
    full.tombstones = Tombstones(full.store, 0.0, full.bell.ring)
    names, use = ids(full), full.get_map("hall").used_frames
    with full.store.database.read() as connection:
        of = select(jobs.c.id).join(frames, frames.c.number == jobs.c.frame_number)
        job = connection.execute(of.where(frames.c.id == names[1])).scalar_one()
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
    assert pruned(full) == revision
    assert full.get_map("hall").used_frames == use - 2
    for missing in names[1:3]:
        with pytest.raises(UnknownFrame):
            full.get_frame("hall", missing)
    with pytest.raises(UnknownJob):
        full.get_job(job)
    assert after(full, 1000) == 0  # the living stay


@pytest.mark.parametrize("needed", ["job", "surface"])
def test_a_row_that_is_needed_stays(full, ids, needed):
    full.tombstones = Tombstones(full.store, 0.0, full.bell.ring)
    full.delete_frame("hall", ids(full)[0])
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
    assert pruned(full) == 0


def test_a_redundant_frame_goes_and_is_judged_anew_when_it_comes_again(full, uploads, work_off):
    camera = uploads[0].meta.intrinsics.model_copy(update={"cx": uploads[0].meta.intrinsics.cx + 1})
    meta = uploads[0].meta.model_copy(update={"intrinsics": camera})
    first, _ = full.add_frame("hall", uploads[0].data, meta, if_novel=0.9)
    work_off(full)
    assert full.get_frame("hall", first.frame_id).state == FrameState.REDUNDANT
    (ago,) = ended_ago(full, FrameState.REDUNDANT)
    assert ago is not None
    assert 0.0 <= ago < 60.0
    assert after(full, DAYS + 0.01) == 1
    assert pruned(full) == 0  # nobody searched it
    second, new = full.add_frame("hall", uploads[0].data, meta)
    assert new
    assert second.frame_id != first.frame_id


@pytest.mark.parametrize("tail_frames", [3, 100], ids=["index", "no index"])
def test_a_reader_that_missed_deletions_begins_anew(data, make_engine, uploads, ids, tail_frames):
    reader, builder = (make_engine(data, unindexed_frames=tail_frames) for _ in range(2))
    assert builder.publish_due() == (tail_frames == 3)
    names = ids(builder)
    assert found(reader, uploads) == sorted(names)
    builder.tombstones = Tombstones(builder.store, 0.0, builder.bell.ring)
    for name in names[4:6]:
        builder.delete_frame("hall", name)
    assert after(builder, DAYS + 1) == 2
    left = sorted(set(names) - set(names[4:6]))
    for engine in (reader, make_engine(data, unindexed_frames=tail_frames)):
        assert found(engine, uploads) == left
        assert engine.view("hall")[2].size == 10


def test_purging_leaves_no_byte_of_a_frame_whose_row_is_gone(data, make_engine, ids):
    """On a node that was off meanwhile: its index is built anew, as nobody knows what went."""
    engine = make_engine(data, unindexed_frames=11)
    assert engine.publish_due() == 1
    engine.tombstones = Tombstones(engine.store, 0.0, engine.bell.ring)
    for name in ids(engine)[:6]:
        engine.delete_frame("hall", name)
    assert after(engine, DAYS + 1) == 6
    with engine.store.database.read() as connection:
        row = find_map(connection, "hall")
    folder = index_folder(engine.settings.indexes, row)
    before = {path.name for path in folder.glob("*.faiss")}
    assert engine.purging.now().indexes == 1
    ((number, path),) = manifests(folder)
    assert (number, read_manifest(path).frames) == (2, 6)
    assert before.isdisjoint(path.name for path in folder.glob("*.faiss"))
    assert engine.purging.now().indexes == 0
