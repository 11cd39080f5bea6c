"""Tests of jobs that are cancelled, retried, or taken over from dead workers."""

import time
from functools import partial

import pytest
from sqlalchemy import update

from sceneprint.engine.jobs.lifecycle import cancel, list_jobs, worker_died
from sceneprint.errors import CannotRetry, JobOver, UnknownJob
from sceneprint.store import queue
from sceneprint.store.queue import read_clock
from sceneprint.store.tables import jobs
from sceneprint_client.api import FrameState, JobState


def row(engine, job_id):
    with engine.store.database.read() as connection:
        return queue.find_job(connection, job_id)


def due(engine):
    found = engine.jobs.due_in_s()
    assert found is not None
    return found


def claimed(engine):
    work = engine.claim("w")
    assert work is not None
    return work


def die(engine, work, *, counts=True):
    held = work.job
    return worker_died(engine.store, held.id, held.token, "signal 11", "Fatal", counts=counts)


def test_a_cancelled_job_is_done_by_nobody_and_can_be_tried_again(empty, uploads, told, work_off):
    added, _ = empty.add_frame("hall", uploads[0].data, uploads[0].meta, 7)
    cancelled = cancel(empty.store, added.job_id)
    assert (cancelled.state, cancelled.priority) == (JobState.CANCELLED, 7)
    assert cancel(empty.store, added.job_id) == cancelled  # who asks twice is not refused
    frame = empty.get_frame("hall", added.frame_id)
    assert (frame.state, frame.reason) == (FrameState.FAILED, "its job was cancelled")
    assert work_off(empty) == []
    again, new = empty.retry_job(added.job_id)
    assert (new, again.state, again.priority, again.attempts) == (True, JobState.QUEUED, 7, 0)
    assert (again.job_id != added.job_id, again.frame_id) == (True, added.frame_id)
    assert empty.retry_job(added.job_id) == (again, False)  # nor is it tried twice
    frame = empty.get_frame("hall", added.frame_id)
    assert (frame.state, frame.reason, frame.job_id) == (FrameState.RECEIVED, None, again.job_id)
    with pytest.raises(CannotRetry, match="is queued and its frame is received"):
        empty.retry_job(again.job_id)
    assert work_off(empty) == [JobState.SUCCEEDED]
    assert told(empty)[1:] == ["frame.received", "frame.failed", "frame.received", "frame.indexed"]
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
    added, _ = empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    work = claimed(empty)
    assert cancel(empty.store, added.job_id).state == JobState.CANCELLED
    assert empty.run(work) is None
    assert empty.get_frame("hall", added.frame_id).state == FrameState.FAILED
    assert empty.get_map("hall").revision == 0
    assert len(list(empty.store.blobs.digests())) == 1  # the upload, and no artifact


def test_what_cannot_be_signed_again_is_refused_with_the_reason(empty, uploads):
    lost, _ = empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    gone, _ = empty.add_frame("hall", uploads[1].data, uploads[1].meta)
    cancel(empty.store, lost.job_id)
    cancel(empty.store, gone.job_id)
    empty.store.blobs.remove(empty.store.blobs.put(uploads[0].data))
    with pytest.raises(CannotRetry, match=f"The upload of frame {lost.frame_id} is missing"):
        empty.retry_job(lost.job_id)
    assert empty.get_frame("hall", lost.frame_id).state == FrameState.FAILED
    empty.delete_frame("hall", gone.frame_id)
    with pytest.raises(CannotRetry, match="is cancelled and its frame is deleted"):
        empty.retry_job(gone.job_id)


def test_all_dead_jobs_are_tried_again_page_by_page(empty, uploads, due_now):
    added = [empty.add_frame("hall", one.data, one.meta)[0] for one in uploads[:4]]
    for _ in added:
        while die(empty, claimed(empty)) != JobState.DEAD:
            due_now(empty)
    ids = [one.job_id for one in added]
    empty.store.blobs.remove(empty.store.blobs.put(uploads[1].data))
    empty.retry_job(ids[3])  # by hand, before, and with success
    assert empty.run(claimed(empty)) == JobState.SUCCEEDED
    first = empty.retry_dead_jobs(limit=2)  # the newest: 3, which has a follower, and 2
    assert [one.frame_id for one in first.retried] == [added[2].frame_id]
    assert first.refused == []
    second = empty.retry_dead_jobs(first.next_cursor, limit=2)
    assert [one.frame_id for one in second.retried] == [added[0].frame_id]
    assert [one.job_id for one in second.refused] == [ids[1]]
    assert "is missing" in second.refused[0].reason
    assert second.next_cursor is None
    waiting = {one.job_id for one in list_jobs(empty.store, JobState.QUEUED).items}
    assert waiting == {first.retried[0].job_id, second.retried[0].job_id}
    counted = {"dead": 1, "queued": 2, "succeeded": 1}  # of retried jobs only the latest
    assert empty.statistics.collect(1, "hall").jobs == counted == empty.statistics.collect(1).jobs
    again = empty.retry_dead_jobs()
    assert (again.retried, [one.job_id for one in again.refused]) == ([], [ids[1]])
    assert empty.retry_dead_jobs(map_names=("elsewhere",)).refused == []


def test_to_be_killed_from_outside_is_no_fault_of_the_job(empty, uploads, due_now):
    added, _ = empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    for attempt in range(1, 10):
        before = time.time()
        assert die(empty, claimed(empty), counts=False) == JobState.QUEUED
        job = row(empty, added.job_id)
        assert (job.attempts, job.failures) == (attempt, 0)
        assert before + 2.0 <= job.run_after <= time.time() + 2.0
        due_now(empty)
    assert die(empty, claimed(empty), counts=False) == JobState.DEAD
    assert empty.get_frame("hall", added.frame_id).reason == "signal 11"


def test_a_death_counts_where_another_has_the_job_by_now(empty, uploads, due_now):
    """A frame that hangs every worker longer than its lease is given up all the same."""
    added, _ = empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    works = []
    for _ in range(4):
        works.append(claimed(empty))
        due_now(empty)
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
    for one in uploads[:3]:
        empty.add_frame("hall", one.data, one.meta)
    running = claimed(empty).job
    with empty.store.database.write() as connection:
        start = read_clock(connection)
        connection.execute(update(jobs).values(run_after=start + 50.0))
        connection.execute(update(jobs).where(jobs.c.number == 3).values(run_after=start + 40.0))
    assert 20.0 < due(empty) <= 40.0
    with empty.store.database.write() as connection:
        changed = update(jobs).where(jobs.c.number == running.number)
        connection.execute(changed.values(leased_until=start + 20.0, run_after=1.0))
    assert 0.0 < due(empty) <= 20.0
