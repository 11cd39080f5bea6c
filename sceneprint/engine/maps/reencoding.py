"""Re-encoding of a map: its frames are signed again with another model, then the map switches.

    begin  -->  jobs  -->  a second signature of each frame  --Reencodings.run-->  switch

Queries go on with the model that the map has. The switch is one commit, made when no frame lacks
the next model's signature; whoever is killed in between leaves what the next one goes on with.
"""

from __future__ import annotations

import logging
import math
import time
from pathlib import Path

import numpy as np

from sceneprint import errors
from sceneprint.engine.search.local_index import trusted
from sceneprint.engine.serializers import map_record, model_label
from sceneprint.engine.upkeep.garbage_collection import collect_blobs
from sceneprint.engine.upkeep.index_upkeep import Upkeep
from sceneprint.index import Generation
from sceneprint.models import Model, read_model, write_model
from sceneprint.store import Store, signatures
from sceneprint.store import reencoding_rows as stored
from sceneprint.store.maps import find_map, keep_model, list_maps, model_names
from sceneprint.store.queue import cancel_jobs
from sceneprint.store.tables import MapRow, jobs
from sceneprint_client.api import Map

log = logging.getLogger(__name__)

#: Seconds that a worker removes former signatures before it looks for frames to sign again.
TIDY_S = 2.0


def begin(store: Store, map_name: str, model: str | Path | Model) -> Map:
    """Have a map signed with another model; where that is under way, try again what broke down.

    Parameters
    ----------
    store : see Store
    map_name : of the map
    model : a preset or a model file, or one that was read

    Raises
    ------
    UnknownMap : no such map.
    UnreadableModel : no such model.
    Conflict : it is the map's model, or the map is being signed with a third one.
    """
    wanted = model if isinstance(model, Model) else read_model(model)
    with store.database.write() as connection:
        row = find_map(connection, map_name)
        if row.next_model_id not in (None, wanted.id):
            label = model_label(model_names(connection)[row.next_model_id], row.next_model_id)
            raise errors.Conflict(
                f"Map {row.name!r} is already switching to {label}. Wait until it has switched, "
                f"or cancel with `sceneprint reencode {row.name} --cancel`."
            )
        if row.next_model_id is None and row.model_id == wanted.id:
            raise errors.Conflict(
                f"Map {row.name!r} is already signed with {wanted.label}. There is nothing to do."
            )
        if row.next_model_id is None:
            keep_model(connection, wanted.id, wanted.name, write_model(wanted))
            stored.begin(connection, row, wanted.id)
            row = find_map(connection, row.name)
    _enqueue(store, row, again=True)
    with store.database.read() as connection:
        return map_record(connection, find_map(connection, map_name))


def cancel(store: Store, map_name: str) -> Map:
    """Let a map keep the model it has, and remove what was made for the other.

    Raises
    ------
    UnknownMap : no such map.
    Conflict : no other model is on its way.
    """
    with store.database.write() as connection:
        row = find_map(connection, map_name)
        if row.next_model_id is None:
            raise errors.Conflict(
                f"Map {row.name!r} is not switching to another model, so there is nothing to "
                "cancel. To undo a finished switch, run it again with --model and the previous "
                "model."
            )
        stored.give_up(connection, row)
    _tidy(store, row)
    with store.database.read() as connection:
        return map_record(connection, find_map(connection, map_name))


class Reencodings:
    """Brings maps on to their next models, and removes what the former left.

    Parameters
    ----------
    store : see Store
    upkeep : that publishes the index of the next model before the switch
    """

    def __init__(self, store: Store, upkeep: Upkeep) -> None:
        self._store, self._upkeep = store, upkeep
        self._tidied: dict[int, tuple[str, ...]] = {}  # the models that a map is known to have

    def run(self) -> None:
        """One look at all maps; what goes wrong with one is logged, and costs no other."""
        with self._store.database.read() as connection:
            rows = list_maps(connection)
        for row in rows:
            try:
                models = stored.models_of(row)
                if row.next_model_id is not None and self._go_on(row):
                    models = (row.next_model_id,)
                if self._tidied.get(row.number) != models and _tidy(self._store, row, TIDY_S):
                    self._tidied[row.number] = models
            except errors.UnknownMap:
                pass  # deleted in the meantime
            except errors.SceneprintError as error:
                log.error("map not reencoded", extra={"map": row.name, "error": str(error)})

    def _go_on(self, row: MapRow) -> bool:
        """Do what can be done now; whether the map has switched."""
        with self._store.database.read() as connection:
            if stored.is_pending(connection, row):
                return False
        if _enqueue(self._store, row):
            return False
        with self._store.database.read() as connection:
            if not stored.is_complete(connection, row):
                return False  # jobs that broke down: somebody must say what is to become of them
        try:
            generation = self._upkeep.ahead(row)
        except errors.BusyIndex:
            return False  # next time
        return self._switch(row, generation)

    def _switch(self, row: MapRow, generation: Generation | None) -> bool:
        with self._store.database.write() as connection:
            now = find_map(connection, row.name)
            if not _still(now, row) or not stored.is_complete(connection, now):
                return False  # a frame was indexed meanwhile, or somebody was first
            found = trusted(connection, now, generation)
            if found is not None:
                # what was signed after the index was published, and had a revision before it
                signed = stored.signed_up_to(connection, now, found.revision)
                stored.touch(connection, now, np.setdiff1d(signed, found.keys).tolist())
            rejected = stored.switch_model(connection, now)
        log.info(
            "map reencoded",
            extra={"map": row.name, "model": row.next_model_id, "rejected": len(rejected)},
        )
        return True


def _enqueue(store: Store, row: MapRow, *, again: bool = False) -> int:
    """Queue a job for each frame that lacks the next model's signature; returns how many."""
    after, queued = 0, 0
    while True:
        with store.database.read() as connection:  # most often there is nothing: no lock
            if not stored.unqueued(connection, row, after, again=again):
                return queued
        with store.database.write() as connection:
            if not _still(find_map(connection, row.name), row):
                return queued
            numbers = stored.unqueued(connection, row, after, again=again)
            stored.enqueue_all(connection, row, numbers)
        if numbers:
            after, queued = numbers[-1], queued + len(numbers)


def _tidy(store: Store, row: MapRow, at_most_s: float = math.inf) -> bool:
    """Cancel and remove what is of neither model of a map, a little at a time; whether all is."""
    start = time.monotonic()
    while True:
        with store.database.read() as connection:
            if not signatures.stale_jobs(connection, find_map(connection, row.name)):
                break
        with store.database.write() as connection:
            now = find_map(connection, row.name)
            stale = signatures.stale_jobs(connection, now)
            cancel_jobs(connection, jobs.c.number.in_(stale))
    after = 0
    while True:
        with store.database.read() as connection:
            if not signatures.stale_signatures(connection, find_map(connection, row.name), after):
                return True
        if time.monotonic() - start > at_most_s:
            return False
        blobs: list[str] = []
        with store.database.write() as connection:
            now = find_map(connection, row.name)
            for number, model_id in signatures.stale_signatures(connection, now, after):
                blobs += signatures.remove_signature(connection, number, model_id)
                after = number - 1  # a frame may have several
        collect_blobs(store, blobs)


def _still(now: MapRow, row: MapRow) -> bool:
    return (now.number, now.next_model_id) == (row.number, row.next_model_id)
