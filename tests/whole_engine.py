"""All parts of the engine over one store, as in a process with service and worker."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from sceneprint.engine.admin import operations
from sceneprint.engine.admin.operations import Audit, Events
from sceneprint.engine.admin.statistics import Statistics
from sceneprint.engine.context import Context, open_context
from sceneprint.engine.ingest.archive_import import Imports
from sceneprint.engine.ingest.uploads import Upload, Uploads
from sceneprint.engine.jobs import lifecycle
from sceneprint.engine.jobs.job_runner import JobRunner
from sceneprint.engine.jobs.lifecycle import Work
from sceneprint.engine.jobs.tasks import Handler, LongJob, queue_task
from sceneprint.engine.maps import map_lifecycle
from sceneprint.engine.maps.map_frames import FrameFiles, get_frame, list_frames
from sceneprint.engine.maps.map_lifecycle import Catalogue
from sceneprint.engine.maps.map_surface import MapSurfaces
from sceneprint.engine.maps.tombstones import Tombstones
from sceneprint.engine.products.associations import Associations
from sceneprint.engine.products.map_coverage import Coverages
from sceneprint.engine.products.reconstruction import Reconstructions
from sceneprint.engine.products.session_differences import Differences
from sceneprint.engine.results.result_views import Inspection, PointClouds
from sceneprint.engine.search.local_index import IndexView
from sceneprint.engine.search.query import Queries
from sceneprint.engine.upkeep.housekeeping import Housekeeping
from sceneprint.engine.upkeep.purge import MemoryPurging
from sceneprint.models import Model
from sceneprint.settings import Settings
from sceneprint.store import maps as stored_maps
from sceneprint.store.keys import KeyRow, find_key
from sceneprint.store.tables import MapRow
from sceneprint_client.api import (
    Added,
    Answer,
    Frame,
    FrameMeta,
    FrameName,
    FrameState,
    Job,
    JobState,
    Map,
    NewMap,
    Page,
    Query,
)
from sceneprint_client.api.admin import MadeKey, RetriedJobs, Scope
from sceneprint_client.api.listing import FrameListing


class Engine:
    """All parts of the engine by name, with short forms of common calls."""

    def __init__(self, settings: Settings, context: Context | None = None) -> None:
        self._stack = ExitStack()
        if context is None:
            context = self._stack.enter_context(open_context(settings))
        self.context = context
        self.settings, self.store, self.bell = settings, context.store, context.bell
        self.signers, self.readers, self.indexes = context.signers, context.readers, context.indexes
        self.query_log = context.query_log
        self.uploads, self.queries = Uploads(context), Queries(context)
        self.imports = Imports(context, self.uploads)
        self.inspection = Inspection(context)
        self.points = PointClouds(context, self.inspection.pairs)
        self.outputs = FrameFiles(self.store, self.signers)
        self.surfaces = MapSurfaces(self.store, self.bell)
        self.associations, self.coverage = Associations(context), Coverages(context, self.queries)
        self.differences, self.reconstructions = Differences(context), Reconstructions(context)
        self.tombstones = Tombstones(self.store, settings.undo_window_s, self.bell.ring)
        self.audit = Audit(self.store, settings.audit_log_days)
        self.events, self.statistics = Events(self.store, settings), Statistics(context)
        self.catalogue = Catalogue(self.store.database)
        self.jobs, self.housekeeping = JobRunner(context), Housekeeping(context)
        self.purging, self.upkeep = self.housekeeping.purging, self.housekeeping.upkeep
        self.memory_purging = MemoryPurging(context)

    def close(self) -> None:
        self._stack.close()

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def create_map(self, new: NewMap) -> tuple[Map, bool]:
        return map_lifecycle.create_map(self.store, new)

    def list_maps(self) -> list[Map]:
        return map_lifecycle.get_maps(self.store)

    def get_map(self, name: str) -> Map:
        return map_lifecycle.get_map(self.store, name)

    def delete_map(self, name: str) -> None:
        map_lifecycle.delete_map(self.context, name)

    def reencode(self, name: str, model: str | Path | Model) -> Map:
        return map_lifecycle.begin_reencoding(self.store, self.bell, name, model)

    def row(self, map_name: str) -> MapRow:
        with self.store.database.read() as connection:
            return stored_maps.find_map(connection, map_name)

    def view(self, map_name: str) -> tuple[MapRow, Model, IndexView]:
        """Return a map with its model and its signatures."""
        row = self.row(map_name)
        model = self.signers(row.model_id).model
        with self.store.database.read() as connection:
            row = stored_maps.find_map(connection, map_name)
            return row, model, self.readers.view(connection, row)

    def rebuild_index(self, map_name: str) -> int:
        return self.upkeep.rebuild(self.row(map_name)).number

    def add_frame(
        self, map_name: str, data: bytes, meta: FrameMeta, priority: int = 0,
        if_novel: float | None = None,
    ) -> tuple[Added, bool]:  # fmt: skip
        outcome, _ = self.uploads.add(map_name, Upload(data, meta, priority, if_novel))
        return outcome.accepted, outcome.new

    def list_frames(
        self, map_name: str, cursor: str | None = None, limit: int = 100,
        state: FrameState | None = None, wanted: FrameListing | None = None,
    ) -> Page[Frame]:  # fmt: skip
        wanted = wanted or FrameListing(state=state)
        return list_frames(self.store, map_name, wanted, cursor, limit)

    def get_frame(self, map_name: str, frame_id: str) -> Frame:
        return get_frame(self.store, map_name, frame_id)

    def delete_frame(self, map_name: str, frame_id: str) -> None:
        self.tombstones.delete_frame(map_name, frame_id)

    def query_frame(self, map_name: str, frame_id: str, query: Query, **more: Any) -> Answer:
        frame = FrameName(map=map_name, frame_id=frame_id)
        return self.queries.stored([map_name], frame, query, **more)

    def create_key(
        self, name: str, grants: Mapping[str, Scope] | None = None, **more: Any
    ) -> MadeKey:
        return operations.create_key(self.store, name, grants, **more)

    def find_key(self, secret: str) -> KeyRow | None:
        with self.store.database.read() as connection:
            return find_key(connection, secret)

    def revoke_key(self, name: str) -> None:
        operations.revoke_key(self.store, name)

    def get_job(self, job_id: str) -> Job:
        return lifecycle.get_job(self.store, job_id)

    def retry_job(self, job_id: str) -> tuple[Job, bool]:
        return lifecycle.retry(self.store, self.bell, job_id)

    def retry_dead_jobs(self, *page: Any, **more: Any) -> RetriedJobs:
        return lifecycle.retry_dead(self.store, self.bell, *page, **more)

    def begin_task(
        self, kind: str, map_name: str | None, data: dict[str, Any], *more: Any
    ) -> tuple[Job, bool]:
        return queue_task(self.store, self.bell, kind, map_name, data, *more)

    def handle(self, kind: str, handler: Handler) -> None:
        """Run jobs of a kind in this process."""
        self.jobs.handlers[kind] = handler

    def claim(self, worker: str) -> Work | LongJob | None:
        return self.jobs.claim(worker)

    def run(self, work: Work | LongJob, broke: Callable[[], None] | None = None) -> JobState | None:
        return self.jobs.run(work, broke)

    def put_back(self, work: Work | LongJob) -> None:
        self.jobs.put_back(work)

    def publish_due(self) -> int:
        return self.housekeeping.run()
