"""Base classes of products, which jobs compute from maps.

    request  --begin-->  queued job  --slices-->  items, files, result  --get | list_all-->  record

A product defines a request, steps and a result. Its job runs in slices; see `tasks`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from sqlalchemy import Connection

from sceneprint.engine.context import Context
from sceneprint.engine.jobs.tasks import IsOver, LongJob, SliceResult, ends_within, queue_task
from sceneprint.engine.serializers import job_progress, when
from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.errors import DamagedBlob, NotIndexed, UnknownJob
from sceneprint.store import queue
from sceneprint.store.audit_log import record_change
from sceneprint.store.maps import current_map, find_map, map_of_number
from sceneprint.store.opaque_ids import row_of
from sceneprint.store.reencoding_rows import PRIORITY as REENCODING_PRIORITY
from sceneprint.store.tables import JobRow, MapRow
from sceneprint_client.api import JobState, Page, Progress
from sceneprint_client.api.admin import Product
from sceneprint_client.api.base import Given

Request = TypeVar("Request", bound=Given)
Record = TypeVar("Record", bound=Product)


class Numbered(Protocol):
    """Record of an item, with the number of the item in the job."""

    number: int


Item = TypeVar("Item", bound=Numbered)

#: Priority below that of uploads and re-encodings: slices run only when no other job waits.
BACKGROUND = REENCODING_PRIORITY - 1
#: Maximum duration of a slice, seconds; it may delay uploads for that long.
SLICE_S = 3.0
#: Number of items to read at once.
_BLOCK = 500


class Products(ABC, Generic[Request, Record]):
    """All products of a kind.

    Attributes
    ----------
    kind : kind of the jobs, such as coverage
    record : class of the API records
    priority : priority of the jobs
    item_count : result field that contains the number of items; other rows of the job follow the
        items
    """

    kind: ClassVar[str]
    record: type[Record]
    priority: ClassVar[int] = BACKGROUND
    item_count: ClassVar[str] = ""

    def __init__(self, context: Context) -> None:
        self._context, self._store = context, context.store

    def start(self, connection: Connection, row: MapRow, request: Request) -> dict[str, Any]:
        """Return the initial progress of a job, with `done` and `total`.

        Raise InvalidRequest if the map lacks sessions or frames of the request.
        """
        raise NotImplementedError

    @abstractmethod
    def run_slice(self, task: LongJob, is_over: IsOver) -> SliceResult:
        """Run a slice, at least one step or the conclusion of the job; return its results."""

    def fields(self, job: JobRow) -> dict[str, Any]:
        """Return the record fields that depend on the request of a job."""
        return {"request": job.data or {}}

    def details(self, connection: Connection, job: JobRow) -> dict[str, Any]:
        """Return the record fields that pages omit."""
        del connection, job
        return {}

    def check_removal(self, connection: Connection, job: JobRow) -> None:
        """Raise Conflict if a map depends on the result of a job."""

    def shows_deleted(self, connection: Connection, job: JobRow) -> bool:
        """Return whether files of a job contain data of a deleted frame."""
        del connection, job
        return False

    def begin(self, map_name: str, request: Request) -> Record:
        """Queue a job, and return its record.

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : See `start`.
        """
        with self._store.database.read() as connection:
            progress = self.start(connection, find_map(connection, map_name), request)
        data = request.model_dump(mode="json", exclude_unset=True)
        bell = self._context.bell
        job, _ = queue_task(self._store, bell, self.kind, map_name, data, self.priority)
        record = self.get(map_name, job.job_id)
        if record.progress is None:
            total = Progress(done=0, total=progress["total"])
            record = record.model_copy(update={"progress": total})
        return record

    def restart(self, row: MapRow, request: Request) -> dict[str, Any]:
        """Return the initial progress, as `start` does, for the current row of a map."""
        with self._store.database.read() as connection:
            return self.start(connection, current_map(connection, row), request)

    def list_all(self, map_name: str, cursor: str | None = None, limit: int = 100) -> Page[Record]:
        """Return a page of the jobs of a map, newest first.

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If the service did not issue the cursor.
        """
        seals = self._store.seals
        before = seals.row("job", cursor)
        with self._store.database.read() as connection:
            find_map(connection, map_name)
            rows = queue.list_jobs(connection, before, limit + 1, None, self.kind, [map_name])
        more = seals.next_cursor("job", [row.job.number for row in rows], limit)
        items = [self.record_of(row.job, map_name) for row in rows[:limit]]
        return Page[self.record](items=items, next_cursor=more)  # type: ignore[name-defined]

    def get(self, map_name: str | None, job_id: str) -> Record:
        """Return a job with its details; see `find` for errors."""
        with self._store.database.read() as connection:
            job = self.find(connection, map_name, job_id)
            return self.record_of(job, map_name, **self.details(connection, job))

    def remove(self, map_name: str | None, job_id: str) -> None:
        """Delete a job with its results, even while a worker runs it.

        Raises
        ------
        UnknownMap, UnknownJob : If the map or the job does not exist.
        Conflict : If the map depends on the job; see `check_removal`.
        """
        with self._store.database.write() as connection:
            job = self.find(connection, map_name, job_id)
            self.check_removal(connection, job)
            blobs = queue.remove_job(connection, job)
            name = (
                None if job.map_number is None else map_of_number(connection, job.map_number).name
            )
            record_change(connection, "job.removed", name, job_id, kind=self.kind)
        collect_deleted_blobs(self._store, blobs)

    def forget(self) -> int:
        """Delete jobs whose files contain data of deleted frames; return their number."""
        with self._store.database.read() as connection:
            jobs = queue.jobs_with_files(connection, self.kind)
            stale = [job.id for job in jobs if self.shows_deleted(connection, job)]
        for job_id in stale:
            with suppress(UnknownJob):
                self.remove(None, job_id)
        return len(stale)

    def find(self, connection: Connection, map_name: str | None, job_id: str) -> JobRow:
        """Return the row of a job.

        Parameters
        ----------
        map_name : name of the map; None searches all maps

        Raises
        ------
        UnknownMap : If the map does not exist.
        UnknownJob : If the map has no job of this kind and id.
        """
        row = None if map_name is None else find_map(connection, map_name)
        with suppress(UnknownJob):
            job = queue.find_job(connection, job_id)
            if job.kind == self.kind and (row is None or job.map_number == row.number):
                return job
        raise self.unknown(job_id, "" if row is None else f" in map {row.name!r}")

    def unknown(self, job_id: str, where: str = "") -> UnknownJob:
        """Return the error for a job that does not exist or is not visible to the caller."""
        return UnknownJob(
            f"There is no {self.record.noun} {job_id!r:.80}{where}. List the jobs with GET "
            "/v1/jobs."
        )

    def record_of(self, job: JobRow, map_name: str | None, **details: Any) -> Record:
        """Return the API record of a job."""
        return self.record.model_validate(
            {
                "job_id": job.id, "map": map_name, "state": job.state,
                "progress": job_progress(job), "result": job.result, "error": job.error,
                "created_at": when(job.created_at), "finished_at": when(job.finished_at),
                **self.fields(job), **details,
            }
        )  # fmt: skip

    def require_success(self, job: JobRow, what: str) -> dict[str, Any]:
        """Return the result of a job.

        Parameters
        ----------
        what : name of the requested part in the error

        Raises
        ------
        NotIndexed : If the job has not succeeded.
        """
        if job.state != JobState.SUCCEEDED or job.result is None:
            why = "" if job.error is None else f" ({job.error})"
            raise NotIndexed(
                f"{self.record.noun.capitalize()} {job.id} is {job.state}{why}. Its {what} will be "
                "available once it has succeeded."
            )
        return job.result

    def file(self, map_name: str | None, job_id: str, name: str) -> queue.JobFile:
        """Return a result file of a job.

        Raises
        ------
        UnknownMap, UnknownJob : If the map or the job does not exist.
        NotIndexed : If the job has not succeeded.
        DamagedBlob : If the file is lost.
        """
        with self._store.database.read() as connection:
            job = self.find(connection, map_name, job_id)
            self.require_success(job, name)
            job_file = queue.files_of(connection, job.number).get(name)
        if job_file is None:
            raise DamagedBlob(
                f"File {name} of {self.record.noun} {job_id} is lost. Delete the "
                f"{self.record.noun} and start another."
            )
        return job_file

    def items(
        self, connection: Connection, job: JobRow, first: int, limit: int
    ) -> list[dict[str, Any]]:
        """Return up to `limit` items of a job from item number `first`; the job may be running."""
        if job.result is not None:
            limit = max(min(limit, job.result[self.item_count] - first), 0)
        rows = queue.items_of(connection, job.number, first, limit)
        return [item | {"number": first + i} for i, item in enumerate(rows)]

    def page_of_items(
        self, map_name: str, job_id: str, cursor: str | None, limit: int,
        records: Callable[[Connection, list[dict[str, Any]]], list[Item]],
    ) -> tuple[list[Item], str | None]:  # fmt: skip
        """Return the records of a page of items, and the cursor of the next page.

        Parameters
        ----------
        records : function that filters items and converts them to records

        Raises
        ------
        UnknownMap, UnknownJob : If the map or the job does not exist.
        InvalidRequest : If the service did not issue the cursor.
        """
        after = row_of(cursor)
        at = 0 if after is None else after + 1
        page: list[Item] = []
        with self._store.database.read() as connection:
            job = self.find(connection, map_name, job_id)
            while len(page) <= limit:
                block = self.items(connection, job, at, _BLOCK)
                page += records(connection, block)
                at += len(block)
                if len(block) < _BLOCK:
                    break
        return page[:limit], str(page[limit - 1].number) if len(page) > limit else None


def spread_evenly(numbers: list[int], most: int) -> list[int]:
    """Return the numbers if there are at most `most`, otherwise `most` of them, evenly spaced."""
    if len(numbers) <= most:
        return numbers
    return [numbers[i * len(numbers) // most] for i in range(most)]


class StepwiseProducts(Products[Request, Record]):
    """Products whose jobs consist of equal steps, such as one step per frame."""

    @abstractmethod
    def step(
        self, task: LongJob, request: Request, progress: dict[str, Any]
    ) -> Sequence[dict[str, Any]]:
        """Run the next step, update `progress`, and return the items of the step."""

    @abstractmethod
    def finish(
        self, task: LongJob, request: Request, progress: dict[str, Any],
        items: list[dict[str, Any]],
    ) -> SliceResult:  # fmt: skip
        """Return the last slice of a job, after its last step; `items` are those of this slice."""

    def run_slice(self, task: LongJob, is_over: IsOver) -> SliceResult:
        """Run at least one step, more while time allows, and the conclusion; return the slice."""
        request: Request = self.record.request_type.model_validate(task.data)  # type: ignore[assignment]
        is_over = ends_within(is_over, SLICE_S)
        progress = dict(task.progress) or self.restart(task.of_map, request)
        items: list[dict[str, Any]] = []
        while progress["done"] < progress["total"]:
            items += self.step(task, request, progress)
            progress["done"] += 1
            if is_over():
                return SliceResult(False, progress, items)
        return self.finish(task, request, progress, items)
