"""Publishing indexes: a map whose tail has grown long gets a new generation."""

from __future__ import annotations

import logging
import os
import shutil
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
from sceneprint.engine.search.local_index import (
    index_folder,
    is_index_folder,
    trusted,
)
from sceneprint.engine.search.shared_index import SharedIndexes
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
from sceneprint.index import Generation, clear, manifests, newest, newest_number, publish, scrub
from sceneprint.index.generation_files import GenerationManifest
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

# Reading the indexes of a machine again, a little at a time, and discarding what is damaged.

#: Seconds of reading in one step: frames wait meanwhile.
STEP_S = 0.25
#: Its date is when the last round was begun, by whichever worker.
_STAMP = ".scrubbed"


class Scrubber:
    """One round of all indexes after another, begun by one worker of the machine at a time.

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
        the folder of a file that was damaged and has been removed: its index must be made anew
        """
        if self._round is None:
            if not self._is_time():
                return None
            self._round = chain.from_iterable(map(scrub, folders))
        until = time.monotonic() + STEP_S
        while time.monotonic() < until:
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
        try:
            if time.time() - stamp.stat().st_mtime < self._pause_s:
                return False
        except OSError:
            pass  # never yet
        try:
            make_folder(self._indexes)
            stamp.touch(PRIVATE_FILE)
        except OSError:
            return False  # a cache that cannot be written cannot be healed either
        return True


log = logging.getLogger(__name__)

#: Seconds between two looks for deletions that an index should know of, at most.
AGING_S = 3600.0
#: Seconds until a host looks again at a map whose index another builds, or could not be shared.
ELSEWHERE_S = 30.0
#: In the folder of an index: read from its times, when it was purged, and when it may be again.
_REST = ".rest"


class Upkeep:
    """Keeps the indexes of one machine near the database.

    Parameters
    ----------
    settings : `indexes` is the folder of all indexes; a generation may lack `tail_frames` frames,
        and as many deletions; after `scrub_s` seconds all files are read again, to see that they
        are sound; an index that lacks a deletion of `deleted_rows_days` ago cannot be brought up
        to date
    shared : indexes of the fleet; None where each host builds its own
    """

    def __init__(
        self, store: Store, signers: Signers, settings: Settings, shared: SharedIndexes | None
    ) -> None:
        self._store, self._signers, self._shared = store, signers, shared
        self._indexes, self._tail_frames = settings.indexes, settings.tail_frames
        self._elsewhere: dict[int, float] = {}  # by map, when it may be looked at again
        # map and model: number of their index, and revision
        self._published: dict[tuple[int, str], tuple[int, int]] = {}
        # map and model: files of their index that this process has verified, by name and inode; to
        # read all of them for each thousand frames would take longer than to write
        self._verified: dict[tuple[int, str], Mapping[str, int]] = {}
        self._models: dict[str, Model | None] = {}
        self._scrubber = Scrubber(settings.indexes, settings.scrub_s)
        self._rows_s = DAY_S * settings.deleted_rows_days
        # map and model: when it is looked next for deletions that the index should know of by now
        self._aged = dict[tuple[int, str], float]()

    def run(self) -> int:
        """Publish what is due, and verify a little; returns how many generations were published.

        What goes wrong with one map's index is logged, and costs neither the others nor any
        frame: queries read from the database what no index holds.
        """
        with self._store.database.read() as connection:
            listed = list_maps(connection)
        rows = [row for row in listed if self._has_index(row.model_id)]
        with self._store.database.read() as connection:
            due = [row for row in rows if self._due(connection, row)]
        # of maps that no other host was at a moment ago
        now, elsewhere = time.monotonic(), self._elsewhere
        published = sum(self._tried(row) for row in due if now >= elsewhere.get(row.number, 0.0))
        self._clean(listed)
        damaged = self._scrubber.step([index_folder(self._indexes, row) for row in rows])
        for row in rows:
            if index_folder(self._indexes, row) == damaged:
                published += self._tried(row, anyway=True)
        return published

    def rebuild(self, row: MapRow) -> Generation:
        """Publish the index of a map from nothing.

        Raises
        ------
        UnknownMap : the map is gone.
        InvalidRequest : there is no indexed frame in it, or its model's signatures are psi itself.
        BusyIndex : another process is building it.
        OSError : it cannot be written; what was there stays.
        """
        if not self._is_indexed(self._signers(row.model_id).model):
            raise InvalidRequest(
                f"Map {row.name!r} has no index to rebuild: its model stores full Fisher "
                "vectors, and queries compare all of them. If the map is too large for that, "
                "switch its model with `sceneprint reencode`."
            )
        generation = self._publish(row, anyway=True, anew=True)
        if generation is None:
            raise BusyIndex(
                f"The index of map {row.name!r} is being built by another process. Try again later."
            )
        return generation

    def ahead(self, row: MapRow) -> Generation | None:
        """Publish the index of the model that a map is about to switch to, where that is due.

        Where it cannot be written, that is logged, and the map has to do without.

        Returns
        -------
        the newest generation of that model, if there is any; none of a model that has no index

        Raises
        ------
        UnknownMap : the map is gone.
        BusyIndex : another process is building it.
        """
        coming = _coming(row)
        if not self._is_indexed(self._signers(coming.model_id).model):
            return None
        try:
            if self._publish(coming) is None:
                with self._store.database.read() as connection:
                    if self._due(connection, coming):
                        raise BusyIndex(
                            f"Another process is building the index of map {row.name!r} for the "
                            "model that it is switching to. Wait until the switch is done."
                        )
            length = self._signers(coming.model_id).model.signature_bytes
            if self._shared is not None:
                self._shared.sync(coming)
            return newest(index_folder(self._indexes, coming), coming.model_id, length)
        except (OSError, ValueError, UnusableStore, DamagedIndex) as error:
            log.error("index publication failed", extra={"map": row.name, "error": str(error)})
            return None

    def _tried(self, row: MapRow, *, anyway: bool = False) -> bool:
        try:
            if anyway and self._shared is not None:
                self._shared.sync(row)  # what was damaged here is fetched again
                return False
            return self._publish(row, anyway=anyway) is not None
        except UnknownMap:
            return False  # deleted in the meantime
        except (OSError, SceneprintError, ValueError) as error:
            log.error("index publication failed", extra={"map": row.name, "error": str(error)})
            if self._shared is not None:  # to build it all again each time would be too dear
                self._elsewhere[row.number] = time.monotonic() + ELSEWHERE_S
            return False

    def _model(self, model_id: str) -> Model | None:
        """A model; None where another version made it, which looks after it."""
        if model_id not in self._models:
            try:
                self._models[model_id] = self._signers(model_id).model
            except SceneprintError:
                self._models[model_id] = None
        return self._models[model_id]

    def _has_index(self, model_id: str) -> bool:
        """Whether maps of a model have an index that is ours to look after."""
        model = self._model(model_id)
        return model is not None and self._is_indexed(model)

    def _is_indexed(self, model: Model) -> bool:
        """Return whether maps of a model have an index: signatures compared by L1 have none."""
        return model.metric == "l2"

    def _due(self, connection: Connection, row: MapRow) -> bool:
        number, since = self._published.get((row.number, row.model_id), (None, 0))
        here = newest_number(index_folder(self._indexes, row))
        if self._shared is None and here != number:
            since = 0  # published by another process, or removed: to be looked at
        return self._is_long(connection, row, since)

    def _is_long(self, connection: Connection, row: MapRow, since: int) -> bool:
        """Whether a generation of that revision lacks too many frames, or deletions; or will soon
        be too old to be brought up to date.
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
        """Whether a generation lacks a deletion whose row has had half of its days."""
        if row.revision == since or time.monotonic() < self._aged.get(
            (row.number, row.model_id), 0
        ):
            return False
        before = read_clock(connection) - self._rows_s / 2
        if newest_deletion(connection, row.number, before) > since:
            return True
        self._aged[row.number, row.model_id] = time.monotonic() + min(self._rows_s / 24, AGING_S)
        return False

    def purge(self, row: MapRow) -> bool:
        """Leave no byte of a deleted frame in the index of a map, be it here or shared; whether
        anything was done.

        Raises
        ------
        UnknownMap : the map is gone, and with it soon its index.
        BusyIndex : another process is building it, and may not know of the latest deletions.
        OSError, UnusableStore : it cannot be written; what was there stays.
        """
        model = self._model(row.model_id)
        if model is None:  # of another version's model, which says so where there is an index
            return self._purge_own(row)
        if not self._is_indexed(model):
            return False
        own = self._purge_own if self._shared is None else self._purge_shared
        return own(row)

    def _purge_own(self, row: MapRow) -> bool:
        """As `purge`: of what is here alone."""
        folder = index_folder(self._indexes, row)
        listed = manifests(folder)
        if not listed:
            return False
        model = self._signers(row.model_id).model
        # before a connection waits for it
        found = self._newest(row, folder, model.signature_bytes)
        with self._store.database.read() as connection:
            allow(connection, 0)
            now = find_map(connection, row.name)
            if now.number != row.number:
                return False
            gone = deleted_since(connection, row.number, 0 if found is None else found.revision)
            empty = count_indexed(connection, row.number, 0) == 0
            if found is not None and found.revision < now.pruned_revision:
                found = None  # of what it has too much, no row tells any more
            left = found is None or len(listed) > 1
            older = left and (now.pruned_revision > 0 or count_gone(connection, row.number, 0) > 0)
        if empty or (found is None and older):
            done = clear(folder)  # of what is damaged, nothing is read: it is made anew in time
        elif found is None:
            return False
        else:
            if found.holds_any(np.fromiter(gone, np.int64)):
                done = self._publish(row, anyway=True, clean=True) is not None
            elif older:
                done = clear(folder, but=found.number)
            else:
                return False
        if not done:
            raise BusyIndex(
                f"Another process is building the index of map {row.name!r}, so it may still "
                "contain bytes of deleted frames. Try again later."
            )
        return True

    def _purge_shared(self, row: MapRow) -> bool:
        """As `purge`: of what the fleet shares, and then of what is here of it."""
        shared = self._shared
        assert shared is not None
        head, folder = shared.head(row), index_folder(self._indexes, row)
        with self._store.database.read() as connection:
            allow(connection, 0)
            now = find_map(connection, row.name)
            if now.number != row.number:
                return False
            since = 0 if head is None else head.revision
            gone = np.fromiter(deleted_since(connection, row.number, since), np.int64)
            empty = count_indexed(connection, row.number, 0) == 0
            older = now.pruned_revision > 0 or count_gone(connection, row.number, 0) > 0
        done = done_here = True
        stale = head is not None and (
            head.revision < now.pruned_revision  # of what it has too much, no row tells any more
            or bool(head.worn_keys)
            or bool(np.isin(gone, shared.keys(row, head)).any())
        )
        if stale and not empty:
            done = self._publish(row, anyway=True, clean=True) is not None
        elif older:  # also what a builder left that died
            with shared.turn(row) as mine:
                if mine is None:
                    done = False
                elif empty:
                    shared.withdraw(row)
                else:
                    shared.tidy(row, clean=True)
        if done and manifests(folder):
            found = None if empty else shared.sync(row)
            if found is None or len(manifests(folder)) > 1:
                done_here = clear(folder, but=None if found is None else found.number)
        if not (done and done_here):
            raise BusyIndex(
                f"Another process is building the index of map {row.name!r}, so it may still "
                "contain bytes of deleted frames. Try again later."
            )
        return stale

    def sweep(self, *, now: bool = False) -> None:
        """Remove shared indexes of maps that are gone, and of models that they had.

        Raises
        ------
        UnusableStore : the object store cannot be used.
        """
        if self._shared is not None:
            self._shared.sweep(lambda: self._known_folders(()), now=now)

    def rest(self, row: MapRow, seconds: float) -> None:
        """Leave the index of a map in peace for so long, whichever process looks after it."""
        now = time.time()
        with suppress(OSError):  # removed meanwhile: then there is nothing to be left in peace
            mark = index_folder(self._indexes, row) / _REST
            mark.touch(PRIVATE_FILE)
            os.utime(mark, (now, now + seconds))

    def is_rested(self, row: MapRow) -> bool:
        """Whether that time is over."""
        try:
            found = (index_folder(self._indexes, row) / _REST).stat()
        except OSError:
            return True
        return not found.st_atime <= time.time() < found.st_mtime  # nor has the clock been set back

    def _publish(
        self, row: MapRow, *, anyway: bool = False, anew: bool = False, clean: bool = False
    ) -> Generation | None:
        shared = self._shared
        if shared is None:
            return self._build(row, anyway=anyway, anew=anew, clean=clean)
        if not anyway and self._is_up_to_date(row, shared):
            return None
        with shared.turn(row) as mine:
            if mine is None:  # another host builds it
                self._elsewhere[row.number] = time.monotonic() + ELSEWHERE_S
                return None
            if not anyway and self._is_up_to_date(row, shared):
                return None  # it has built it meanwhile
            if not anew:
                shared.sync(row)
            folder = index_folder(self._indexes, row)

            def share(manifest: GenerationManifest) -> bool:
                mine()
                return shared.share(folder, manifest)

            after = shared.newest_number(row)
            made = self._build(row, anyway=anyway, anew=anew, clean=clean, after=after, share=share)
            if made is not None:
                shared.tidy(row, clean=clean)
            return made

    def _is_up_to_date(self, row: MapRow, shared: SharedIndexes) -> bool:
        """Whether what the fleet shares of a map is near enough to it."""
        head = shared.head(row)
        with self._store.database.read() as connection:
            now = replace(find_map(connection, row.name), model_id=row.model_id)
            found = trusted(connection, now, head)
            since = 0 if found is None else found.revision
            if found is not None:
                self._published[row.number, row.model_id] = found.number, since
            return not self._is_long(connection, now, since)

    def _build(
        self, row: MapRow, *, anyway: bool = False, anew: bool = False, clean: bool = False,
        after: int = 0, share: Callable[[GenerationManifest], bool] = lambda _: True,
    ) -> Generation | None:  # fmt: skip
        signer = self._signers(row.model_id)  # before a connection is held: it takes one itself
        damaged: list[int] = []
        with self._store.database.read() as connection:
            allow(connection, 0)  # it does nothing itself, for as long as building takes
            now = find_map(connection, row.name)
            if row.model_id == now.next_model_id and is_complete(connection, now):
                now = replace(now, model_id=row.model_id)  # about to be the map's own
            if (now.number, now.model_id) != (row.number, row.model_id):
                return None  # made anew, or signed anew, in the meantime; next time
            folder = index_folder(self._indexes, now)
            length = signer.model.signature_bytes
            previous = None
            if not anew:
                previous = trusted(connection, now, self._newest(now, folder, length))
            since = 0 if previous is None else previous.revision
            if previous is not None:
                self._note(now, previous)
            if not anyway and not self._is_long(connection, now, since):
                return None  # another worker was first
            if previous is None and count_indexed(connection, now.number, 0) == 0:
                if anew:
                    raise InvalidRequest(
                        f"Map {now.name!r} has no indexed frame, so there is nothing to build."
                    )
                return None
            generation = publish(
                folder,
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
        if generation is None:
            return None
        self._note(now, generation)
        log.info(
            "index published",
            extra={"map": now.name, "generation": generation.number, "frames": len(generation)},
        )
        return generation

    def _note(self, row: MapRow, found: Generation) -> None:
        self._published[row.number, row.model_id] = found.number, found.revision
        self._verified[row.number, row.model_id] = found.inodes

    def _newest(self, row: MapRow, folder: Path, length: int) -> Generation | None:
        """The newest sound generation here; what this process has verified is not read again."""
        sound = self._verified.get((row.number, row.model_id))
        return newest(folder, row.model_id, length, sound=sound)

    def _clean(self, rows: Sequence[MapRow]) -> None:
        """Remove the indexes of maps that are no more, of models that they had, and of psi."""
        if not self._indexes.is_dir():
            return
        kept = self._known_folders(rows)
        for folder in self._indexes.iterdir():
            if is_index_folder(folder.name) and folder.name not in kept:
                shutil.rmtree(folder, ignore_errors=True)
                log.info("index removed", extra={"folder": folder.name})

    def _known_folders(self, rows: Sequence[MapRow]) -> set[str]:
        """Names of the folders of indexes of these maps, and of those that there are now."""
        with self._store.database.read() as connection:  # a map may have been made since
            known = [*rows, *list_maps(connection)]
        known += [_coming(row) for row in known if row.next_model_id is not None]
        # a model of another version is another's concern
        known = [r for r in known if self._model(r.model_id) is None or self._has_index(r.model_id)]
        return {index_folder(self._indexes, row).name for row in known}


def _coming(row: MapRow) -> MapRow:
    """A map as it will be with the model that it is being signed with."""
    if row.next_model_id is None:
        raise ValueError(f"map {row.name} has no next model")
    return replace(row, model_id=row.next_model_id)


def _blocks(
    connection: Connection, row: MapRow, since: int, damaged: list[int]
) -> Iterator[tuple[NDArray[np.int64], Bytes]]:
    """Keys and signatures of what was indexed after a revision; numbers of those left out."""
    for block in changes_since(connection, row, since):
        damaged += [one.number for one in block if one.vector is None and not one.deleted]
        made = [(one.number, one.vector) for one in block if one.vector is not None]
        if made:
            rows = np.stack([np.frombuffer(vector, np.uint8) for _, vector in made])
            yield np.array([number for number, _ in made], np.int64), rows
