"""Tests of the scrub, which reads all stored bytes in slices and has damage repaired."""

import time

import pytest
from sqlalchemy import select, update

from sceneprint.maintenance.scrub import Scrub
from sceneprint.settings import Settings
from sceneprint.store.scrub_rows import PASS_S, SLICE_S, ScrubRow, read_scrub
from sceneprint.store.tables import frames, scrubs, signatures
from sceneprint_client.api import JobState
from tests.engine.conftest import flip


@pytest.fixture(autouse=True)
def _patient(monkeypatch):
    """Slices end by what they read, however slow the machine is."""
    monkeypatch.setattr("sceneprint.maintenance.scrub.TURN_S", 60.0)


def _scrub(engine, rate=1.0):
    settings = engine.settings.model_copy(update={"blob_check_mb_per_s": rate})
    return Scrub(settings, engine.store)


def _row(engine):
    with engine.store.database.read() as connection:
        return read_scrub(connection)


def _due(engine):
    with engine.store.database.write() as connection:
        connection.execute(update(scrubs).values(next_at=0.0))


def _blobs(engine):
    """Uploads, artifacts and ids of the frames, in their order."""
    with engine.store.database.read() as connection:
        rows = connection.execute(
            select(frames.c.blob, signatures.c.geometry, frames.c.id)
            .join(signatures, signatures.c.frame_number == frames.c.number)
            .order_by(frames.c.number)
        ).all()
    place = engine.store.blobs.path
    return [place(r[0]) for r in rows], [place(r[1]) for r in rows], [r[2] for r in rows]


def test_all_bytes_are_read_once_a_day(full):
    uploads, artifacts, _ = _blobs(full)
    before = time.time()
    row = _scrub(full).run(now=True)
    assert (row.blobs, row.damaged) == (len(uploads) + len(artifacts), 0)
    assert row.bytes == sum(one.stat().st_size for one in (*uploads, *artifacts))
    stored = _row(full)
    assert (stored.position, stored.blobs, stored.bytes) == (0, row.blobs, row.bytes)
    assert stored.finished_at is not None
    assert before <= stored.began_at <= stored.finished_at <= time.time()
    assert stored.next_at == stored.began_at + PASS_S
    assert _scrub(full).run(now=True) is None  # nobody else begins another
    told = full.statistics.collect().scrub
    assert (told.blobs, told.bytes, told.damaged) == (row.blobs, row.bytes, 0)


def test_damage_is_told_and_what_can_be_made_again_is(full, work_off):
    uploads, artifacts, ids = _blobs(full)
    sound = artifacts[1].read_bytes()
    flip(artifacts[1], 500)
    artifacts[2].unlink()
    flip(uploads[3], 500)
    with full.store.database.write() as connection:
        vector = select(signatures.c.vector).limit(1)
        size = len(connection.execute(vector).scalar_one())
        number = select(frames.c.number).where(frames.c.id == ids[4]).scalar_subquery()
        connection.execute(
            update(signatures)
            .where(signatures.c.frame_number == number)
            .values(vector=b"\7" * size)
        )
        connection.execute(update(frames).where(frames.c.id == ids[5]).values(pose_x=7.0))
    row = _scrub(full).run(now=True)
    assert row.damaged == 5
    wanted = full.events.wanted("hall", ["frame.damaged"])
    found = full.events.page(wanted).items
    assert {(one.frame_id, one.data.get("upload", False)) for one in found} == {
        (ids[1], False), (ids[2], False), (ids[3], True), (ids[4], False),
    }  # fmt: skip
    assert uploads[3].exists()  # nothing is moved while nobody looks
    assert work_off(full) == [JobState.SUCCEEDED] * 3
    assert artifacts[1].read_bytes() == sound
    assert artifacts[2].exists()
    _due(full)
    again = _scrub(full).run(now=True)
    assert again.damaged == 2  # the upload, until it is sent again, and the position


def test_a_slice_is_as_large_as_the_rate_and_goes_on_where_the_last_one_ended(full, monkeypatch):
    uploads, artifacts, _ = _blobs(full)
    monkeypatch.setattr("sceneprint.maintenance.scrub.AT_ONCE", 5)
    sizes = [a.stat().st_size + b.stat().st_size for a, b in zip(uploads, artifacts, strict=True)]
    rate = sizes[0] / 1e6 / SLICE_S  # a slice is over with the first five
    seen = []
    for _ in range(4):
        row = _scrub(full, rate).run(now=True)
        seen.append((row.blobs, row.bytes))
        stored = _row(full)
        if stored.finished_at is None:
            assert stored.next_at == pytest.approx(time.time() + SLICE_S, abs=30)
        _due(full)
    assert seen == [
        (10, sum(sizes[:5])), (20, sum(sizes[:10])), (24, sum(sizes)), (24, sum(sizes)),
    ]  # fmt: skip
    assert _row(full).finished_at is not None


def test_two_workers_do_not_read_the_same_slice(full):
    first, second = _scrub(full, 1e-6), _scrub(full, 1e-6)
    assert first.run(now=True) is not None
    assert second.run(now=True) is None


def test_none_is_read_where_it_is_switched_off(full):
    assert _scrub(full, 0.0).run(now=True) is None
    assert _row(full) is None
    assert Settings.model_fields["blob_check_mb_per_s"].default == 1.0


@pytest.mark.parametrize(
    ("next_at", "due"), [(100.0, True), (160.0, False), (101.0 + PASS_S, True)]
)
def test_a_clock_that_was_set_back_does_not_stop_it(next_at, due):
    assert ScrubRow(1, 0, next_at, 0.0, None, 0, 0, 0).is_due(100.0) is due
