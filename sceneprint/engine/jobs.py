"""Jobs beyond their doing: listed, cancelled, tried again, and taken from workers that died."""

from __future__ import annotations

import logging
from collections.abc import Collection

from sqlalchemy import Connection

from sceneprint.engine.cursors import opened
from sceneprint.engine.wire import tell_job
from sceneprint.errors import CannotRetry
from sceneprint.schemas import FrameState, Job, JobState, Page
from sceneprint.store import Store, cancelling, listing, queue
from sceneprint.store.deaths import fail_of_dead
from sceneprint.store.events import tell
from sceneprint.store.frames import frame_of, set_state
from sceneprint.store.listing import list_jobs as list_stored
from sceneprint.store.maps import map_of
from sceneprint.store.records import JobRow
from sceneprint.store.reencoding import REENCODE

log = logging.getLogger(__name__)

CANCELLED = "its job was cancelled"
_BEING_SIGNED = (FrameState.RECEIVED, FrameState.SIGNING)
_GIVEN_UP = (FrameState.FAILED, FrameState.REJECTED)


def list_jobs(
    store: Store, state: JobState | None, cursor: str | None, limit: int, kind: str | None = None,
    map_names: Collection[str] | None = None,
) -> Page[Job]:  # fmt: skip
    """Jobs, the newest first.

    Parameters
    ----------
    store : see Store
    state, kind : that are wanted; default: all
    cursor, limit : of the page
    map_names : whose jobs are wanted; default: of all maps, and of none

    Raises
    ------
    InvalidRequest : a cursor that was not given out.
    """
    before = opened(store.seals, "job", cursor)
    with store.database.read() as connection:
        found = list_stored(connection, before, limit + 1, state, kind, map_names)
    items = [
        tell_job(one.job, one.frame_id, one.map_name, one.followed_by) for one in found[:limit]
    ]
    more = store.seals.seal("job", found[limit - 1].job.number) if len(found) > limit else None
    return Page[Job](items=items, next_cursor=more)


def get_job(store: Store, job_id: str) -> Job:
    """A job; UnknownJob where there is none."""
    with store.database.read() as connection:
        return _told(connection, listing.find_job(connection, job_id))


def cancel(store: Store, job_id: str) -> Job:
    """Give a job up that is not over; of one that is cancelled already nothing changes.

    A worker that is at it goes on to the end, and what it brings is refused.

    Raises
    ------
    UnknownJob : there is none.
    JobOver : there is nothing left to give up.
    """
    with store.database.write() as connection:
        job = listing.find_job(connection, job_id)
        if job.state != JobState.CANCELLED:
            cancelling.cancel(connection, job)
            _fail_frame(connection, job, CANCELLED)
        return _told(connection, listing.find_job(connection, job_id))


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
        job = listing.find_job(connection, job_id)
        if job.frame_number is None:
            return _retry_task(connection, job)
        frame = frame_of(connection, job.frame)
        row = map_of(connection, frame.map_number)
        latest = listing.last_of(connection, job.kind, frame.number, job.model_id) or job
        if latest.number != job.number and not latest.state.over:
            return _told(connection, latest), False
        if latest.number != job.number:
            raise CannotRetry(
                f"Job {job.id} was followed by {latest.id}, which is {latest.state}. Retry that."
            )
        wanted = frame.state in _GIVEN_UP
        if job.kind == REENCODE:
            wanted = frame.state == FrameState.INDEXED and row.next_model_id == job.model_id
        if not (job.state.over and wanted) or job.state == JobState.SUCCEEDED:
            raise CannotRetry(
                f"Job {job.id} is {job.state} and its frame {frame.state}: nothing was given up "
                "that could be tried again."
            )
        if not store.blobs.holds(frame.blob):
            raise CannotRetry(
                f"The upload of frame {frame.id} is gone from the data folder, so there is "
                "nothing to sign. Restore the folder from a copy, or upload the frame again."
            )
        again = queue.enqueue(connection, job.kind, frame.number, job.priority, job.model_id)
        if job.kind != REENCODE:
            set_state(connection, frame.number, FrameState.RECEIVED)
            tell(connection, "frame.received", row.name, frame.id, again.id)
        return _told(connection, again), True


def worker_died(
    store: Store, job_id: str, token: int, error: str, traceback: str, *, counts: bool
) -> JobState | None:
    """Take a job from a worker that died over it, now and not when its lease runs out.

    Parameters
    ----------
    store : see Store
    job_id, token : of the dead worker's claim
    error, traceback : what is known of its death
    counts : whether the job may have been the cause

    Returns
    -------
    state : of the job; None where the death changed nothing
    """
    with store.database.write() as connection:
        job = fail_of_dead(connection, job_id, token, error, traceback, counts=counts)
        if job is None:
            return None
        if job.frame_number is None:
            pass  # it is of no single frame
        elif job.state == JobState.DEAD:
            _fail_frame(connection, job, error)
        elif frame_of(connection, job.frame).state == FrameState.SIGNING:
            set_state(connection, job.frame, FrameState.RECEIVED)
    about = {"job_id": job_id, "state": job.state, "attempt": job.attempts, "error": error}
    log.error("worker died over a job", extra={**about, "traceback": traceback})
    return job.state


def _fail_frame(connection: Connection, job: JobRow, reason: str) -> None:
    """A frame that will not be signed; one that is indexed, or gone, stays so."""
    if job.frame_number is None:
        return
    frame = frame_of(connection, job.frame)
    if frame.state in _BEING_SIGNED:
        set_state(connection, frame.number, FrameState.FAILED, reason)
        name = map_of(connection, frame.map_number).name
        tell(connection, "frame.failed", name, frame.id, job.id)


def _retry_task(connection: Connection, job: JobRow) -> tuple[Job, bool]:
    """A long job goes on where it stood, as the same job: what it found so far is kept."""
    if not job.state.over:
        return _told(connection, job), False
    if job.state == JobState.SUCCEEDED:
        raise CannotRetry(f"Job {job.id} is {job.state}: nothing was given up.")
    cancelling.revive(connection, job)
    return _told(connection, listing.find_job(connection, job.id)), True


def _told(connection: Connection, job: JobRow) -> Job:
    frame_id = followed_by = None
    if job.frame_number is not None:
        frame_id = frame_of(connection, job.frame).id
        last = listing.last_of(connection, job.kind, job.frame_number, job.model_id)
        followed_by = None if last is None or last.number == job.number else last.id
    name = None if job.map_number is None else map_of(connection, job.map_number).name
    return tell_job(job, frame_id, name, followed_by)
