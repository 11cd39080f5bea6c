"""The queue: jobs as rows, so that a frame and its job are one commit.

    enqueue  -->  queued  --claim-->  running  --finish | fail-->  over, or queued again

Tenants take turns: a claim takes a due job of the tenant whose last claim is oldest, the one with
the highest priority. Between two jobs of a tenant, each other tenant gets at most one per
concurrently claiming worker. Upkeep without a tenant, such as the re-encoding of a map, waits for
all other jobs.

A claim is a lease: if the worker does not renew it in time, another worker gets the job. Each claim
has a token greater than the last, and results with an older token are refused. So a job may run
twice, but takes effect once.

On PostgreSQL, claims and renewals wait for no turn (`write(turn=False)`), so that a thousand
workers do not delay uploads. Locks of the job's row order them:

- two claims: SKIP LOCKED makes each go on to the next job; a row that changed before it was locked
  is checked again, and skipped if it is no longer due;
- a claim, and an end (`finish`, `fail`, `requeue_slice`, `release_job`, `check_held`) by a worker
  whose lease is over: either the end locks the job first and the claim skips it, or the claim is
  first and the end finds another token;
- a claim, and `cancel`, a deletion, `dead_letter` or `fail_dead_worker`: these lock the job before
  all else. If the claim is first, they wait for its commit and see the new row (READ COMMITTED
  evaluates WHERE again); else the claim skips the job;
- a renewal, and any of these: the UPDATE of the row with its token waits for the other one, and
  then changes the row or finds none.

A claim locks the job before its frame, and so do writers with a turn, which rules out deadlocks.
Times are the database's (`now`), since the clocks of hosts may differ by hours.
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
    """A job with the names of its frame and map."""

    job: JobRow
    frame_id: str | None
    map_name: str | None
    followed_by: str | None  # id of the latest job of the same frame and kind, if it is another


def list_jobs(
    connection: Connection, before: int | None, limit: int, state: JobState | None,
    kind: str | None = None, map_names: Collection[str] | None = None,
) -> list[ListedJob]:  # fmt: skip
    """Return jobs, the newest first.

    Parameters
    ----------
    before : number of the last job of the previous page
    limit : maximum number of jobs
    state, kind : conditions; None: any
    map_names : names of the only maps; jobs without a map are excluded then
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
    """Select the id of the latest job of the frame, kind and model of a job, if it is another."""
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
    """Return the job of an id; raise UnknownJob if the job does not exist."""
    row = connection.execute(select(jobs).where(jobs.c.id == job_id)).mappings().first()
    if row is None:
        raise unknown_job(job_id)
    return job_row(row)


def job_of_number(connection: Connection, number: int) -> JobRow | None:
    """Return the job of a number; None if it was removed."""
    row = connection.execute(select(jobs).where(jobs.c.number == number)).mappings().first()
    return None if row is None else job_row(row)


def unknown_job(job_id: str) -> UnknownJob:
    """Return the error for a job that does not exist, or that the caller may not see."""
    return UnknownJob(
        f"There is no job {job_id!r:.80}. An upload returns the id of its job, and deleting a map "
        "deletes its jobs."
    )


def latest_job(
    connection: Connection, kind: str, frame_number: int, model_id: str | None = None
) -> JobRow | None:
    """Return the latest job of a frame with a kind and model."""
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
    """Return the latest `sign` job of each frame, without its re-encodings."""
    statement = select(jobs.c.frame_number, jobs.c.id).where(jobs.c.kind == "sign")
    rows = rows_among(
        connection, statement.order_by(jobs.c.number), jobs.c.frame_number, frame_numbers
    )
    return {row[0]: row[1] for row in rows}


def count_jobs(
    connection: Connection, map_number: int | None = None,
    states: Collection[JobState] | None = None,
) -> dict[str, int]:  # fmt: skip
    """Return the numbers of jobs by state, of one map or of all; requested ones may be 0.

    A dead job that was retried does not count: its latest retry does.
    """
    counts = select(jobs.c.state, func.count()).group_by(jobs.c.state)
    if map_number is not None:
        counts = counts.where(jobs.c.map_number == map_number)
    if states is not None:
        counts = counts.where(jobs.c.state.in_(states))
    found = dict.fromkeys(map(str, states or ()), 0)
    found |= {row[0]: row[1] for row in connection.execute(counts)}
    if found.get(JobState.DEAD):
        retried = select(func.count()).where(jobs.c.state == JobState.DEAD, _later_job().exists())
        if map_number is not None:
            retried = retried.where(jobs.c.map_number == map_number)
        found[JobState.DEAD] -= connection.execute(retried).scalar_one()
        if states is None and not found[JobState.DEAD]:
            del found[JobState.DEAD]
    return found


def waiting_by_tenant(connection: Connection) -> dict[str, int]:
    """Return the number of queued jobs of each tenant that has any."""
    counts = select(jobs.c.tenant, func.count()).where(jobs.c.state == JobState.QUEUED)
    return {row[0]: row[1] for row in connection.execute(counts.group_by(jobs.c.tenant))}


def read_clock(connection: Connection) -> float:
    """Return the time now by the database's clock, seconds since 1970."""
    if connection.dialect.name == "sqlite":
        return time.time()
    return float(connection.execute(select(now(connection))).scalar_one())


#: States of jobs that are not over.
PENDING = (JobState.QUEUED, JobState.RUNNING)
#: Number of failures after which a job is dead.
MAXIMUM_FAILURES = 3
#: Number of attempts after which a job is dead. It is greater, since a worker may die of another
#: cause than its job: frequent restarts of a machine must not cost a frame.
MAXIMUM_ATTEMPTS = 10
#: Highest priority of upkeep, which no user requested.
UPKEEP = -10
#: Seconds before the second attempt; the pause quadruples with each failure.
BACKOFF_S = 2.0
#: Longest pause of a job, and longest lease (seconds). A job with a later time was written before
#: the clock was set back, and is due now.
LONGEST_PAUSE_S, LONGEST_LEASE_S = 60.0, 3600.0


def enqueue(
    connection: Connection, kind: str, frame_number: int | None, priority: int = 0,
    model_id: str | None = None, *, map_number: int | None = None,
    data: dict[str, Any] | None = None,
) -> JobRow:  # fmt: skip
    """Queue a job, in the transaction of the change that it follows from.

    Parameters
    ----------
    connection : writing transaction
    kind, frame_number, priority, model_id, data : columns of the table
    map_number : map of a job without a single frame; else the frame's map is used
    """
    map_column: Any = map_number
    if frame_number is not None:
        own = frames.c.number == frame_number
        map_column = select(frames.c.map_number).where(own).scalar_subquery()
    values = job_values(connection, kind, priority, model_id, data)
    new = insert(jobs).values(map_number=map_column, frame_number=frame_number, **values)
    return job_row(connection.execute(new.returning(jobs)).mappings().one())


def due_in_s(connection: Connection) -> float | None:
    """Return the seconds until a job can be claimed if none changes; None without jobs. Takes no
    lock.
    """
    waiting = select(func.min(jobs.c.run_after)).where(jobs.c.state == JobState.QUEUED)
    silent = select(func.min(jobs.c.leased_until)).where(jobs.c.state == JobState.RUNNING)
    scalars = [connection.execute(one).scalar() for one in (waiting, silent)]
    times = [time for time in scalars if time is not None]
    return min(times) - read_clock(connection) if times else None


def has_due(connection: Connection) -> bool:
    """Return whether there is a job to claim or to give up, without a lock."""
    at = now(connection)
    early, late = jobs.c.run_after <= at, jobs.c.run_after > at + LONGEST_PAUSE_S
    waiting = and_(jobs.c.state == JobState.QUEUED, or_(early, late))
    silent = and_(jobs.c.state == JobState.RUNNING, _lease_over(at))
    statement = select(jobs.c.number).where(or_(waiting, silent)).limit(1)
    return connection.execute(statement).first() is not None


def _lease_over(at: ColumnElement[float]) -> ColumnElement[bool]:
    """Return the condition that a lease has ended, or is too long to have been granted by this
    clock.
    """
    return or_(jobs.c.leased_until < at, jobs.c.leased_until > at + LONGEST_LEASE_S)


def claim(connection: Connection, worker: str, lease_s: float) -> JobRow | None:
    """Take the next job: a queued one, or one whose lease has ended.

    Parameters
    ----------
    connection : writing transaction
    worker : name of the worker
    lease_s : seconds until the lease ends
    """
    at = now(connection)
    waiting = _waiting(at)
    silent = jobs.c.state == JobState.RUNNING, _lease_over(at)
    place = None
    for one in _tenants_due(connection, *waiting):  # all jobs of the first one may be locked
        place = _lock_first(connection, one.turn, *waiting, jobs.c.tenant == one.tenant)
        if place is not None:
            break
    # a silent worker's job, of which there are few, is locked only if it comes first
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


#: Aliases of the table, created once, as each takes a millisecond.
_FIRST, _LATER, _TURNS = (jobs.alias() for _ in range(3))


class _Place(NamedTuple):
    """The position of a job in the order of claims: the least is next."""

    upkeep: bool
    turn: int  # of its tenant, the latest
    tenant: str
    later: int  # its priority, negated
    attempts: int
    number: int


def _lock_first(connection: Connection, turn: int, *due: ColumnElement[bool]) -> _Place | None:
    """Lock and return the first due job of one tenant; None if other workers have locked all of
    them.

    Jobs with fewer attempts come first, so that a job whose worker dies again and again does not
    block others.
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
    """Return the first due job of all tenants; reads all due jobs."""
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
    return max(one or 0 for one in turns)


def _is_upkeep(tenant: str, priority: int) -> bool:
    """Return whether a job waits for all jobs that users requested."""
    return tenant == NOBODY and priority <= UPKEEP


def _turns_of(tenant: ColumnElement[str]) -> tuple[Label[int | None], Label[int | None]]:
    """Return the latest turns of a tenant: of its jobs, and of its removed jobs."""
    of_jobs = select(func.max(_TURNS.c.turn)).where(_TURNS.c.tenant == tenant)
    saved = select(tenants.c.turn).where(tenants.c.name == tenant)
    return of_jobs.scalar_subquery().label("of_jobs"), saved.scalar_subquery().label("saved")


class _TenantDue(NamedTuple):
    """A tenant with a due job: the least is next."""

    upkeep: bool
    turn: int  # its latest
    tenant: str
    priority: int  # of its first job


def _tenants_due(connection: Connection, *due: ColumnElement[bool]) -> list[_TenantDue]:
    """Return the tenants with a due job, in the order of claims.

    The index is read once for each tenant with a queued job, however many jobs there are.
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
    """Return whether a job of another tenant, or of a higher priority, waits for this one's next
    slice.
    """
    return any(
        one.tenant != held.tenant or one.priority > held.priority
        for one in _tenants_due(connection, *_waiting(now(connection)))
        if not one.upkeep
    )


def _waiting(at: ColumnElement[float]) -> tuple[ColumnElement[bool], ...]:
    """Return the conditions of queued jobs that are due."""
    # "+ 0.0" makes SQLite use the index that has the order, instead of sorting all due jobs
    due_at = jobs.c.run_after + 0.0
    return jobs.c.state == JobState.QUEUED, or_(due_at <= at, due_at > at + LONGEST_PAUSE_S)


def _last_turn(connection: Connection) -> int:
    """Return the latest turn of any tenant."""
    of_jobs, saved = select(func.max(jobs.c.turn)), select(func.max(tenants.c.turn))
    statement = select(of_jobs.scalar_subquery(), saved.scalar_subquery())
    return _latest(*connection.execute(statement).one())


def renew(connection: Connection, held: JobRow, lease_s: float) -> None:
    """Extend a lease; raise LostLease if another worker holds the job, or the job is over."""
    _hold(connection, held, leased_until=now(connection) + lease_s)


def check_held(connection: Connection, held: JobRow) -> None:
    """Check that a claim is the latest, in the transaction that stores a part of its work.

    Raises
    ------
    LostLease : see `renew`.
    """
    # locked until the commit, so that no worker claims the job meanwhile if the lease is over
    own = select(jobs.c.number).where(*_own(held)).with_for_update()
    if connection.execute(own).first() is None:
        raise _lost(held)


def finish(
    connection: Connection, held: JobRow, state: JobState, error: str | None = None,
    traceback: str | None = None, **values: object,
) -> None:  # fmt: skip
    """End a job, in the transaction that stores its results; `values` are other columns.

    Raises
    ------
    LostLease : see `renew`; the transaction must not be committed.
    """
    _hold(
        connection, held, state=state, error=error, traceback=traceback, leased_until=None,
        finished_at=now(connection), **values,
    )  # fmt: skip


def requeue_slice(
    connection: Connection, held: JobRow, progress: dict[str, Any], after_s: float = 0.0
) -> None:
    """Queue a long job for its next slice, behind waiting jobs; the attempts start again.

    Parameters
    ----------
    connection : writing transaction
    progress : progress so far
    after_s : seconds until the job is due

    Raises
    ------
    LostLease : see `renew`.
    """
    # one attempt, not zero: the job's number is lower than those of later jobs, and would put it
    # before them again
    _hold(
        connection, held, state=JobState.QUEUED, attempts=1, failures=0,
        leased_until=None, worker=None, run_after=now(connection) + after_s, progress=progress,
    )  # fmt: skip


def fail(connection: Connection, held: JobRow, error: str, traceback: str) -> JobState:
    """Queue a failed job for another attempt, or declare it dead.

    Raises
    ------
    LostLease : see `renew`.
    """
    # read again: the death of an earlier worker may have been counted since the claim
    stored = select(jobs.c.failures).where(jobs.c.number == held.number)
    failures = (connection.execute(stored).scalar() or 0) + 1
    if failures >= MAXIMUM_FAILURES or held.attempts >= MAXIMUM_ATTEMPTS:
        finish(connection, held, JobState.DEAD, error, traceback)
        return JobState.DEAD
    _hold(
        connection, held, state=JobState.QUEUED, error=error, traceback=traceback,
        failures=failures, leased_until=None, run_after=now(connection) + pause_s(failures),
    )  # fmt: skip
    return JobState.QUEUED


def pause_s(failures: int) -> float:
    """Return the seconds before the next attempt of a job after a number of failures."""
    return BACKOFF_S * 4.0 ** (failures - 1)


def release_job(connection: Connection, held: JobRow, after_s: float = 0.0) -> None:
    """Queue a job that was not started, as if it had not been claimed.

    Parameters
    ----------
    connection : writing transaction
    after_s : seconds until the job is due

    Raises
    ------
    LostLease : see `renew`.
    """
    _hold(
        connection, held, state=JobState.QUEUED, attempts=held.attempts - 1,
        leased_until=None, worker=None, run_after=now(connection) + after_s,
    )  # fmt: skip


def _hold(connection: Connection, held: JobRow, **values: object) -> None:
    """Change a job if its claim is the latest; else raise LostLease."""
    changed = connection.execute(update(jobs).where(*_own(held)).values(**values))
    if changed.rowcount != 1:
        raise _lost(held)


def _own(held: JobRow) -> tuple[ColumnElement[bool], ...]:
    """Return the conditions that a job is held by a claim."""
    return (
        jobs.c.number == held.number,
        jobs.c.token == held.token,
        jobs.c.state == JobState.RUNNING,
        # a promoted standby that lacked the claim may have issued its token again
        jobs.c.worker == held.worker,
    )


def _lost(held: JobRow) -> LostLease:
    return LostLease(
        f"Job {held.id} is no longer held by this worker: its lease ran out, or it was "
        "cancelled. Nothing was stored."
    )


def has_exhausted(connection: Connection) -> bool:
    """Return whether there is a job for `dead_letter`, without a lock."""
    statement = select(jobs.c.number).where(*_out_of_tries(now(connection))).limit(1)
    return connection.execute(statement).first() is not None


def dead_letter(connection: Connection) -> list[JobRow]:
    """Declare jobs dead whose workers fall silent again and again, and return them."""
    at = now(connection)
    rows = connection.execute(
        update(jobs)
        .where(*_out_of_tries(at))
        .values(
            state=JobState.DEAD, finished_at=at, leased_until=None,
            error=f"its worker fell silent in the last of {MAXIMUM_ATTEMPTS} attempts",
        )
        .returning(jobs)
    ).mappings()  # fmt: skip
    return [job_row(row) for row in rows]


def fail_dead_worker(
    connection: Connection, job_id: str, token: int, error: str, traceback: str, *, counts: bool
) -> JobRow | None:
    """Take a job from a worker that died, without waiting for its lease: queue it again, or declare
    it dead.

    Parameters
    ----------
    connection : writing transaction
    job_id, token : claim of the dead worker
    error, traceback : description of its death
    counts : whether the job may have caused the death; if not, the attempt is no failure

    Returns
    -------
    job : the job as it is now; None if nothing changed for its workers: the job is over, or another
        worker claimed it when the lease ended
    """
    # locked, as claims wait for no turn
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
    """Return the conditions of a job whose worker fell silent in the last attempt."""
    return (
        jobs.c.state == JobState.RUNNING,
        _lease_over(at),
        jobs.c.attempts >= MAXIMUM_ATTEMPTS,
    )


def cancel(connection: Connection, job: JobRow) -> None:
    """Cancel a job; a worker that runs it learns so when it stores its result.

    Raises
    ------
    JobOver : the job is over.
    """
    if job.state.over:
        raise JobOver(f"Job {job.id} is {job.state}: {job.state.sentence} Nothing is left to do.")
    cancel_jobs(connection, jobs.c.number == job.number)


def cancel_jobs(connection: Connection, *which: ColumnElement[bool]) -> None:
    """Cancel the queued and running jobs that meet some conditions."""
    connection.execute(
        update(jobs)
        .where(*which, jobs.c.state.in_(PENDING))
        .values(state=JobState.CANCELLED, finished_at=now(connection), leased_until=None)
    )


def requeue_job(connection: Connection, job: JobRow) -> None:
    """Queue a finished job again, with all attempts."""
    connection.execute(
        update(jobs)
        .where(jobs.c.number == job.number)
        .values(
            state=JobState.QUEUED, attempts=0, failures=0, error=None, traceback=None,
            finished_at=None, leased_until=None, worker=None, run_after=now(connection),
        )
    )  # fmt: skip


# Results of long jobs: items, appended slice by slice, and files.

#: Number of rows to insert at once.
_BLOCK = 500


@dataclass(frozen=True)
class JobFile:
    """A file of a job.

    Parameters
    ----------
    name : unique name within the job, such as mesh.ply
    blob : existing blob with the content
    bytes : size
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
    """Return items of a job in order, from number `first`."""
    statement = (
        select(job_items.c.data)
        .where(job_items.c.job_number == job_number, job_items.c.number >= first)
        .order_by(job_items.c.number)
        .limit(limit)
    )
    return list(connection.execute(statement).scalars())


def add_files(connection: Connection, job_number: int, files: Iterable[JobFile]) -> None:
    """Add files to a job; they replace files of the same names."""
    for one in files:
        remove_parts(connection, job_number, items=False, files=[one.name])
        connection.execute(insert(job_files).values(job_number=job_number, **asdict(one)))
        if one.name == ARCHIVE:
            _count_archive(connection, job_number, one.bytes)


def _count_archive(connection: Connection, job_number: int, size: int) -> None:
    """Add the bytes of an archive to the use of its import's map."""
    own = select(jobs.c.map_number).where(jobs.c.number == job_number)
    map_number: Any = own.scalar_subquery()
    add_usage(connection, map_number, 0, size)


def files_of(connection: Connection, job_number: int) -> dict[str, JobFile]:
    """Return the files of a job by their names."""
    c = job_files.c
    statement = select(c.name, c.blob, c.bytes, c.media_type).where(c.job_number == job_number)
    return {row.name: JobFile(*row) for row in connection.execute(statement.order_by(c.name))}


def jobs_with_files(connection: Connection, kind: str) -> list[JobRow]:
    """Return the jobs of a kind that have any file, the oldest first."""
    having = jobs.c.number.in_(select(job_files.c.job_number)), jobs.c.kind == kind
    rows = connection.execute(select(jobs).where(*having).order_by(jobs.c.number)).mappings()
    return [job_row(row) for row in rows]


def finished_with_file(connection: Connection, name: str) -> list[int]:
    """Return the numbers of finished jobs that still have a file with a name."""
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
    """Remove items and files of a job.

    Parameters
    ----------
    connection : writing transaction
    items : whether to remove the items
    files : names of the files to remove; default: all

    Returns
    -------
    blobs : blobs of the removed files; sweep them after the commit
    """
    if items:
        connection.execute(delete(job_items).where(job_items.c.job_number == job_number))
    own = job_files.c.job_number == job_number
    if files is not None:
        own &= job_files.c.name.in_(list(files))
    c = job_files.c
    removed = connection.execute(select(c.name, c.blob, c.bytes).where(own)).all()
    connection.execute(delete(job_files).where(own))
    for one in removed:
        if one.name == ARCHIVE:
            _count_archive(connection, job_number, -one.bytes)
    return [one.blob for one in removed]


def replace_result(connection: Connection, job: JobRow, result: dict[str, Any]) -> JobRow:
    """Correct the result of a finished job, and return the job."""
    own = update(jobs).where(jobs.c.number == job.number).values(result=result)
    return job_row(connection.execute(own.returning(jobs)).mappings().one())


def remove_job(connection: Connection, job: JobRow) -> list[str]:
    """Remove a job with its items and files; a worker that runs it loses its lease.

    Returns
    -------
    blobs : blobs of the removed files; sweep them after the commit
    """
    blobs = remove_parts(connection, job.number)
    save_turns(connection, job.tenant)
    connection.execute(delete(jobs).where(jobs.c.number == job.number))
    return blobs
