"""Long jobs of one kind that belong to maps: found, listed and removed.

MapJobs  --find | page | remove-->  rows of jobs of a map, by the ids that the outside knows
"""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection

from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.errors import UnknownJob
from sceneprint.store import Store
from sceneprint.store.maps import find_map
from sceneprint.store.queue import find_job, list_jobs, remove_job
from sceneprint.store.tables import JobRow


@dataclass(frozen=True, eq=False)
class MapJobs:
    """The jobs of a kind in all maps.

    Parameters
    ----------
    store : with the jobs
    kind : of the jobs, such as associate
    noun : what one is called in errors, such as association
    path : of the list below a map's path, such as associations
    """

    store: Store
    kind: str
    noun: str
    path: str

    def find(self, connection: Connection, map_name: str, job_id: str) -> JobRow:
        """A job of a map.

        Raises
        ------
        UnknownMap : no such map.
        UnknownJob : the map has no job of this kind and id.
        """
        row = find_map(connection, map_name)
        message = (
            f"There is no {self.noun} {job_id!r:.80} in map {row.name!r}. List them with "
            f"GET /v1/maps/{row.name}/{self.path}."
        )
        try:
            job = find_job(connection, job_id)
        except UnknownJob:
            raise UnknownJob(message) from None
        if job.kind != self.kind or job.map_number != row.number:
            raise UnknownJob(message)
        return job

    def page(
        self, map_name: str, cursor: str | None, limit: int
    ) -> tuple[list[JobRow], str | None]:
        """Jobs of a map, the newest first, and the cursor of the next page.

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : a cursor that was not given out.
        """
        seals = self.store.seals
        before = seals.row("job", cursor)
        with self.store.database.read() as connection:
            find_map(connection, map_name)
            found = list_jobs(connection, before, limit + 1, None, self.kind, [map_name])
        more = seals.next_cursor("job", [one.job.number for one in found], limit)
        return [one.job for one in found[:limit]], more

    def remove(self, map_name: str, job_id: str) -> None:
        """Delete a job with its results; one that is not over is given up.

        Raises
        ------
        UnknownMap, UnknownJob : there is none.
        """
        with self.store.database.write() as connection:
            blobs = remove_job(connection, self.find(connection, map_name, job_id))
        collect_deleted_blobs(self.store, blobs)
