"""The engine's maps, keys and jobs: what is neither a frame nor a query."""

from __future__ import annotations

import logging
import time
from collections.abc import Collection, Mapping
from datetime import datetime
from pathlib import Path

from sceneprint.engine import jobs, keys, maps, reencoding
from sceneprint.engine.again import Again
from sceneprint.engine.associating import Associating
from sceneprint.engine.associations import Associations
from sceneprint.engine.audit import Audit
from sceneprint.engine.imports import Imports
from sceneprint.engine.inspecting import Inspection
from sceneprint.engine.keeping import open_kept
from sceneprint.engine.operations import Operations
from sceneprint.engine.outputs import Outputs
from sceneprint.engine.points import PointClouds
from sceneprint.engine.purging import Purging
from sceneprint.engine.querying import Queries
from sceneprint.engine.readers import Readers
from sceneprint.engine.reconstructions import Reconstructions
from sceneprint.engine.reencoding import Reencoding
from sceneprint.engine.retiring import Retiring
from sceneprint.engine.shown import Standing
from sceneprint.engine.signers import Signers
from sceneprint.engine.sweeping import sweep_deleted
from sceneprint.engine.tasks import Tasks
from sceneprint.engine.upkeep import Upkeep
from sceneprint.engine.uploads import Uploads
from sceneprint.engine.vector_tables import VectorTables
from sceneprint.engine.warming import warm
from sceneprint.engine.wire import tell_map
from sceneprint.errors import ModelError
from sceneprint.models import PRESETS, Model, read_model
from sceneprint.schemas import Job, JobState, Map, NewMap, Page
from sceneprint.schemas.keys import Key, MadeKey, Scope
from sceneprint.settings import Settings
from sceneprint.store import keys as stored_keys
from sceneprint.store import maps as stored_maps
from sceneprint.store import open_store
from sceneprint.store.associations import ASSOCIATE
from sceneprint.store.bell import Bell
from sceneprint.store.notices import Notices
from sceneprint.store.reencoding import models_of

log = logging.getLogger(__name__)


class Administration:
    """One store, opened, with its maps, keys and jobs.

    Parameters
    ----------
    settings : see Settings

    Raises
    ------
    UnusableStore, NewerSchema : the store cannot be opened.
    """

    def __init__(self, settings: Settings) -> None:
        from threadpoolctl import threadpool_limits

        self.settings = settings
        replica = settings.replica_url
        self.store = open_store(
            settings.database, settings.blobs,
            None if replica is None else replica.get_secret_value(), settings.replica_lag_s,
            settings.purge_s,
        )  # fmt: skip
        self.signers = Signers(self.store.database, settings.cache_dir)
        self._upkeep = Upkeep(
            self.store, self.signers, settings.indexes, settings.tail_frames, settings.scrub_s
        )
        self._reencoding = Reencoding(self.store, self._upkeep)
        self._readers = Readers(self.signers, settings.indexes, settings.search)
        self._vector_tables = VectorTables(self.signers, settings.search)
        self.kept = open_kept(
            settings, self.store.blobs, lambda kept: Standing(self.store).asked(kept)
        )
        self.inspection = Inspection(self.store, self.signers, self.kept)
        self.queries = Queries(self.store, self.signers, self._readers, self.kept)
        self.again = Again(self.store, self.kept, self.queries)
        # threads of the service work side by side, and sums have one order: the same bytes always
        self._limits = threadpool_limits(1)
        server = not self.store.database.is_sqlite
        self.bell = Notices(self.store.database) if server else Bell(settings.bell_dir)
        self.uploads = Uploads(self.store, self.bell, settings.concurrency)
        self.tasks = Tasks(self.store, self.bell)
        self.imports = Imports(self.store, self.tasks, self.uploads, settings.import_bytes)
        self.associations = Associations(self.store, self.tasks)
        associating = Associating(self.store, self.signers, self._readers)
        self.tasks.register(ASSOCIATE, associating)
        self.audit = Audit(self.store)
        self.outputs = Outputs(self.store, self.signers)
        self.points = PointClouds(self.store, self.inspection.pairs, self.kept)
        self.reconstructions = Reconstructions(self.store, self.tasks)
        self.retiring = Retiring(self.store)
        self.purging = Purging(
            self.store, self._upkeep, self.kept, self.reconstructions, settings.purge_s
        )
        self._purged = time.monotonic()
        self.operations = Operations(self.store, settings, self.bell)

    def close(self) -> None:
        """Give back what was opened."""
        self._limits.restore_original_limits()
        self.bell.close()
        self.store.close()

    def warm(self) -> None:
        """Load code and tables of every model in use before the first request needs them."""
        with self.store.database.read() as connection:
            used = {one for row in stored_maps.list_maps(connection) for one in models_of(row)}
        for model_id in used:
            try:
                warm(self.signers(model_id))
            except ModelError as error:  # it costs the maps of this model, and no others
                log.error("a model cannot be used", extra={"model": model_id, "error": str(error)})
        if not used:
            warm(self.signers.of(read_model(PRESETS[0])))

    # maps

    def create_map(self, new: NewMap) -> tuple[Map, bool]:
        """Make a map, or find it there as wanted; see `maps.create_map`."""
        return maps.create_map(self.store, new)

    def list_maps(self) -> Page[Map]:
        """All maps by name."""
        with self.store.database.read() as connection:
            rows = stored_maps.list_maps(connection)
            return Page[Map](items=[tell_map(connection, row) for row in rows])

    def get_map(self, name: str) -> Map:
        """A map; UnknownMap where there is none."""
        with self.store.database.read() as connection:
            return tell_map(connection, stored_maps.find_map(connection, name))

    def delete_map(self, name: str) -> None:
        """Remove a map with all that is in it; UnknownMap where there is none."""
        with self.store.database.write() as connection:
            blobs = stored_maps.remove_map(connection, stored_maps.find_map(connection, name))
        self._readers.forget(name)
        sweep_deleted(self.store, blobs)

    def reencode(self, name: str, model: str | Path | Model) -> Map:
        """Have a map signed with another model, to which it then switches; see `begin`."""
        told = reencoding.begin(self.store, name, model)
        self.bell.ring()
        return told

    def forget_gone(self) -> None:
        """Give up what is held of maps that another process deleted, and now and then of frames."""
        with self.store.database.read() as connection:
            if time.monotonic() - self._purged < self.settings.purge_s / 2:
                self._readers.tidy(connection)
                return
            self._purged = time.monotonic()
            self._readers.purge(connection)
        self.kept.forget(Standing(self.store).all_of)  # this node may have no worker

    def cancel_reencode(self, name: str) -> Map:
        """Let a map keep the model it has; see `reencoding.cancel`."""
        return reencoding.cancel(self.store, name)

    # jobs

    def get_job(self, job_id: str) -> Job:
        """A job; UnknownJob where there is none."""
        return jobs.get_job(self.store, job_id)

    def list_jobs(
        self, state: JobState | None = None, cursor: str | None = None, limit: int = 100,
        kind: str | None = None, map_names: Collection[str] | None = None,
    ) -> Page[Job]:  # fmt: skip
        """Jobs, the newest first; see `jobs.list_jobs`."""
        return jobs.list_jobs(self.store, state, cursor, limit, kind, map_names)

    def cancel_job(self, job_id: str) -> Job:
        """Give up a job that is not over; see `jobs.cancel`."""
        return jobs.cancel(self.store, job_id)

    def retry_job(self, job_id: str) -> tuple[Job, bool]:
        """Try again what was given up, in a new job; see `jobs.retry`."""
        job, new = jobs.retry(self.store, job_id)
        if new:
            self.bell.ring()
        return job, new

    # keys

    def create_key(
        self, name: str, grants: Mapping[str, Scope] | None = None,
        expires_at: datetime | None = None,
    ) -> MadeKey:  # fmt: skip
        """Make a key, and show its secret; see `keys.create_key`."""
        return keys.create_key(self.store, name, grants, expires_at)

    def list_keys(self, cursor: str | None = None, limit: int = 100) -> Page[Key]:
        """Keys by name; see `keys.list_keys`."""
        return keys.list_keys(self.store, cursor, limit)

    def revoke_key(self, name: str) -> None:
        """Let a key open nothing any more; UnknownKey where there is none."""
        with self.store.database.write() as connection:
            stored_keys.revoke_key(connection, name)

    def find_key(self, secret: str) -> stored_keys.KeyRow | None:
        """The key with that secret, or None; also one that has expired."""
        with self.store.database.read() as connection:
            return stored_keys.find_key(connection, secret)
