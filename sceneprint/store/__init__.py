"""The store: a database of maps, frames, signatures and jobs, and the blobs that it refers to.

All other data on disk is a cache. Functions take the connection of a transaction, so that related
changes are committed together. `Store` also caches geometry artifacts, since consecutive queries of
a robot are mostly aligned with the same ten to twenty frames.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import OrderedDict
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from sqlalchemy import make_url
from sqlalchemy.exc import ArgumentError

from sceneprint.atomic_files import make_folder
from sceneprint.decoders import Decoders, LocalDecoders
from sceneprint.errors import StoreAway, UnusableStore
from sceneprint.formats.artifact import read_geometry
from sceneprint.store.blobs.folder import Blobs, FileLocks, FolderBlobs, Locks
from sceneprint.store.blobs.object_client import open_objects
from sceneprint.store.blobs.object_store import BucketOwner, ObjectBlobs
from sceneprint.store.database import (
    Database,
    database_exists,
    open_database,
)
from sceneprint.store.database_errors import unusable
from sceneprint.store.opaque_ids import OpaqueIds
from sceneprint.store.postgres.session_locks import SessionLocks
from sceneprint.store.sqlite import is_read_only
from sceneprint.types import Geometry

__all__ = [
    "Blobs", "Database", "FolderBlobs", "Store", "open_blobs", "open_database", "open_store",
]  # fmt: skip

log = logging.getLogger(__name__)


#: Ratio of the memory of a cached geometry to the size of its arrays: derived samples, plane
#: weights and symmetries add up to 20 %.
_OVERHEAD = 1.25


@dataclass(frozen=True, eq=False)
class _Entry:
    geometry: Geometry
    size: int
    read_at: float


class GeometryCache:
    """Cache of geometry artifacts in memory; safe to share between threads.

    The least recently used entries are evicted first. Keys are hashes of the content, so entries
    are never stale.

    Parameters
    ----------
    most_bytes : maximum total size of the entries; 0 disables the cache
    """

    def __init__(self, blobs: Blobs, most_bytes: int) -> None:
        self._blobs, self._most_bytes = blobs, most_bytes
        self._lock = threading.Lock()
        self._entries: OrderedDict[str, _Entry] = OrderedDict()
        self._bytes = 0

    def read(self, digest: str) -> Geometry:
        """Return the geometry of an artifact, from the cache if possible, else from its blob.

        The geometry is then cached, so callers must not change it.

        Raises
        ------
        DamagedBlob : If the blob is missing or damaged.
        UnreadableGeometry : If the blob is not an artifact of this version.
        """
        with self._lock:
            entry = self._entries.get(digest)
            if entry is not None:
                self._entries.move_to_end(digest)
                return entry.geometry
        geometry = read_geometry(self._blobs.get(digest))
        entry = _Entry(geometry, int(_OVERHEAD * _array_bytes(geometry)), time.monotonic())
        with self._lock:
            self._remove(digest)  # in case another thread has added it
            self._entries[digest] = entry
            self._bytes += entry.size
            while self._bytes > self._most_bytes:
                self._remove(next(iter(self._entries)))
        return geometry

    def forget(self, digests: Iterable[str]) -> None:
        """Remove the entries of these artifacts, whose frames were deleted."""
        with self._lock:
            for digest in digests:
                self._remove(digest)

    def forget_older(self, seconds: float) -> None:
        """Remove entries older than `seconds`: another process may have deleted their frames."""
        until = time.monotonic() - seconds
        with self._lock:
            for digest in [d for d, entry in self._entries.items() if entry.read_at <= until]:
                self._remove(digest)

    @property
    def bytes_held(self) -> int:
        """Estimated memory of all entries, bytes."""
        return self._bytes

    def _remove(self, digest: str) -> None:
        entry = self._entries.pop(digest, None)
        if entry is not None:
            self._bytes -= entry.size


def _array_bytes(geometry: Geometry) -> int:
    values = [*vars(geometry.surface).values(), *vars(geometry.patches).values()]
    arrays = [value for value in values if isinstance(value, np.ndarray)]
    return sum(array.nbytes for array in arrays) + geometry.descriptors.nbytes


@dataclass(frozen=True, eq=False)
class Store:
    """An open database with its blobs.

    Parameters
    ----------
    geometry_bytes : maximum size of the cache of geometry artifacts, bytes
    """

    database: Database
    blobs: Blobs
    geometry_bytes: int = 0
    decoders: Decoders = field(default_factory=lambda: LocalDecoders(1))

    @property
    def read_only(self) -> bool:
        """Return whether the store was opened read-only, or its disk became read-only."""
        return self.database.read_only or self.database.turned_read_only or self.blobs.read_only

    @cached_property
    def geometries(self) -> GeometryCache:
        """Cache of geometry artifacts."""
        return GeometryCache(self.blobs, self.geometry_bytes)

    @cached_property
    def seals(self) -> OpaqueIds:
        """Cipher of the row numbers in public ids and cursors."""
        return OpaqueIds(self.database)

    def close(self) -> None:
        """Close all connections, and stop the decoders."""
        self.decoders.close()
        self.blobs.close()
        self.database.close()


def open_store(
    url: str, blobs: Path | str, geometry_bytes: int = 0, decoders: Decoders | None = None
) -> Store:
    """Open a store, and create the database and the blobs if both are missing.

    The blob folder of an existing database is never created: if its disk is not mounted yet, the
    mount would later hide the new folder.

    Parameters
    ----------
    blobs : folder, or URL of an object store
    decoders : decoders of uploads; default: one upload at a time in this process

    Raises
    ------
    UnusableStore, NewerSchema : See `open_database` and `open_blobs`.
    """
    new = not is_read_only(url) and not database_exists(url)
    if isinstance(blobs, Path):
        FolderBlobs(blobs, make=new)
    if new:
        _make_folder_of(url)
    database = open_database(url)
    try:
        return Store(
            database, open_blobs(blobs, database), geometry_bytes, decoders or LocalDecoders(1)
        )
    except BaseException:
        database.close()
        raise


def open_blobs(
    blobs: Path | str, database: Database, *, make: bool = False, claim: bool = True
) -> Blobs:
    """Open the blobs of a database.

    If the object store is unreachable, log a warning; requests fail until it is reachable.

    Parameters
    ----------
    blobs : folder, or URL of an object store
    make : whether to create a missing folder
    claim : whether to mark an unclaimed prefix or folder as owned by this database

    Raises
    ------
    UnusableStore : If the blobs cannot be opened, or belong to another database.
    """
    may_mark = claim and not database.read_only
    if isinstance(blobs, Path):
        folder = FolderBlobs(blobs, make=make)
        # detect two databases of a server that use the same folder by mistake
        if not database.is_sqlite and blobs.is_dir():
            may_mark &= os.access(blobs, os.W_OK)  # false for a read-only mount
            BucketOwner.of_folder(blobs).claim(OpaqueIds(database).owner, anew=may_mark)
        return folder
    objects = open_objects(blobs)
    locks: Locks
    if database.file is not None:
        locks = FileLocks(database.file.with_name(f"{database.file.name}-blobs"), make=True)
    elif database.is_sqlite:
        raise UnusableStore(
            "Blobs in an object store require a permanent database. Set SCENEPRINT_DATABASE_URL to "
            "a file or a server."
        )
    else:
        locks = SessionLocks(database)
    opened = ObjectBlobs(objects, locks, lambda: OpaqueIds(database).owner)
    try:
        opened.claim(anew=may_mark)
    except StoreAway as error:
        log.warning("object store unreachable", extra={"error": str(error)})
    return opened


def _make_folder_of(url: str) -> None:
    """Create the folder of a SQLite file; ignore other and invalid URLs.

    Raise UnusableStore if it cannot be created.
    """
    with suppress(ArgumentError, ValueError):
        parsed = make_url(url)
        if parsed.get_backend_name() == "sqlite" and parsed.database:
            folder = Path(parsed.database).absolute().parent
            try:
                make_folder(folder)
            except OSError as error:
                raise unusable(f"{folder}: the folder cannot be created", error) from error
