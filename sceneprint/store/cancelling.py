"""What others than its worker do to a job: give it up, or have it tried once more."""

from __future__ import annotations

from sqlalchemy import Connection, update

from sceneprint.errors import JobOver
from sceneprint.schemas import JobState
from sceneprint.store.clock import now
from sceneprint.store.records import JobRow
from sceneprint.store.tables import jobs


def cancel(connection: Connection, job: JobRow) -> None:
    """Cancel a job; a worker that is at it learns so when it brings its result.

    Raises
    ------
    JobOver : there is nothing left to cancel.
    """
    if job.state.over:
        raise JobOver(f"Job {job.id} is {job.state}: {job.state.sentence} Nothing is left to do.")
    connection.execute(
        update(jobs)
        .where(jobs.c.number == job.number)
        .values(state=JobState.CANCELLED, finished_at=now(connection), leased_until=None)
    )


def cancel_of(connection: Connection, frame_number: int) -> None:
    """Cancel what is still to be done for a frame."""
    connection.execute(
        update(jobs)
        .where(
            jobs.c.frame_number == frame_number,
            jobs.c.state.in_((JobState.QUEUED, JobState.RUNNING)),
        )
        .values(state=JobState.CANCELLED, finished_at=now(connection), leased_until=None)
    )


def revive(connection: Connection, job: JobRow) -> None:
    """Queue a job again that is over, with all its tries before it."""
    connection.execute(
        update(jobs)
        .where(jobs.c.number == job.number)
        .values(
            state=JobState.QUEUED, attempts=0, failures=0, error=None, traceback=None,
            finished_at=None, leased_until=None, worker=None, run_after=now(connection),
        )
    )  # fmt: skip
