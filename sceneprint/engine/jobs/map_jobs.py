"""Begin, list, read and remove the jobs that compute something of a map.

    request  --MapJobs.queue-->  queued job  --get | list_all-->  record of the API

A kind of such jobs has a request, a result and a record; its jobs are done in slices, see `tasks`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

from sqlalchemy import Connection

from sceneprint.engine.jobs.tasks import Tasks
from sceneprint.engine.serializers import job_progress, when
from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.errors import NotIndexed, UnknownJob
from sceneprint.store import Store
from sceneprint.store.audit_log import record_change
from sceneprint.store.maps import find_map
from sceneprint.store.opaque_ids import row_of
from sceneprint.store.queue import find_job, list_jobs, remove_job
from sceneprint.store.tables import JobRow
from sceneprint_client.api import JobState, Page, Progress
from sceneprint_client.api.admin import MapJob
from sceneprint_client.api.base import Given

Record = TypeVar("Record", bound=MapJob)
Item = TypeVar("Item")

#: Items that are read at once.
BLOCK = 500


class MapJobs(Generic[Record]):
    """The jobs of a kind in all maps.

    Parameters
    ----------
    record : of the API, with the request in `asked` and the result in `result`
    kind : of the jobs, such as associate
    noun : name of such a job in errors and in the field of its id, such as association
    path : of the list below a map's path, such as associations
    priority : of the jobs
    """

    def __init__(
        self, store: Store, tasks: Tasks, record: type[Record], *, kind: str, noun: str, path: str,
        priority: int = 0,
    ) -> None:  # fmt: skip
        self._store, self._tasks, self._record = store, tasks, record
        self._kind, self._noun, self._path, self._priority = kind, noun, path, priority

    def queue(self, map_name: str, request: Given, total: int | None = None) -> Record:
        """Queue a job.

        Parameters
        ----------
        request : what it computes
        total : number of its steps, if known

        Raises
        ------
        UnknownMap : no such map.
        """
        data = request.model_dump(mode="json", exclude_unset=True)
        job, _ = self._tasks.begin(self._kind, map_name, data, self._priority)
        begun = self.get(map_name, job.job_id)
        if total is not None and begun.progress is None:
            begun = begun.model_copy(update={"progress": Progress(done=0, total=total)})
        return begun

    def list_all(self, map_name: str, cursor: str | None = None, limit: int = 100) -> Page[Record]:
        """Return the jobs of a map, the newest first.

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : a cursor that was not given out.
        """
        seals = self._store.seals
        before = seals.row("job", cursor)
        with self._store.database.read() as connection:
            find_map(connection, map_name)
            found = list_jobs(connection, before, limit + 1, None, self._kind, [map_name])
        more = seals.next_cursor("job", [one.job.number for one in found], limit)
        items = [self.record(one.job, map_name) for one in found[:limit]]
        return Page[self._record](items=items, next_cursor=more)  # type: ignore[name-defined]

    def get(self, map_name: str, job_id: str) -> Record:
        """Return a job; raises UnknownMap or UnknownJob where there is none."""
        with self._store.database.read() as connection:
            return self.record(self.find(connection, map_name, job_id), map_name)

    def remove(self, map_name: str, job_id: str) -> None:
        """Delete a job with its results; one that is not over is given up.

        Raises
        ------
        UnknownMap, UnknownJob : there is none.
        Conflict : the map depends on it; see `check_removal`.
        """
        with self._store.database.write() as connection:
            job = self.find(connection, map_name, job_id)
            self.check_removal(connection, job)
            blobs = remove_job(connection, job)
            record_change(connection, "job.removed", map_name, job_id, kind=self._kind)
        collect_deleted_blobs(self._store, blobs)

    def check_removal(self, connection: Connection, job: JobRow) -> None:
        """Raise where a job has to stay, which kinds decide."""

    def find(self, connection: Connection, map_name: str, job_id: str) -> JobRow:
        """Return the row of a job of a map.

        Raises
        ------
        UnknownMap : no such map.
        UnknownJob : the map has no job of this kind and id.
        """
        row = find_map(connection, map_name)
        message = (
            f"There is no {self._noun} {job_id!r:.80} in map {row.name!r}. List them with "
            f"GET /v1/maps/{row.name}/{self._path}."
        )
        try:
            job = find_job(connection, job_id)
        except UnknownJob:
            raise UnknownJob(message) from None
        if job.kind != self._kind or job.map_number != row.number:
            raise UnknownJob(message)
        return job

    def record(self, job: JobRow, map_name: str, **more: Any) -> Record:
        """Return a job as the API has it, with the fields that only some kinds have."""
        return self._record.model_validate(
            {
                f"{self._noun}_id": job.id, "map": map_name, "asked": job.data or {},
                "state": job.state, "progress": job_progress(job), "result": job.result,
                "error": job.error, "created_at": when(job.created_at),
                "finished_at": when(job.finished_at), **more,
            }
        )  # fmt: skip

    def require_success(self, job: JobRow, map_name: str, what: str) -> dict[str, Any]:
        """Return the result of a job; raises NotIndexed until it has succeeded.

        Parameters
        ----------
        job, map_name : see `find`
        what : exists once the job has succeeded, such as "its graph exists"
        """
        if job.state != JobState.SUCCEEDED or job.result is None:
            raise NotIndexed(
                f"{self._noun.capitalize()} {job.id} is {job.state}; {what} once it has succeeded. "
                f"See GET /v1/maps/{map_name}/{self._path}/{job.id}."
            )
        return job.result


def page_of_items(
    cursor: str | None, limit: int, read: Callable[[int], Sequence[dict[str, Any]]],
    make: Callable[[int, Sequence[dict[str, Any]]], Sequence[Item]],
    number: Callable[[Item], int],
) -> tuple[list[Item], str | None]:  # fmt: skip
    """Return a page of the items of a job that pass a filter, and the cursor of the next page.

    Parameters
    ----------
    read : the items from a place on, BLOCK of them where there are so many
    make : records of those items of a block that pass, by its first place
    number : place of a record

    Raises
    ------
    InvalidRequest : a cursor that was not given out.
    """
    after = row_of(cursor)
    at = 0 if after is None else after + 1
    found: list[Item] = []
    while len(found) <= limit:
        block = read(at)
        found += make(at, block)
        at += len(block)
        if len(block) < BLOCK:
            break
    return found[:limit], str(number(found[limit - 1])) if len(found) > limit else None
