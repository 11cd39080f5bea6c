"""The ends a job can come to, other than the good one, and the job while it is in hand."""

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
from sceneprint.store.maps import frame_of, map_of
from sceneprint.store.queue import fail_of_dead
from sceneprint.store.queue import list_jobs as list_stored
from sceneprint.store.reencoding_rows import REENCODE
from sceneprint.store.tables import ARCHIVE, FrameRow, JobRow, MapRow
from sceneprint_client.api import FrameState, Job, JobState, Page
from sceneprint_client.api.admin import RefusedRetry, RetriedJobs

log = logging.getLogger(__name__)

#: Seconds until a job is tried again whose result could not be stored.
LEFT_S = 5.0


@dataclass(frozen=True, eq=False)
class Work:
    """A job in hand.

    Parameters
    ----------
    job : as it was claimed
    frame, map : that it is about
    """

    job: JobRow
    frame: FrameRow
    map: MapRow

    @property
    def again(self) -> bool:
        """Whether the frame is indexed, stays so all the while, and is signed once more."""
        return self.job.kind == REENCODE

    @property
    def model_id(self) -> str:
        """Of the model to sign with."""
        return self.job.model_id or self.map.model_id


class Outdated(Exception):
    """The map has come to have another model since the job was claimed."""


def put_back(store: Store, work: Work, after_s: float = 0.0) -> None:
    """Queue again what was claimed and not begun, as when a worker is told to stop."""
    of_map = store.database.write(map_number=work.map.number)
    with suppress(LostLease), of_map as connection:
        queue.give_back(connection, work.job, after_s)
        if not work.again:
            set_state(connection, work.frame.number, FrameState.RECEIVED)


def restart_jobs(store: Store, work: Work) -> JobState | None:
    """What was signed with a model that the map no longer has, or will not have, is of no use."""
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
    """Note what has become of a job."""
    record_event(connection, kind, work.map.name, work.frame.id, work.job.id)


def reject(store: Store, work: Work, error: FrameError) -> JobState | None:
    """A frame that holds nothing to sign: it would hold nothing the next time either."""
    reason = str(error).removeprefix(f"{work.frame.id}: ")
    try:
        with store.database.write(map_number=work.map.number) as connection:
            queue.finish(connection, work.job, JobState.FAILED, reason)
            if not work.again:
                if map_of(connection, work.frame.map_number).model_id != work.model_id:
                    raise Outdated
                set_state(connection, work.frame.number, FrameState.REJECTED, reason)
                record_job_event(connection, "frame.rejected", work)
    except LostLease:
        return None
    except Outdated:
        return restart_jobs(store, work)
    return JobState.FAILED


def break_down(store: Store, work: Work, error: Exception) -> JobState | None:
    """Queue a job again over which something went wrong, or let it be dead."""
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
    """What a job says of an error that it broke down over, and its traceback."""
    known = isinstance(error, SceneprintError)
    reason = str(error) if known else f"{type(error).__name__}: {error}"
    return reason, "".join(traceback.format_exception(error))


def about(work: Work, **more: object) -> dict[str, object]:
    """What a line of the log says of a job."""
    return {
        "job_id": work.job.id,
        "frame_id": work.frame.id,
        "map": work.map.name,
        "attempt": work.job.attempts,
        **more,
    }


# Holding a lease while the work goes on.


@contextmanager
def renewed(store: Store, claim: JobRow, lease_s: float, longest_s: float) -> Iterator[None]:
    """Renew a lease from a thread of its own while the work goes on."""
    done = threading.Event()

    def renew() -> None:
        until = time.monotonic() + longest_s
        while not done.wait(lease_s / 3) and time.monotonic() < until:
            try:
                with store.database.write(turn=False) as connection:
                    queue.renew(connection, claim, lease_s)
            except LostLease:
                return  # the end of the work will learn of it
            except SceneprintError as error:  # the database may be back before the lease is over
                log.warning("lease not renewed", extra={"error": str(error)})

    thread = threading.Thread(target=renew, name="lease", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


# Jobs beyond their doing: listed, cancelled, tried again, and taken from workers that died.

CANCELLED = "its job was cancelled"
_BEING_SIGNED = (FrameState.RECEIVED, FrameState.SIGNING)
_GIVEN_UP = (FrameState.FAILED, FrameState.REJECTED)


def list_jobs(
    store: Store, state: JobState | None = None, cursor: str | None = None, limit: int = 100,
    kind: str | None = None, map_names: Collection[str] | None = None,
) -> Page[Job]:  # fmt: skip
    """A page of jobs, the newest first; see `queue.list_jobs`.

    Raises
    ------
    InvalidRequest : a cursor that was not given out.
    """
    before = store.seals.row("job", cursor)
    with store.database.read() as connection:
        found = list_stored(connection, before, limit + 1, state, kind, map_names)
    items = [
        job_record(one.job, one.frame_id, one.map_name, one.followed_by) for one in found[:limit]
    ]
    more = store.seals.next_cursor("job", [one.job.number for one in found], limit)
    return Page[Job](items=items, next_cursor=more)


def get_job(store: Store, job_id: str) -> Job:
    """A job; UnknownJob where there is none."""
    with store.database.read() as connection:
        return _job_record(connection, queue.find_job(connection, job_id))


def cancel(store: Store, job_id: str) -> Job:
    """Cancel a job that is not over; of one that is cancelled already nothing changes.

    A worker that holds it goes on to the end, and its result is refused. The archive of an import
    is removed at once.

    Raises
    ------
    UnknownJob : there is none.
    JobOver : there is nothing left to give up.
    """
    with store.database.write() as connection:
        job = queue.find_job(connection, job_id)
        gone: list[str] = []
        if job.state != JobState.CANCELLED:
            queue.cancel(connection, job)
            record_change(connection, "job.cancelled", _map_name(connection, job), job.id)
            fail_frame(connection, job, CANCELLED)
            gone = queue.remove_parts(connection, job.number, items=False, files=[ARCHIVE])
        cancelled = _job_record(connection, queue.find_job(connection, job_id))
    collect_deleted_blobs(store, gone)
    return cancelled


def retry(store: Store, job_id: str) -> tuple[Job, bool]:
    """Try again what was given up, in a new job of the same priority.

    Returns
    -------
    job : the new one
    new : False where the frame is being tried again already, by a job that is returned

    Raises
    ------
    UnknownJob : there is none.
    CannotRetry : it was not given up, its frame has a later job that is over, or its upload is
        gone.
    """
    with store.database.write() as connection:
        job = queue.find_job(connection, job_id)
        if job.frame_number is None:
            return _retry_task(connection, job)
        frame = frame_of(connection, job.frame)
        row = map_of(connection, frame.map_number)
        latest = queue.last_of(connection, job.kind, frame.number, job.model_id) or job
        if latest.number != job.number and not latest.state.over:
            return _job_record(connection, latest), False
        if latest.number != job.number:
            raise CannotRetry(
                f"Job {job.id} was replaced by {latest.id}, which is {latest.state}. Retry that "
                "one."
            )
        wanted = frame.state in _GIVEN_UP
        if job.kind == REENCODE:
            wanted = frame.state == FrameState.INDEXED and row.next_model_id == job.model_id
        if not (job.state.over and wanted) or job.state == JobState.SUCCEEDED:
            raise CannotRetry(
                f"Job {job.id} is {job.state} and its frame is {frame.state}, so there is "
                "nothing to retry."
            )
        if not store.blobs.holds(frame.blob):
            raise CannotRetry(
                f"The upload of frame {frame.id} is missing from the data folder, so it cannot "
                "be signed. Restore the folder from a backup, or upload the frame again."
            )
        again = queue.enqueue(connection, job.kind, frame.number, job.priority, job.model_id)
        record_change(connection, "job.retried", row.name, job.id)
        if job.kind != REENCODE:
            set_state(connection, frame.number, FrameState.RECEIVED)
            record_event(connection, "frame.received", row.name, frame.id, again.id)
        return _job_record(connection, again), True


def retry_dead(
    store: Store, cursor: str | None = None, limit: int = 100,
    map_names: Collection[str] | None = None,
) -> RetriedJobs:  # fmt: skip
    """Try again a page of dead jobs, the newest first; those that were tried since stay.

    Each is a commit of its own: what was tried again before a fault is.

    Raises
    ------
    InvalidRequest : a cursor that was not given out.
    """
    page = list_jobs(store, JobState.DEAD, cursor, limit, map_names=map_names)
    retried, refused = [], []
    for job in page.items:
        if job.followed_by is not None:
            continue
        try:
            again, is_new = retry(store, job.job_id)
        except (CannotRetry, UnknownJob) as error:
            refused.append(RefusedRetry(job_id=job.job_id, reason=str(error)))
        else:
            retried += [again] if is_new else []
    return RetriedJobs(retried=retried, refused=refused, next_cursor=page.next_cursor)


def worker_died(
    store: Store, job_id: str, token: int, error: str, traceback: str, *, counts: bool
) -> JobState | None:
    """Take a job from a worker that died over it, now and not when its lease runs out.

    Parameters are those of `queue.fail_of_dead`. Returns the state of the job; None where the death
    changed nothing.
    """
    with store.database.write() as connection:
        job = fail_of_dead(connection, job_id, token, error, traceback, counts=counts)
        if job is None:
            return None
        if job.frame_number is None:
            pass  # it is of no single frame
        elif job.state == JobState.DEAD:
            fail_frame(connection, job, error)
        elif frame_of(connection, job.frame).state == FrameState.SIGNING:
            set_state(connection, job.frame, FrameState.RECEIVED)
    about = {"job_id": job_id, "state": job.state, "attempt": job.attempts, "error": error}
    log.error("worker died during a job", extra={**about, "traceback": traceback})
    return job.state


def fail_frame(connection: Connection, job: JobRow, reason: str | None) -> None:
    """A frame that will not be signed; one that is indexed, or gone, stays so."""
    if job.frame_number is None:
        return
    frame = frame_of(connection, job.frame)
    if frame.state in _BEING_SIGNED:
        set_state(connection, frame.number, FrameState.FAILED, reason)
        name = map_of(connection, frame.map_number).name
        record_event(connection, "frame.failed", name, frame.id, job.id)


def _retry_task(connection: Connection, job: JobRow) -> tuple[Job, bool]:
    """A long job goes on where it stood, as the same job: what it found so far is kept."""
    if not job.state.over:
        return _job_record(connection, job), False
    if job.state == JobState.SUCCEEDED:
        raise CannotRetry(f"Job {job.id} is {job.state}, so there is nothing to retry.")
    queue.revive(connection, job)
    record_change(connection, "job.retried", _map_name(connection, job), job.id)
    return _job_record(connection, queue.find_job(connection, job.id)), True


def _job_record(connection: Connection, job: JobRow) -> Job:
    frame_id = followed_by = None
    if job.frame_number is not None:
        frame_id = frame_of(connection, job.frame).id
        last = queue.last_of(connection, job.kind, job.frame_number, job.model_id)
        followed_by = None if last is None or last.number == job.number else last.id
    return job_record(job, frame_id, _map_name(connection, job), followed_by)


def _map_name(connection: Connection, job: JobRow) -> str | None:
    return None if job.map_number is None else map_of(connection, job.map_number).name
