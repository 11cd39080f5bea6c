"""The truth: one database with maps, frames, signatures and jobs, and blobs.

Everything else on disk is a cache of this. Functions take the connection of a transaction, so
that what belongs together is committed together; `Store` opens both parts, and the geometry
artifacts that were read lately.

A query compares itself with ten to twenty frames of the map, and a robot's next query with mostly
the same ones. What depends on a frame alone is kept along with its artifact.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import OrderedDict
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
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
    is_there,
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


# Geometry artifacts in memory.

#: Memory of a frame over that of its arrays: samples, plane weights and symmetries are kept too,
#: 0.2 of them where queries have used all of it.
_OVERHEAD = 1.25


@dataclass(frozen=True, eq=False)
class _Entry:
    geometry: Geometry
    size: int
    read_at: float


class GeometryCache:
    """Bounded in bytes, least recently used first; safe to share between threads.

    Entries are known by the hash of their content, so that none is ever out of date.

    Parameters
    ----------
    blobs : what artifacts are read from
    most_bytes : of all entries together; 0 keeps none
    """

    def __init__(self, blobs: Blobs, most_bytes: int) -> None:
        self._blobs, self._most_bytes = blobs, most_bytes
        self._lock = threading.Lock()
        self._entries: OrderedDict[str, _Entry] = OrderedDict()
        self._bytes = 0

    def read(self, digest: str) -> Geometry:
        """The artifact of a digest, which callers must not change.

        Raises
        ------
        DamagedBlob : it is missing, or not what it was.
        UnreadableGeometry : it is no artifact of this version.
        """
        with self._lock:
            entry = self._entries.get(digest)
            if entry is not None:
                self._entries.move_to_end(digest)
                return entry.geometry
        geometry = read_geometry(self._blobs.get(digest))
        entry = _Entry(geometry, int(_OVERHEAD * _array_bytes(geometry)), time.monotonic())
        with self._lock:
            self._remove(digest)  # another thread has read it meanwhile
            self._entries[digest] = entry
            self._bytes += entry.size
            while self._bytes > self._most_bytes:
                self._remove(next(iter(self._entries)))
        return geometry

    def forget(self, digests: Iterable[str]) -> None:
        """Drop entries whose frames were deleted."""
        with self._lock:
            for digest in digests:
                self._remove(digest)

    def forget_older(self, seconds: float) -> None:
        """Drop what was read longer ago: another process may have deleted its frame since."""
        until = time.monotonic() - seconds
        with self._lock:
            for digest in [d for d, entry in self._entries.items() if entry.read_at <= until]:
                self._remove(digest)

    @property
    def bytes_held(self) -> int:
        """Memory of all entries, estimated."""
        return self._bytes

    def _remove(self, digest: str) -> None:
        entry = self._entries.pop(digest, None)
        if entry is not None:
            self._bytes -= entry.size


def _array_bytes(geometry: Geometry) -> int:
    values = [*vars(geometry.surface).values(), *vars(geometry.patches).values()]
    arrays = [value for value in values if isinstance(value, np.ndarray)]
    return sum(array.nbytes for array in arrays) + geometry.descriptors.nbytes


# Database and blobs.


@dataclass(frozen=True, eq=False)
class Store:
    """Database and blobs, opened.

    Parameters
    ----------
    decoders : that bytes of uploads are decoded by
    """

    database: Database
    blobs: Blobs
    geometry_bytes: int = 0
    decoders: Decoders = field(default_factory=lambda: LocalDecoders(1))

    @property
    def read_only(self) -> bool:
        """Whether nothing can be stored: it was opened so, or its disk was remounted since."""
        return self.database.read_only or self.database.turned_read_only or self.blobs.read_only

    @cached_property
    def geometries(self) -> GeometryCache:
        """Geometry artifacts, those that were read lately from memory."""
        return GeometryCache(self.blobs, self.geometry_bytes)

    @cached_property
    def seals(self) -> OpaqueIds:
        """What numbers of its rows look like from outside."""
        return OpaqueIds(self.database)

    def close(self) -> None:
        """Give back all connections, and end the decoders."""
        self.decoders.close()
        self.blobs.close()
        self.database.close()


def open_store(
    url: str, blobs: Path | str, geometry_bytes: int = 0, decoders: Decoders | None = None
) -> Store:
    """Open both, made where both are missing.

    The folder of a database that is there is never made: its disk is not mounted, and what was
    written in its place would be gone when it is.

    Parameters
    ----------
    blobs : folder, or URL of an object store
    decoders : see Store; default: one upload at a time in this process

    Raises
    ------
    UnusableStore, NewerSchema : see `open_database` and `open_blobs`.
    """
    return replace(
        _open_store(url, blobs), geometry_bytes=geometry_bytes,
        decoders=decoders or LocalDecoders(1),
    )  # fmt: skip


def _open_store(url: str, blobs: Path | str) -> Store:
    new = not is_read_only(url) and not is_there(url)
    if isinstance(blobs, Path):
        FolderBlobs(blobs, make=new)
        if new:  # its folder need not be that of the blobs: `file:///folder`
            _make_folder_of(url)
    elif new:
        _make_folder_of(url)
    database = open_database(url)
    try:
        found = open_blobs(blobs, database)
        return Store(database, found)
    except BaseException:
        database.close()
        raise


def open_blobs(
    blobs: Path | str, database: Database, *, make: bool = False, claim: bool = True
) -> Blobs:
    """Open the blobs that a database refers to.

    An object store that is away is no error yet: what is asked of it is refused while it is.

    Parameters
    ----------
    blobs : folder, or URL of an object store
    database : whose they are
    make : a folder that is missing
    claim : mark a prefix of an object store, or the folder of a fleet, that is nobody's yet; else
        it is looked at alone

    Raises
    ------
    UnusableStore : they cannot be opened, or are another database's.
    """
    anew = claim and not database.read_only
    if isinstance(blobs, Path):
        folder = FolderBlobs(blobs, make=make)
        # a folder beside a file of SQLite is that file's; hosts may name any to a server
        if not database.is_sqlite and blobs.is_dir():
            anew &= os.access(blobs, os.W_OK)  # who reads alone may have it mounted so
            BucketOwner.of_folder(blobs).claim(OpaqueIds(database).owner, anew=anew)
        return folder
    objects = open_objects(blobs)
    locks: Locks
    if database.file is not None:
        locks = FileLocks(database.file.with_name(f"{database.file.name}-blobs"), make=True)
    elif database.is_sqlite:
        raise UnusableStore("Blobs in an object store need a database that is kept: name a file.")
    else:
        locks = SessionLocks(database)
    found = ObjectBlobs(objects, locks, lambda: OpaqueIds(database).owner)
    try:
        found.claim(anew=anew)
    except StoreAway as error:
        log.warning("object store unreachable", extra={"error": str(error)})
    return found


def _make_folder_of(url: str) -> None:
    """The folder of a new SQLite file; opening it says what is wrong with any other URL."""
    with suppress(ArgumentError, ValueError):
        parsed = make_url(url)
        if parsed.get_backend_name() == "sqlite" and parsed.database:
            folder = Path(parsed.database).absolute().parent
            try:
                make_folder(folder)
            except OSError as error:
                raise unusable(f"{folder}: the folder cannot be made", error) from error
