"""Tests that damage is found, by the scrub and by queries, and repaired from uploads."""

import time

import pytest
from sqlalchemy import select, update

from sceneprint.engine.upkeep.repair import PAUSE_S, PRIORITY
from sceneprint.errors import DamagedBlob
from sceneprint.maintenance.scrub import Scrub
from sceneprint.store.scrub_rows import PASS_S, SLICE_S, ScrubRow, read_scrub
from sceneprint.store.tables import frames, jobs, scrubs, signatures
from sceneprint_client.api import JobState, Query
from tests.engine.conftest import flip, packed_again


def number_of(engine, frame_id):
    actual = engine.fetch(select(frames.c.number).where(frames.c.id == frame_id))
    return int(actual.scalar_one())


def column(engine, frame_id, name):
    statement = select(signatures.c[name]).where(
        signatures.c.frame_number == number_of(engine, frame_id)
    )
    return engine.fetch(statement).scalar_one()


def upload_of(engine, frame_id):
    return engine.fetch(select(frames.c.blob).where(frames.c.id == frame_id)).scalar_one()


def artifact(engine, frame_id):
    return engine.store.blobs.path(column(engine, frame_id, "geometry"))


def waiting(engine):
    statement = select(jobs).where(jobs.c.state == JobState.QUEUED)
    return list(engine.fetch(statement).all())


def damage_signature(engine, frame_id):
    """Change a byte of the vector, and return the sound one."""
    sound = column(engine, frame_id, "vector")
    data = bytearray(sound)
    data[100] ^= 8
    own = signatures.c.frame_number == number_of(engine, frame_id)
    engine.write(update(signatures).where(own).values(vector=bytes(data)))
    return sound


def statuses(answer):
    return {m.frame_id: (m.validation.status, m.validation.reason) for m in answer.matches}


@pytest.mark.parametrize("how", ["changed", "missing"])
def test_a_damaged_artifact_is_skipped_and_soon_made_again(full, uploads, how):
    def ask():
        return statuses(full.ask(uploads[1]))

    before = ask()
    hurt = full.ids()[1]
    path = artifact(full, hurt)
    sound, revision = path.read_bytes(), full.row("hall").revision
    path.unlink() if how == "missing" else flip(path, 500)
    full.store.geometries.forget_older(0)  # as after a while
    accepted = {name for name, one in before.items() if one[0] == "accepted"} - {hurt}
    for _ in range(3):  # a crowd of queries is one job
        now = ask()
        assert now[hurt][0] == "skipped"
        assert "blob" in str(now[hurt][1])
        assert all(now[name] == before[name] for name in accepted)
    (job,) = waiting(full)
    wanted = ("reencode", number_of(full, hurt), PRIORITY)
    assert (job.kind, job.frame_number, job.priority) == wanted
    assert full.get_frame("hall", hurt).state == "indexed"
    assert full.work_off() == [JobState.SUCCEEDED]
    assert path.read_bytes() == sound
    assert ask() == before
    assert full.row("hall").revision == revision
    assert waiting(full) == []


def test_a_frame_whose_own_artifact_is_damaged_is_answered_and_soon_well(full):
    hurt = full.ids()[3]
    before = full.query_frame("hall", hurt, Query())
    flip(artifact(full, hurt), 500)
    answer = full.query_frame("hall", hurt, Query())
    assert statuses(answer) == statuses(before)
    assert [m.transform for m in answer.matches] == [m.transform for m in before.matches]
    wanted = full.events.wanted("hall", ["frame.damaged"])
    (event,) = full.events.page(wanted).items
    assert (event.frame_id, event.job_id) == (hurt, waiting(full)[0].id)
    assert [job.frame_number for job in waiting(full)] == [number_of(full, hurt)]
    assert full.work_off() == [JobState.SUCCEEDED]
    assert statuses(full.query_frame("hall", hurt, Query())) == statuses(before)


def test_a_damaged_signature_is_never_compared_and_soon_made_again(full, make_engine, uploads):
    hurt, query = full.ids()[3], Query(stages=("retrieve",), k=50)

    def ask(engine):
        answer = engine.ask(uploads[3], query)
        return [(m.frame_id, m.distance) for m in answer.matches]

    whole = ask(full)
    assert whole[0] == (hurt, 0)
    sound = damage_signature(full, hurt)
    fresh = make_engine()  # `full` holds it from before
    assert ask(fresh) == whole[1:]
    assert [job.frame_number for job in waiting(full)] == [number_of(full, hurt)]
    assert full.work_off() == [JobState.SUCCEEDED]
    assert column(full, hurt, "vector") == sound
    for engine in (fresh, full):  # one that passed it over, and one that held it
        assert ask(engine) == whole


def test_a_frame_with_nothing_sound_left_says_so(full):
    hurt = full.ids()[3]
    flip(artifact(full, hurt), 500)
    blob = upload_of(full, hurt)
    flip(full.store.blobs.path(blob), 500)
    with pytest.raises(DamagedBlob, match=f"blob {blob[:12]} is damaged"):
        full.query_frame("hall", hurt, Query())


def test_what_cannot_be_healed_is_not_tried_for_ever(full, uploads):
    hurt = full.ids()[1]
    artifact(full, hurt).unlink()
    full.store.blobs.path(upload_of(full, hurt)).unlink()

    def ask():
        return full.ask(uploads[1])

    assert statuses(ask())[hurt][0] == "skipped"
    for _ in range(3):
        assert len(full.work_off()) == 1
        full.make_due()
    assert full.statistics.state_counts()[1]["dead"] == 1
    assert statuses(ask())[hurt][0] == "skipped"
    assert waiting(full) == []
    assert full.get_frame("hall", hurt).state == "indexed"  # it is found all the while
    full.write(update(jobs).values(created_at=jobs.c.created_at - PAUSE_S))
    ask()
    assert len(waiting(full)) == 1


def test_an_upload_that_comes_again_otherwise_packed_takes_the_place(full, uploads):
    hurt, each = full.ids()[2], uploads[2]
    other = packed_again(each.data, 1)
    blob = upload_of(full, hurt)
    flip(full.store.blobs.path(blob), 500)
    added, new = full.add_frame("hall", other, each.meta)
    assert (added.frame_id, new) == (hurt, False)
    now = upload_of(full, hurt)
    assert full.store.blobs.get(now) == other
    assert full.get_frame("hall", hurt).bytes == len(other)
    assert not full.store.blobs.holds(blob)


def test_a_store_that_cannot_be_written_costs_no_answer(full, uploads, caplog):
    frame = full.list_frames("hall").items[0].frame_id
    flip(artifact(full, frame), 500)
    with full.store.database.write() as connection:
        connection.exec_driver_sql("ALTER TABLE jobs RENAME TO away")
    answer = full.ask(uploads[0])
    assert statuses(answer)[frame][0] == "skipped"
    assert answer.status == "found"
    assert "repair failed" in caplog.text


@pytest.fixture(autouse=True)
def _patient(monkeypatch):
    """Slices end by what they read, however slow the machine is."""
    monkeypatch.setattr("sceneprint.maintenance.scrub.TURN_S", 60.0)


def _scrub(engine, rate=1.0):
    settings = engine.settings.model_copy(update={"blob_check_mb_per_s": rate})
    scrub = Scrub(settings, engine.store)
    scrub._next = 0.0
    return scrub


def _row(engine):
    with engine.store.database.read() as connection:
        return read_scrub(connection)


def _due(engine):
    engine.write(update(scrubs).values(next_at=0.0))


def _blobs(engine):
    """Uploads, artifacts and ids of the frames, in their order."""
    rows = engine.fetch(
        select(frames.c.blob, signatures.c.geometry, frames.c.id)
        .join(signatures, signatures.c.frame_number == frames.c.number)
        .order_by(frames.c.number)
    ).all()
    place = engine.store.blobs.path
    return [place(r[0]) for r in rows], [place(r[1]) for r in rows], [r[2] for r in rows]


def test_all_bytes_are_read_once_a_day(full):
    uploads, artifacts, _ = _blobs(full)
    before = time.time()
    row = _scrub(full).run()
    assert (row.blobs, row.damaged) == (len(uploads) + len(artifacts), 0)
    assert row.bytes == sum(one.stat().st_size for one in (*uploads, *artifacts))
    stored = _row(full)
    assert (stored.position, stored.blobs, stored.bytes) == (0, row.blobs, row.bytes)
    assert stored.finished_at is not None
    assert before <= stored.began_at <= stored.finished_at <= time.time()
    assert stored.next_at == stored.began_at + PASS_S
    assert _scrub(full).run() is None  # nobody else begins another
    result = full.statistics.collect().scrub
    assert (result.blobs, result.bytes, result.damaged) == (row.blobs, row.bytes, 0)


def test_damage_is_told_and_what_can_be_made_again_is(full):
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
    row = _scrub(full).run()
    assert row.damaged == 5
    wanted = full.events.wanted("hall", ["frame.damaged"])
    actual = full.events.page(wanted).items
    assert {(item.frame_id, item.data.get("upload", False)) for item in actual} == {
        (ids[1], False), (ids[2], False), (ids[3], True), (ids[4], False),
    }  # fmt: skip
    assert uploads[3].exists()  # nothing is moved while nobody looks
    assert full.work_off() == [JobState.SUCCEEDED] * 3
    assert artifacts[1].read_bytes() == sound
    assert artifacts[2].exists()
    _due(full)
    again = _scrub(full).run()
    assert again.damaged == 2  # the upload, until it is sent again, and the position


def test_a_slice_is_as_large_as_the_rate_and_goes_on_where_the_last_one_ended(full, monkeypatch):
    uploads, artifacts, _ = _blobs(full)
    monkeypatch.setattr("sceneprint.maintenance.scrub.AT_ONCE", 5)
    sizes = [a.stat().st_size + b.stat().st_size for a, b in zip(uploads, artifacts, strict=True)]
    rate = sizes[0] / 1e6 / SLICE_S  # a slice is over with the first five
    seen = []
    for _ in range(4):
        row = _scrub(full, rate).run()
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
    assert first.run() is not None
    assert second.run() is None


@pytest.mark.parametrize(
    ("next_at", "due"), [(100.0, True), (160.0, False), (101.0 + PASS_S, True)]
)
def test_a_clock_that_was_set_back_does_not_stop_it(next_at, due):
    assert ScrubRow(1, 0, next_at, 0.0, None, 0, 0, 0).is_due(100.0) is due
