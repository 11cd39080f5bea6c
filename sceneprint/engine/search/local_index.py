"""What queries search: each map's signatures, caught up with the database before every query.

A `Reader` holds one map: the newest version of its index, and the tail of frames indexed after
it. What it hands out is an `IndexView`, which never changes; catching up makes a new one beside it.
A map without an index on this node is all tail: its signatures are read from the database once, and
compared exactly until a worker has published its index. Signatures compared by L1 never have one.
"""

from __future__ import annotations

import logging
import mmap
import os
import re
import tempfile
import threading
import time
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from sceneprint.atomic_files import make_folder
from sceneprint.errors import UnusableStore
from sceneprint.geometry.retrieval.ranking import Metric
from sceneprint.index import (
    IndexVersion,
    SearchHits,
    Tail,
    newest,
    newest_number,
    search,
    signatures_of,
)
from sceneprint.index.index_manifest import SCHEMA_VERSION, IndexManifest
from sceneprint.index.part_files import Keys
from sceneprint.models import Model
from sceneprint.store.events import holds_anchor
from sceneprint.store.signatures import SignatureChange, changes_since, count_indexed
from sceneprint.store.tables import MapRow
from sceneprint.types import Bytes

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class IndexView:
    """A map as of one revision: an index, and the frames that are newer.

    Parameters
    ----------
    model_id : of the model that made all signatures
    metric : how they are compared
    revision : of the map
    size : frames that can be found
    dead : frames that it holds and that are deleted
    damaged : frames that were passed over, as their signature is damaged
    version : of its index, or None
    tail : frames newer than it
    """

    model_id: str
    metric: Metric
    revision: int
    size: int
    dead: frozenset[int]
    damaged: frozenset[int]
    version: IndexVersion | None
    tail: Tail

    @property
    def number(self) -> int:
        """Number of the version of the index; 0 where none is used."""
        return 0 if self.version is None else self.version.number

    def search(
        self, query: Bytes, size: int, *, dead: frozenset[int], among: Keys | None = None,
        exact: bool = False,
    ) -> SearchHits:  # fmt: skip
        """Return the nearest frames by exact distance; see `index.search`."""
        return search(
            query, self.version, self.tail, size, metric=self.metric, dead=dead, among=among,
            exact=exact,
        )  # fmt: skip

    def nearer(
        self, query: Bytes, key: int, distance: int, *, dead: frozenset[int],
        among: Keys | None = None,
    ) -> int:  # fmt: skip
        """Count the frames that come before one in the order of exact distance, then of keys."""
        hits = self.search(query, max(self.size, 1), dead=dead, among=among, exact=True)
        same = (hits.distances == distance) & (hits.keys < key)
        return int(((hits.distances < distance) | same).sum())

    def signatures(self, keys: Keys) -> Bytes:
        """Return the signatures (r, D) of frames that it has; see `index.signatures_of`."""
        return signatures_of(keys, self.version, self.tail)

    def has(self, keys: Keys) -> NDArray[np.bool_]:
        """Return which frames (n,) can be found."""
        known = self.tail.places.of(keys) >= 0
        if self.version is not None:
            known |= self.version.has(keys)
        alive: NDArray[np.bool_] = known & ~np.isin(keys, list(self.dead))
        return alive


# The tail of a reader while it grows: appended to behind what has been handed out of it.

#: Bytes of signatures up to which they are held in memory. More go to a file that has no name,
#: whose pages the kernel drops and reads again as it likes: a map that has lost its index is
#: scanned whole, and may be larger than the machine's memory.
IN_MEMORY = 256 << 20


class AppendBuffer:
    """Signatures in the order of their revisions; a tail that it returns never changes.

    Parameters
    ----------
    length : bytes of a signature
    folder : where a file for many of them may be created, else the system's temporary folder
    capacity : signatures to make room for at first
    """

    def __init__(self, length: int, folder: Path, capacity: int = 64) -> None:
        self._folder, self._capacity = folder, max(capacity, 64)
        self._keys: NDArray[np.int64] = np.empty(self._capacity, np.int64)
        self._revisions: NDArray[np.int64] = np.empty(self._capacity, np.int64)
        self._rows = self._room(self._capacity, length)
        self._places: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self._places)

    @property
    def bytes_held(self) -> int:
        """Memory that the signatures take and nobody but this process can give back."""
        return self._rows.nbytes if self._rows.nbytes <= IN_MEMORY else 0

    def reserve(self, more: int) -> None:
        """Make room for that many more at once: growing step by step would copy all each time.

        Raises
        ------
        UnusableStore : If there is no room on the disk.
        """
        n = len(self)
        if n + more > self._capacity:
            length = self._rows.shape[1]
            # twice as many, but no more than memory would be used for at once
            step = min(self._capacity, max(IN_MEMORY // length, 64))
            capacity = max(n + more, self._capacity + step)
            rows = self._room(capacity, length)  # where this fails, all is as it was
            rows[:n] = self._rows[:n]  # views keep the old arrays
            new = np.empty(capacity - n, np.int64)
            self._keys = np.concatenate([self._keys[:n], new])
            self._revisions = np.concatenate([self._revisions[:n], new])
            self._capacity, self._rows = capacity, rows

    def append(self, change: SignatureChange, row: Bytes) -> None:
        """Take the signature of a frame that is not there yet."""
        self.reserve(1)
        n = len(self)
        self._keys[n], self._revisions[n], self._rows[n] = change.number, change.revision, row
        self._places[change.number] = n

    def copy(self, after: int, without: Collection[int] = ()) -> AppendBuffer:
        """Return the signatures indexed after a revision, without some keys, in other arrays."""
        n = len(self)
        wanted = (self._revisions[:n] > after) & ~np.isin(self._keys[:n], list(without))
        places = np.flatnonzero(wanted)
        n = len(places)
        kept = AppendBuffer(self._rows.shape[1], self._folder, n)
        kept._keys[:n], kept._revisions[:n] = self._keys[places], self._revisions[places]
        np.take(self._rows, places, axis=0, out=kept._rows[:n], mode="clip")  # no copy beside
        kept._places = {key: place for place, key in enumerate(kept._keys[:n].tolist())}
        return kept

    def revision_of(self, key: int) -> int:
        """Return the revision of the signature of a frame; 0 where it is not there."""
        place = self._places.get(key)
        return 0 if place is None else int(self._revisions[place])

    def tail(self) -> Tail:
        """Return all that is there now."""
        n = len(self)
        return Tail(self._keys[:n], self._rows[:n])

    def _room(self, capacity: int, length: int) -> Bytes:
        size = capacity * length
        if size <= IN_MEMORY:
            return np.empty((capacity, length), np.uint8)
        mapped = _nameless(self._folder, size)
        return np.frombuffer(mapped, np.uint8).reshape(capacity, length)


def _nameless(folder: Path, size: int) -> mmap.mmap:
    """A file of that size, mapped, that the kernel removes with its last user."""
    failed: OSError | None = None
    for place in (folder, Path(tempfile.gettempdir())):
        try:
            make_folder(place)
            with tempfile.TemporaryFile(dir=place) as file:
                # set aside now: a page that has no room when it is written kills the process
                os.posix_fallocate(file.fileno(), 0, size)
                return mmap.mmap(file.fileno(), size)
        except OSError as error:
            failed = error
    raise UnusableStore(
        f"{folder}: no room for {size >> 20} MB of unindexed signatures "
        f"({failed and failed.strerror}). Free some space, or let a worker publish an index."
    ) from failed


#: Frames that a reader may be behind before it begins again with a newer index, if there is one.
READ_MOST = 20_000
#: Seconds between two looks for a newer version, and until one that is damaged, or out of reach
#: for a moment, is read again.
_LOOK_S, _AGAIN_S = 1.0, 60.0


def index_folder(indexes: Path, row: MapRow) -> Path:
    """Return the folder of the index of a map.

    No other map has it, even one that had the same name, and no other model, whose signatures are
    not comparable. No other schema has it: a version of the product that runs beside this one has
    a folder of its own.
    """
    created = f"{row.number}-{round(1e6 * row.created_at):x}"
    return indexes / f"{row.name}-{created}-{row.model_id[:12]}.{SCHEMA_VERSION}"


_FOLDER_NAME = re.compile(
    rf"[a-z0-9][a-z0-9_-]{{0,62}}-\d+-[0-9a-f]+-[0-9a-f]{{12}}\.{SCHEMA_VERSION}"
)


def is_index_folder(name: str) -> bool:
    """Return whether a name is one of `index_folder`."""
    return _FOLDER_NAME.fullmatch(name) is not None


#: A version, or its manifest alone.
Published = TypeVar("Published", IndexVersion, IndexManifest)


def trusted(connection: Connection, row: MapRow, found: Published | None) -> Published | None:
    """A version, unless the database was put back to a state before it, and went on; or rows of
    frames that were deleted since are gone, so that nobody can tell which.
    """
    if found is None or found.revision < row.pruned_revision:
        return None
    if found.revision <= row.revision and holds_anchor(connection, found.anchor):
        return found
    return None


class Reader:
    """One map, searched by many threads.

    Parameters
    ----------
    connection, row : see `view`
    folder : of its index
    model : of its signatures
    """

    def __init__(self, connection: Connection, row: MapRow, folder: Path, model: Model) -> None:
        self._folder, self._model = folder, model
        self._looked = self._asked = time.monotonic()
        self._lock = threading.Lock()
        self._unsound = 0, 0.0  # number of a version that cannot be used, until the next try
        self._begin(connection, row)

    def _begin(self, connection: Connection, row: MapRow) -> None:
        """Hold the newest version, and nothing else."""
        self._tail = AppendBuffer(self._model.signature_bytes, self._folder.parent)
        self._dead: dict[int, int] = {}  # what was deleted after the version, and when
        self._damaged: set[int] = set()
        found = self._newest(connection, row, None)
        self._publish(found, 0 if found is None else found.revision)

    @property
    def version(self) -> IndexVersion | None:
        """That is used."""
        return self._view.version

    @property
    def bytes_held(self) -> int:
        """Memory of the tail."""
        return self._tail.bytes_held

    def is_outdated(self) -> bool:
        """Whether there is an index that this reader does not use."""
        number = self._newest_number()
        unsound, until = self._unsound
        return number not in (None, self._view.number) and (
            number != unsound or time.monotonic() > until
        )

    def lost_index(self, idle_s: float) -> bool:
        """Whether nobody asked for so long, and the index that it uses is not on the disk."""
        idle = time.monotonic() - self._asked > idle_s
        return idle and self._view.number > 0 and newest_number(self._folder) is None

    def view(self, connection: Connection, row: MapRow) -> IndexView:
        """The map as of the row's revision, or later."""
        self._asked = time.monotonic()
        behind = self._view.revision < row.revision
        # who only looks for a newer version waits for nobody
        if (behind or self._is_time()) and self._lock.acquire(blocking=behind):
            try:
                if self._view.revision < row.revision:
                    self._catch_up(connection, row)
                if self._is_time():
                    self._swap(connection, row)
            finally:
                self._lock.release()
        return self._view

    def purge(self, connection: Connection, row: MapRow) -> None:
        """Hold no signature of a deleted frame any more, but what the newest index has of it."""
        with self._lock:
            if self._view.revision < row.revision:
                self._catch_up(connection, row)
            self._swap(connection, row)
            gone = {number for number in self._dead if self._tail.revision_of(number)}
            if gone:
                self._tail = self._tail.copy(0, without=gone)
                self._publish(self._view.version, self._view.revision)

    def _is_time(self) -> bool:
        return time.monotonic() - self._looked >= _LOOK_S

    def _catch_up(self, connection: Connection, row: MapRow) -> None:
        is_far_behind = row.revision - self._view.revision > READ_MOST and self.is_outdated()
        if 0 < self._view.revision < row.pruned_revision or is_far_behind:
            self._begin(connection, row)
        view = self._view
        self._tail.reserve(count_indexed(connection, row.number, view.revision))
        for block in changes_since(connection, row, view.revision):
            for change in block:
                self._take(change)
        self._publish(view.version, row.revision)

    def _take(self, change: SignatureChange) -> None:
        self._damaged.discard(change.number)
        if change.deleted:
            self._dead[change.number] = change.revision  # a newer version may hold it
        elif change.vector is None:
            # one frame must not cost the others; a worker's log says it too
            log.error("damaged signature skipped", extra={"frame_id": change.frame_id})
            self._damaged.add(change.number)
        elif self._tail.revision_of(change.number) < change.revision:
            # else an error ended the last time half way
            if self._tail.revision_of(change.number):  # signed anew, as it had been damaged
                self._tail = self._tail.copy(0, without={change.number})
            self._tail.append(change, np.frombuffer(change.vector, np.uint8))
            self._dead.pop(change.number, None)  # rejected by a model, and tried again by another

    def _swap(self, connection: Connection, row: MapRow) -> None:
        """Take another version, if a worker has published one, and keep the rest as tail."""
        self._looked = time.monotonic()
        view = self._view
        if not self.is_outdated():
            return
        found = self._newest(connection, row, view.version)
        since = 0 if view.version is None else view.version.revision
        # one of the same revision stands for one that was found damaged
        if (
            found is None or found.number == view.number
            or not since <= found.revision <= view.revision
        ):  # fmt: skip
            if found is not None and found.revision < since:  # a fleet's, older than one made here
                self._unsound = found.number, time.monotonic() + _AGAIN_S
            return
        self._tail = self._tail.copy(found.revision)
        self._dead = {n: deleted for n, deleted in self._dead.items() if deleted > found.revision}
        self._publish(found, view.revision)

    def _newest_number(self) -> int | None:
        return newest_number(self._folder) if self._model.metric == "l2" else None

    def _newest(
        self, connection: Connection, row: MapRow, known: IndexVersion | None
    ) -> IndexVersion | None:
        number = self._newest_number()
        if number is None:
            return None
        length = self._model.signature_bytes
        found = newest(self._folder, row.model_id, length, known=known)
        if found is None or found.number < number:
            self._unsound = number, time.monotonic() + _AGAIN_S
        return trusted(connection, row, found)

    def _publish(self, version: IndexVersion | None, revision: int) -> None:
        tail, both = self._tail.tail(), 0
        deleted = np.fromiter(self._dead, np.int64, len(self._dead))
        held = np.isin(deleted, tail.keys)
        if version is not None:
            held |= version.has(deleted)
            both = int(version.has(tail.keys).sum())  # signed anew since
        dead = frozenset(deleted[held].tolist())
        size = len(version or ()) + len(tail) - both - len(dead)
        model, damaged = self._model, frozenset(self._damaged)
        self._view = IndexView(model.id, model.metric, revision, size, dead, damaged, version, tail)
