"""Tests of long jobs, each of whose slices is stored once."""

import pytest
from sqlalchemy import select, update

from sceneprint.engine.jobs.lifecycle import list_jobs
from sceneprint.engine.jobs.tasks import LongJob, SliceResult
from sceneprint.engine.upkeep.garbage_collection import collect_blobs
from sceneprint.errors import CannotRetry, InvalidRequest, UnknownJob
from sceneprint.store.events import number_events
from sceneprint.store.queue import JobFile, files_of, find_job, items_of, remove_job
from sceneprint.store.tables import events, jobs
from sceneprint_client.api import JobState, NewMap


@pytest.fixture
def engine(make_engine):
    engine = make_engine()
    engine.create_map(NewMap(name="hall", model="depth"))
    return engine


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


def test_each_slice_is_kept_and_the_last_one_ends_the_job(engine, work_off):
    engine.handle("count", count_to(engine, 3))
    job, _ = engine.begin_task("count", "hall", {"to": 3})
    assert (job.kind, job.map, job.frame_id, job.progress) == ("count", "hall", None, None)
    claimed = engine.claim("w")
    assert isinstance(claimed, LongJob)
    assert (claimed.data, claimed.of_map.name) == ({"to": 3}, "hall")
    assert engine.run(claimed) == JobState.QUEUED
    between = engine.get_job(job.job_id)
    assert (between.state, between.attempts, between.result) == (JobState.QUEUED, 1, None)
    assert (between.progress.done, between.progress.total) == (1, 3)
    assert work_off(engine) == [JobState.QUEUED, JobState.SUCCEEDED]
    ended = engine.get_job(job.job_id)
    assert (ended.state, ended.result) == (JobState.SUCCEEDED, {"sum": 3})
    assert items(engine, job) == [0, 1, 2]
    number_events(engine.store.database)
    with engine.store.database.read() as connection:
        number = find_job(connection, job.job_id).number
        assert engine.store.blobs.get(files_of(connection, number)["part"].blob) == b"part 2"
        asked = select(events.c.kind, events.c.data).where(events.c.job_id == job.job_id)
        assert connection.execute(asked).all() == [("numbers.found", {"sum": 3})]


def test_a_slice_of_a_worker_that_fell_silent_counts_once(engine, work_off):
    engine.handle("count", count_to(engine, 2))
    job, _ = engine.begin_task("count", "hall", {})
    late = engine.claim("silent")
    with engine.store.database.write() as connection:
        connection.execute(update(jobs).values(leased_until=1.0))
    assert work_off(engine) == [JobState.QUEUED, JobState.SUCCEEDED]
    assert engine.run(late) is None  # its slice is refused whole
    assert items(engine, job) == [0, 1]


def test_what_cannot_be_done_fails_at_once_and_goes_on_when_retried(engine, work_off):
    able = False

    def handle(task, is_over):
        if task.progress and not able:
            raise InvalidRequest("the second step is impossible")
        return count_to(engine, 3)(task, is_over)

    engine.handle("count", handle)
    job, _ = engine.begin_task("count", "hall", {})
    assert work_off(engine) == [JobState.QUEUED, JobState.FAILED]
    failed = engine.get_job(job.job_id)
    assert (failed.error, failed.traceback) == ("the second step is impossible", None)
    able = True
    again, new = engine.retry_job(job.job_id)
    assert (again.job_id, again.state, new) == (job.job_id, JobState.QUEUED, True)
    assert engine.retry_job(job.job_id)[1] is False  # it waits already
    assert work_off(engine) == [JobState.QUEUED, JobState.SUCCEEDED]
    assert items(engine, job) == [0, 1, 2]
    with pytest.raises(CannotRetry, match="so no retry is needed"):
        engine.retry_job(job.job_id)


def test_a_map_takes_its_long_jobs_and_their_files_along(engine, work_off):
    engine.handle("count", count_to(engine, 2))
    job, _ = engine.begin_task("count", "hall", {})
    other, _ = engine.begin_task("count", None, {})
    claimed = engine.claim("w")
    assert engine.run(claimed) == JobState.QUEUED
    with engine.store.database.read() as connection:
        blob = files_of(connection, find_job(connection, job.job_id).number)["part"].blob
    assert engine.store.blobs.holds(blob)
    engine.delete_map("hall")
    assert not engine.store.blobs.holds(blob)
    with pytest.raises(UnknownJob):
        engine.get_job(job.job_id)
    assert work_off(engine) == [JobState.QUEUED, JobState.SUCCEEDED]
    assert engine.get_job(other.job_id).state == JobState.SUCCEEDED
    assert [one.job_id for one in list_jobs(engine.store, map_names=["hall"]).items] == []
    assert [one.job_id for one in list_jobs(engine.store, kind="count").items] == [other.job_id]


def test_frames_that_wait_are_signed_between_two_slices(engine, uploads, work_off, due_now):
    engine.handle("count", count_to(engine, 3))
    engine.begin_task("count", "hall", {})
    first = engine.claim("w")
    assert isinstance(first, LongJob)
    assert engine.run(first) == JobState.QUEUED
    due_now(engine)
    engine.add_frame("hall", uploads[0].data, uploads[0].meta)
    frame = engine.claim("w")
    assert frame is not None
    assert not isinstance(frame, LongJob)
    engine.put_back(frame)
    assert work_off(engine) == [JobState.SUCCEEDED, JobState.QUEUED, JobState.SUCCEEDED]


def test_tries_before_a_slice_that_came_through_count_no_more(engine):
    engine.handle("count", count_to(engine, 30))
    job, _ = engine.begin_task("count", "hall", {})
    for _ in range(12):  # a machine that is restarted within every other slice
        assert isinstance(engine.claim("killed"), LongJob)
        with engine.store.database.write() as connection:
            connection.execute(update(jobs).values(leased_until=1.0))
        again = engine.claim("w")
        assert isinstance(again, LongJob)
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
    assert claimed is not None
    assert engine.run(claimed, lambda: broke.append(True)) is None
    assert broke == []  # its worker goes on
    assert list(engine.store.blobs.digests()) == []  # nor is anything left


def test_a_file_that_a_deletion_swept_is_made_again(engine, work_off):
    swept = []

    def handle(task, is_over):
        outcome = count_to(engine, 1)(task, is_over)
        if not swept:  # another job that had made the same is removed at this moment
            swept.append(outcome.files[0].blob)
            collect_blobs(engine.store, swept)
        return outcome

    engine.handle("count", handle)
    job, _ = engine.begin_task("count", "hall", {})
    assert work_off(engine) == [JobState.QUEUED, JobState.SUCCEEDED]
    assert engine.get_job(job.job_id).attempts == 1
    assert engine.store.blobs.get(swept[0]) == b"part 0"
