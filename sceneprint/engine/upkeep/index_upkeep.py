"""Publishing indexes: a map with many frames or deletions that its index lacks gets a new one."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from sceneprint.atomic_files import PRIVATE_FILE, make_folder
from sceneprint.engine.search.index_place import IndexPlace
from sceneprint.engine.search.local_index import trusted
from sceneprint.engine.signers import Signers
from sceneprint.engine.upkeep.repair import resign_frames
from sceneprint.errors import (
    BusyIndex,
    DamagedIndex,
    InvalidRequest,
    SceneprintError,
    UnknownMap,
    UnusableStore,
)
from sceneprint.geometry.retrieval.ranking import Metric
from sceneprint.index import IndexVersion, newest, newest_number, publish, scrub
from sceneprint.index.index_manifest import IndexManifest
from sceneprint.models import Model
from sceneprint.settings import Settings
from sceneprint.store import Store
from sceneprint.store.deletion import DAY_S, newest_deletion
from sceneprint.store.events import anchor_of_now
from sceneprint.store.maps import find_map, list_maps
from sceneprint.store.postgres.connection import allow
from sceneprint.store.queue import read_clock
from sceneprint.store.reencoding_rows import is_complete
from sceneprint.store.signatures import changes_since, count_gone, count_indexed, deleted_since
from sceneprint.store.tables import MapRow
from sceneprint.types import Bytes

log = logging.getLogger(__name__)

#: Seconds for which indexes are verified in one step: frames wait meanwhile.
STEP_S = 0.25
#: Its date is when the last round was begun, by whichever worker.
_STAMP = ".scrubbed"
#: Seconds between two looks for deletions that an index should know of, at most.
AGING_S = 3600.0
#: Seconds until a host looks again at a map whose index another builds, or could not be shared.
ELSEWHERE_S = 30.0
#: In the folder of an index: read from its times, when it was purged, and when it may be again.
_REST = ".rest"


class Scrubber:
    """Verifies all indexes of the machine, one round after another, by one worker at a time.

    Parameters
    ----------
    indexes : folder of all indexes
    pause_s : seconds from the beginning of one round to that of the next
    """

    def __init__(self, indexes: Path, pause_s: float) -> None:
        self._indexes, self._pause_s = indexes, pause_s
        self._round: Iterator[Path | None] | None = None
        self._looked = -pause_s

    def step(self, folders: Sequence[Path]) -> Path | None:
        """Go on for a moment; begin a round where it is time.

        Parameters
        ----------
        folders : of the indexes that there are

        Returns
        -------
        the folder of a file that was damaged and has been removed: its index must be built anew
        """
        if self._round is None and self._is_time():
            self._round = chain.from_iterable(map(scrub, folders))
        until = time.monotonic() + STEP_S
        while self._round is not None and time.monotonic() < until:
            try:
                damaged = next(self._round)
            except StopIteration:
                self._round = None
                return None
            if damaged is not None:
                log.error("damaged index file removed", extra={"path": str(damaged)})
                damaged.unlink(missing_ok=True)  # what names it is passed over from now on
                return damaged.parent
        return None

    def _is_time(self) -> bool:
        if time.monotonic() - self._looked < min(self._pause_s, 60):
            return False
        self._looked = time.monotonic()
        stamp = self._indexes / _STAMP
        with suppress(OSError):  # never yet
            if time.time() - stamp.stat().st_mtime < self._pause_s:
                return False
        try:
            make_folder(self._indexes)
            stamp.touch(PRIVATE_FILE)
        except OSError:
            return False  # a cache that cannot be written cannot be healed either
        return True


class Upkeep:
    """Keeps the indexes of one machine near the database.

    Parameters
    ----------
    settings : an index may lack `tail_frames` frames, and as many deletions; after `scrub_s`
        seconds all parts are read again, to see that they are sound; an index that lacks a deletion
        of `deleted_rows_days` ago cannot be brought up to date
    place : where the indexes are
    """

    def __init__(
        self, store: Store, signers: Signers, settings: Settings, place: IndexPlace
    ) -> None:
        self._store, self._signers, self._place = store, signers, place
        self._tail_frames = settings.unindexed_frames
        self._elsewhere: dict[int, float] = {}  # by map, when it may be looked at again
        # map and model: number of their index, and revision
        self._published: dict[tuple[int, str], tuple[int, int]] = {}
        # map and model: parts of their index that this process has verified, by name and inode; to
        # read all of them for each thousand frames would take longer than to write
        self._verified: dict[tuple[int, str], Mapping[str, int]] = {}
        self._metrics: dict[str, Metric | None] = {}
        self._scrubber = Scrubber(settings.indexes, settings.index_check_interval_s)
        self._rows_s = DAY_S * settings.deleted_rows_days
        # map and model: when it is looked next for deletions that the index should know of by now
        self._aged = dict[tuple[int, str], float]()

    def run(self) -> int:
        """Publish what is due, and verify a little; returns how many indexes were published.

        What goes wrong with one map's index is logged, and costs neither the others nor any
        frame: queries read from the database what no index holds.
        """
        with self._store.database.read() as connection:
            rows = list_maps(connection)
        rows = [row for row in rows if self._metric(row.model_id) == "l2"]
        with self._store.database.read() as connection:
            due = [row for row in rows if self._is_due(connection, row)]
        # of maps that no other host was at a moment ago
        now, elsewhere = time.monotonic(), self._elsewhere
        published = sum(self._tried(row) for row in due if now >= elsewhere.get(row.number, 0.0))
        self._place.remove_unknown()
        damaged = self._scrubber.step([self._place.folder(row) for row in rows])
        for row in rows:
            if self._place.folder(row) == damaged:
                published += self._tried(row, anyway=True)
        return published

    def rebuild(self, row: MapRow) -> IndexVersion:
        """Publish the index of a map from nothing.

        Raises
        ------
        UnknownMap : the map is gone.
        InvalidRequest : there is no indexed frame in it, or its model's signatures are psi itself.
        BusyIndex : another process is building it.
        OSError : it cannot be written; what was there stays.
        """
        if self._signers(row.model_id).model.metric != "l2":
            raise InvalidRequest(
                f"Map {row.name!r} has no index to rebuild: its model stores full Fisher "
                "vectors, and queries compare all of them. If the map is too large for that, "
                "switch its model with `sceneprint reencode`."
            )
        version = self._publish(row, anyway=True, anew=True)
        if version is None:
            raise BusyIndex(
                f"The index of map {row.name!r} is being built by another process. Try again later."
            )
        return version

    def ahead(self, row: MapRow) -> IndexVersion | None:
        """Publish the index of the model that a map is about to switch to, where that is due.

        Where it cannot be written, that is logged, and the map has to do without.

        Returns
        -------
        the newest index of that model, if there is any; none of a model that has no index

        Raises
        ------
        UnknownMap : the map is gone.
        BusyIndex : another process is building it.
        """
        if row.next_model_id is None:
            raise ValueError(f"map {row.name} has no next model")
        coming = replace(row, model_id=row.next_model_id)
        model = self._signers(coming.model_id).model
        if model.metric != "l2":
            return None
        try:
            if self._publish(coming) is None:
                with self._store.database.read() as connection:
                    if self._is_due(connection, coming):
                        raise BusyIndex(
                            f"Another process is building the index of map {row.name!r} for the "
                            "model that it is switching to. Wait until the switch is done."
                        )
            self._place.sync(coming)
            return self._newest(coming, model)
        except (OSError, ValueError, UnusableStore, DamagedIndex) as error:
            log.error("index publication failed", extra={"map": row.name, "error": str(error)})
            return None

    def _tried(self, row: MapRow, *, anyway: bool = False) -> bool:
        try:
            if anyway and self._place.is_shared:
                self._place.sync(row)  # what was damaged here is fetched again
                return False
            return self._publish(row, anyway=anyway) is not None
        except UnknownMap:
            return False  # deleted in the meantime
        except (OSError, SceneprintError, ValueError) as error:
            log.error("index publication failed", extra={"map": row.name, "error": str(error)})
            if self._place.is_shared:  # to build it all again each time would be too dear
                self._elsewhere[row.number] = time.monotonic() + ELSEWHERE_S
            return False

    def _metric(self, model_id: str) -> Metric | None:
        """Return how the signatures of a model are compared; those of L1 have no index.

        None where another version made the model, and looks after the indexes of its maps.
        """
        if model_id not in self._metrics:
            self._metrics[model_id] = None
            with suppress(SceneprintError):
                self._metrics[model_id] = self._signers(model_id).model.metric
        return self._metrics[model_id]

    def _is_due(self, connection: Connection, row: MapRow) -> bool:
        number, since = self._published.get((row.number, row.model_id), (None, 0))
        if not self._place.is_shared and newest_number(self._place.folder(row)) != number:
            since = 0  # published by another process, or removed: to be looked at
        return self._is_long(connection, row, since)

    def _is_long(self, connection: Connection, row: MapRow, since: int) -> bool:
        """Return whether an index of that revision lacks too many frames, or deletions; or will
        soon be too old to be brought up to date.
        """
        if since < row.pruned_revision:
            since = 0
        if since and self._is_aging(connection, row, since):
            return True
        if row.revision - since <= self._tail_frames:  # spares the counting
            return False
        return count_indexed(connection, row.number, since) > self._tail_frames or (
            count_gone(connection, row.number, since) > self._tail_frames
        )

    def _is_aging(self, connection: Connection, row: MapRow, since: int) -> bool:
        """Return whether an index lacks a deletion whose row has had half of its days."""
        key = (row.number, row.model_id)
        if row.revision == since or time.monotonic() < self._aged.get(key, 0):
            return False
        before = read_clock(connection) - self._rows_s / 2
        if newest_deletion(connection, row.number, before) > since:
            return True
        self._aged[key] = time.monotonic() + min(self._rows_s / 24, AGING_S)
        return False

    def purge(self, row: MapRow) -> bool:
        """Leave no byte of a deleted frame in the index of a map, be it here or shared.

        Returns
        -------
        whether an index had to be written again

        Raises
        ------
        UnknownMap : the map is gone, and with it soon its index.
        BusyIndex : another process is building it, and may not know of the latest deletions.
        OSError, UnusableStore : it cannot be written; what was there stays.
        """
        if self._metric(row.model_id) == "l1":
            return False
        head = self._place.head(row)
        with self._store.database.read() as connection:
            now = replace(find_map(connection, row.name), model_id=row.model_id)
            if now.number != row.number:
                return False
            empty = count_indexed(connection, row.number, 0) == 0
            older = now.pruned_revision > 0 or count_gone(connection, row.number, 0) > 0
        stale = head is not None and bool(self._place.stale_keys(now, head))
        done = True
        if stale and not empty:
            done = self._publish(row, anyway=True, clean=True) is not None
        if done and older:  # also what a builder left that died
            head = None if empty else self._place.head(row)
            done = self._place.remove_all_but(row, head)
        if not done:
            raise BusyIndex(
                f"Another process is building the index of map {row.name!r}, so it may still "
                "contain bytes of deleted frames. Try again later."
            )
        return stale

    def sweep(self, *, now: bool = False) -> None:
        """Remove shared indexes of maps that are gone, and of models that they had."""
        self._place.sweep(now=now)

    def rest(self, row: MapRow, seconds: float) -> None:
        """Leave the index of a map in peace for so long, whichever process looks after it."""
        now = time.time()
        with suppress(OSError):  # removed meanwhile: then there is nothing to be left in peace
            mark = self._place.folder(row) / _REST
            mark.touch(PRIVATE_FILE)
            os.utime(mark, (now, now + seconds))

    def is_rested(self, row: MapRow) -> bool:
        """Return whether that time is over."""
        try:
            found = (self._place.folder(row) / _REST).stat()
        except OSError:
            return True
        return not found.st_atime <= time.time() < found.st_mtime  # nor has the clock been set back

    def _publish(
        self, row: MapRow, *, anyway: bool = False, anew: bool = False, clean: bool = False
    ) -> IndexVersion | None:
        """Publish the index of a map where it is due, or anyway; None where it is not published."""
        if not anyway and self._is_up_to_date(row):
            return None
        with self._place.turn(row) as require:
            if require is None:  # another host builds it
                self._elsewhere[row.number] = time.monotonic() + ELSEWHERE_S
                return None
            if not anew:
                self._place.sync(row)

            def share(manifest: IndexManifest) -> bool:
                require()
                return self._place.share(row, manifest)

            made = self._build(row, share, anyway=anyway, anew=anew, clean=clean)
            if made is None:
                return None
            self._place.prune(row, clean=clean)
        self._published[row.number, row.model_id] = made.number, made.revision
        self._verified[row.number, row.model_id] = made.inodes
        log.info(
            "index published",
            extra={"map": row.name, "version": made.number, "frames": len(made)},
        )
        return made

    def _build(
        self, row: MapRow, share: Callable[[IndexManifest], bool], *, anyway: bool,
        anew: bool, clean: bool,
    ) -> IndexVersion | None:  # fmt: skip
        model = self._signers(row.model_id).model  # before a connection is held: it takes one
        after, damaged = self._place.last_number(row), list[int]()
        with self._store.database.read() as connection:
            allow(connection, 0)  # it does nothing itself, for as long as building takes
            now = find_map(connection, row.name)
            if row.model_id == now.next_model_id and is_complete(connection, now):
                now = replace(now, model_id=row.model_id)  # about to be the map's own
            if (now.number, now.model_id) != (row.number, row.model_id):
                return None  # made anew, or signed anew, in the meantime; next time
            previous = trusted(connection, now, None if anew else self._newest(now, model))
            since = 0 if previous is None else previous.revision
            if not anyway and not self._is_long(connection, now, since):
                return None  # another worker was first
            if previous is None and count_indexed(connection, now.number, 0) == 0:
                if not anew:
                    return None
                raise InvalidRequest(
                    f"Map {now.name!r} has no indexed frame, so there is nothing to build."
                )
            made = publish(
                self._place.folder(now),
                model_id=now.model_id,
                revision=now.revision,
                blocks=_blocks(connection, now, since, damaged),
                previous=previous,
                drop=deleted_since(connection, now.number, since),
                anchor=partial(anchor_of_now, self._store.database, now.name),
                clean=clean,
                after=after,
                share=share,
            )
        resign_frames(self._store, now, damaged, now.model_id)
        return made

    def _is_up_to_date(self, row: MapRow) -> bool:
        """Return whether the newest index of a map, by its manifest, is near enough to it."""
        head = self._place.head(row)
        with self._store.database.read() as connection:
            now = replace(find_map(connection, row.name), model_id=row.model_id)
            found = trusted(connection, now, head)
            since = 0 if found is None else found.revision
            if found is not None:
                self._published[row.number, row.model_id] = found.number, since
            return not self._is_long(connection, now, since)

    def _newest(self, row: MapRow, model: Model) -> IndexVersion | None:
        """Return the newest sound index here; what this process has verified is not read again."""
        sound = self._verified.get((row.number, row.model_id))
        found = newest(self._place.folder(row), row.model_id, model.signature_bytes, sound=sound)
        if found is not None:
            self._verified[row.number, row.model_id] = found.inodes
        return found


def _blocks(
    connection: Connection, row: MapRow, since: int, damaged: list[int]
) -> Iterator[tuple[NDArray[np.int64], Bytes]]:
    """Yield keys and signatures of what was indexed after a revision; note those left out."""
    for block in changes_since(connection, row, since):
        damaged += [one.number for one in block if one.vector is None and not one.deleted]
        made = [(one.number, one.vector) for one in block if one.vector is not None]
        if made:
            rows = np.stack([np.frombuffer(vector, np.uint8) for _, vector in made])
            yield np.array([number for number, _ in made], np.int64), rows
