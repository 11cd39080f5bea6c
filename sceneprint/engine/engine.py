"""The engine: what service, workers and the embedded client do, they do through this."""

from __future__ import annotations

import logging
from types import TracebackType

from sceneprint.engine import keys, maps
from sceneprint.engine import work as working
from sceneprint.engine.answers import answer
from sceneprint.engine.asking import Asked, ask_stored, ask_upload
from sceneprint.engine.readers import Readers
from sceneprint.engine.signers import Signers
from sceneprint.engine.upkeep import Upkeep
from sceneprint.engine.uploads import sweep, upload
from sceneprint.engine.warming import warm
from sceneprint.engine.wire import tell_frames, tell_job, tell_map
from sceneprint.errors import InvalidRequest, ModelError, UnknownMap
from sceneprint.models import PRESETS, read_model
from sceneprint.schemas import (
    Added,
    Answer,
    Frame,
    FrameMeta,
    FrameState,
    Job,
    JobState,
    Map,
    NewMap,
    Page,
    Query,
)
from sceneprint.settings import Settings
from sceneprint.store import frames as stored_frames
from sceneprint.store import keys as stored_keys
from sceneprint.store import maps as stored_maps
from sceneprint.store import open_store, queue
from sceneprint.store.records import MapRow

log = logging.getLogger(__name__)


class Engine:
    """Maps, frames, queries and jobs over one store; safe to share between threads.

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
        self._upkeep = Upkeep(self.store, self.signers, settings.indexes, settings.tail_frames)
        self._readers = Readers(self.signers, settings.indexes, settings.tail_frames)
        # threads of the service work side by side, and sums have one order: the same bytes always
        self._limits = threadpool_limits(1)

    def close(self) -> None:
        """Give back what was opened."""
        self._limits.restore_original_limits()
        self.store.database.close()

    def warm(self) -> None:
        """Load code and tables of every model in use before the first request needs them."""
        with self.store.database.read() as connection:
            used = {row.model_id for row in stored_maps.list_maps(connection)}
        for model_id in used:
            try:
                warm(self.signers(model_id))
            except ModelError as error:  # it costs the maps of this model, and no others
                log.error("a model cannot be used", extra={"model": model_id, "error": str(error)})
        if not used:
            warm(self.signers.of(read_model(PRESETS[0])))

    def __enter__(self) -> Engine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self.close()

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
        sweep(self.store, blobs)

    # frames

    def add_frame(self, map_name: str, data: bytes, meta: FrameMeta) -> tuple[Added, bool]:
        """Take a frame into a map; see `upload`."""
        return upload(self.store, map_name, data, meta)

    def list_frames(
        self, map_name: str, cursor: str | None = None, limit: int = 100,
        state: FrameState | None = None,
    ) -> Page[Frame]:  # fmt: skip
        """Frames of a map in the order they came, deleted ones only where asked for.

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : a cursor that was not given out.
        """
        if cursor is not None and not (cursor.isascii() and cursor.isdigit() and len(cursor) < 19):
            raise InvalidRequest(
                f"The cursor {cursor!r:.40} was not given out. Take `next_cursor` of a page.",
                (("cursor", "not given out"),),
            )
        with self.store.database.read() as connection:
            row = stored_maps.find_map(connection, map_name)
            found = stored_frames.list_frames(
                connection, row.number, int(cursor or 0), limit + 1, state
            )
            more = len(found) > limit
            items = tell_frames(connection, row, found[:limit])
        return Page[Frame](items=items, next_cursor=str(found[limit - 1].number) if more else None)

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
            queue.cancel_of(connection, frame.number)
            blobs = stored_frames.delete_frame(connection, row, frame)
        sweep(self.store, blobs)

    def get_job(self, job_id: str) -> Job:
        """A job; UnknownJob where there is none."""
        with self.store.database.read() as connection:
            job = queue.find_job(connection, job_id)
            frame = stored_frames.frame_of(connection, job.frame_number)
            return tell_job(connection, job, stored_maps.map_of(connection, frame.map_number).name)

    # queries

    def query_upload(self, map_name: str, data: bytes, meta: FrameMeta, query: Query) -> Answer:
        """Look a frame up that is not kept; see `ask_upload`."""
        row = self._row(map_name)
        return self._answer(row, ask_upload(data, meta, self.signers(row.model_id), query), query)

    def query_frame(self, map_name: str, frame_id: str, query: Query) -> Answer:
        """Look a frame of the map up among the others; see `ask_stored`."""
        row = self._row(map_name)
        self.signers(row.model_id)  # opened while no connection is held: a crowd would hold all
        return self._answer(row, ask_stored(self.store, map_name, frame_id, query), query)

    def _row(self, map_name: str) -> MapRow:
        with self.store.database.read() as connection:
            return stored_maps.find_map(connection, map_name)

    def _answer(self, asked_of: MapRow, asked: Asked, query: Query) -> Answer:
        with self.store.database.read() as connection:
            row = stored_maps.find_map(connection, asked_of.name)
            if row.number != asked_of.number:
                raise UnknownMap(
                    f"Map {row.name!r} was deleted and made anew while it was asked. Ask again."
                )
            view = self._readers.view(connection, row)
        return answer(self.store, row, self.signers(row.model_id).model, view, asked, query)

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

    # work

    def claim(self, worker: str) -> working.Work | None:
        """Take the next job, or None; see `work.claim`."""
        return working.claim(self.store, worker, self.settings.lease_s)

    def run(self, work: working.Work) -> JobState | None:
        """Do a claimed job; see `work.run`."""
        return working.run(self.store, self.signers, work, self.settings.lease_s)

    def put_back(self, work: working.Work) -> None:
        """Return a claimed job undone."""
        working.put_back(self.store, work)

    def counts(self) -> tuple[dict[str, int], dict[str, int]]:
        """How many frames and how many jobs are in each state."""
        with self.store.database.read() as connection:
            return stored_frames.count_states(connection), queue.count_jobs(connection)

    def publish_due(self) -> int:
        """Publish the indexes that have fallen behind; returns how many."""
        return self._upkeep.run()
