"""Queue of jobs: a table of the database, so that one commit stores a frame and its job.

    enqueue  -->  queued  --claim-->  running  --finish | fail-->  over, or queued again

Tenants take turns: a claim selects the tenant with the oldest latest claim, and its due job of
highest priority. Upkeep without a tenant, such as the re-encoding of a map, waits for all other
jobs.

A claim is a lease: if the worker does not renew it in time, another worker can claim the job. The
token of a job increases with each claim, and results with an older token are refused. A job may
therefore run twice, but takes effect only once.

On PostgreSQL, claims and renewals take no turn (`write(turn=False)`), so that a thousand workers do
not delay uploads. Locks of the row of the job order them:

- two claims: SKIP LOCKED makes each continue with the next job; a row that changed before it was
  locked is checked again, and skipped if it is no longer due;
- a claim, and an end (`finish`, `fail`, `requeue_slice`, `release_job`, `check_held`) by a worker
  whose lease has expired: either the end locks the job first and the claim skips it, or the claim
  is first and the end reads another token;
- a claim, and `cancel`, a deletion, `dead_letter` or `fail_dead_worker`, which lock the job first:
  after a claim, they wait for its commit and see the new row (READ COMMITTED evaluates WHERE
  again); before a claim, they make it skip the job;
- a renewal, and any of these: the UPDATE of the row with its token waits for the other transaction,
  and then changes the row or matches none.

Claims and writers with a turn lock the job before its frame, which rules out deadlocks. Times come
from the clock of the database (`now`), since those of hosts may differ by hours.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

from sqlalchemy import (
    ColumnElement,
    Connection,
    Label,
    Row,
    Select,
    and_,
    delete,
    func,
    insert,
    or_,
    select,
    update,
)

from sceneprint.errors import JobOver, LostLease, UnknownJob
from sceneprint.process import NOBODY
from sceneprint.store.maps import add_usage
from sceneprint.store.tables import (
    ARCHIVE,
    JOB_COLUMNS,
    JobRow,
    count_rows,
    frames,
    job_files,
    job_items,
    job_of_columns,
    job_row,
    job_values,
    jobs,
    maps,
    now,
    rows_among,
    tenants,
)
from sceneprint.store.tenants import save_turns
from sceneprint_client.api import JobState


@dataclass(frozen=True)
class ListedJob:
    """A job, with the names of its frame and its map."""

    job: JobRow
    frame_id: str | None
    map_name: str | None
    followed_by: str | None  # id of the latest later job of the same frame and kind


def list_jobs(
    connection: Connection, before: int | None, limit: int, state: JobState | None,
    kind: str | None = None, map_names: Collection[str] | None = None,
) -> list[ListedJob]:  # fmt: skip
    """Return jobs, newest first.

    Parameters
    ----------
    before : number of the last job of the previous page
    limit : maximum number of jobs
    state, kind : conditions; None matches all jobs
    map_names : names of the selected maps, excluding jobs without a map; None selects all jobs
    """
    last = _later_job().scalar_subquery()
    statement = (
        select(
            *JOB_COLUMNS, frames.c.id.label("frame_id"), maps.c.name.label("map_name"),
            last.label("followed_by"),
        )
        .join(frames, frames.c.number == jobs.c.frame_number, isouter=True)
        .join(maps, maps.c.number == jobs.c.map_number, isouter=True)
        .order_by(jobs.c.number.desc())
        .limit(limit)
    )  # fmt: skip
    if kind is not None:
        statement = statement.where(jobs.c.kind == kind)
    if map_names is not None:
        statement = statement.where(maps.c.name.in_(list(map_names)))
    if before is not None:
        statement = statement.where(jobs.c.number < before)
    if state is not None:
        statement = statement.where(jobs.c.state == state)
    rows: list[Any] = list(connection.execute(statement))
    return [ListedJob(job_of_columns(row), *row[len(JOB_COLUMNS) :]) for row in rows]


def _later_job() -> Select[tuple[str]]:
    """Return a subquery for the latest later job with the same frame, kind and model as a job."""
    later = jobs.alias()
    return (
        select(later.c.id)
        .where(
            later.c.frame_number == jobs.c.frame_number, later.c.kind == jobs.c.kind,
            later.c.model_id.is_not_distinct_from(jobs.c.model_id), later.c.number > jobs.c.number,
        )
        .order_by(later.c.number.desc())
        .limit(1)
        .correlate(jobs)
    )  # fmt: skip


def find_job(connection: Connection, job_id: str) -> JobRow:
    """Return a job by id. Raise UnknownJob if it does not exist."""
    row = connection.execute(select(jobs).where(jobs.c.id == job_id)).mappings().first()
    if row is None:
        raise unknown_job(job_id)
    return job_row(row)


def job_of_number(connection: Connection, number: int) -> JobRow | None:
    """Return a job by number; None if it was removed."""
    row = connection.execute(select(jobs).where(jobs.c.number == number)).mappings().first()
    return None if row is None else job_row(row)


def unknown_job(job_id: str) -> UnknownJob:
    """Return the error for a job that does not exist or is hidden from the caller."""
    return UnknownJob(
        f"There is no job {job_id!r:.80}. Check the id in the response to the upload. The deletion "
        "of a map also deletes its jobs."
    )


def latest_job(
    connection: Connection, kind: str, frame_number: int, model_id: str | None = None
) -> JobRow | None:
    """Return the latest job of a frame with a kind and a model; None without such a job."""
    row = connection.execute(
        select(jobs)
        .where(
            jobs.c.frame_number == frame_number, jobs.c.kind == kind,
            jobs.c.model_id.is_(None) if model_id is None else jobs.c.model_id == model_id,
        )
        .order_by(jobs.c.number.desc())
        .limit(1)
    ).mappings().first()  # fmt: skip
    return None if row is None else job_row(row)


def signing_jobs(connection: Connection, frame_numbers: list[int]) -> dict[int, str]:
    """Return the id of the latest job of the kind `sign` of each frame, by frame number."""
    statement = select(jobs.c.frame_number, jobs.c.id).where(jobs.c.kind == "sign")
    rows = rows_among(
        connection, statement.order_by(jobs.c.number), jobs.c.frame_number, frame_numbers
    )
    return {row[0]: row[1] for row in rows}


def count_jobs(
    connection: Connection, map_number: int | None = None,
    states: Collection[JobState] | None = None,
) -> dict[str, int]:  # fmt: skip
    """Count the jobs of a map, or of all maps, by state.

    Of a retried dead job, only the latest retry counts. With `states`, count exactly these states.
    """
    counts = select(jobs.c.state, func.count()).group_by(jobs.c.state)
    if map_number is not None:
        counts = counts.where(jobs.c.map_number == map_number)
    if states is not None:
        counts = counts.where(jobs.c.state.in_(states))
    totals = dict.fromkeys(map(str, states or ()), 0)
    totals |= {row[0]: row[1] for row in connection.execute(counts)}
    if totals.get(JobState.DEAD):
        retried = select(func.count()).where(jobs.c.state == JobState.DEAD, _later_job().exists())
        if map_number is not None:
            retried = retried.where(jobs.c.map_number == map_number)
        totals[JobState.DEAD] -= connection.execute(retried).scalar_one()
        if states is None and not totals[JobState.DEAD]:
            del totals[JobState.DEAD]
    return totals


def waiting_by_tenant(connection: Connection) -> dict[str, int]:
    """Count the queued jobs by tenant, for tenants with queued jobs."""
    counts = select(jobs.c.tenant, func.count()).where(jobs.c.state == JobState.QUEUED)
    return {row[0]: row[1] for row in connection.execute(counts.group_by(jobs.c.tenant))}


def read_clock(connection: Connection) -> float:
    """Return the current time by the clock of the database, seconds since 1970."""
    if connection.dialect.name == "sqlite":
        return time.time()
    return float(connection.execute(select(now(connection))).scalar_one())


#: States of unfinished jobs.
PENDING = (JobState.QUEUED, JobState.RUNNING)
#: Number of failures after which a job is dead.
MAXIMUM_FAILURES = 3
#: Number of attempts after which a job is dead. It exceeds MAXIMUM_FAILURES, because a worker may
#: die for reasons other than its job, such as frequent restarts of a machine.
MAXIMUM_ATTEMPTS = 10
#: Highest priority of upkeep jobs.
UPKEEP = -10
#: Pause before the second attempt, seconds. It quadruples with each failure.
BACKOFF_S = 2.0
#: Maximum pause of a job, and maximum lease, seconds. Later times were written before the clock was
#: set back, so the job is due immediately.
LONGEST_PAUSE_S, LONGEST_LEASE_S = 60.0, 3600.0


def enqueue(
    connection: Connection, kind: str, frame_number: int | None, priority: int = 0,
    model_id: str | None = None, *, map_number: int | None = None,
    data: dict[str, Any] | None = None,
) -> JobRow:  # fmt: skip
    """Queue a job, in the transaction of the change that requires it.

    Parameters
    ----------
    connection : writing transaction
    kind, frame_number, priority, model_id, data : columns of the table
    map_number : number of the map, for a job without a frame
    """
    map_column: Any = map_number
    if frame_number is not None:
        own = frames.c.number == frame_number
        map_column = select(frames.c.map_number).where(own).scalar_subquery()
    values = job_values(connection, kind, priority, model_id, data)
    new = insert(jobs).values(map_number=map_column, frame_number=frame_number, **values)
    return job_row(connection.execute(new.returning(jobs)).mappings().one())


def due_in_s(connection: Connection) -> float | None:
    """Return the seconds until a job is due or a lease expires; None without jobs. Take no lock."""
    waiting = select(func.min(jobs.c.run_after)).where(jobs.c.state == JobState.QUEUED)
    silent = select(func.min(jobs.c.leased_until)).where(jobs.c.state == JobState.RUNNING)
    scalars = [connection.execute(due).scalar() for due in (waiting, silent)]
    times = [time for time in scalars if time is not None]
    return min(times) - read_clock(connection) if times else None


def has_due(connection: Connection) -> bool:
    """Return whether a job can be claimed or must be marked as dead. Take no lock."""
    at = now(connection)
    early, late = jobs.c.run_after <= at, jobs.c.run_after > at + LONGEST_PAUSE_S
    waiting = and_(jobs.c.state == JobState.QUEUED, or_(early, late))
    silent = and_(jobs.c.state == JobState.RUNNING, _lease_over(at))
    statement = select(jobs.c.number).where(or_(waiting, silent)).limit(1)
    return connection.execute(statement).first() is not None


def _lease_over(at: ColumnElement[float]) -> ColumnElement[bool]:
    """Return the condition for leases that have expired, or began before the clock was set back."""
    return or_(jobs.c.leased_until < at, jobs.c.leased_until > at + LONGEST_LEASE_S)


def claim(connection: Connection, worker: str, lease_s: float) -> JobRow | None:
    """Claim the next job that is queued or has an expired lease; return None without such a job.

    Parameters
    ----------
    connection : writing transaction
    lease_s : duration of the lease, seconds
    """
    at = now(connection)
    waiting = _waiting(at)
    silent = jobs.c.state == JobState.RUNNING, _lease_over(at)
    place = None
    for tenant in _tenants_due(connection, *waiting):  # continue if all jobs of a tenant are locked
        place = _lock_first(connection, tenant.turn, *waiting, jobs.c.tenant == tenant.tenant)
        if place is not None:
            break
    # prefer a job with an expired lease if it comes first; there are few such jobs
    other = _first_of_few(connection, *silent)
    if other is not None and (place is None or other < place):
        own = jobs.c.number == other.number
        place = _lock_first(connection, other.turn, *silent, own) or place
    if place is None:
        return None
    row = connection.execute(
        update(jobs)
        .where(jobs.c.number == place.number)
        .values(
            state=JobState.RUNNING, attempts=jobs.c.attempts + 1, token=jobs.c.token + 1,
            leased_until=at + lease_s, worker=worker, started_at=at,
            turn=_last_turn(connection) + 1,
        )
        .returning(jobs)
    ).mappings().one()  # fmt: skip
    return job_row(row)


#: Aliases of the table, created only once, since each takes a millisecond.
_FIRST, _LATER, _TURNS = (jobs.alias() for _ in range(3))


class _Place(NamedTuple):
    """Position of a job in the order of claims, lowest first."""

    upkeep: bool
    turn: int  # latest turn of its tenant
    tenant: str
    later: int  # negated priority
    attempts: int
    number: int


def _lock_first(connection: Connection, turn: int, *due: ColumnElement[bool]) -> _Place | None:
    """Lock the first due job of a tenant; return None if other workers have locked all of them.

    Jobs with fewer attempts come first, so that a job that kills workers does not block others.
    """
    row = connection.execute(
        select(jobs.c.priority, jobs.c.attempts, jobs.c.number, jobs.c.tenant)
        .where(*due, jobs.c.attempts < MAXIMUM_ATTEMPTS)
        .order_by(jobs.c.priority.desc(), jobs.c.attempts, jobs.c.number)
        .limit(1)
        .with_for_update(skip_locked=True)
    ).first()
    return None if row is None else _place(row, turn)


def _first_of_few(connection: Connection, *due: ColumnElement[bool]) -> _Place | None:
    """Return the first due job of all tenants, by reading all due jobs."""
    statement = select(
        jobs.c.priority, jobs.c.attempts, jobs.c.number, jobs.c.tenant, *_turns_of(jobs.c.tenant)
    ).where(*due, jobs.c.attempts < MAXIMUM_ATTEMPTS)
    rows = connection.execute(statement).all()
    return min((_place(row, _latest(row.of_jobs, row.saved)) for row in rows), default=None)


def _place(row: Row[*tuple[Any, ...]], turn: int) -> _Place:
    return _Place(
        _is_upkeep(row.tenant, row.priority), turn, row.tenant, -row.priority, row.attempts,
        row.number,
    )  # fmt: skip


def _latest(*turns: int | None) -> int:
    return max(turn or 0 for turn in turns)


def _is_upkeep(tenant: str, priority: int) -> bool:
    """Return whether a job is upkeep, which yields to all other jobs."""
    return tenant == NOBODY and priority <= UPKEEP


def _turns_of(tenant: ColumnElement[str]) -> tuple[Label[int | None], Label[int | None]]:
    """Return expressions for the latest turn of a tenant's jobs, and of its removed jobs."""
    of_jobs = select(func.max(_TURNS.c.turn)).where(_TURNS.c.tenant == tenant)
    saved = select(tenants.c.turn).where(tenants.c.name == tenant)
    return of_jobs.scalar_subquery().label("of_jobs"), saved.scalar_subquery().label("saved")


class _TenantDue(NamedTuple):
    """A tenant with a due job, sorted by precedence, lowest first."""

    upkeep: bool
    turn: int  # latest turn
    tenant: str
    priority: int  # priority of its first job


def _tenants_due(connection: Connection, *due: ColumnElement[bool]) -> list[_TenantDue]:
    """Return the tenants with a due job, in the order of claims.

    The cost depends on the number of tenants with queued jobs, not on the number of jobs.
    """
    names = (
        select(func.min(_FIRST.c.tenant).label("tenant"))
        .where(_FIRST.c.state == JobState.QUEUED)
        .cte("names", recursive=True)
    )
    following = (
        select(func.min(_LATER.c.tenant))
        .where(_LATER.c.state == JobState.QUEUED, _LATER.c.tenant > names.c.tenant)
        .correlate(names)
        .scalar_subquery()
    )
    names = names.union_all(select(following).where(names.c.tenant.is_not(None)))
    best = (
        select(jobs.c.priority)
        .where(*due, jobs.c.attempts < MAXIMUM_ATTEMPTS, jobs.c.tenant == names.c.tenant)
        .order_by(jobs.c.priority.desc(), jobs.c.attempts, jobs.c.number)
        .limit(1)
        .correlate(names)
        .scalar_subquery()
        .label("best")
    )
    statement = select(names.c.tenant, best, *_turns_of(names.c.tenant)).where(
        names.c.tenant.is_not(None)
    )
    rows = (row for row in connection.execute(statement) if row.best is not None)
    return sorted(
        _TenantDue(
            _is_upkeep(row.tenant, row.best), _latest(row.of_jobs, row.saved), row.tenant, row.best
        )
        for row in rows
    )


def has_waiting_before(connection: Connection, held: JobRow) -> bool:
    """Return whether a waiting job precedes the next slice of a running job."""
    return any(
        tenant.tenant != held.tenant or tenant.priority > held.priority
        for tenant in _tenants_due(connection, *_waiting(now(connection)))
        if not tenant.upkeep
    )


def _waiting(at: ColumnElement[float]) -> tuple[ColumnElement[bool], ...]:
    """Return the SQL conditions for queued jobs that are due."""
    # "+ 0.0" makes SQLite use the sorted index instead of sorting all due jobs
    due_at = jobs.c.run_after + 0.0
    return jobs.c.state == JobState.QUEUED, or_(due_at <= at, due_at > at + LONGEST_PAUSE_S)


def _last_turn(connection: Connection) -> int:
    """Return the latest turn of any tenant."""
    of_jobs, saved = select(func.max(jobs.c.turn)), select(func.max(tenants.c.turn))
    statement = select(of_jobs.scalar_subquery(), saved.scalar_subquery())
    return _latest(*connection.execute(statement).one())


def renew(connection: Connection, held: JobRow, lease_s: float) -> None:
    """Renew a lease for `lease_s` seconds. Raise LostLease if the job is no longer held."""
    _update_held(connection, held, leased_until=now(connection) + lease_s)


def check_held(connection: Connection, held: JobRow) -> None:
    """Check that a worker still holds a job, in the transaction that stores part of its work.

    Raises
    ------
    LostLease : If another worker holds the job, or the job is over.
    """
    # lock the job until the commit, so that no other worker claims it if the lease has expired
    own = select(jobs.c.number).where(*_held_conditions(held)).with_for_update()
    if connection.execute(own).first() is None:
        raise _lost(held)


def finish(
    connection: Connection, held: JobRow, state: JobState, error: str | None = None,
    traceback: str | None = None, **values: object,
) -> None:  # fmt: skip
    """End a job, in the transaction that stores its results; `values` are further columns.

    Raises
    ------
    LostLease : See `renew`.
    """
    _update_held(
        connection, held, state=state, error=error, traceback=traceback, leased_until=None,
        finished_at=now(connection), **values,
    )  # fmt: skip


def requeue_slice(
    connection: Connection, held: JobRow, progress: dict[str, Any], after_s: float = 0.0
) -> None:
    """Queue the next slice of a long job behind waiting jobs, and reset its attempts.

    Parameters
    ----------
    connection : writing transaction
    progress : new value of the column `progress`
    after_s : seconds until the job is due

    Raises
    ------
    LostLease : If another worker holds the job, or the job is over.
    """
    # one attempt, not zero, so that the job does not precede later jobs
    _update_held(
        connection, held, state=JobState.QUEUED, attempts=1, failures=0,
        leased_until=None, worker=None, run_after=now(connection) + after_s, progress=progress,
    )  # fmt: skip


def fail(connection: Connection, held: JobRow, error: str, traceback: str) -> JobState:
    """Queue a failed job for another attempt, or mark it as dead; return its new state.

    Raises
    ------
    LostLease : If another worker holds the job, or the job is over.
    """
    # read the count again: the death of an earlier worker may have been counted since the claim
    stored = select(jobs.c.failures).where(jobs.c.number == held.number)
    failures = (connection.execute(stored).scalar() or 0) + 1
    if failures >= MAXIMUM_FAILURES or held.attempts >= MAXIMUM_ATTEMPTS:
        finish(connection, held, JobState.DEAD, error, traceback)
        return JobState.DEAD
    _update_held(
        connection, held, state=JobState.QUEUED, error=error, traceback=traceback,
        failures=failures, leased_until=None, run_after=now(connection) + pause_s(failures),
    )  # fmt: skip
    return JobState.QUEUED


def pause_s(failures: int) -> float:
    """Return the pause, in seconds, before the next attempt at a job with this many failures."""
    return BACKOFF_S * 4.0 ** (failures - 1)


def release_job(connection: Connection, held: JobRow, after_s: float = 0.0) -> None:
    """Return a claimed job to the queue without counting the attempt.

    Parameters
    ----------
    connection : writing transaction
    after_s : seconds until the job is due

    Raises
    ------
    LostLease : See `renew`.
    """
    _update_held(
        connection, held, state=JobState.QUEUED, attempts=held.attempts - 1,
        leased_until=None, worker=None, run_after=now(connection) + after_s,
    )  # fmt: skip


def _update_held(connection: Connection, held: JobRow, **values: object) -> None:
    """Change columns of a job. Raise LostLease if the worker no longer holds the job."""
    changed = connection.execute(update(jobs).where(*_held_conditions(held)).values(**values))
    if changed.rowcount != 1:
        raise _lost(held)


def _held_conditions(held: JobRow) -> tuple[ColumnElement[bool], ...]:
    """Return the SQL conditions under which a worker still holds a job."""
    return (
        jobs.c.number == held.number,
        jobs.c.token == held.token,
        jobs.c.state == JobState.RUNNING,
        # a promoted standby that lacks the claim may issue its token again
        jobs.c.worker == held.worker,
    )


def _lost(held: JobRow) -> LostLease:
    return LostLease(
        f"This worker no longer holds job {held.id}: the lease expired, or the job was cancelled. "
        "Nothing was stored."
    )


def has_exhausted(connection: Connection) -> bool:
    """Return whether `dead_letter` would mark a job as dead. Take no lock."""
    statement = select(jobs.c.number).where(*_out_of_tries(now(connection))).limit(1)
    return connection.execute(statement).first() is not None


def dead_letter(connection: Connection) -> list[JobRow]:
    """Mark jobs as dead if their workers stopped responding in all attempts; return these jobs."""
    at = now(connection)
    rows = connection.execute(
        update(jobs)
        .where(*_out_of_tries(at))
        .values(
            state=JobState.DEAD, finished_at=at, leased_until=None,
            error=f"its worker stopped responding in the last of {MAXIMUM_ATTEMPTS} attempts",
        )
        .returning(jobs)
    ).mappings()  # fmt: skip
    return [job_row(row) for row in rows]


def fail_dead_worker(
    connection: Connection, job_id: str, token: int, error: str, traceback: str, *, counts: bool
) -> JobRow | None:
    """Queue the job of a dead worker again, or mark it as dead, before the lease expires.

    If another worker has claimed the job, only count the failure.

    Parameters
    ----------
    connection : writing transaction
    error, traceback : description of the worker's death
    counts : whether the attempt counts as a failure, since the job may have caused the death

    Returns
    -------
    job : changed job; None if the job is over, or another worker has claimed it
    """
    # lock the job, since claims take no turn
    locked = select(jobs).where(jobs.c.id == job_id).with_for_update()
    row = connection.execute(locked).mappings().first()
    if row is None or JobState(row["state"]).over:
        return None
    held = row["token"] == token and row["state"] == JobState.RUNNING
    if not held and (row["token"] == token or not counts):
        return None
    failures = row["failures"] + counts
    values = {"failures": failures, "error": error, "traceback": traceback}
    if failures >= MAXIMUM_FAILURES or (held and row["attempts"] >= MAXIMUM_ATTEMPTS):
        values |= {"state": JobState.DEAD, "leased_until": None, "finished_at": now(connection)}
    elif held:
        again = now(connection) + pause_s(max(failures, 1))
        values |= {"state": JobState.QUEUED, "leased_until": None, "run_after": again}
    change = update(jobs).where(jobs.c.number == row["number"]).values(**values).returning(jobs)
    job = job_row(connection.execute(change).mappings().one())
    return None if job.state == JobState.RUNNING else job


def _out_of_tries(at: ColumnElement[float]) -> tuple[ColumnElement[bool], ...]:
    """Return the SQL conditions for jobs whose worker stopped responding in the last attempt."""
    return (
        jobs.c.state == JobState.RUNNING,
        _lease_over(at),
        jobs.c.attempts >= MAXIMUM_ATTEMPTS,
    )


def cancel(connection: Connection, job: JobRow) -> None:
    """Cancel a job; a worker that runs it cannot store its result.

    Raises
    ------
    JobOver : If the job is over.
    """
    if job.state.over:
        raise JobOver(f"Job {job.id} is {job.state}: {job.state.sentence} It cannot be cancelled.")
    cancel_jobs(connection, jobs.c.number == job.number)


def cancel_jobs(connection: Connection, *which: ColumnElement[bool]) -> None:
    """Cancel the queued and running jobs that satisfy all conditions in `which`."""
    connection.execute(
        update(jobs)
        .where(*which, jobs.c.state.in_(PENDING))
        .values(state=JobState.CANCELLED, finished_at=now(connection), leased_until=None)
    )


def requeue_job(connection: Connection, job: JobRow) -> None:
    """Queue a finished job again, and reset its attempts."""
    connection.execute(
        update(jobs)
        .where(jobs.c.number == job.number)
        .values(
            state=JobState.QUEUED, attempts=0, failures=0, error=None, traceback=None,
            finished_at=None, leased_until=None, worker=None, run_after=now(connection),
        )
    )  # fmt: skip


# Results of long jobs: items and files.

#: Number of rows to insert at once.
_BLOCK = 500


@dataclass(frozen=True)
class JobFile:
    """A file of a job.

    Parameters
    ----------
    name : unique name within the job, such as mesh.ply
    blob : digest of the content, whose blob must exist
    """

    name: str
    blob: str
    bytes: int
    media_type: str


def append_items(connection: Connection, job_number: int, items: list[dict[str, Any]]) -> None:
    """Append items to the results of a job."""
    first = count_rows(connection, job_items.c.job_number == job_number)
    for start in range(0, len(items), _BLOCK):
        rows = [
            {"job_number": job_number, "number": first + start + i, "data": item}
            for i, item in enumerate(items[start : start + _BLOCK])
        ]
        connection.execute(insert(job_items), rows)


def items_of(
    connection: Connection, job_number: int, first: int = 0, limit: int | None = None
) -> list[dict[str, Any]]:
    """Return items of a job in order, starting at number `first`."""
    statement = (
        select(job_items.c.data)
        .where(job_items.c.job_number == job_number, job_items.c.number >= first)
        .order_by(job_items.c.number)
        .limit(limit)
    )
    return list(connection.execute(statement).scalars())


def add_files(connection: Connection, job_number: int, files: Iterable[JobFile]) -> None:
    """Add files to a job; replace files of the same names. An archive counts against the quota."""
    for file in files:
        remove_parts(connection, job_number, items=False, files=[file.name])
        connection.execute(insert(job_files).values(job_number=job_number, **asdict(file)))
        if file.name == ARCHIVE:
            _count_archive(connection, job_number, file.bytes)


def _count_archive(connection: Connection, job_number: int, size: int) -> None:
    """Add the size of the archive of an import to the usage of its map."""
    own = select(jobs.c.map_number).where(jobs.c.number == job_number)
    map_number: Any = own.scalar_subquery()
    add_usage(connection, map_number, 0, size)


def files_of(connection: Connection, job_number: int) -> dict[str, JobFile]:
    """Return the files of a job by name."""
    c = job_files.c
    statement = select(c.name, c.blob, c.bytes, c.media_type).where(c.job_number == job_number)
    return {row.name: JobFile(*row) for row in connection.execute(statement.order_by(c.name))}


def jobs_with_files(connection: Connection, kind: str) -> list[JobRow]:
    """Return the jobs of a kind that have files, oldest first."""
    having = jobs.c.number.in_(select(job_files.c.job_number)), jobs.c.kind == kind
    rows = connection.execute(select(jobs).where(*having).order_by(jobs.c.number)).mappings()
    return [job_row(row) for row in rows]


def finished_with_file(connection: Connection, name: str) -> list[int]:
    """Return the numbers of finished jobs that have a file with this name."""
    over = jobs.c.state.in_([state for state in JobState if state.over])
    statement = (
        select(jobs.c.number)
        .join(job_files, job_files.c.job_number == jobs.c.number)
        .where(job_files.c.name == name, over)
    )
    return list(connection.execute(statement).scalars())


def remove_parts(
    connection: Connection, job_number: int, *, items: bool = True,
    files: Iterable[str] | None = None,
) -> list[str]:  # fmt: skip
    """Remove items and files from a job; an archive no longer counts against the quota.

    Parameters
    ----------
    connection : writing transaction
    files : names of the files to remove; default: all files

    Returns
    -------
    blobs : blobs of the removed files, to be collected after the commit
    """
    if items:
        connection.execute(delete(job_items).where(job_items.c.job_number == job_number))
    own = job_files.c.job_number == job_number
    if files is not None:
        own &= job_files.c.name.in_(list(files))
    c = job_files.c
    removed = connection.execute(select(c.name, c.blob, c.bytes).where(own)).all()
    connection.execute(delete(job_files).where(own))
    for file in removed:
        if file.name == ARCHIVE:
            _count_archive(connection, job_number, -file.bytes)
    return [file.blob for file in removed]


def replace_result(connection: Connection, job: JobRow, result: dict[str, Any]) -> JobRow:
    """Replace the result of a finished job; return the changed job."""
    own = update(jobs).where(jobs.c.number == job.number).values(result=result)
    return job_row(connection.execute(own.returning(jobs)).mappings().one())


def remove_job(connection: Connection, job: JobRow) -> list[str]:
    """Remove a job with its items and files; a worker that runs it loses its lease.

    Returns
    -------
    blobs : blobs of the removed files, to be collected after the commit
    """
    blobs = remove_parts(connection, job.number)
    save_turns(connection, job.tenant)
    connection.execute(delete(jobs).where(jobs.c.number == job.number))
    return blobs
