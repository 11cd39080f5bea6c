"""Tests that damaged derived data is rebuilt from uploads during service."""

import pytest
from sqlalchemy import select, update

from sceneprint.engine.upkeep import repair
from sceneprint.engine.upkeep.repair import MOST, PAUSE_S, PRIORITY, resign_frames
from sceneprint.errors import DamagedBlob
from sceneprint.store.frames import set_state
from sceneprint.store.maps import find_map
from sceneprint.store.tables import frames, jobs, signatures
from sceneprint_client.api import FrameState, JobState, Query


def row_of(engine):
    with engine.store.database.read() as connection:
        return find_map(connection, "hall")


def number_of(engine, frame_id):
    with engine.store.database.read() as connection:
        found = connection.execute(select(frames.c.number).where(frames.c.id == frame_id))
        return int(found.scalar_one())


def column(engine, frame_id, name):
    asked = select(signatures.c[name]).where(
        signatures.c.frame_number == number_of(engine, frame_id)
    )
    with engine.store.database.read() as connection:
        return connection.execute(asked).scalar_one()


def artifact(engine, frame_id):
    return engine.store.blobs.path(column(engine, frame_id, "geometry"))


def waiting(engine):
    asked = select(jobs).where(jobs.c.state == JobState.QUEUED)
    with engine.store.database.read() as connection:
        return list(connection.execute(asked).all())


def damage(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 8
    path.write_bytes(data)
    return bytes(data)


def damage_signature(engine, frame_id):
    """Change a byte of the vector, and return the sound one."""
    sound = column(engine, frame_id, "vector")
    data = bytearray(sound)
    data[100] ^= 8
    own = signatures.c.frame_number == number_of(engine, frame_id)
    with engine.store.database.write() as connection:
        connection.execute(update(signatures).where(own).values(vector=bytes(data)))
    return sound


def statuses(answer):
    return {m.frame_id: (m.validation.status, m.validation.reason) for m in answer.matches}


@pytest.mark.parametrize("how", ["changed", "missing"])
def test_a_damaged_artifact_is_skipped_and_soon_made_again(full, uploads, ids, work_off, how):
    asked = uploads[1]
    before = full.queries.upload(["hall"], asked.data, asked.meta, Query())
    hurt = before.matches[0].frame_id
    path = artifact(full, hurt)
    sound, revision = path.read_bytes(), row_of(full).revision
    path.unlink() if how == "missing" else damage(path)
    full.store.geometries.forget_older(0)  # as after a while
    for _ in range(3):  # a crowd of queries is one job
        answer = full.queries.upload(["hall"], asked.data, asked.meta, Query())
        status, reason = statuses(answer)[hurt]
        assert status == "skipped"
        assert "blob" in str(reason)
        others = {k: v for k, v in statuses(answer).items() if k != hurt}
        assert (
            others.items()
            >= {
                k: v for k, v in statuses(before).items() if k != hurt and v[0] == "accepted"
            }.items()
        )
    (job,) = waiting(full)
    assert (job.kind, job.frame_number, job.priority) == (
        "reencode",
        number_of(full, hurt),
        PRIORITY,
    )
    assert full.get_frame("hall", hurt).state == "indexed"
    assert work_off(full) == [JobState.SUCCEEDED]
    assert path.read_bytes() == sound
    assert statuses(full.queries.upload(["hall"], asked.data, asked.meta, Query())) == statuses(
        before
    )
    # the signature is the same, and nobody has anything to learn
    assert row_of(full).revision == revision
    assert waiting(full) == []


def test_a_frame_whose_own_artifact_is_damaged_is_answered_and_soon_well(full, ids, work_off):
    hurt = ids(full)[3]
    before = full.query_frame("hall", hurt, Query())
    damage(artifact(full, hurt))
    answer = full.query_frame("hall", hurt, Query())
    assert statuses(answer) == statuses(before)
    assert [m.transform for m in answer.matches] == [m.transform for m in before.matches]
    wanted = full.events.wanted("hall", ["frame.damaged"])
    (event,) = full.events.page(wanted).items
    assert (event.frame_id, event.job_id) == (hurt, waiting(full)[0].id)
    assert [job.frame_number for job in waiting(full)] == [number_of(full, hurt)]
    assert work_off(full) == [JobState.SUCCEEDED]
    assert statuses(full.query_frame("hall", hurt, Query())) == statuses(before)


def test_a_damaged_signature_is_never_compared_and_soon_made_again(
    full, make_engine, uploads, ids, work_off
):
    hurt, ask = ids(full)[3], Query(stages=("retrieve",), k=50)
    others = full.query_frame("hall", hurt, ask)
    sound = damage_signature(full, hurt)
    answer = full.query_frame("hall", hurt, ask)
    assert [(m.frame_id, m.distance) for m in answer.matches] == [
        (m.frame_id, m.distance) for m in others.matches
    ]
    assert [job.frame_number for job in waiting(full)] == [number_of(full, hurt)]
    fresh = make_engine()  # `full` holds it from before
    answer = fresh.queries.upload(["hall"], uploads[3].data, uploads[3].meta, ask)
    assert [(m.frame_id, m.distance) for m in answer.matches] == [
        (m.frame_id, m.distance) for m in others.matches
    ]
    assert work_off(full) == [JobState.SUCCEEDED]
    assert column(full, hurt, "vector") == sound
    for engine in (fresh, full):  # one that passed it over, and one that held it
        answer = engine.queries.upload(["hall"], uploads[3].data, uploads[3].meta, ask)
        assert (answer.matches[0].frame_id, answer.matches[0].distance) == (hurt, 0)
        assert len(answer.matches) == answer.counts.map == 12
        assert len({m.frame_id for m in answer.matches}) == 12


def test_who_passes_a_damaged_signature_over_has_it_made_again(
    full, make_engine, uploads, ids, work_off
):
    hurt, ask = ids(full)[3], Query(stages=("retrieve",), k=50)
    damage_signature(full, hurt)
    answer = full.queries.upload(["hall"], uploads[3].data, uploads[3].meta, ask)
    assert hurt not in [m.frame_id for m in answer.matches]
    assert [job.frame_number for job in waiting(full)] == [number_of(full, hurt)]
    assert work_off(full) == [JobState.SUCCEEDED]
    answer = full.queries.upload(["hall"], uploads[3].data, uploads[3].meta, ask)
    assert answer.matches[0].frame_id == hurt
    assert full.view("hall")[2].damaged == frozenset()
    # now by whoever publishes an index
    other = ids(full)[4]
    damage_signature(full, other)
    assert make_engine(unindexed_frames=1).publish_due() == 1
    assert [job.frame_number for job in waiting(full)] == [number_of(full, other)]
    assert work_off(full) == [JobState.SUCCEEDED]
    answer = make_engine().queries.upload(["hall"], uploads[4].data, uploads[4].meta, ask)
    assert (answer.index_version, answer.matches[0].frame_id) == (1, other)
    assert len(answer.matches) == answer.counts.map == 12


def test_a_frame_with_nothing_sound_left_says_so(full, ids):
    hurt = ids(full)[3]
    damage(artifact(full, hurt))
    with full.store.database.read() as connection:
        blob = connection.execute(select(frames.c.blob).where(frames.c.id == hurt)).scalar_one()
    damage(full.store.blobs.path(blob))
    with pytest.raises(DamagedBlob, match=f"blob {blob[:12]} is damaged"):
        full.query_frame("hall", hurt, Query())


def test_what_cannot_be_healed_is_not_tried_for_ever(full, uploads, ids, work_off, due_now):
    hurt = ids(full)[1]
    artifact(full, hurt).unlink()
    with full.store.database.read() as connection:
        blob = connection.execute(select(frames.c.blob).where(frames.c.id == hurt)).scalar_one()
    full.store.blobs.path(blob).unlink()

    def ask():
        return full.queries.upload(["hall"], uploads[1].data, uploads[1].meta, Query())

    assert statuses(ask())[hurt][0] == "skipped"
    for _ in range(3):
        assert len(work_off(full)) == 1
        due_now(full)
    assert full.statistics.state_counts()[1]["dead"] == 1
    assert statuses(ask())[hurt][0] == "skipped"
    assert waiting(full) == []
    assert full.get_frame("hall", hurt).state == "indexed"  # it is found all the while
    with full.store.database.write() as connection:
        connection.execute(update(jobs).values(created_at=jobs.c.created_at - PAUSE_S))
    ask()
    assert len(waiting(full)) == 1


def test_an_upload_that_comes_again_heals_all_that_was_lost(full, uploads, ids, work_off):
    hurt, each = ids(full)[2], uploads[2]
    path = artifact(full, hurt)
    sound = path.read_bytes()
    path.unlink()
    with full.store.database.read() as connection:
        blob = connection.execute(select(frames.c.blob).where(frames.c.id == hurt)).scalar_one()
    damage(full.store.blobs.path(blob))
    added, new = full.add_frame("hall", each.data, each.meta)
    assert (added.frame_id, added.state, new) == (hurt, "indexed", False)
    assert full.store.blobs.get(blob) == each.data
    assert work_off(full) == [JobState.SUCCEEDED]
    assert path.read_bytes() == sound


def test_an_upload_that_comes_again_otherwise_packed_takes_the_place(full, uploads, ids):
    """Other bytes of the same content: the frame refers to them, and nothing to the damaged."""
    import io

    from PIL import Image

    hurt, each = ids(full)[2], uploads[2]
    with full.store.database.read() as connection:
        blob = connection.execute(select(frames.c.blob).where(frames.c.id == hurt)).scalar_one()
    out = io.BytesIO()
    Image.open(io.BytesIO(each.data)).save(out, "PNG", compress_level=1)
    for _ in range(2):
        damage(full.store.blobs.path(blob))
        added, new = full.add_frame("hall", out.getvalue(), each.meta)
        assert (added.frame_id, new) == (hurt, False)
        with full.store.database.read() as connection:
            asked = select(frames.c.blob, frames.c.bytes).where(frames.c.id == hurt)
            now, size = connection.execute(asked).one()
        assert full.store.blobs.get(now) == out.getvalue()
        assert size == len(out.getvalue())
        assert (full.store.blobs.holds(blob), blob == now) in ((False, False), (True, True))
        blob = now


def test_at_most_so_many_a_query_and_none_that_is_not_indexed(full, ids):
    row, numbers = row_of(full), [number_of(full, one) for one in ids(full)]
    full.delete_frame("hall", ids(full)[0])
    with full.store.database.write() as connection:
        set_state(connection, numbers[6], FrameState.FAILED)
    assert resign_frames(full.store, row, [numbers[0], numbers[6]], row.model_id) == 0
    assert resign_frames(full.store, row, [numbers[1]] * 3 + [10**6], row.model_id) == 1
    assert resign_frames(full.store, row, numbers[1:3], row.model_id) == 1
    assert len(numbers) < MOST < 100
    assert resign_frames(full.store, row, list(range(10**6, 10**6 + 100)), row.model_id) == 0


def test_a_store_that_cannot_be_written_costs_no_answer(full, uploads, caplog):
    frame = full.list_frames("hall").items[0].frame_id
    damage(artifact(full, frame))
    with full.store.database.write() as connection:
        connection.exec_driver_sql("ALTER TABLE jobs RENAME TO away")
    answer = full.queries.upload(["hall"], uploads[0].data, uploads[0].meta, Query())
    assert statuses(answer)[frame][0] == "skipped"
    assert answer.status == "found"
    assert "repair failed" in caplog.text


def test_frames_that_cannot_be_healed_keep_no_other_from_it(full, ids, monkeypatch):
    monkeypatch.setattr(repair, "MOST", 2)
    monkeypatch.setattr(repair, "PAUSE_S", 0.0)
    names = ids(full)
    numbers = [number_of(full, name) for name in names]
    with full.store.database.write() as connection:  # uploads of the first are known to be lost
        connection.execute(
            update(frames)
            .where(frames.c.number.in_(numbers[:6]))
            .values(reason=repair.reason_of_loss("missing", found=True))
        )
    for _ in range(200):
        resign_frames(full.store, row_of(full), numbers, row_of(full).model_id)
        if {job.frame_number for job in waiting(full)} == set(numbers[6:]):
            break
    tried = [job.frame_number for job in waiting(full)]
    assert sorted(tried) == sorted(numbers[6:])  # each once, and of the others none
