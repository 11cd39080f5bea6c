"""State transitions of jobs, such as failure, cancellation and retry, and lease renewal."""

from __future__ import annotations

import logging
import threading
import time
import traceback
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from sqlalchemy import Connection

from sceneprint.engine.serializers import job_record
from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.errors import CannotRetry, FrameError, LostLease, SceneprintError, UnknownJob
from sceneprint.store import Store, queue
from sceneprint.store.audit_log import record_change
from sceneprint.store.events import record_event
from sceneprint.store.frames import set_state
from sceneprint.store.maps import frame_of, map_of_number
from sceneprint.store.queue import fail_dead_worker
from sceneprint.store.queue import list_jobs as list_stored
from sceneprint.store.reencoding_rows import REENCODE
from sceneprint.store.tables import IMPORT_FILES, FrameRow, JobRow, MapRow
from sceneprint.store.wakeup import Wakeup
from sceneprint_client.api import FrameState, Job, JobState, Page
from sceneprint_client.api.admin import RefusedRetry, RetriedJobs

log = logging.getLogger(__name__)

#: Delay, in seconds, before the next attempt of a job whose result could not be stored.
DELAY_S = 5.0


@dataclass(frozen=True, eq=False)
class Work:
    """A claimed job that signs a frame."""

    job: JobRow
    frame: FrameRow
    map: MapRow

    @property
    def again(self) -> bool:
        """Return whether the job signs an indexed frame again; the frame remains indexed."""
        return self.job.kind == REENCODE

    @property
    def model_id(self) -> str:
        """Id of the model of the new signature."""
        return self.job.model_id or self.map.model_id


class Outdated(Exception):
    """The map has switched to another model since the job was claimed."""


def put_back(store: Store, work: Work, after_s: float = 0.0) -> None:
    """Return a claimed job to the queue, due in `after_s` seconds, unless the lease was lost."""
    writing = store.database.write(map_number=work.map.number)
    with suppress(LostLease), writing as connection:
        queue.release_job(connection, work.job, after_s)
        if not work.again:
            set_state(connection, work.frame.number, FrameState.RECEIVED)


def restart_job(store: Store, work: Work) -> JobState | None:
    """Queue a job whose map has switched models, or cancel it if its frame is signed again.

    Return QUEUED or CANCELLED; None if the lease was lost.
    """
    if not work.again:
        put_back(store, work)
        return JobState.QUEUED
    try:
        with store.database.write(map_number=work.map.number) as connection:
            queue.finish(connection, work.job, JobState.CANCELLED)
    except LostLease:
        return None
    return JobState.CANCELLED


def record_job_event(connection: Connection, kind: str, work: Work) -> None:
    """Record an event with the frame and the id of a job."""
    record_event(connection, kind, work.map.name, work.frame.id, work.job.id)


def reject(store: Store, work: Work, error: FrameError) -> JobState | None:
    """Mark a job as failed, and its frame as rejected, after an error that a retry would repeat.

    A frame that is signed again (`work.again`) is not rejected. If the map has switched models, the
    job is restarted. Return FAILED, or the result of `restart_job`; None if the lease was lost.
    """
    reason = str(error).removeprefix(f"{work.frame.id}: ")
    try:
        with store.database.write(map_number=work.map.number) as connection:
            queue.finish(connection, work.job, JobState.FAILED, reason)
            if not work.again:
                if map_of_number(connection, work.frame.map_number).model_id != work.model_id:
                    raise Outdated
                set_state(connection, work.frame.number, FrameState.REJECTED, reason)
                record_job_event(connection, "frame.rejected", work)
    except LostLease:
        return None
    except Outdated:
        return restart_job(store, work)
    return JobState.FAILED


def break_down(store: Store, work: Work, error: Exception) -> JobState | None:
    """Queue a failed job for another attempt, or mark it as dead and its frame as failed.

    Return QUEUED or DEAD; None if the lease was lost.
    """
    reason, trace = failure_texts(error)
    log.error("job raised an exception", extra=about(work, error=reason, traceback=trace))
    try:
        with store.database.write(map_number=work.map.number) as connection:
            state = queue.fail(connection, work.job, reason, trace)
            if work.again:
                return state
            dead = state == JobState.DEAD
            after = FrameState.FAILED if dead else FrameState.RECEIVED
            set_state(connection, work.frame.number, after, reason if dead else None)
            if dead:
                record_job_event(connection, "frame.failed", work)
    except LostLease:
        return None
    return state


def failure_texts(error: Exception) -> tuple[str, str]:
    """Return the message and the traceback of an error."""
    reason = str(error)
    if not isinstance(error, SceneprintError):
        reason = f"{type(error).__name__}: {error}"
    return reason, "".join(traceback.format_exception(error))


def about(work: Work, **more: object) -> dict[str, object]:
    """Return the log fields of a job, with the fields `more` added."""
    return {
        "job_id": work.job.id, "frame_id": work.frame.id, "map": work.map.name,
        "attempt": work.job.attempts, **more,
    }  # fmt: skip


@contextmanager
def renewed(store: Store, claim: JobRow, lease_s: float, longest_s: float) -> Iterator[None]:
    """Renew the lease of a job in a thread during the context, for at most `longest_s` seconds."""
    done = threading.Event()

    def renew() -> None:
        until = time.monotonic() + longest_s
        while not done.wait(lease_s / 3) and time.monotonic() < until:
            try:
                with store.database.write(turn=False) as connection:
                    queue.renew(connection, claim, lease_s)
            except LostLease:
                return
            except SceneprintError as error:  # retry until the lease expires
                log.warning("lease not renewed", extra={"error": str(error)})

    thread = threading.Thread(target=renew, name="lease", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


# Operations of users on jobs, and jobs of dead workers.

CANCELLED = "its job was cancelled"
_BEING_SIGNED = (FrameState.RECEIVED, FrameState.SIGNING)
_GIVEN_UP = (FrameState.FAILED, FrameState.REJECTED)


def list_jobs(
    store: Store, state: JobState | None = None, cursor: str | None = None, limit: int = 100,
    kind: str | None = None, map_names: Collection[str] | None = None,
) -> Page[Job]:  # fmt: skip
    """Return a page of jobs, newest first; see `queue.list_jobs`.

    Raise InvalidRequest if the service did not issue the cursor.
    """
    before = store.seals.row("job", cursor)
    with store.database.read() as connection:
        rows = list_stored(connection, before, limit + 1, state, kind, map_names)
    items = [
        job_record(row.job, row.frame_id, row.map_name, row.followed_by) for row in rows[:limit]
    ]
    more = store.seals.next_cursor("job", [row.job.number for row in rows], limit)
    return Page[Job](items=items, next_cursor=more)


def get_job(store: Store, job_id: str) -> Job:
    """Return a job; raise UnknownJob if it does not exist."""
    with store.database.read() as connection:
        return _job_record(connection, queue.find_job(connection, job_id))


def cancel(store: Store, job_id: str) -> Job:
    """Cancel a queued or running job, and fail its unsigned frame; return a cancelled job
    unchanged.

    A worker may continue with the job, but its result is refused. The archive of an import is
    removed immediately.

    Raises
    ------
    UnknownJob : If the job does not exist.
    JobOver : If the job succeeded, failed or is dead.
    """
    with store.database.write() as connection:
        job = queue.find_job(connection, job_id)
        unused: list[str] = []
        if job.state != JobState.CANCELLED:
            queue.cancel(connection, job)
            record_change(connection, "job.cancelled", _map_name(connection, job), job.id)
            fail_frame(connection, job, CANCELLED)
            unused = queue.remove_parts(connection, job.number, items=False, files=IMPORT_FILES)
        cancelled = _job_record(connection, queue.find_job(connection, job_id))
    collect_deleted_blobs(store, unused)
    return cancelled


def retry(store: Store, bell: Wakeup, job_id: str) -> tuple[Job, bool]:
    """Retry a failed, dead or cancelled job: queue a new job, or resume a long job.

    Returns
    -------
    job : new or resumed job, an unfinished job that already retries the frame, or the unfinished
        long job itself
    is_new : whether the job was queued by this call

    Raises
    ------
    UnknownJob : If the job does not exist.
    CannotRetry : If the job succeeded. For the job of a frame, also if it is unfinished, a later
        job of the frame has ended, the frame needs no retry, or the upload is lost.
    """
    job, is_new = _retry(store, job_id)
    if is_new:
        bell.ring()
    return job, is_new


def _retry(store: Store, job_id: str) -> tuple[Job, bool]:
    with store.database.write() as connection:
        job = queue.find_job(connection, job_id)
        if job.frame_number is None:
            return _retry_task(connection, job)
        frame = frame_of(connection, job.frame)
        row = map_of_number(connection, frame.map_number)
        latest = queue.latest_job(connection, job.kind, frame.number, job.model_id) or job
        if latest.number != job.number and not latest.state.over:
            return _job_record(connection, latest), False
        if latest.number != job.number:
            raise CannotRetry(
                f"Job {job.id} was replaced by job {latest.id}, whose state is {latest.state}. "
                "Retry the later job."
            )
        can_retry = frame.state in _GIVEN_UP
        if job.kind == REENCODE:
            can_retry = frame.state == FrameState.INDEXED and row.next_model_id == job.model_id
        if not (job.state.over and can_retry) or job.state == JobState.SUCCEEDED:
            raise CannotRetry(
                f"Job {job.id} is {job.state} and its frame is {frame.state}, so no retry is "
                "needed."
            )
        if not store.blobs.holds(frame.blob):
            raise CannotRetry(
                f"The upload of frame {frame.id} is missing from the data folder, so it cannot "
                "be signed. Restore the folder from a backup, or upload the frame again."
            )
        new = queue.enqueue(connection, job.kind, frame.number, job.priority, job.model_id)
        record_change(connection, "job.retried", row.name, job.id)
        if job.kind != REENCODE:
            set_state(connection, frame.number, FrameState.RECEIVED)
            record_event(connection, "frame.received", row.name, frame.id, new.id)
        return _job_record(connection, new), True


def retry_dead(
    store: Store, bell: Wakeup, cursor: str | None = None, limit: int = 100,
    map_names: Collection[str] | None = None,
) -> RetriedJobs:  # fmt: skip
    """Retry the dead jobs of a page, newest first, unless retried before; return the new jobs.

    Each retry is a transaction of its own, so an error does not undo earlier retries. Raise
    InvalidRequest if the service did not issue the cursor.
    """
    page = list_jobs(store, JobState.DEAD, cursor, limit, map_names=map_names)
    retried, refused = [], []
    for job in page.items:
        if job.followed_by is not None:
            continue
        try:
            again, is_new = retry(store, bell, job.job_id)
        except (CannotRetry, UnknownJob) as error:
            refused.append(RefusedRetry(job_id=job.job_id, reason=str(error)))
        else:
            retried += [again] if is_new else []
    return RetriedJobs(retried=retried, refused=refused, next_cursor=page.next_cursor)


def worker_died(
    store: Store, job_id: str, token: int, error: str, traceback: str, *, counts: bool
) -> JobState | None:
    """Release a job of a dead worker before the end of its lease.

    Return the new state of the job; None if the job is over or another worker holds it. See
    `queue.fail_dead_worker` for the parameters.
    """
    with store.database.write() as connection:
        job = fail_dead_worker(connection, job_id, token, error, traceback, counts=counts)
        if job is None:
            return None
        if job.state == JobState.DEAD:
            fail_frame(connection, job, error)
        elif (
            job.frame_number is not None
            and frame_of(connection, job.frame).state == FrameState.SIGNING
        ):
            set_state(connection, job.frame, FrameState.RECEIVED)
    about = {"job_id": job_id, "state": job.state, "attempt": job.attempts, "error": error}
    log.error("worker died during a job", extra={**about, "traceback": traceback})
    return job.state


def fail_frame(connection: Connection, job: JobRow, reason: str | None) -> None:
    """Mark the frame of a job as failed, and record an event, if the frame awaits its signature."""
    if job.frame_number is None:
        return
    frame = frame_of(connection, job.frame)
    if frame.state in _BEING_SIGNED:
        set_state(connection, frame.number, FrameState.FAILED, reason)
        name = map_of_number(connection, frame.map_number).name
        record_event(connection, "frame.failed", name, frame.id, job.id)


def _retry_task(connection: Connection, job: JobRow) -> tuple[Job, bool]:
    """Queue a failed long job again, to resume after its last slice; return it as `retry` does."""
    if not job.state.over:
        return _job_record(connection, job), False
    if job.state == JobState.SUCCEEDED:
        raise CannotRetry(f"Job {job.id} is {job.state}, so no retry is needed.")
    queue.requeue_job(connection, job)
    record_change(connection, "job.retried", _map_name(connection, job), job.id)
    return _job_record(connection, queue.find_job(connection, job.id)), True


def _job_record(connection: Connection, job: JobRow) -> Job:
    frame_id = followed_by = None
    if job.frame_number is not None:
        frame_id = frame_of(connection, job.frame).id
        last = queue.latest_job(connection, job.kind, job.frame_number, job.model_id)
        followed_by = None if last is None or last.number == job.number else last.id
    return job_record(job, frame_id, _map_name(connection, job), followed_by)


def _map_name(connection: Connection, job: JobRow) -> str | None:
    return None if job.map_number is None else map_of_number(connection, job.map_number).name
