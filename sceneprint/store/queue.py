"""The queue: jobs as rows, so that a frame and its job are one commit.

    enqueue  -->  queued  --claim-->  running  --finish | fail-->  over, or queued again

A claim is a lease: who does not renew it in time loses the job to another worker. Each claim has
a token greater than the last; a worker that comes back late holds an old one, and what it brings
is refused. So a job may run twice, but takes effect once.

Claims and renewals wait for no turn on PostgreSQL (`write(turn=False)`), where a thousand workers
would stand in the way of uploads. What keeps them apart is the row of the job, locked:

- two claims: SKIP LOCKED, so that each goes on to the next job; a row that changed before it was
  locked is looked at again, and passed over if it is no longer due;
- a claim, and an end (`finish`, `fail`, `go_on`, `give_back`, `check_held`) by a worker whose
  lease is over: the end locks the job first and the claim passes it over, or the claim was first
  and the end finds another token;
- a claim, and `cancel`, a deletion, `bury` or `fail_of_dead`: these lock the job before all else.
  Where the claim was first they wait for its commit, and see the job as it is then (READ
  COMMITTED looks at WHERE once more); where they were, the claim passes it over;
- a renewal, and any of these: an UPDATE of the token's own row, which waits for the other, and
  then finds that it holds no more, or finds nothing.

A claim locks the job, then its frame; whoever has the turn does so in the same order, so that none
waits in a circle. Times are the database's (`clock`): hosts may differ by hours.
"""

from __future__ import annotations

import uuid
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Connection, and_, func, insert, or_, select, update

from sceneprint.errors import LostLease
from sceneprint.logs import request_id
from sceneprint.schemas import JobState
from sceneprint.store.clock import now, read_clock
from sceneprint.store.listing import find_job
from sceneprint.store.records import JobRow, job_row
from sceneprint.store.tables import frames, jobs

#: Tries that broke down before a job is dead.
MAXIMUM_FAILURES = 3
#: Tries in all before it is. More, as a worker that fell silent or was killed may have died of
#: something else: a machine that is restarted again and again must not cost a frame.
MAXIMUM_ATTEMPTS = 10
#: Seconds before the second try; each further one waits four times as long.
BACKOFF_S = 2.0


@dataclass(frozen=True)
class Claim:
    """A job that this worker holds until its lease runs out."""

    job: JobRow

    @property
    def token(self) -> int:
        """Of this claim alone."""
        return self.job.token


def enqueue(
    connection: Connection, kind: str, frame_number: int | None, priority: int = 0,
    model_id: str | None = None, *, map_number: int | None = None,
    data: dict[str, Any] | None = None,
) -> JobRow:  # fmt: skip
    """Queue a job, in the transaction that stores what it is about.

    Parameters
    ----------
    connection : of a writing transaction
    kind, frame_number, priority, model_id, data : see the table
    map_number : where it is of no single frame; else the frame's map is taken
    """
    job_id = uuid.uuid4().hex
    made = now(connection)
    if data is None and request_id() is not None:
        data = {"request_id": request_id()}  # whose log its worker's lines belong to
    of_map: Any = map_number
    if frame_number is not None:
        of_map = (
            select(frames.c.map_number).where(frames.c.number == frame_number).scalar_subquery()
        )
    connection.execute(
        insert(jobs).values(
            id=job_id, kind=kind, map_number=of_map, frame_number=frame_number,
            model_id=model_id, data=data, state=JobState.QUEUED,
            priority=priority, attempts=0, failures=0, token=0, run_after=made, created_at=made,
        )
    )  # fmt: skip
    return find_job(connection, job_id)


def due_in_s(connection: Connection) -> float | None:
    """Seconds until the next job can be claimed if nobody touches any; costs no lock."""
    waiting = select(func.min(jobs.c.run_after)).where(jobs.c.state == JobState.QUEUED)
    silent = select(func.min(jobs.c.leased_until)).where(jobs.c.state == JobState.RUNNING)
    times = [connection.execute(one).scalar() for one in (waiting, silent)]
    found = [one for one in times if one is not None]
    return min(found) - read_clock(connection) if found else None


def has_due(connection: Connection) -> bool:
    """Whether there is a job to claim or to bury; costs no lock."""
    at = now(connection)
    waiting = and_(jobs.c.state == JobState.QUEUED, jobs.c.run_after <= at)
    silent = and_(jobs.c.state == JobState.RUNNING, jobs.c.leased_until < at)
    asked = select(jobs.c.number).where(or_(waiting, silent)).limit(1)
    return connection.execute(asked).first() is not None


def claim(connection: Connection, worker: str, lease_s: float) -> Claim | None:
    """Take the next job: one that waits, or one whose worker fell silent.

    Parameters
    ----------
    connection : of a writing transaction
    worker : who asks
    lease_s : seconds until it must be renewed
    """
    at = now(connection)
    # "+ 0.0" keeps SQLite to the index that has the order: it would sort all that is due
    waiting = jobs.c.state == JobState.QUEUED, jobs.c.run_after + 0.0 <= at
    silent = jobs.c.state == JobState.RUNNING, jobs.c.leased_until < at
    # of those that fell silent, which are few, one is locked only where its turn is before
    found, other = _first(connection, *waiting, locked=True), _first(connection, *silent)
    if other is not None and (found is None or other < found):
        found = _first(connection, *silent, jobs.c.number == other[-1], locked=True) or found
    if found is None:
        return None
    row = connection.execute(
        update(jobs)
        .where(jobs.c.number == found[-1])
        .values(
            state=JobState.RUNNING, attempts=jobs.c.attempts + 1, token=jobs.c.token + 1,
            leased_until=at + lease_s, worker=worker, started_at=at,
        )
        .returning(jobs)
    ).mappings().one()  # fmt: skip
    return Claim(job_row(row))


def _first(
    connection: Connection, *due: ColumnElement[bool], locked: bool = False
) -> tuple[int, int, int] | None:
    """The first to be claimed of some jobs that are due: its place in the order, and its number.

    What was tried before goes behind what was not: a frame that kills its worker, or a machine
    that dies again and again, must not hold up or use up the same job.
    """
    asked = (
        select(jobs.c.priority, jobs.c.attempts, jobs.c.number)
        .where(*due, jobs.c.attempts < MAXIMUM_ATTEMPTS)
        .order_by(jobs.c.priority.desc(), jobs.c.attempts, jobs.c.number)
        .limit(1)
    )
    if locked:
        asked = asked.with_for_update(skip_locked=True)
    found = connection.execute(asked).first()
    return None if found is None else (-found.priority, found.attempts, found.number)


def renew(connection: Connection, held: Claim, lease_s: float) -> None:
    """Extend a lease.

    Raises
    ------
    LostLease : the job has been given to another worker, or is over.
    """
    _hold(connection, held, leased_until=now(connection) + lease_s)


def check_held(connection: Connection, held: Claim) -> None:
    """See that a claim is still the latest, in the transaction that stores a part of its work.

    Raises
    ------
    LostLease : as `renew`.
    """
    # locked until the commit: else a claim might come in between where the lease is over
    own = select(jobs.c.number).where(*_own(held)).with_for_update()
    if connection.execute(own).first() is None:
        raise _lost(held)


def finish(
    connection: Connection, held: Claim, state: JobState, error: str | None = None,
    traceback: str | None = None, **values: object,
) -> None:  # fmt: skip
    """End a job, in the transaction that stores what it made; `values`: of its other columns.

    Raises
    ------
    LostLease : as `renew`; the transaction must not be committed.
    """
    _hold(
        connection, held, state=state, error=error, traceback=traceback, leased_until=None,
        finished_at=now(connection), **values,
    )  # fmt: skip


def go_on(connection: Connection, held: Claim, progress: dict[str, Any]) -> None:
    """Queue a long job again after a part of it, behind those that wait.

    However many tries it took, they count no more: it came further.

    Raises
    ------
    LostLease : as `renew`.
    """
    # one try, and not none: its number is less than that of all that came since, and it would
    # go before them with every part
    _hold(
        connection, held, state=JobState.QUEUED, attempts=1, failures=0,
        leased_until=None, worker=None, run_after=now(connection), progress=progress,
    )  # fmt: skip


def fail(connection: Connection, held: Claim, error: str, traceback: str) -> JobState:
    """Queue a job that broke down for another try, or let it be dead.

    Raises
    ------
    LostLease : as `renew`.
    """
    # not as it was claimed: an earlier worker may have died over the job since
    known = select(jobs.c.failures).where(jobs.c.number == held.job.number)
    failures = (connection.execute(known).scalar() or 0) + 1
    if failures >= MAXIMUM_FAILURES or held.job.attempts >= MAXIMUM_ATTEMPTS:
        finish(connection, held, JobState.DEAD, error, traceback)
        return JobState.DEAD
    _hold(
        connection, held, state=JobState.QUEUED, error=error, traceback=traceback,
        failures=failures, leased_until=None, run_after=now(connection) + pause_s(failures),
    )  # fmt: skip
    return JobState.QUEUED


def pause_s(failures: int) -> float:
    """Seconds before the next try of a job that broke down so often."""
    return BACKOFF_S * 4.0 ** (failures - 1)


def give_back(connection: Connection, held: Claim, after_s: float = 0.0) -> None:
    """Queue a job again that was not begun, as if it had not been claimed.

    Parameters
    ----------
    connection : of a writing transaction
    held : the job
    after_s : seconds in which others go before it

    Raises
    ------
    LostLease : as `renew`.
    """
    _hold(
        connection, held, state=JobState.QUEUED, attempts=held.job.attempts - 1,
        leased_until=None, worker=None, run_after=now(connection) + after_s,
    )  # fmt: skip


def _hold(connection: Connection, held: Claim, **values: object) -> None:
    """Change a job while its claim is the latest."""
    changed = connection.execute(update(jobs).where(*_own(held)).values(**values))
    if changed.rowcount != 1:
        raise _lost(held)


def _own(held: Claim) -> tuple[ColumnElement[bool], ...]:
    """What holds of a job while a claim on it does."""
    return (
        jobs.c.number == held.job.number,
        jobs.c.token == held.token,
        jobs.c.state == JobState.RUNNING,
        # a standby that lacked the claim, and was promoted, may have given its token to another
        jobs.c.worker == held.job.worker,
    )


def _lost(held: Claim) -> LostLease:
    return LostLease(
        f"Job {held.job.id} is no longer held by this worker: its lease ran out, or it was "
        "cancelled. Nothing was stored."
    )
