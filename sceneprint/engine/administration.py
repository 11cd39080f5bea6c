"""The engine's maps, keys and jobs: what is neither a frame nor a query."""

from __future__ import annotations

import logging
from pathlib import Path

from sceneprint.engine import jobs, keys, maps, reencoding
from sceneprint.engine.readers import Readers
from sceneprint.engine.reencoding import Reencoding
from sceneprint.engine.signers import Signers
from sceneprint.engine.upkeep import Upkeep
from sceneprint.engine.uploads import sweep_deleted
from sceneprint.engine.warming import warm
from sceneprint.engine.wire import tell_map
from sceneprint.errors import ModelError
from sceneprint.models import PRESETS, read_model
from sceneprint.schemas import Job, JobState, Map, NewMap, Page
from sceneprint.settings import Settings
from sceneprint.store import keys as stored_keys
from sceneprint.store import maps as stored_maps
from sceneprint.store import open_store
from sceneprint.store.bell import Bell
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
        self.store = open_store(settings.database, settings.blob_dir)
        self.signers = Signers(self.store.database, settings.cache_dir)
        self._upkeep = Upkeep(
            self.store, self.signers, settings.indexes, settings.tail_frames, settings.scrub_s
        )
        self._reencoding = Reencoding(self.store, self._upkeep)
        self._readers = Readers(self.signers, settings.indexes)
        # threads of the service work side by side, and sums have one order: the same bytes always
        self._limits = threadpool_limits(1)
        self.bell = Bell(settings.bell_dir)

    def close(self) -> None:
        """Give back what was opened."""
        self._limits.restore_original_limits()
        self.store.database.close()

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

    def reencode(self, name: str, model: str | Path) -> Map:
        """Have a map signed with another model, to which it then switches; see `begin`."""
        told = reencoding.begin(self.store, name, model)
        self.bell.ring()
        return told

    def cancel_reencode(self, name: str) -> Map:
        """Let a map keep the model it has; see `reencoding.cancel`."""
        return reencoding.cancel(self.store, name)

    # jobs

    def get_job(self, job_id: str) -> Job:
        """A job; UnknownJob where there is none."""
        return jobs.get_job(self.store, job_id)

    def list_jobs(
        self, state: JobState | None = None, cursor: str | None = None, limit: int = 100
    ) -> Page[Job]:
        """Jobs of all maps, the newest first; see `jobs.list_jobs`."""
        return jobs.list_jobs(self.store, state, cursor, limit)

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

    def create_key(self, name: str) -> str:
        """Make a key and return its secret; see `keys.create_key`."""
        return keys.create_key(self.store, name)

    def list_keys(self) -> list[tuple[str, float]]:
        """Name of every key, and when it was made."""
        with self.store.database.read() as connection:
            return stored_keys.list_keys(connection)

    def revoke_key(self, name: str) -> None:
        """Let a key open nothing any more; UnknownKey where there is none."""
        with self.store.database.write() as connection:
            stored_keys.revoke_key(connection, name)

    def key_name(self, secret: str) -> str | None:
        """Name of the key with that secret, or None."""
        with self.store.database.read() as connection:
            return stored_keys.key_name(connection, secret)
