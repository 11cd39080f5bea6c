"""The engine: what service, workers and the embedded client do, they do through this."""

from __future__ import annotations

import logging
from collections.abc import Callable
from types import TracebackType

from sceneprint.engine import jobs
from sceneprint.engine import work as working
from sceneprint.engine.administration import Administration
from sceneprint.engine.browsing import list_frames
from sceneprint.engine.endings import Work, put_back
from sceneprint.engine.slices import Task
from sceneprint.engine.sweeping import sweep_deleted
from sceneprint.engine.uploads import Upload
from sceneprint.engine.views import View
from sceneprint.engine.wire import tell_frames
from sceneprint.errors import BusyIndex
from sceneprint.models import Model
from sceneprint.schemas import (
    Added,
    Answer,
    Frame,
    FrameMeta,
    FrameState,
    JobState,
    NamedFrame,
    Page,
    Query,
)
from sceneprint.schemas.browsing import FrameListing
from sceneprint.store import cancelling, listing, queue
from sceneprint.store import frames as stored_frames
from sceneprint.store import maps as stored_maps
from sceneprint.store.records import MapRow

log = logging.getLogger(__name__)


class Engine(Administration):
    """Maps, frames, queries and jobs over one store; safe to share between threads.

    Parameters
    ----------
    settings : see Settings

    Raises
    ------
    UnusableStore, NewerSchema : the store cannot be opened.
    """

    def __enter__(self) -> Engine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self.close()

    # frames

    def add_frame(
        self, map_name: str, data: bytes, meta: FrameMeta, priority: int = 0,
        if_novel: float | None = None,
    ) -> tuple[Added, bool]:  # fmt: skip
        """Take a frame into a map; see `Uploads.add`."""
        upload = Upload(data, meta, priority, if_novel)
        outcome, _ = self.uploads.add(map_name, upload)
        return outcome.taken, outcome.new

    def list_frames(
        self, map_name: str, cursor: str | None = None, limit: int = 100,
        state: FrameState | None = None, wanted: FrameListing | None = None,
    ) -> Page[Frame]:  # fmt: skip
        """Frames of a map in the order they came, deleted ones only where asked for.

        Parameters
        ----------
        map_name : of the map
        cursor : of the page before
        limit : most frames
        state : in this one; None for all but deleted ones
        wanted : more that must hold, `state` with it

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : a cursor that was not given out.
        """
        return list_frames(self.store, map_name, wanted or FrameListing(state=state), cursor, limit)

    def get_frame(self, map_name: str, frame_id: str) -> Frame:
        """A frame; UnknownMap or UnknownFrame where there is none."""
        with self.store.database.read() as connection:
            row = stored_maps.find_map(connection, map_name)
            frame = stored_frames.find_frame(connection, row, frame_id)
            return tell_frames(connection, row, [frame])[0]

    def delete_frame(self, map_name: str, frame_id: str) -> None:
        """Take a frame out of its map, effective at once.

        Raises
        ------
        UnknownMap, UnknownFrame : there is none, or it was deleted before.
        """
        with self.store.database.write() as connection:
            row = stored_maps.find_map(connection, map_name)
            frame = stored_frames.find_frame(connection, row, frame_id)
            cancelling.cancel_of(connection, frame.number)
            blobs = stored_frames.delete_frame(connection, row, frame)
        sweep_deleted(self.store, blobs)

    # queries

    def query_upload(
        self, map_name: str, data: bytes, meta: FrameMeta, query: Query, since: float | None = None
    ) -> Answer:
        """Look a frame up that is not kept; see `Queries.upload`."""
        return self.queries.upload([map_name], data, meta, query, since)

    def query_frame(
        self, map_name: str, frame_id: str, query: Query, since: float | None = None
    ) -> Answer:
        """Look a frame of the map up among the others; see `Queries.stored`."""
        frame = NamedFrame.model_construct(map=map_name, frame_id=frame_id)
        return self.queries.stored([map_name], frame, query, since)

    def view(self, map_name: str) -> tuple[MapRow, Model, View]:
        """A map with its model and all its signatures, as they are now; UnknownMap."""
        row = self._row(map_name)
        while True:  # its signer opened while no connection is held
            model = self.signers(row.model_id).model
            with self.store.database.read() as connection:
                row = stored_maps.find_map(connection, map_name)
                if row.model_id == model.id:
                    return row, model, self._readers.view(connection, row)

    def _row(self, map_name: str) -> MapRow:
        with self.store.database.read() as connection:
            return stored_maps.find_map(connection, map_name)

    # work

    def claim(self, worker: str) -> Work | Task | None:
        """Take the next job, or None; see `work.claim`."""
        return working.claim(self.store, worker, self.settings.lease_s)

    def due_in_s(self) -> float | None:
        """Seconds until the next job can be claimed if nobody comes before, or None."""
        with self.store.database.read() as connection:
            return queue.due_in_s(connection)

    def run(self, work: Work | Task, broke: Callable[[], None] | None = None) -> JobState | None:
        """Do a claimed job, or a slice of a long one; see `work.run` and `Tasks.run`."""
        if isinstance(work, Task):
            return self.tasks.run(work, self.settings.lease_s, self.settings.job_s, broke)
        return working.run(
            self.store, self.signers, self._readers, work, self.settings.lease_s,
            self.settings.job_s, broke,
        )  # fmt: skip

    def worker_died(
        self, job_id: str, token: int, error: str, traceback: str, *, counts: bool
    ) -> JobState | None:
        """Take a job from a worker that died over it; see `jobs.worker_died`."""
        return jobs.worker_died(self.store, job_id, token, error, traceback, counts=counts)

    def put_back(self, work: Work | Task) -> None:
        """Return a claimed job undone."""
        if isinstance(work, Task):
            self.tasks.put_back(work)
        else:
            put_back(self.store, work)
        self.bell.ring()

    def counts(self) -> tuple[dict[str, int], dict[str, int]]:
        """How many frames and how many jobs are in each state."""
        with self.store.database.read() as connection:
            return stored_frames.count_states(connection), listing.count_jobs(connection)

    def publish_due(self) -> int:
        """Bring maps on to their next models, delete what is too old, publish the indexes that have
        fallen behind, verify a little, and remove what is no longer kept; returns how many indexes
        were published.
        """
        self._reencoding.run()
        self.retiring.run()
        published = self._upkeep.run()
        self._vector_tables.run()
        self.operations.tidy()
        self.imports.tidy()
        if self.purging.run() is not None:
            with self.store.database.read() as connection:
                self._readers.purge(connection)
        return published

    def rebuild_index(self, map_name: str) -> int:
        """Publish the index of a map from nothing; returns the number of its generation.

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : there is no indexed frame in it.
        BusyIndex : another process is building it.
        """
        generation = self._upkeep.rebuild(self._row(map_name))
        if generation is None:
            raise BusyIndex(
                f"The index of map {map_name!r} is being built by another process. Try again "
                "when it is done."
            )
        return generation.number
