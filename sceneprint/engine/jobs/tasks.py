"""Long jobs, that are of no single frame: done in slices.

    begin  -->  queued  --claim-->  LongJob  --Tasks.run-->  a SliceResult for each slice

What a slice found, how far it came, and that the job goes on or is over, is one commit, fenced by
the job's token. A slice whose worker died is done again from where the last one ended.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Connection

from sceneprint.engine.jobs.lifecycle import LEFT_S, failure_texts, renewed
from sceneprint.engine.serializers import job_record
from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.errors import (
    Conflict,
    FrameError,
    InvalidRequest,
    LostLease,
    MissingDependency,
    NotFound,
    QuotaExceeded,
    SceneprintError,
    StoreError,
    UnknownJob,
    UnusableStore,
)
from sceneprint.store import Store, queue
from sceneprint.store.audit_log import record_change
from sceneprint.store.deletion import make_room
from sceneprint.store.events import record_event
from sceneprint.store.keys import IdempotentRequest
from sceneprint.store.maps import find_map, living_map, map_of
from sceneprint.store.tables import ARCHIVE, JobRow, MapRow
from sceneprint.store.wakeup import Wakeup
from sceneprint_client.api import Job, JobState


class Swept(StoreError):
    """A deletion removed a file before the commit that would have referred to it."""


@dataclass(frozen=True, eq=False)
class LongJob:
    """A long job in hand.

    Parameters
    ----------
    job : as it was claimed
    map : that it is about; None where it is of none
    """

    job: JobRow
    map: MapRow | None

    @property
    def data(self) -> dict[str, Any]:
        """What was asked for."""
        return self.job.data or {}

    @property
    def progress(self) -> dict[str, Any]:
        """Progress as of the last slice; empty before the first."""
        return self.job.progress or {}

    @property
    def of_map(self) -> MapRow:
        """The map, of a kind of job that always has one."""
        if self.map is None:
            raise ValueError(f"job {self.job.id} has no map")
        return self.map


@dataclass(frozen=True, eq=False)
class SliceResult:
    """What a slice came to.

    Parameters
    ----------
    over : whether the job is done
    progress : `done` and `total` for people, and whatever the next slice needs to go on
    items : found in this slice
    files : made in this slice, blobs that are there
    result : in short, at the end
    drop : names of files of the job that are of no use any more
    event : kind of the event that tells of the end, such as association.found; its data is `result`
    write : what else the commit stores; returns blobs that may be of no use any more
    blobs : that `write` comes to refer to; they are there
    after_s : seconds before the next slice, where the job waits for others
    """

    over: bool
    progress: dict[str, Any]
    items: list[dict[str, Any]] = field(default_factory=list)
    files: list[queue.JobFile] = field(default_factory=list)
    result: dict[str, Any] | None = None
    drop: Collection[str] = ()
    event: str | None = None
    write: Callable[[Connection], Collection[str]] | None = None
    blobs: Collection[str] = ()
    after_s: float = 0.0


#: Whether a slice is to end at its next step, as its time is over or somebody else waits.
IsOver = Callable[[], bool]
#: Does a slice of a job until it is to end, at least a step of it; may be done again.
Handler = Callable[[LongJob, IsOver], SliceResult]


log = logging.getLogger(__name__)

#: Seconds of a slice at most, and between two looks whether another job waits that goes before.
SLICE_S, LOOK_S = 15.0, 0.1
#: Errors that trying again cannot help: what was asked for cannot be done.
HOPELESS = (
    FrameError, InvalidRequest, NotFound, Conflict, MissingDependency, QuotaExceeded,
)  # fmt: skip


def ends_within(is_over: IsOver, seconds: float) -> IsOver:
    """The end of a slice that takes no longer than that from now."""
    until = time.monotonic() + seconds
    return lambda: time.monotonic() >= until or is_over()


class Tasks:
    """Kinds of long jobs, each with what does it."""

    def __init__(self, store: Store, bell: Wakeup) -> None:
        self._store, self._bell = store, bell
        self._handlers: dict[str, Handler] = {}

    def register(self, kind: str, handler: Handler) -> None:
        """Let jobs of a kind be done by this process.

        Parameters
        ----------
        kind, handler : see there
        """
        self._handlers[kind] = handler

    def begin(
        self, kind: str, map_name: str | None, data: dict[str, Any], priority: int = 0,
        files: Collection[queue.JobFile] = (), once: IdempotentRequest | None = None,
    ) -> tuple[Job, bool]:  # fmt: skip
        """Queue a job of a kind.

        Parameters
        ----------
        kind : such as associate
        map_name : that it is about, or None
        data : what is asked for, as JSON
        priority : as of frames
        files : that it works on
        once : the request that is to take effect once

        Returns
        -------
        job : the job
        replayed : whether `once` began it before; it is told as it is

        Raises
        ------
        UnknownMap : no such map.
        Swept : a file is gone; put it once more.
        IdempotencyConflict : something else was asked with the key of `once`.
        QuotaExceeded : the map has no room for an archive among the files.
        """
        with self._store.database.write() as connection:
            row = None if map_name is None else find_map(connection, map_name)
            before = None if once is None else once.found(connection)
            if before is not None:
                with suppress(UnknownJob):  # its map may have been deleted and made anew
                    there = queue.find_job(connection, before["job_id"])
                    return job_record(there, None, map_name), True
            self._check(files)
            size = sum(one.bytes for one in files if one.name == ARCHIVE)
            gone = [] if row is None else make_room(connection, row, size, new=False)
            number = None if row is None else row.number
            job = queue.enqueue(connection, kind, None, priority, map_number=number, data=data)
            queue.add_files(connection, job.number, files)
            record_change(connection, "job.queued", map_name, job.id, kind=kind)
            if once is not None:
                once.keep(connection, {"job_id": job.id})
        collect_deleted_blobs(self._store, gone)
        self._bell.ring()
        return job_record(job, None, map_name), False

    def run(
        self,
        task: LongJob,
        lease_s: float,
        longest_s: float,
        broke: Callable[[], None] | None = None,
    ) -> JobState | None:
        """Do a slice of a claimed job; see `signature_job.run` for the rest."""
        start, job = time.perf_counter(), task.job
        state: JobState | None
        try:
            with renewed(self._store, task.job, lease_s, longest_s):
                handler = self._handlers.get(job.kind)
                if handler is None:
                    raise MissingDependency(
                        f"This process cannot run jobs of kind {job.kind!r}. Run a worker with "
                        "`sceneprint serve` or `sceneprint work`."
                    )
                outcome = handler(task, self._end_of_slice(job))
                state = self._keep(task, outcome)
        except LostLease as error:
            log.warning("lease lost", extra=_about(task, error=str(error)))
            return None
        except HOPELESS as error:
            state = self._fail(task, str(error))
        except Swept:
            self.put_back(task)
            state = JobState.QUEUED
        except UnusableStore:  # a full disk is no fault of the job's, and costs it no try
            self.put_back(task, LEFT_S)
            raise
        except Exception as error:
            state = self._break_down(task, error)
            if broke is not None and not isinstance(error, SceneprintError):
                broke()
        milliseconds = round(1e3 * (time.perf_counter() - start), 1)
        log.info("job %s", state, extra=_about(task, state=state, milliseconds=milliseconds))
        return state

    def _end_of_slice(self, job: JobRow) -> IsOver:
        """When a slice of a job ends that begins now."""
        until, look_at = time.monotonic() + SLICE_S, 0.0

        def is_over() -> bool:
            nonlocal look_at
            now = time.monotonic()
            if now < until and now >= look_at:
                look_at = now + LOOK_S
                with self._store.database.read() as connection:
                    return queue.waits_before(connection, job)
            return now >= until

        return is_over

    def put_back(self, task: LongJob, after_s: float = 0.0) -> None:
        """Return a claimed job undone."""
        with suppress(LostLease, UnusableStore), self._store.database.write() as connection:
            queue.give_back(connection, task.job, after_s)

    def _keep(self, task: LongJob, outcome: SliceResult) -> JobState:
        try:
            gone = self._stored(task, outcome)
        except Exception:  # nothing came to refer to them
            made = [*(one.blob for one in outcome.files), *outcome.blobs]
            collect_deleted_blobs(self._store, made)
            raise
        collect_deleted_blobs(self._store, gone)
        if not outcome.over:
            self._bell.ring()
        return JobState.SUCCEEDED if outcome.over else JobState.QUEUED

    def _stored(self, task: LongJob, outcome: SliceResult) -> list[str]:
        """What a slice came to, in one commit; returns blobs that may be of no use any more."""
        job, number = task.job, None if task.map is None else task.map.number
        with self._store.database.write(map_number=number) as connection:
            if outcome.over:
                queue.finish(
                    connection, task.job, JobState.SUCCEEDED, progress=outcome.progress,
                    result=outcome.result,
                )  # fmt: skip
                if outcome.event is not None:
                    name = None if task.map is None else map_of(connection, task.map.number).name
                    record_event(
                        connection, outcome.event, name, None, job.id, **(outcome.result or {})
                    )
            else:
                queue.go_on(connection, task.job, outcome.progress, outcome.after_s)
            self._check(outcome.files)
            if not all(map(self._store.blobs.holds, outcome.blobs)):
                raise Swept("A deletion elsewhere swept the same bytes before they were stored.")
            # after the job: it may be gone, and nothing can be of one that is
            queue.append_items(connection, job.number, outcome.items)
            before = queue.files_of(connection, job.number)
            gone = _make_room(connection, task.map, before, outcome.files)
            queue.add_files(connection, job.number, outcome.files)
            gone += queue.remove_parts(connection, job.number, items=False, files=outcome.drop)
            gone += [before[one.name].blob for one in outcome.files if one.name in before]
            return gone if outcome.write is None else [*gone, *outcome.write(connection)]

    def _check(self, files: Collection[queue.JobFile]) -> None:
        """See that files are there, in the transaction that comes to refer to them."""
        for one in files:
            if not self._store.blobs.holds(one.blob):
                raise Swept(
                    f"A deletion elsewhere swept the same {one.name} before its job was stored."
                )

    def _fail(self, task: LongJob, reason: str) -> JobState | None:
        try:
            with self._store.database.write() as connection:
                queue.finish(connection, task.job, JobState.FAILED, reason)
        except LostLease:
            return None
        return JobState.FAILED

    def _break_down(self, task: LongJob, error: Exception) -> JobState | None:
        reason, trace = failure_texts(error)
        log.error("job raised an exception", extra=_about(task, error=reason, traceback=trace))
        try:
            with self._store.database.write() as connection:
                return queue.fail(connection, task.job, reason, trace)
        except LostLease:
            return None


def _make_room(
    connection: Connection, row: MapRow | None, before: Mapping[str, queue.JobFile],
    files: Collection[queue.JobFile],
) -> list[str]:  # fmt: skip
    """Make room for an archive that takes the place of a smaller one; returns doomed blobs."""
    [size] = [one.bytes for one in files if one.name == ARCHIVE] or [0]
    if row is None or size == 0:
        return []
    held = before[ARCHIVE].bytes if ARCHIVE in before else 0
    return make_room(connection, living_map(connection, row), size - held, new=False)


def _about(task: LongJob, **more: object) -> dict[str, object]:
    """What a line of the log says of a job."""
    job = task.job
    name = None if task.map is None else task.map.name
    return {"job_id": job.id, "kind": job.kind, "map": name, "attempt": job.attempts, **more}
