"""Jobs whose workers died over them.

Who started the workers sees one die at once, and need not wait for its lease to run out.
"""

from __future__ import annotations

from sqlalchemy import ColumnElement, Connection, select, update

from sceneprint.schemas import JobState
from sceneprint.store import queue
from sceneprint.store.clock import now
from sceneprint.store.records import JobRow, job_row
from sceneprint.store.tables import jobs


def is_given_up(connection: Connection) -> bool:
    """Whether there is a job to `bury`; costs no lock."""
    asked = select(jobs.c.number).where(*_given_up(now(connection))).limit(1)
    return connection.execute(asked).first() is not None


def bury(connection: Connection) -> list[JobRow]:
    """Give up jobs whose workers fall silent again and again: a frame that kills its worker."""
    at = now(connection)
    rows = connection.execute(
        update(jobs)
        .where(*_given_up(at))
        .values(
            state=JobState.DEAD, finished_at=at, leased_until=None,
            error=f"its worker fell silent, and {queue.MAXIMUM_ATTEMPTS} tries are over",
        )
        .returning(jobs)
    ).mappings()  # fmt: skip
    return [job_row(row) for row in rows]


def fail_of_dead(
    connection: Connection, job_id: str, token: int, error: str, traceback: str, *, counts: bool
) -> JobRow | None:
    """Take a job from a worker that died over it: queued for another try, or dead.

    Parameters
    ----------
    connection : of a writing transaction
    job_id, token : of the dead worker's claim
    error, traceback : what is known of its death
    counts : whether the job may have been the cause; if not, it is an attempt and no failure

    Returns
    -------
    job : as it is now; None where the death changes nothing: the job is over, or is another
        worker's, who took it when the lease of this one ran out, and may still do it
    """
    # locked: a claim, which waits for no turn, may be about to take it
    asked = select(jobs).where(jobs.c.id == job_id).with_for_update()
    row = connection.execute(asked).mappings().first()
    if row is None or JobState(row["state"]).over:
        return None
    held = row["token"] == token and row["state"] == JobState.RUNNING
    if not held and (row["token"] == token or not counts):
        return None
    failures = row["failures"] + counts
    known = {"failures": failures, "error": error, "traceback": traceback}
    if failures >= queue.MAXIMUM_FAILURES or (held and row["attempts"] >= queue.MAXIMUM_ATTEMPTS):
        known |= {"state": JobState.DEAD, "leased_until": None, "finished_at": now(connection)}
    elif held:
        again = now(connection) + queue.pause_s(max(failures, 1))
        known |= {"state": JobState.QUEUED, "leased_until": None, "run_after": again}
    change = update(jobs).where(jobs.c.number == row["number"]).values(**known).returning(jobs)
    job = job_row(connection.execute(change).mappings().one())
    return None if job.state == JobState.RUNNING else job


def _given_up(at: ColumnElement[float]) -> tuple[ColumnElement[bool], ...]:
    """What holds of a job that fell silent in the last of its tries."""
    return (
        jobs.c.state == JobState.RUNNING,
        jobs.c.leased_until < at,
        jobs.c.attempts >= queue.MAXIMUM_ATTEMPTS,
    )
