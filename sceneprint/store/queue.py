"""The queue: jobs as rows, so that a frame and its job are one commit.

    enqueue  -->  queued  --claim-->  running  --finish | fail-->  over, or queued again

Tenants take turns: a claim goes to the tenant that was served the longest ago of those that have
a job due, and takes its first by priority. Between two turns of one, each other has at most one,
for each worker that claims at the same moment. What nobody asked for, such as the re-encoding of
a map, waits while anybody has a job.

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
- a claim, and `cancel`, a deletion, `dead_letter` or `fail_of_dead`: these lock the job before all
  else. Where the claim was first they wait for its commit, and see the job as it is then (READ
  COMMITTED looks at WHERE once more); where they were, the claim passes it over;
- a renewal, and any of these: an UPDATE of the token's own row, which waits for the other, and
  then finds that it holds no more, or finds nothing.

A claim locks the job, then its frame; whoever has the turn does so in the same order, so that none
waits in a circle. Times are the database's (`now`): hosts may differ by hours.
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
from sceneprint.store.maps import count_on
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
from sceneprint.store.tenants import keep_turns
from sceneprint_client.api import JobState

# Jobs, one by one and as a list.


@dataclass(frozen=True)
class Listed:
    """A job with the names of what it is about."""

    job: JobRow
    frame_id: str | None
    map_name: str | None
    followed_by: str | None  # id of the latest job of the same frame and kind, if it is another


def list_jobs(
    connection: Connection, before: int | None, limit: int, state: JobState | None,
    kind: str | None = None, map_names: Collection[str] | None = None,
) -> list[Listed]:  # fmt: skip
    """Jobs, the newest first, from below number `before` on.

    Parameters
    ----------
    before, limit : see above
    state, kind : of those that are wanted
    map_names : of those that are wanted; jobs of no map are not among them
    """
    later = jobs.alias()
    last = (
        select(later.c.id)
        .where(
            later.c.frame_number == jobs.c.frame_number, later.c.kind == jobs.c.kind,
            later.c.model_id.is_not_distinct_from(jobs.c.model_id), later.c.number > jobs.c.number,
        )
        .order_by(later.c.number.desc())
        .limit(1)
        .correlate(jobs)
        .scalar_subquery()
    )  # fmt: skip
    asked = (
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
        asked = asked.where(jobs.c.kind == kind)
    if map_names is not None:
        asked = asked.where(maps.c.name.in_(list(map_names)))
    if before is not None:
        asked = asked.where(jobs.c.number < before)
    if state is not None:
        asked = asked.where(jobs.c.state == state)
    found: list[Any] = list(connection.execute(asked))
    return [Listed(job_of_columns(row), *row[len(JOB_COLUMNS) :]) for row in found]


def find_job(connection: Connection, job_id: str) -> JobRow:
    """The job of an id.

    Raises
    ------
    UnknownJob : there is none.
    """
    row = connection.execute(select(jobs).where(jobs.c.id == job_id)).mappings().first()
    if row is None:
        raise unknown_job(job_id)
    return job_row(row)


def job_of_number(connection: Connection, number: int) -> JobRow | None:
    """The job of a number; None where it was removed."""
    row = connection.execute(select(jobs).where(jobs.c.number == number)).mappings().first()
    return None if row is None else job_row(row)


def unknown_job(job_id: str) -> UnknownJob:
    """What is said of a job that is not there, or not for whoever asks: the same words."""
    return UnknownJob(
        f"There is no job {job_id!r:.80}. An upload answers with the id of its job, and "
        "deleting a map deletes its jobs."
    )


def last_of(
    connection: Connection, kind: str, frame_number: int, model_id: str | None = None
) -> JobRow | None:
    """The latest job of a kind, and for a model, of a frame."""
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


def job_ids_of(connection: Connection, frame_numbers: list[int]) -> dict[int, str]:
    """The latest job of each frame that is to have it indexed, not those that sign it again."""
    asked = select(jobs.c.frame_number, jobs.c.id).where(jobs.c.kind == "sign")
    found = rows_among(
        connection, asked.order_by(jobs.c.number), jobs.c.frame_number, frame_numbers
    )
    return {row[0]: row[1] for row in found}


def count_jobs(
    connection: Connection, map_number: int | None = None,
    states: Collection[JobState] | None = None,
) -> dict[str, int]:  # fmt: skip
    """How many jobs are in each state that has any, of one map or of all; of some states, 0 too."""
    asked = select(jobs.c.state, func.count()).group_by(jobs.c.state)
    if map_number is not None:
        asked = asked.where(jobs.c.map_number == map_number)
    if states is not None:
        asked = asked.where(jobs.c.state.in_(states))
    none = dict.fromkeys(map(str, states or ()), 0)
    return none | {row[0]: row[1] for row in connection.execute(asked)}


def waiting_by_tenant(connection: Connection) -> dict[str, int]:
    """How many jobs of each tenant wait; of none that has none."""
    asked = select(jobs.c.tenant, func.count()).where(jobs.c.state == JobState.QUEUED)
    return {row[0]: row[1] for row in connection.execute(asked.group_by(jobs.c.tenant))}


def read_clock(connection: Connection) -> float:
    """The time now, seconds since 1970."""
    if connection.dialect.name == "sqlite":
        return time.time()
    return float(connection.execute(select(now(connection))).scalar_one())


#: States of jobs that something may still come of.
PENDING = (JobState.QUEUED, JobState.RUNNING)
#: Tries that broke down before a job is dead.
MAXIMUM_FAILURES = 3
#: Tries in all before it is. More, as a worker that fell silent or was killed may have died of
#: something else: a machine that is restarted again and again must not cost a frame.
MAXIMUM_ATTEMPTS = 10
#: Priority of upkeep, and of whatever else nobody asked for that has no more.
UPKEEP = -10
#: Seconds before the second try; each further one waits four times as long.
BACKOFF_S = 2.0
#: No job waits longer than this, and no lease is longer (seconds): what is due later was written
#: before the clock was set back, and is due now.
LONGEST_PAUSE_S, LONGEST_LEASE_S = 60.0, 3600.0


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
    of_map: Any = map_number
    if frame_number is not None:
        of_map = (
            select(frames.c.map_number).where(frames.c.number == frame_number).scalar_subquery()
        )
    values = job_values(connection, kind, priority, model_id, data)
    made = insert(jobs).values(map_number=of_map, frame_number=frame_number, **values)
    return job_row(connection.execute(made.returning(jobs)).mappings().one())


def due_in_s(connection: Connection) -> float | None:
    """Seconds until the next job can be claimed if nobody touches any; costs no lock."""
    waiting = select(func.min(jobs.c.run_after)).where(jobs.c.state == JobState.QUEUED)
    silent = select(func.min(jobs.c.leased_until)).where(jobs.c.state == JobState.RUNNING)
    times = [connection.execute(one).scalar() for one in (waiting, silent)]
    found = [one for one in times if one is not None]
    return min(found) - read_clock(connection) if found else None


def has_due(connection: Connection) -> bool:
    """Whether there is a job to claim or to move to the dead letters; costs no lock."""
    at = now(connection)
    early, late = jobs.c.run_after <= at, jobs.c.run_after > at + LONGEST_PAUSE_S
    waiting = and_(jobs.c.state == JobState.QUEUED, or_(early, late))
    silent = and_(jobs.c.state == JobState.RUNNING, _lease_over(at))
    asked = select(jobs.c.number).where(or_(waiting, silent)).limit(1)
    return connection.execute(asked).first() is not None


def _lease_over(at: ColumnElement[float]) -> ColumnElement[bool]:
    """That a lease has ended, or ends later than any lease that was given by this clock."""
    return or_(jobs.c.leased_until < at, jobs.c.leased_until > at + LONGEST_LEASE_S)


def claim(connection: Connection, worker: str, lease_s: float) -> JobRow | None:
    """Take the next job: one that waits, or one whose worker fell silent.

    Parameters
    ----------
    connection : of a writing transaction
    worker : who asks
    lease_s : seconds until it must be renewed
    """
    at = now(connection)
    waiting = _waiting(at)
    silent = jobs.c.state == JobState.RUNNING, _lease_over(at)
    found = None
    for one in _tenants_due(connection, *waiting):  # the first's may all be locked
        found = _lock_first(connection, one.turn, *waiting, jobs.c.tenant == one.tenant)
        if found is not None:
            break
    # of those that fell silent, which are few, one is locked only where its turn is before
    other = _first_of_few(connection, *silent)
    if other is not None and (found is None or other < found):
        own = jobs.c.number == other.number
        found = _lock_first(connection, other.turn, *silent, own) or found
    if found is None:
        return None
    row = connection.execute(
        update(jobs)
        .where(jobs.c.number == found.number)
        .values(
            state=JobState.RUNNING, attempts=jobs.c.attempts + 1, token=jobs.c.token + 1,
            leased_until=at + lease_s, worker=worker, started_at=at,
            turn=_last_turn(connection) + 1,
        )
        .returning(jobs)
    ).mappings().one()  # fmt: skip
    return job_row(row)


#: The table in other parts of a statement: made once, as each takes a millisecond to make.
_FIRST, _LATER, _TURNS = (jobs.alias() for _ in range(3))


class _Place(NamedTuple):
    """Where a job stands in the order of claims: the least is next."""

    upkeep: bool
    turn: int  # of its tenant, the latest
    tenant: str
    later: int  # its priority, negated
    attempts: int
    number: int


def _lock_first(connection: Connection, turn: int, *due: ColumnElement[bool]) -> _Place | None:
    """The first to be claimed of the due jobs of one tenant, locked; others may have locked all.

    What was tried before goes behind what was not: a frame that kills its worker, or a machine
    that dies again and again, must not hold up or use up the same job.
    """
    asked = (
        select(jobs.c.priority, jobs.c.attempts, jobs.c.number, jobs.c.tenant)
        .where(*due, jobs.c.attempts < MAXIMUM_ATTEMPTS)
        .order_by(jobs.c.priority.desc(), jobs.c.attempts, jobs.c.number)
        .limit(1)
        .with_for_update(skip_locked=True)
    )
    found = connection.execute(asked).first()
    return None if found is None else _place(found, turn)


def _first_of_few(connection: Connection, *due: ColumnElement[bool]) -> _Place | None:
    """The first to be claimed of the due jobs of all tenants, each of which is looked at."""
    asked = select(
        jobs.c.priority, jobs.c.attempts, jobs.c.number, jobs.c.tenant, *_turns_of(jobs.c.tenant)
    ).where(*due, jobs.c.attempts < MAXIMUM_ATTEMPTS)
    rows = connection.execute(asked).all()
    return min((_place(row, _latest(row.served, row.kept)) for row in rows), default=None)


def _place(row: Row[*tuple[Any, ...]], turn: int) -> _Place:
    return _Place(
        _is_upkeep(row.tenant, row.priority), turn, row.tenant, -row.priority, row.attempts,
        row.number,
    )  # fmt: skip


def _latest(*turns: int | None) -> int:
    return max(one or 0 for one in turns)


def _is_upkeep(tenant: str, priority: int) -> bool:
    """Whether a job waits for all that somebody asked for."""
    return tenant == NOBODY and priority <= UPKEEP


def _turns_of(tenant: ColumnElement[str]) -> tuple[Label[int | None], Label[int | None]]:
    """The latest turn of a tenant: of its jobs, and of those that were removed."""
    served = select(func.max(_TURNS.c.turn)).where(_TURNS.c.tenant == tenant)
    kept = select(tenants.c.turn).where(tenants.c.name == tenant)
    return served.scalar_subquery().label("served"), kept.scalar_subquery().label("kept")


class _TenantDue(NamedTuple):
    """A tenant with a queued job that is due: the least is next."""

    upkeep: bool
    turn: int  # its latest
    tenant: str
    priority: int  # of its first job


def _tenants_due(connection: Connection, *due: ColumnElement[bool]) -> list[_TenantDue]:
    """Tenants that have a queued job due, in the order of the next.

    The index is asked once for each tenant with a queued job, however many jobs there are.
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
    asked = select(names.c.tenant, best, *_turns_of(names.c.tenant)).where(
        names.c.tenant.is_not(None)
    )
    rows = (row for row in connection.execute(asked) if row.best is not None)
    return sorted(
        _TenantDue(
            _is_upkeep(row.tenant, row.best), _latest(row.served, row.kept), row.tenant, row.best
        )
        for row in rows
    )


def waits_before(connection: Connection, held: JobRow) -> bool:
    """Whether a job waits that goes before another slice of this one, once that is put back: one of
    another tenant, or of a higher priority.
    """
    return any(
        one.tenant != held.tenant or one.priority > held.priority
        for one in _tenants_due(connection, *_waiting(now(connection)))
        if not one.upkeep
    )


def _waiting(at: ColumnElement[float]) -> tuple[ColumnElement[bool], ...]:
    """Jobs that are due to be claimed."""
    # "+ 0.0" keeps SQLite to the index that has the order: it would sort all that is due
    due_at = jobs.c.run_after + 0.0
    return jobs.c.state == JobState.QUEUED, or_(due_at <= at, due_at > at + LONGEST_PAUSE_S)


def _last_turn(connection: Connection) -> int:
    """The latest turn of any tenant."""
    of_jobs, kept = select(func.max(jobs.c.turn)), select(func.max(tenants.c.turn))
    asked = select(of_jobs.scalar_subquery(), kept.scalar_subquery())
    return _latest(*connection.execute(asked).one())


def renew(connection: Connection, held: JobRow, lease_s: float) -> None:
    """Extend a lease.

    Raises
    ------
    LostLease : the job has been given to another worker, or is over.
    """
    _hold(connection, held, leased_until=now(connection) + lease_s)


def check_held(connection: Connection, held: JobRow) -> None:
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
    connection: Connection, held: JobRow, state: JobState, error: str | None = None,
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


def go_on(
    connection: Connection, held: JobRow, progress: dict[str, Any], after_s: float = 0.0
) -> None:
    """Queue a long job again after a part of it, behind those that wait.

    However many tries it took, they count no more: it came further. It is not claimed within
    `after_s` seconds.

    Raises
    ------
    LostLease : as `renew`.
    """
    # one try, and not none: its number is less than that of all that came since, and it would
    # go before them with every part
    _hold(
        connection, held, state=JobState.QUEUED, attempts=1, failures=0,
        leased_until=None, worker=None, run_after=now(connection) + after_s, progress=progress,
    )  # fmt: skip


def fail(connection: Connection, held: JobRow, error: str, traceback: str) -> JobState:
    """Queue a job that broke down for another try, or let it be dead.

    Raises
    ------
    LostLease : as `renew`.
    """
    # not as it was claimed: an earlier worker may have died over the job since
    known = select(jobs.c.failures).where(jobs.c.number == held.number)
    failures = (connection.execute(known).scalar() or 0) + 1
    if failures >= MAXIMUM_FAILURES or held.attempts >= MAXIMUM_ATTEMPTS:
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


def give_back(connection: Connection, held: JobRow, after_s: float = 0.0) -> None:
    """Queue a job again that was not begun, as if it had not been claimed.

    Parameters
    ----------
    connection : of a writing transaction
    after_s : seconds in which others go before it

    Raises
    ------
    LostLease : as `renew`.
    """
    _hold(
        connection, held, state=JobState.QUEUED, attempts=held.attempts - 1,
        leased_until=None, worker=None, run_after=now(connection) + after_s,
    )  # fmt: skip


def _hold(connection: Connection, held: JobRow, **values: object) -> None:
    """Change a job while its claim is the latest."""
    changed = connection.execute(update(jobs).where(*_own(held)).values(**values))
    if changed.rowcount != 1:
        raise _lost(held)


def _own(held: JobRow) -> tuple[ColumnElement[bool], ...]:
    """What holds of a job while a claim on it does."""
    return (
        jobs.c.number == held.number,
        jobs.c.token == held.token,
        jobs.c.state == JobState.RUNNING,
        # a standby that lacked the claim, and was promoted, may have given its token to another
        jobs.c.worker == held.worker,
    )


def _lost(held: JobRow) -> LostLease:
    return LostLease(
        f"Job {held.id} is no longer held by this worker: its lease ran out, or it was "
        "cancelled. Nothing was stored."
    )


# Jobs whose workers died over them.
#
# Who started the workers sees one die at once, and need not wait for its lease to run out.


def is_given_up(connection: Connection) -> bool:
    """Whether there is a job to `dead_letter`; costs no lock."""
    asked = select(jobs.c.number).where(*_out_of_tries(now(connection))).limit(1)
    return connection.execute(asked).first() is not None


def dead_letter(connection: Connection) -> list[JobRow]:
    """Give up jobs whose workers fall silent again and again: a frame that kills its worker."""
    at = now(connection)
    rows = connection.execute(
        update(jobs)
        .where(*_out_of_tries(at))
        .values(
            state=JobState.DEAD, finished_at=at, leased_until=None,
            error=f"its worker fell silent, and {MAXIMUM_ATTEMPTS} tries are over",
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
    if failures >= MAXIMUM_FAILURES or (held and row["attempts"] >= MAXIMUM_ATTEMPTS):
        known |= {"state": JobState.DEAD, "leased_until": None, "finished_at": now(connection)}
    elif held:
        again = now(connection) + pause_s(max(failures, 1))
        known |= {"state": JobState.QUEUED, "leased_until": None, "run_after": again}
    change = update(jobs).where(jobs.c.number == row["number"]).values(**known).returning(jobs)
    job = job_row(connection.execute(change).mappings().one())
    return None if job.state == JobState.RUNNING else job


def _out_of_tries(at: ColumnElement[float]) -> tuple[ColumnElement[bool], ...]:
    """What holds of a job that fell silent in the last of its tries."""
    return (
        jobs.c.state == JobState.RUNNING,
        _lease_over(at),
        jobs.c.attempts >= MAXIMUM_ATTEMPTS,
    )


# What others than its worker do to a job: give it up, or have it tried once more.


def cancel(connection: Connection, job: JobRow) -> None:
    """Cancel a job; a worker that is at it learns so when it brings its result.

    Raises
    ------
    JobOver : there is nothing left to cancel.
    """
    if job.state.over:
        raise JobOver(f"Job {job.id} is {job.state}: {job.state.sentence} Nothing is left to do.")
    cancel_jobs(connection, jobs.c.number == job.number)


def cancel_jobs(connection: Connection, *which: ColumnElement[bool]) -> None:
    """Cancel those of some jobs that wait or run."""
    connection.execute(
        update(jobs)
        .where(*which, jobs.c.state.in_(PENDING))
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


# What long jobs find and make: items, appended slice by slice, and files.

#: Rows that are inserted at once.
_BLOCK = 500


@dataclass(frozen=True)
class JobFile:
    """A file of a job.

    Parameters
    ----------
    name : such as mesh.ply, once a job
    blob : that holds its bytes, and is there
    bytes : size
    """

    name: str
    blob: str
    bytes: int
    media_type: str


def append_items(connection: Connection, job_number: int, items: list[dict[str, Any]]) -> None:
    """Add to what a job has found."""
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
    """Items of a job in the order in which they were found, from number `first` on."""
    asked = (
        select(job_items.c.data)
        .where(job_items.c.job_number == job_number, job_items.c.number >= first)
        .order_by(job_items.c.number)
    )
    return list(connection.execute(asked if limit is None else asked.limit(limit)).scalars())


def add_files(connection: Connection, job_number: int, files: Iterable[JobFile]) -> None:
    """Let a job have files; one of the same name gives way."""
    for one in files:
        remove_parts(connection, job_number, items=False, files=[one.name])
        connection.execute(insert(job_files).values(job_number=job_number, **asdict(one)))
        if one.name == ARCHIVE:
            _count_archive(connection, job_number, one.bytes)


def _count_archive(connection: Connection, job_number: int, size: int) -> None:
    """Add the bytes of an archive to those that the map of its import holds."""
    of_map: Any = select(jobs.c.map_number).where(jobs.c.number == job_number).scalar_subquery()
    count_on(connection, of_map, 0, size)


def files_of(connection: Connection, job_number: int) -> dict[str, JobFile]:
    """Files of a job by their names."""
    c = job_files.c
    asked = select(c.name, c.blob, c.bytes, c.media_type).where(c.job_number == job_number)
    return {row.name: JobFile(*row) for row in connection.execute(asked.order_by(c.name))}


def jobs_with_files(connection: Connection, kind: str) -> list[JobRow]:
    """Jobs of a kind that have any file, the oldest first."""
    having = select(job_files.c.job_number)
    asked = select(jobs).where(jobs.c.number.in_(having), jobs.c.kind == kind)
    return [job_row(row) for row in connection.execute(asked.order_by(jobs.c.number)).mappings()]


def finished_with_file(connection: Connection, name: str) -> list[int]:
    """Return the numbers of the jobs that are over and still have a file of this name."""
    asked = (
        select(jobs.c.number)
        .join(job_files, job_files.c.job_number == jobs.c.number)
        .where(
            job_files.c.name == name,
            jobs.c.state.in_([state for state in JobState if state.over]),
        )
    )
    return list(connection.execute(asked).scalars())


def remove_parts(
    connection: Connection, job_number: int, *, items: bool = True,
    files: Iterable[str] | None = None,
) -> list[str]:  # fmt: skip
    """Forget what a job found and made.

    Parameters
    ----------
    connection : of a writing transaction
    items : whether its items go
    files : names of the files that go; default: all

    Returns
    -------
    blobs : that it referred to: sweep them when this is committed
    """
    if items:
        connection.execute(delete(job_items).where(job_items.c.job_number == job_number))
    own = job_files.c.job_number == job_number
    if files is not None:
        own &= job_files.c.name.in_(list(files))
    c = job_files.c
    found = connection.execute(select(c.name, c.blob, c.bytes).where(own)).all()
    connection.execute(delete(job_files).where(own))
    for one in found:
        if one.name == ARCHIVE:
            _count_archive(connection, job_number, -one.bytes)
    return [one.blob for one in found]


def replace_result(connection: Connection, job: JobRow, result: dict[str, Any]) -> JobRow:
    """Return a job that is over with what it came to corrected."""
    own = update(jobs).where(jobs.c.number == job.number).values(result=result)
    return job_row(connection.execute(own.returning(jobs)).mappings().one())


def remove_job(connection: Connection, job: JobRow) -> list[str]:
    """Forget a job with all that it found; a worker that is at it finds its lease lost.

    Returns
    -------
    blobs : that it referred to: sweep them when this is committed
    """
    blobs = remove_parts(connection, job.number)
    keep_turns(connection, job.tenant)
    connection.execute(delete(jobs).where(jobs.c.number == job.number))
    return blobs
