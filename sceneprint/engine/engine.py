"""The engine: what service, workers and the embedded client do, they do through this."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection, Mapping
from datetime import datetime
from pathlib import Path
from types import TracebackType

from sceneprint.decoders import Decoders, LocalDecoders
from sceneprint.decoders.pool import DecoderPool
from sceneprint.engine.admin import operations
from sceneprint.engine.admin.operations import Audit, OperatorTasks
from sceneprint.engine.ingest.archive_import import MAP_KIND, Imports
from sceneprint.engine.ingest.map_import import MapImporter
from sceneprint.engine.ingest.uploads import Upload, Uploads
from sceneprint.engine.jobs import lifecycle
from sceneprint.engine.jobs import signature_job as working
from sceneprint.engine.jobs.lifecycle import Work, put_back
from sceneprint.engine.jobs.tasks import LongJob, Tasks
from sceneprint.engine.maps import map_lifecycle
from sceneprint.engine.maps.map_copy import MapCopies
from sceneprint.engine.maps.map_frames import FrameFiles, list_frames
from sceneprint.engine.maps.map_lifecycle import Reencodings
from sceneprint.engine.maps.map_surface import MapSurfaces, SurfaceUpkeep
from sceneprint.engine.maps.surface_job import SURFACE, SurfaceHandler
from sceneprint.engine.maps.tombstones import Tombstones
from sceneprint.engine.products.associations import Associations
from sceneprint.engine.products.join_upkeep import JoinUpkeep
from sceneprint.engine.products.map_coverage import Coverages
from sceneprint.engine.products.reconstruction import Reconstructions
from sceneprint.engine.products.session_differences import Differences
from sceneprint.engine.results.query_entry import SentQuery
from sceneprint.engine.results.query_log import QueryLog
from sceneprint.engine.results.result_views import Inspection, PointClouds
from sceneprint.engine.search.index_place import IndexPlace
from sceneprint.engine.search.local_index import IndexView
from sceneprint.engine.search.query import Queries
from sceneprint.engine.search.retrieval import Readers
from sceneprint.engine.serializers import frame_records, map_record
from sceneprint.engine.signers import Signers, warm
from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.engine.upkeep.index_upkeep import Upkeep
from sceneprint.engine.upkeep.purge import Purging, Retention
from sceneprint.errors import ModelError
from sceneprint.geometry.kernel import Cores
from sceneprint.models import Model
from sceneprint.process import current_tenant, work_of
from sceneprint.settings import Settings
from sceneprint.store import frames as stored_frames
from sceneprint.store import keys as stored_keys
from sceneprint.store import maps as stored_maps
from sceneprint.store import open_store, queue
from sceneprint.store.answer_files import open_answers
from sceneprint.store.database_errors import PATIENCE_S, open_patiently
from sceneprint.store.deletion import remove_map
from sceneprint.store.events import number_events
from sceneprint.store.reencoding_rows import models_of
from sceneprint.store.tables import MapRow
from sceneprint.store.wakeup import Notices, Wakeup
from sceneprint_client.api import (
    Added,
    Answer,
    Frame,
    FrameMeta,
    FrameState,
    Job,
    JobState,
    Map,
    NamedFrame,
    NewMap,
    Page,
    Query,
)
from sceneprint_client.api.admin import MadeKey, RetriedJobs, Scope
from sceneprint_client.api.listing import FrameListing

log = logging.getLogger(__name__)


def decoders_of(settings: Settings) -> Decoders:
    """Where uploads are decoded, by the settings; processes start with the first upload."""
    if settings.decoders == 0:
        return LocalDecoders(settings.concurrency)
    return DecoderPool(
        settings.decoders, settings.decoder_bytes, settings.decoder_s, current_tenant
    )


class Engine:
    """Maps, frames, queries and jobs over one store; safe to share between threads.

    Raises
    ------
    UnusableStore, NewerSchema : the store cannot be opened.
    """

    def __init__(self, settings: Settings) -> None:
        from threadpoolctl import threadpool_limits

        self.settings = settings
        self.store = open_store(
            settings.database, settings.blobs, settings.geometry_bytes, decoders_of(settings)
        )
        self.signers = Signers(self.store.database, settings.cache_dir)
        self._indexes = IndexPlace(self.store, settings)
        self._upkeep = Upkeep(self.store, self.signers, settings, self._indexes)
        self._reencoding = Reencodings(self.store, self._upkeep)
        self._readers = Readers(self.signers, self._indexes)
        answers = open_answers(self.store.blobs, settings.query_dir)
        self.query_log = QueryLog(self.store, answers, settings)
        self.inspection = Inspection(self.store, self.signers, self.query_log)
        self._cores = Cores(settings.query_cores)
        self.queries = Queries(self.store, self.signers, self._readers, self.query_log, self._cores)
        # threads of the service work side by side, and sums have one order: the same bytes always
        self._limits = threadpool_limits(1)
        server = not self.store.database.is_sqlite
        self.bell = Notices(self.store.database) if server else Wakeup(settings.bell_dir)
        self.uploads = Uploads(self.store, self.bell)
        self.tasks = Tasks(self.store, self.bell)
        self.imports = Imports(self.store, self.tasks, self.uploads, settings.import_bytes)
        map_importer = MapImporter(
            self.store, self.signers, self.uploads, self.queries, 0.75 * settings.job_s
        )
        self.tasks.register(MAP_KIND, map_importer)
        self.associations = Associations(self.store, self.tasks, self.signers, self._readers)
        self.coverage = Coverages(self.store, self.tasks, self.signers, self.queries)
        self.differences = Differences(self.store, self.tasks, self.signers)
        self.surfaces = MapSurfaces(self.store, self.bell)
        self.tasks.register(SURFACE, SurfaceHandler(self.store, self.signers))
        self._surface_upkeep = SurfaceUpkeep(
            self.store, self.bell, auto=settings.surfaces == "auto"
        )
        self._join_upkeep = JoinUpkeep(self.store, self.bell, auto=settings.joins == "auto")
        self.audit = Audit(self.store, settings.audit_kept_days)
        self.key_uses = stored_keys.KeyUses()
        self.outputs = FrameFiles(self.store, self.signers)
        self.copies = MapCopies(self.store)
        self.points = PointClouds(self.store, self.signers, self.inspection.pairs, self.query_log)
        self.reconstructions = Reconstructions(self.store, self.tasks)
        self.retiring = Retention(self.store, settings.deleted_rows_days)
        self.tombstones = Tombstones(self.store, settings.undo_s, self.bell.ring)
        self.purging = Purging(
            self.store, self._upkeep, self.query_log, self.tombstones,
            (self.reconstructions, self.differences), settings.purge_s, settings.quarantine_dir,
        )  # fmt: skip
        self._purged = time.monotonic()
        self.operations = OperatorTasks(self.store, settings, self.bell)

    def close(self) -> None:
        """Give back what was opened."""
        self._indexes.close()
        self.query_log.close()
        self._limits.restore_original_limits()
        self._cores.close()
        self.bell.close()
        self.store.close()

    def warm(self) -> None:
        """Load code and tables of every model in use before a request needs them."""
        with self.store.database.read() as connection:
            used = {one for row in stored_maps.list_maps(connection) for one in models_of(row)}
        for model_id in used:
            try:
                warm(self.signers(model_id))
            except ModelError as error:  # it costs the maps of this model, and no others
                log.error("model unusable", extra={"model": model_id, "error": str(error)})

    # maps

    def create_map(self, new: NewMap) -> tuple[Map, bool]:
        """Make a map, or find it there as wanted; see `map_lifecycle.create_map`."""
        return map_lifecycle.create_map(self.store, new)

    def list_maps(self) -> Page[Map]:
        """All maps by name."""
        with self.store.database.read() as connection:
            rows = stored_maps.list_maps(connection)
            return Page[Map](items=[map_record(connection, row) for row in rows])

    def get_map(self, name: str) -> Map:
        """A map; UnknownMap where there is none."""
        with self.store.database.read() as connection:
            return map_record(connection, stored_maps.find_map(connection, name))

    def delete_map(self, name: str) -> None:
        """Remove a map with all that is in it; UnknownMap where there is none."""
        self.query_log.remove_of_map(name)  # most of them, while other writers get their turns
        with self.store.database.write() as connection:
            blobs = remove_map(connection, stored_maps.find_map(connection, name))
        self._readers.forget(name)
        collect_deleted_blobs(self.store, blobs)

    def reencode(self, name: str, model: str | Path | Model) -> Map:
        """Have a map signed with another model; see `map_lifecycle.begin_reencoding`."""
        told = map_lifecycle.begin_reencoding(self.store, name, model)
        self.bell.ring()
        return told

    def forget_gone(self) -> None:
        """Give up what is held of maps that another process deleted, and now and then of frames."""
        self.query_log.tidy()  # this node may have no worker
        with self.store.database.read() as connection:
            if time.monotonic() - self._purged < self.settings.purge_s / 2:
                self._readers.tidy(connection)
                return
            self._purged = time.monotonic()
            self.store.geometries.forget_older(self.settings.purge_s / 2)
        self._indexes.purge_local()
        with self.store.database.read() as connection:
            self._readers.purge(connection)

    # jobs

    def get_job(self, job_id: str) -> Job:
        """A job; UnknownJob where there is none."""
        return lifecycle.get_job(self.store, job_id)

    def retry_job(self, job_id: str) -> tuple[Job, bool]:
        """Try again what was given up, in a new job; see `lifecycle.retry`."""
        job, new = lifecycle.retry(self.store, job_id)
        if new:
            self.bell.ring()
        return job, new

    def retry_dead_jobs(
        self, cursor: str | None = None, limit: int = 100,
        map_names: Collection[str] | None = None,
    ) -> RetriedJobs:  # fmt: skip
        """Try again a page of dead jobs; see `lifecycle.retry_dead`."""
        done = lifecycle.retry_dead(self.store, cursor, limit, map_names)
        if done.retried:
            self.bell.ring()
        return done

    # keys

    def create_key(
        self, name: str, grants: Mapping[str, Scope] | None = None,
        expires_at: datetime | None = None, tenant: str | None = None,
    ) -> MadeKey:  # fmt: skip
        """Make a key, and show its secret; see `operations.create_key`."""
        return operations.create_key(self.store, name, grants, expires_at, tenant)

    def rotate_key(self, name: str, overlap_s: float = operations.OVERLAP_S) -> MadeKey:
        """Give a key a new secret, and show it; see `operations.rotate_key`."""
        return operations.rotate_key(self.store, name, overlap_s)

    def revoke_key(self, name: str) -> None:
        """Revoke a key; UnknownKey."""
        with self.store.database.write() as connection:
            stored_keys.revoke_key(connection, name)

    def find_key(self, secret: str) -> stored_keys.KeyRow | None:
        """The key with that secret, or None; also one that has expired."""
        with self.store.database.read() as connection:
            found = stored_keys.find_key(connection, secret)
        if found is not None and (found.expires_at is None or found.expires_at > time.time()):
            self.key_uses.note(found)
        return found

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
        """Frames of a map in the order they came, deleted ones only where asked for; see
        `map_frames.list_frames`. `wanted` has more that must hold, `state` with it.
        """
        return list_frames(self.store, map_name, wanted or FrameListing(state=state), cursor, limit)

    def get_frame(self, map_name: str, frame_id: str) -> Frame:
        """A frame; UnknownMap or UnknownFrame where there is none."""
        with self.store.database.read() as connection:
            row = stored_maps.find_map(connection, map_name)
            frame = stored_maps.find_frame(connection, row, frame_id)
            return frame_records(connection, row, [frame])[0]

    def delete_frame(self, map_name: str, frame_id: str) -> None:
        """Delete a frame, effective at once; `tombstones` can restore it for some time.

        Raises
        ------
        UnknownMap, UnknownFrame : there is none, or it was deleted before.
        """
        with self.store.database.write() as connection:
            row = stored_maps.find_map(connection, map_name)
            frame = stored_maps.find_frame(connection, row, frame_id)
            deletion = self.tombstones.begin(row)
            blobs = stored_frames.delete_frame(connection, row, frame, deletion)
        collect_deleted_blobs(self.store, blobs)

    # queries

    def query_frame(
        self, map_name: str, frame_id: str, query: Query, since: float | None = None,
        sent: SentQuery | None = None,
    ) -> Answer:  # fmt: skip
        """Look a frame of the map up among the others; see `Queries.stored`."""
        frame = NamedFrame.model_construct(map=map_name, frame_id=frame_id)
        return self.queries.stored([map_name], frame, query, since, sent)

    def view(self, map_name: str) -> tuple[MapRow, Model, IndexView]:
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

    def claim(self, worker: str) -> Work | LongJob | None:
        """Take the next job, or None; see `signature_job.claim`."""
        return working.claim(self.store, worker, self.settings.lease_s)

    def due_in_s(self) -> float | None:
        """Seconds until the next job can be claimed if nobody comes before, or None."""
        with self.store.database.read() as connection:
            return queue.due_in_s(connection)

    def run(self, work: Work | LongJob, broke: Callable[[], None] | None = None) -> JobState | None:
        """Do a claimed job, or a slice of a long one; see `signature_job.run` and `Tasks.run`."""
        with work_of(work.job.tenant):  # so are jobs that it queues
            if isinstance(work, LongJob):
                return self.tasks.run(work, self.settings.lease_s, self.settings.job_s, broke)
            return working.run(
                self.store, self.signers, self._readers, work, self.settings.lease_s,
                self.settings.job_s, broke,
            )  # fmt: skip

    def put_back(self, work: Work | LongJob) -> None:
        """Return a claimed job undone."""
        if isinstance(work, LongJob):
            self.tasks.put_back(work)
        else:
            put_back(self.store, work)
        self.bell.ring()

    def counts(self) -> tuple[dict[str, int], dict[str, int]]:
        """How many frames and how many jobs are in each state; see `Statistics.counts`."""
        with self.store.database.read() as connection:
            found = self.operations.statistics.counts(connection)
        return dict(found.frames), dict(found.jobs)

    def publish_due(self) -> int:
        """Bring maps on to their next models, delete what is too old, publish the indexes that have
        fallen behind, look for joins, verify a little, and remove what is no longer kept; returns
        how many indexes were published.
        """
        number_events(self.store.database)  # where nobody reads them
        self._reencoding.run()
        self.retiring.run()
        published = self._upkeep.run()
        self.operations.tidy()
        self.audit.tidy()
        self.query_log.tidy()
        self.imports.tidy()
        self._surface_upkeep.run()
        self._join_upkeep.run()
        if self.purging.run() is not None:
            with self.store.database.read() as connection:
                self._readers.purge(connection)
        return published

    def rebuild_index(self, map_name: str) -> int:
        """Publish the index of a map from nothing; returns its number.

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : there is no indexed frame in it.
        BusyIndex : another process is building it.
        """
        return self._upkeep.rebuild(self._row(map_name)).number


def open_engine(
    settings: Settings, patience_s: float = PATIENCE_S,
    may_go_on: Callable[[float], bool] | None = None,
) -> Engine:  # fmt: skip
    """An engine, as soon as its database answers; a fault that waiting cannot mend is told at once.

    Parameters
    ----------
    patience_s : seconds to wait at most
    may_go_on : waits so many seconds, and says whether to try again; default: it always is

    Raises
    ------
    UnusableStore, NewerSchema : see Engine. Of a server that is away, once it was waited for.
    """
    _ = settings.served_blobs
    return open_patiently(lambda: Engine(settings), patience_s, may_go_on)
