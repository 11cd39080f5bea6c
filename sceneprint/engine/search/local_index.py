"""Readers of local indexes, which add the signatures that an index does not contain yet.

A `Reader` consists of the newest version of the index of a map and a tail of newer frames. It
provides immutable `IndexView`s, and creates a new view when the map has changed. Without an index,
all signatures are in the tail, and are compared exactly. Signatures with the metric L1 never have
an index.
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
from sceneprint.index.index_manifest import SCHEMA_VERSION, IndexManifest, newest_number
from sceneprint.index.index_version import (
    IndexVersion,
    SearchHits,
    Tail,
    newest,
    search,
    signatures_of,
)
from sceneprint.index.part_files import Keys
from sceneprint.models import Model
from sceneprint.store.events import holds_anchor
from sceneprint.store.signatures import SignatureChange, changes_since, count_indexed
from sceneprint.store.tables import MapRow
from sceneprint.types import Bytes

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class IndexView:
    """The signatures of a map at a revision: a version of its index, and newer frames.

    Parameters
    ----------
    size : number of searchable frames
    dead : frame numbers of deleted frames in the index or the tail
    damaged : frame numbers of frames without a readable signature
    version : version of the index; None if there is no index
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
        """Number of the version of the index; 0 if there is no index."""
        return 0 if self.version is None else self.version.number

    def search(
        self, query: Bytes, size: int, *, dead: frozenset[int], among: Keys | None = None,
        exact: bool = False,
    ) -> SearchHits:  # fmt: skip
        """Return the `size` nearest frames by exact distance, except `dead`; see `index.search`."""
        return search(
            query, self.version, self.tail, size, metric=self.metric, dead=dead, among=among,
            exact=exact,
        )  # fmt: skip

    def nearer(
        self, query: Bytes, key: int, distance: int, *, dead: frozenset[int],
        among: Keys | None = None,
    ) -> int:  # fmt: skip
        """Return the number of frames that rank before frame `key`, which is at `distance`."""
        hits = self.search(query, max(self.size, 1), dead=dead, among=among, exact=True)
        same = (hits.distances == distance) & (hits.keys < key)
        return int(((hits.distances < distance) | same).sum())

    def signatures(self, keys: Keys) -> Bytes:
        """Return the signatures (r, D) of frames; see `index.signatures_of`."""
        return signatures_of(keys, self.version, self.tail)

    def has(self, keys: Keys) -> NDArray[np.bool_]:
        """Return a mask (n,) of the frames that the view contains."""
        included = self.tail.places.of(keys) >= 0
        if self.version is not None:
            included |= self.version.has(keys)
        alive: NDArray[np.bool_] = included & ~np.isin(keys, list(self.dead))
        return alive


#: Maximum size of signatures in memory, bytes. Larger tails are in a mapped file, whose pages the
#: kernel can evict.
IN_MEMORY = 256 << 20


class AppendBuffer:
    """A growing buffer of signatures, sorted by revision; tails that it returned never change.

    Parameters
    ----------
    length : length of a signature in bytes
    folder : folder for a mapped file; the fallback is the temporary folder of the system
    """

    def __init__(self, length: int, folder: Path, capacity: int = 64) -> None:
        self._folder, self._capacity = folder, max(capacity, 64)
        self._keys: NDArray[np.int64] = np.empty(self._capacity, np.int64)
        self._revisions: NDArray[np.int64] = np.empty(self._capacity, np.int64)
        self._rows = self._allocate(self._capacity, length)
        self._places: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self._places)

    @property
    def bytes_held(self) -> int:
        """Size, in bytes, of the memory that the kernel cannot evict."""
        return self._rows.nbytes if self._rows.nbytes <= IN_MEMORY else 0

    def reserve(self, more: int) -> None:
        """Reserve capacity for `more` signatures, to avoid repeated copies.

        Raise UnusableStore if the disk has no room for the file.
        """
        n = len(self)
        if n + more > self._capacity:
            length = self._rows.shape[1]
            # double the capacity, but add at most IN_MEMORY bytes
            step = min(self._capacity, max(IN_MEMORY // length, 64))
            capacity = max(n + more, self._capacity + step)
            rows = self._allocate(capacity, length)  # allocate first, since this may fail
            rows[:n] = self._rows[:n]  # copy, since views use the old array
            new = np.empty(capacity - n, np.int64)
            self._keys = np.concatenate([self._keys[:n], new])
            self._revisions = np.concatenate([self._revisions[:n], new])
            self._capacity, self._rows = capacity, rows

    def append(self, change: SignatureChange, row: Bytes) -> None:
        """Append the signature of a frame that is not in the buffer."""
        self.reserve(1)
        n = len(self)
        self._keys[n], self._revisions[n], self._rows[n] = change.number, change.revision, row
        self._places[change.number] = n

    def copy(self, after: int, without: Collection[int] = ()) -> AppendBuffer:
        """Return a buffer with the signatures after a revision, except of the frames `without`."""
        n = len(self)
        selected = (self._revisions[:n] > after) & ~np.isin(self._keys[:n], list(without))
        places = np.flatnonzero(selected)
        n = len(places)
        result = AppendBuffer(self._rows.shape[1], self._folder, n)
        result._keys[:n], result._revisions[:n] = self._keys[places], self._revisions[places]
        np.take(self._rows, places, axis=0, out=result._rows[:n], mode="clip")
        result._places = {key: place for place, key in enumerate(result._keys[:n].tolist())}
        return result

    def revision_of(self, key: int) -> int:
        """Return the revision of the signature of a frame; 0 if the frame is not in the buffer."""
        place = self._places.get(key)
        return 0 if place is None else int(self._revisions[place])

    def tail(self) -> Tail:
        """Return the current content as a tail."""
        n = len(self)
        return Tail(self._keys[:n], self._rows[:n])

    def _allocate(self, capacity: int, length: int) -> Bytes:
        size = capacity * length
        if size <= IN_MEMORY:
            return np.empty((capacity, length), np.uint8)
        mapped = _nameless(self._folder, size)
        return np.frombuffer(mapped, np.uint8).reshape(capacity, length)


def _nameless(folder: Path, size: int) -> mmap.mmap:
    """Return a mapped temporary file of `size` bytes; raise UnusableStore if the disk is full."""
    failed: OSError | None = None
    for place in (folder, Path(tempfile.gettempdir())):
        try:
            make_folder(place)
            with tempfile.TemporaryFile(dir=place) as file:
                # allocate now: on a full disk, a later write to a page would kill the process
                os.posix_fallocate(file.fileno(), 0, size)
                return mmap.mmap(file.fileno(), size)
        except OSError as error:
            failed = error
    raise UnusableStore(
        f"{folder}: the disk has no room for {size >> 20} MB of unindexed signatures "
        f"({failed and failed.strerror}). Free some space, or let a worker publish an index."
    ) from failed


#: Maximum number of new frames to read; a reader that lacks more restarts with a newer index.
READ_MOST = 20_000
#: Seconds between checks for a newer version, and until an unreadable version is tried again.
_LOOK_S, _AGAIN_S = 1.0, 60.0


def index_folder(indexes: Path, row: MapRow) -> Path:
    """Return the folder of the index of a map.

    The name is unique for each map (even for maps of the same name), model and schema version.
    """
    created = f"{row.number}-{round(1e6 * row.created_at):x}"
    return indexes / f"{row.name}-{created}-{row.model_id[:12]}.{SCHEMA_VERSION}"


_FOLDER_NAME = re.compile(
    rf"[a-z0-9][a-z0-9_-]{{0,62}}-\d+-[0-9a-f]+-[0-9a-f]{{12}}\.{SCHEMA_VERSION}"
)


def is_index_folder(name: str) -> bool:
    """Return whether a name is that of an index folder of any map."""
    return _FOLDER_NAME.fullmatch(name) is not None


#: A version or its manifest.
Published = TypeVar("Published", IndexVersion, IndexManifest)


def trusted(connection: Connection, row: MapRow, published: Published | None) -> Published | None:
    """Return `published` if it is consistent with the database, else None.

    It is inconsistent if the database was restored to an earlier state, or no longer has the rows
    of frames that were deleted after the version.
    """
    if published is None or published.revision < row.pruned_revision:
        return None
    if published.revision <= row.revision and holds_anchor(connection, published.anchor):
        return published
    return None


class Reader:
    """Reader of a map's signatures for many threads."""

    def __init__(self, connection: Connection, row: MapRow, folder: Path, model: Model) -> None:
        self._folder, self._model = folder, model
        self._looked = self._asked = time.monotonic()
        self._lock = threading.Lock()
        self._unsound = 0, 0.0  # number of an unreadable version, and time of the next attempt
        self._begin(connection, row)

    def _begin(self, connection: Connection, row: MapRow) -> None:
        """Restart with the newest version and an empty tail."""
        self._tail = AppendBuffer(self._model.signature_bytes, self._folder.parent)
        self._dead: dict[int, int] = {}  # frames deleted after the version, with their revision
        self._damaged: set[int] = set()
        version = self._newest(connection, row, None)
        self._publish(version, 0 if version is None else version.revision)

    @property
    def version(self) -> IndexVersion | None:
        """Current version of the index; None if there is no index."""
        return self._view.version

    @property
    def bytes_held(self) -> int:
        """Size, in bytes, of the memory of the tail that the kernel cannot evict."""
        return self._tail.bytes_held

    def is_outdated(self) -> bool:
        """Return whether another usable version exists."""
        number = self._newest_number()
        unsound, until = self._unsound
        return number not in (None, self._view.number) and (
            number != unsound or time.monotonic() > until
        )

    def lost_index(self, idle_s: float) -> bool:
        """Return whether the reader was idle for `idle_s` seconds, and its index was removed."""
        idle = time.monotonic() - self._asked > idle_s
        return idle and self._view.number > 0 and newest_number(self._folder) is None

    def view(self, connection: Connection, row: MapRow) -> IndexView:
        """Return a view of the map at the revision of `row` or later."""
        self._asked = time.monotonic()
        behind = self._view.revision < row.revision
        # wait for the lock only to catch up, not to check for a newer version
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
        """Switch to the newest version, and remove signatures of deleted frames from the tail."""
        with self._lock:
            if self._view.revision < row.revision:
                self._catch_up(connection, row)
            self._swap(connection, row)
            deleted = {number for number in self._dead if self._tail.revision_of(number)}
            if deleted:
                self._tail = self._tail.copy(0, without=deleted)
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
            self._dead[change.number] = change.revision
        elif change.vector is None:
            log.error("damaged signature skipped", extra={"frame_id": change.frame_id})
            self._damaged.add(change.number)
        elif self._tail.revision_of(change.number) < change.revision:
            # otherwise, an interrupted call has appended it already
            if self._tail.revision_of(change.number):  # a damaged frame was signed again
                self._tail = self._tail.copy(0, without={change.number})
            self._tail.append(change, np.frombuffer(change.vector, np.uint8))
            self._dead.pop(change.number, None)  # another model had rejected the frame

    def _swap(self, connection: Connection, row: MapRow) -> None:
        """Switch to another version if one is available; newer frames remain in the tail."""
        self._looked = time.monotonic()
        view = self._view
        if not self.is_outdated():
            return
        version = self._newest(connection, row, view.version)
        since = 0 if view.version is None else view.version.revision
        # a version of the same revision replaces a damaged one
        if (
            version is None or version.number == view.number
            or not since <= version.revision <= view.revision
        ):  # fmt: skip
            if version is not None and version.revision < since:  # an older, shared version
                self._unsound = version.number, time.monotonic() + _AGAIN_S
            return
        self._tail = self._tail.copy(version.revision)
        self._dead = {n: deleted for n, deleted in self._dead.items() if deleted > version.revision}
        self._publish(version, view.revision)

    def _newest_number(self) -> int | None:
        return newest_number(self._folder) if self._model.metric == "l2" else None

    def _newest(
        self, connection: Connection, row: MapRow, previous: IndexVersion | None
    ) -> IndexVersion | None:
        number = self._newest_number()
        if number is None:
            return None
        length = self._model.signature_bytes
        version = newest(self._folder, row.model_id, length, previous=previous)
        if version is None or version.number < number:
            self._unsound = number, time.monotonic() + _AGAIN_S
        return trusted(connection, row, version)

    def _publish(self, version: IndexVersion | None, revision: int) -> None:
        tail, both = self._tail.tail(), 0
        deleted = np.fromiter(self._dead, np.int64, len(self._dead))
        included = np.isin(deleted, tail.keys)
        if version is not None:
            included |= version.has(deleted)
            both = int(version.has(tail.keys).sum())  # frames that were signed again
        dead = frozenset(deleted[included].tolist())
        size = len(version or ()) + len(tail) - both - len(dead)
        model, damaged = self._model, frozenset(self._damaged)
        self._view = IndexView(model.id, model.metric, revision, size, dead, damaged, version, tail)
