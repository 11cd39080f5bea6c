"""Tests of jobs, short and long, that fail, are cancelled, retried or taken over."""

import io
from functools import partial

import numpy as np
import pytest
from PIL import Image
from sqlalchemy import update

from sceneprint.engine.jobs.lifecycle import cancel, list_jobs, worker_died
from sceneprint.engine.jobs.tasks import LongJob, SliceResult
from sceneprint.engine.maps.tombstones import Tombstones
from sceneprint.engine.upkeep.garbage_collection import collect_blobs
from sceneprint.errors import CannotRetry, InvalidRequest, JobOver, UnknownJob
from sceneprint.store import queue
from sceneprint.store.maps import find_map
from sceneprint.store.queue import JobFile, find_job, items_of, read_clock, remove_job
from sceneprint.store.signatures import changes_since
from sceneprint.store.tables import jobs
from sceneprint_client.api import FrameMeta, FrameState, JobState
from tests.engine.conftest import packed_again


def row(engine, job_id):
    with engine.store.database.read() as connection:
        return queue.find_job(connection, job_id)


def die(engine, work, *, counts=True):
    held = work.job
    return worker_died(engine.store, held.id, held.token, "signal 11", "Fatal", counts=counts)


def test_a_cancelled_job_is_done_by_nobody_and_can_be_tried_again(empty, uploads):
    added, _ = empty.add_frame("hall", uploads[0].data, uploads[0].meta, 7)
    cancelled = cancel(empty.store, added.job_id)
    assert (cancelled.state, cancelled.priority) == (JobState.CANCELLED, 7)
    assert cancel(empty.store, added.job_id) == cancelled  # who asks twice is not refused
    frame = empty.get_frame("hall", added.frame_id)
    assert (frame.state, frame.reason) == (FrameState.FAILED, "its job was cancelled")
    assert empty.work_off() == []
    again, new = empty.retry_job(added.job_id)
    assert (new, again.state, again.priority, again.attempts) == (True, JobState.QUEUED, 7, 0)
    assert (again.job_id != added.job_id, again.frame_id) == (True, added.frame_id)
    assert empty.retry_job(added.job_id) == (again, False)  # nor is it tried twice
    frame = empty.get_frame("hall", added.frame_id)
    assert (frame.state, frame.reason, frame.job_id) == (FrameState.RECEIVED, None, again.job_id)
    with pytest.raises(CannotRetry, match="is queued and its frame is received"):
        empty.retry_job(again.job_id)
    assert empty.work_off() == [JobState.SUCCEEDED]
    assert empty.event_kinds()[1:] == [
        "frame.received",
        "frame.failed",
        "frame.received",
        "frame.indexed",
    ]
    with pytest.raises(JobOver, match=r"is succeeded: .* It cannot be cancelled\."):
        cancel(empty.store, again.job_id)
    with pytest.raises(CannotRetry, match="is succeeded and its frame is indexed"):
        empty.retry_job(again.job_id)
    replaced = f"was replaced by job {again.job_id}, whose state is succeeded"
    with pytest.raises(CannotRetry, match=replaced):
        empty.retry_job(added.job_id)
    for ask in (partial(cancel, empty.store), empty.retry_job):
        with pytest.raises(UnknownJob, match="nobody"):
            ask("nobody")


def test_what_is_cancelled_while_it_is_signed_is_not_stored(empty, uploads):
    added, _ = empty.add(uploads[0])
    work = empty.claim("w")
    assert cancel(empty.store, added.job_id).state == JobState.CANCELLED
    assert empty.run(work) is None
    assert empty.get_frame("hall", added.frame_id).state == FrameState.FAILED
    assert empty.get_map("hall").revision == 0
    assert len(list(empty.store.blobs.digests())) == 1  # the upload, and no artifact


def test_what_cannot_be_signed_again_is_refused_with_the_reason(empty, uploads):
    lost, _ = empty.add(uploads[0])
    gone, _ = empty.add(uploads[1])
    cancel(empty.store, lost.job_id)
    cancel(empty.store, gone.job_id)
    empty.store.blobs.remove(empty.store.blobs.put(uploads[0].data))
    with pytest.raises(CannotRetry, match=f"The upload of frame {lost.frame_id} is missing"):
        empty.retry_job(lost.job_id)
    assert empty.get_frame("hall", lost.frame_id).state == FrameState.FAILED
    empty.delete_frame("hall", gone.frame_id)
    with pytest.raises(CannotRetry, match="is cancelled and its frame is deleted"):
        empty.retry_job(gone.job_id)


def test_all_dead_jobs_are_tried_again_page_by_page(empty, uploads):
    added = [empty.add(upload)[0] for upload in uploads[:4]]
    for _ in added:
        while die(empty, empty.claim("w")) != JobState.DEAD:
            empty.make_due()
    ids = [frame.job_id for frame in added]
    empty.store.blobs.remove(empty.store.blobs.put(uploads[1].data))
    empty.retry_job(ids[3])  # by hand, before, and with success
    assert empty.run(empty.claim("w")) == JobState.SUCCEEDED
    first = empty.retry_dead_jobs(limit=2)  # the newest: 3, which has a follower, and 2
    assert [frame.frame_id for frame in first.retried] == [added[2].frame_id]
    assert first.refused == []
    second = empty.retry_dead_jobs(first.next_cursor, limit=2)
    assert [frame.frame_id for frame in second.retried] == [added[0].frame_id]
    assert [frame.job_id for frame in second.refused] == [ids[1]]
    assert "is missing" in second.refused[0].reason
    assert second.next_cursor is None
    waiting = {job.job_id for job in list_jobs(empty.store, JobState.QUEUED).items}
    assert waiting == {first.retried[0].job_id, second.retried[0].job_id}
    counted = {"dead": 1, "queued": 2, "succeeded": 1}  # of retried jobs only the latest
    assert empty.statistics.collect(1, "hall").jobs == counted == empty.statistics.collect(1).jobs
    again = empty.retry_dead_jobs()
    assert (again.retried, [frame.job_id for frame in again.refused]) == ([], [ids[1]])
    assert empty.retry_dead_jobs(map_names=("elsewhere",)).refused == []


def test_a_death_counts_where_another_has_the_job_by_now(empty, uploads):
    added, _ = empty.add(uploads[0])
    works = []
    for _ in range(4):
        works.append(empty.claim("w"))
        empty.make_due()
    assert die(empty, works[0], counts=False) is None
    assert die(empty, works[0]) is None
    job = row(empty, added.job_id)
    assert (job.state, job.token, job.failures) == (JobState.RUNNING, 4, 1)
    assert (job.error, job.traceback) == ("signal 11", "Fatal")
    assert die(empty, works[1]) is None
    assert die(empty, works[2]) == JobState.DEAD  # though a fourth is at it still
    assert die(empty, works[0]) is None  # it is over
    assert row(empty, added.job_id).failures == 3
    assert empty.run(works[3]) is None
    frame = empty.get_frame("hall", added.frame_id)
    assert (frame.state, frame.reason) == (FrameState.FAILED, "signal 11")


def test_when_there_is_something_to_do_next(empty, uploads):
    assert empty.jobs.due_in_s() is None
    for upload in uploads[:3]:
        empty.add(upload)
    running = empty.claim("w").job
    with empty.store.database.write() as connection:
        start = read_clock(connection)
        connection.execute(update(jobs).values(run_after=start + 50.0))
        connection.execute(update(jobs).where(jobs.c.number == 3).values(run_after=start + 40.0))
    assert 20.0 < empty.jobs.due_in_s() <= 40.0
    changed = update(jobs).where(jobs.c.number == running.number)
    empty.write(changed.values(leased_until=start + 20.0, run_after=1.0))
    assert 0.0 < empty.jobs.due_in_s() <= 20.0


def png(samples):
    out = io.BytesIO()
    Image.fromarray(samples.astype(np.uint16)).save(out, "PNG")
    return out.getvalue()


def changes(engine):
    with engine.store.database.read() as connection:
        row = find_map(connection, "hall")
        return [change for block in changes_since(connection, row, 0) for change in block]


def test_a_frame_with_nothing_to_sign_is_rejected_with_the_reason(empty, uploads):
    samples = np.full((480, 640), 60_000)  # beyond the range of the model
    meta = FrameMeta(intrinsics=uploads[0].meta.intrinsics)
    added, _ = empty.add_frame("hall", png(samples), meta)
    assert empty.work_off() == [JobState.FAILED]
    frame, job = empty.get_frame("hall", added.frame_id), empty.get_job(added.job_id)
    assert frame.state == FrameState.REJECTED
    assert frame.reason == job.error
    assert frame.reason
    assert added.frame_id not in frame.reason
    assert (job.state, job.attempts, job.traceback) == (JobState.FAILED, 1, None)
    assert job.finished_at is not None
    assert empty.event_kinds()[-1] == "frame.rejected"
    again, new = empty.add_frame("hall", png(samples), meta)
    assert (new, again.state, again.reason) == (False, FrameState.REJECTED, frame.reason)
    assert changes(empty) == []
    assert empty.get_map("hall").revision == 0
    empty.tombstones = Tombstones(empty.store, 0.0, empty.bell.ring)
    empty.delete_frame("hall", added.frame_id)
    assert list(empty.store.blobs.digests()) == []
    assert empty.get_job(added.job_id).state == JobState.FAILED


def test_a_frame_whose_blob_is_gone_is_tried_thrice_and_failed(empty, uploads):
    added, _ = empty.add(uploads[0])
    empty.store.blobs.remove(empty.store.blobs.put(uploads[0].data))
    for _ in range(2):
        claimed = empty.claim("w")
        assert empty.get_frame("hall", added.frame_id).state == FrameState.SIGNING
        assert empty.run(claimed) == JobState.QUEUED
        frame = empty.get_frame("hall", added.frame_id)
        assert (frame.state, frame.reason) == (FrameState.RECEIVED, None)
        assert empty.claim("w") is None  # not at once
        empty.make_due()
    assert empty.run(empty.claim("w")) == JobState.DEAD
    frame, job = empty.get_frame("hall", added.frame_id), empty.get_job(added.job_id)
    assert (frame.state, job.state, job.attempts) == (FrameState.FAILED, JobState.DEAD, 3)
    assert frame.reason == job.error
    assert "cannot be read (No such file or directory)" in frame.reason
    assert "DamagedBlob" in job.traceback
    assert empty.event_kinds() == ["map.created", "frame.received", "frame.failed"]
    # sent once more, in another packing, it is tried once more: the same frame, another job
    again, new = empty.add_frame("hall", packed_again(uploads[0].data), uploads[0].meta)
    assert (again.frame_id, new, again.state) == (added.frame_id, True, FrameState.RECEIVED)
    assert again.job_id != added.job_id
    assert empty.run(empty.claim("w")) == JobState.SUCCEEDED
    frame = empty.get_frame("hall", added.frame_id)
    assert (frame.state, frame.reason, frame.job_id) == (FrameState.INDEXED, None, again.job_id)
    assert len(list(empty.store.blobs.digests())) == 2  # upload and artifact


@pytest.mark.parametrize("how", ["frame", "map"])
def test_what_is_deleted_while_it_is_signed_stays_deleted(empty, uploads, how):
    added, _ = empty.add(uploads[0])
    claimed = empty.claim("w")
    assert claimed is not None
    if how == "map":
        empty.delete_map("hall")
    else:
        empty.delete_frame("hall", added.frame_id)
        assert empty.get_job(added.job_id).state == JobState.CANCELLED
    empty.store.blobs.put(uploads[0].data)  # it had read it before
    assert empty.run(claimed) is None
    assert empty.event_kinds()[-1] == f"{how}.deleted"
    if how == "frame":
        assert empty.get_frame("hall", added.frame_id).state == FrameState.DELETED
        assert empty.get_map("hall").revision == 1
    empty.store.blobs.remove(empty.store.blobs.put(uploads[0].data))
    assert list(empty.store.blobs.digests()) == []  # nor is what it made kept


@pytest.fixture
def engine(empty):
    return empty


def count_to(engine, most):
    """A handler that finds one number a slice, and keeps a file of each."""

    def handle(task, _):
        done = task.progress.get("done", 0)
        blob = engine.store.blobs.put(f"part {done}".encode())
        return SliceResult(
            over=done + 1 == most,
            progress={"done": done + 1, "total": most},
            items=[{"n": done}],
            files=[JobFile("part", blob, 6, "text/plain")],
            result={"sum": sum(range(most))} if done + 1 == most else None,
            event="numbers.found",
        )

    return handle


def items(engine, job):
    with engine.store.database.read() as connection:
        number = find_job(connection, job.job_id).number
        return [item["n"] for item in items_of(connection, number)]


def test_each_slice_is_kept_and_the_last_one_ends_the_job(engine):
    engine.handle("count", count_to(engine, 3))
    job, _ = engine.begin_task("count", "hall", {"to": 3})
    assert (job.kind, job.map, job.frame_id, job.progress) == ("count", "hall", None, None)
    claimed = engine.claim("w")
    assert (claimed.data, claimed.of_map.name) == ({"to": 3}, "hall")
    assert engine.run(claimed) == JobState.QUEUED
    between = engine.get_job(job.job_id)
    assert (between.state, between.attempts, between.result) == (JobState.QUEUED, 1, None)
    assert (between.progress.done, between.progress.total) == (1, 3)
    assert engine.work_off() == [JobState.QUEUED, JobState.SUCCEEDED]
    ended = engine.get_job(job.job_id)
    assert (ended.state, ended.result) == (JobState.SUCCEEDED, {"sum": 3})
    assert items(engine, job) == [0, 1, 2]
    (event,) = engine.events.page(engine.events.wanted("hall", ["numbers."])).items
    assert (event.kind, event.job_id, event.data) == ("numbers.found", job.job_id, {"sum": 3})
    [blob] = engine.store.blobs.digests()  # each file takes the place of the one before
    assert engine.store.blobs.get(blob) == b"part 2"


def test_a_slice_of_a_worker_that_fell_silent_counts_once(engine):
    engine.handle("count", count_to(engine, 2))
    job, _ = engine.begin_task("count", "hall", {})
    late = engine.claim("silent")
    engine.write(update(jobs).values(leased_until=1.0))
    assert engine.work_off() == [JobState.QUEUED, JobState.SUCCEEDED]
    assert engine.run(late) is None  # its slice is refused whole
    assert items(engine, job) == [0, 1]


def test_what_cannot_be_done_fails_at_once_and_goes_on_when_retried(engine):
    able = False

    def handle(task, is_over):
        if task.progress and not able:
            raise InvalidRequest("the second step is impossible")
        return count_to(engine, 3)(task, is_over)

    engine.handle("count", handle)
    job, _ = engine.begin_task("count", "hall", {})
    assert engine.work_off() == [JobState.QUEUED, JobState.FAILED]
    failed = engine.get_job(job.job_id)
    assert (failed.error, failed.traceback) == ("the second step is impossible", None)
    able = True
    again, new = engine.retry_job(job.job_id)
    assert (again.job_id, again.state, new) == (job.job_id, JobState.QUEUED, True)
    assert engine.retry_job(job.job_id)[1] is False  # it waits already
    assert engine.work_off() == [JobState.QUEUED, JobState.SUCCEEDED]
    assert items(engine, job) == [0, 1, 2]
    with pytest.raises(CannotRetry, match="so no retry is needed"):
        engine.retry_job(job.job_id)


def test_a_map_takes_its_long_jobs_and_their_files_along(engine):
    engine.handle("count", count_to(engine, 2))
    job, _ = engine.begin_task("count", "hall", {})
    other, _ = engine.begin_task("count", None, {})
    claimed = engine.claim("w")
    assert engine.run(claimed) == JobState.QUEUED
    assert len(list(engine.store.blobs.digests())) == 1
    engine.delete_map("hall")
    assert list(engine.store.blobs.digests()) == []
    with pytest.raises(UnknownJob):
        engine.get_job(job.job_id)
    assert engine.work_off() == [JobState.QUEUED, JobState.SUCCEEDED]
    assert engine.get_job(other.job_id).state == JobState.SUCCEEDED
    assert [job.job_id for job in list_jobs(engine.store, kind="count").items] == [other.job_id]


def test_tries_before_a_slice_that_came_through_count_no_more(engine):
    engine.handle("count", count_to(engine, 30))
    job, _ = engine.begin_task("count", "hall", {})
    for _ in range(12):  # a machine that is restarted within every other slice
        assert isinstance(engine.claim("killed"), LongJob)
        engine.write(update(jobs).values(leased_until=1.0))
        again = engine.claim("w")
        assert engine.run(again) == JobState.QUEUED
    assert items(engine, job) == list(range(12))


def test_a_job_that_is_removed_while_a_slice_runs_is_no_fault_of_its_worker(engine):
    def handle(task, is_over):
        with engine.store.database.write() as connection:
            remove_job(connection, find_job(connection, task.job.id))
        return count_to(engine, 2)(task, is_over)

    engine.handle("count", handle)
    engine.begin_task("count", "hall", {})
    broke = []
    claimed = engine.claim("w")
    assert engine.run(claimed, lambda: broke.append(True)) is None
    assert broke == []  # its worker goes on
    assert list(engine.store.blobs.digests()) == []  # nor is anything left


def test_a_file_that_a_deletion_swept_is_made_again(engine):
    swept = []

    def handle(task, is_over):
        outcome = count_to(engine, 1)(task, is_over)
        if not swept:  # another job that had made the same is removed at this moment
            swept.append(outcome.files[0].blob)
            collect_blobs(engine.store, swept)
        return outcome

    engine.handle("count", handle)
    job, _ = engine.begin_task("count", "hall", {})
    assert engine.work_off() == [JobState.QUEUED, JobState.SUCCEEDED]
    assert engine.get_job(job.job_id).attempts == 1
    assert engine.store.blobs.get(swept[0]) == b"part 0"
