"""Long jobs: jobs of a map or of the store that run in slices.

    queue_task  -->  queued  --claim-->  LongJob  --Tasks.run-->  a SliceResult for each slice

The results and the progress of a slice are stored in one commit, which verifies that the worker
still holds the job. If a worker dies, its slice is repeated.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Connection

from sceneprint.engine.jobs.lifecycle import DELAY_S, failure_texts, renewed
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
from sceneprint.store.maps import current_map, find_map, map_of_number
from sceneprint.store.tables import ARCHIVE, JobRow, MapRow
from sceneprint.store.wakeup import Wakeup
from sceneprint_client.api import Job, JobState


class Swept(StoreError):
    """A blob was removed before the commit that refers to it."""


@dataclass(frozen=True, eq=False)
class LongJob:
    """A claimed long job.

    Parameters
    ----------
    map : map of the job; None for a job without a map
    """

    job: JobRow
    map: MapRow | None

    @property
    def data(self) -> dict[str, Any]:
        """Parameters of the job."""
        return self.job.data or {}

    @property
    def progress(self) -> dict[str, Any]:
        """Progress after the last slice; empty before the first."""
        return self.job.progress or {}

    @property
    def of_map(self) -> MapRow:
        """Map of the job; raise ValueError if the job has none."""
        if self.map is None:
            raise ValueError(f"job {self.job.id} has no map")
        return self.map


@dataclass(frozen=True, eq=False)
class SliceResult:
    """The results of a slice.

    Parameters
    ----------
    over : whether this slice is the last
    progress : `done` and `total` for users, and the state that the next slice needs
    files : new files of the job, whose blobs are stored
    result : result of the job; only from the last slice
    drop : names of files to remove from the job
    event : kind of the event to record after the last slice, such as association.found; its data
        is `result`
    write : function that stores further rows in the same commit, and returns blobs that may be
        unreferenced then
    blobs : stored blobs that `write` refers to
    after_s : delay before the next slice, seconds
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


#: Function that returns whether a slice must end because its time is up or another job waits.
IsOver = Callable[[], bool]
#: Function that runs a slice of at least one step; a slice may be repeated after a crash.
Handler = Callable[[LongJob, IsOver], SliceResult]


log = logging.getLogger(__name__)

#: Maximum duration of a slice, and seconds between checks for waiting jobs.
SLICE_S, LOOK_S = 15.0, 0.1
#: Errors that a retry would repeat.
HOPELESS = (
    FrameError, InvalidRequest, NotFound, Conflict, MissingDependency, QuotaExceeded,
)  # fmt: skip


def ends_within(is_over: IsOver, seconds: float) -> IsOver:
    """Return an `IsOver` that also ends the slice `seconds` seconds from now."""
    until = time.monotonic() + seconds
    return lambda: time.monotonic() >= until or is_over()


def queue_task(
    store: Store, bell: Wakeup, kind: str, map_name: str | None, data: dict[str, Any],
    priority: int = 0, files: Collection[queue.JobFile] = (), once: IdempotentRequest | None = None,
) -> tuple[Job, bool]:  # fmt: skip
    """Queue a long job, and wake a worker.

    Parameters
    ----------
    kind : kind of the job, such as associate
    map_name : map of the job; None for a job without a map
    data : request as JSON
    priority : priority, on the scale of upload priorities
    files : files of the job, whose blobs are stored
    once : idempotent request

    Returns
    -------
    job : record of the job
    replayed : whether an earlier request with the key of `once` queued the job

    Raises
    ------
    UnknownMap : If the map does not exist.
    Swept : If the blob of a file was removed, so that it must be stored again.
    IdempotencyConflict : If an earlier request with the key of `once` was different.
    QuotaExceeded : If the map has no room for an archive among the files.
    """
    with store.database.write() as connection:
        row = None if map_name is None else find_map(connection, map_name)
        before = None if once is None else once.stored_result(connection)
        if before is not None:
            with suppress(UnknownJob):  # the map was deleted and created again
                job_before = queue.find_job(connection, before["job_id"])
                return job_record(job_before, None, map_name), True
        _check_files(store, files)
        size = sum(file.bytes for file in files if file.name == ARCHIVE)
        unused = [] if row is None else make_room(connection, row, size, new=False)
        number = None if row is None else row.number
        job = queue.enqueue(connection, kind, None, priority, map_number=number, data=data)
        queue.add_files(connection, job.number, files)
        record_change(connection, "job.queued", map_name, job.id, kind=kind)
        if once is not None:
            once.store(connection, {"job_id": job.id})
    collect_deleted_blobs(store, unused)
    bell.ring()
    return job_record(job, None, map_name), False


class Tasks:
    """Runner of long jobs.

    Parameters
    ----------
    handlers : handlers of the job kinds that this process can run
    """

    def __init__(self, store: Store, bell: Wakeup, handlers: Mapping[str, Handler]) -> None:
        self._store, self._bell, self._handlers = store, bell, handlers

    def run(
        self, task: LongJob, lease_s: float, longest_s: float,
        broke: Callable[[], None] | None = None,
    ) -> JobState | None:  # fmt: skip
        """Run a slice of a job, and store its results; return its state; None for a lost lease."""
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
                state = self._store_result(task, outcome)
        except LostLease as error:
            log.warning("lease lost", extra=_about(task, error=str(error)))
            return None
        except HOPELESS as error:
            state = self._fail(task, str(error))
        except Swept:
            self.put_back(task)
            state = JobState.QUEUED
        except UnusableStore:  # a full disk does not count as a failure of the job
            self.put_back(task, DELAY_S)
            raise
        except Exception as error:
            state = self._break_down(task, error)
            if broke is not None and not isinstance(error, SceneprintError):
                broke()
        milliseconds = round(1e3 * (time.perf_counter() - start), 1)
        log.info("job %s", state, extra=_about(task, state=state, milliseconds=milliseconds))
        return state

    def _end_of_slice(self, job: JobRow) -> IsOver:
        """Return a function that tells a slice that starts now to end; see IsOver."""
        until, look_at = time.monotonic() + SLICE_S, 0.0

        def is_over() -> bool:
            nonlocal look_at
            now = time.monotonic()
            if now < until and now >= look_at:
                look_at = now + LOOK_S
                with self._store.database.read() as connection:
                    return queue.has_waiting_before(connection, job)
            return now >= until

        return is_over

    def put_back(self, task: LongJob, after_s: float = 0.0) -> None:
        """Return a claimed job to the queue, due after `after_s` seconds."""
        with suppress(LostLease, UnusableStore), self._store.database.write() as connection:
            queue.release_job(connection, task.job, after_s)

    def _store_result(self, task: LongJob, outcome: SliceResult) -> JobState:
        try:
            unused_now = self._commit(task, outcome)
        except Exception:  # nothing refers to the new blobs
            unused = [*(file.blob for file in outcome.files), *outcome.blobs]
            collect_deleted_blobs(self._store, unused)
            raise
        collect_deleted_blobs(self._store, unused_now)
        if not outcome.over:
            self._bell.ring()
        return JobState.SUCCEEDED if outcome.over else JobState.QUEUED

    def _commit(self, task: LongJob, outcome: SliceResult) -> list[str]:
        """Store the results of a slice in one commit; return blobs that may be unreferenced now."""
        job, number = task.job, None if task.map is None else task.map.number
        with self._store.database.write(map_number=number) as connection:
            if outcome.over:
                queue.finish(
                    connection, task.job, JobState.SUCCEEDED, progress=outcome.progress,
                    result=outcome.result,
                )  # fmt: skip
                if outcome.event is not None:
                    name = None if number is None else map_of_number(connection, number).name
                    record_event(
                        connection, outcome.event, name, None, job.id, **(outcome.result or {})
                    )
            else:
                queue.requeue_slice(connection, task.job, outcome.progress, outcome.after_s)
            _check_files(self._store, outcome.files)
            if not all(map(self._store.blobs.holds, outcome.blobs)):
                raise Swept("A deletion removed a blob before the commit that refers to it.")
            queue.append_items(connection, job.number, outcome.items)
            before = queue.files_of(connection, job.number)
            unused = _make_room(connection, task.map, before, outcome.files)
            queue.add_files(connection, job.number, outcome.files)
            unused += queue.remove_parts(connection, job.number, items=False, files=outcome.drop)
            unused += [before[file.name].blob for file in outcome.files if file.name in before]
            return unused if outcome.write is None else [*unused, *outcome.write(connection)]

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


def _check_files(store: Store, files: Collection[queue.JobFile]) -> None:
    """Raise Swept if the blob of a file is missing in the transaction that refers to it."""
    for file in files:
        if not store.blobs.holds(file.blob):
            raise Swept(f"A deletion removed the blob of {file.name} before its job was stored.")


def _make_room(
    connection: Connection, row: MapRow | None, before: Mapping[str, queue.JobFile],
    files: Collection[queue.JobFile],
) -> list[str]:  # fmt: skip
    """Make room in the quota for a new or larger archive; return blobs that may be unreferenced."""
    [size] = [file.bytes for file in files if file.name == ARCHIVE] or [0]
    if row is None or size == 0:
        return []
    size_before = before[ARCHIVE].bytes if ARCHIVE in before else 0
    return make_room(connection, current_map(connection, row), size - size_before, new=False)


def _about(task: LongJob, **more: object) -> dict[str, object]:
    """Return the log fields of a job, with the fields `more` added."""
    job = task.job
    name = None if task.map is None else task.map.name
    return {"job_id": job.id, "kind": job.kind, "map": name, "attempt": job.attempts, **more}
