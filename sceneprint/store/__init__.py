"""The truth: one database with maps, frames, signatures and jobs, and blobs.

Everything else on disk is a cache of this. Functions take the connection of a transaction, so
that what belongs together is committed together; `Store` opens both parts.
"""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from sqlalchemy import make_url
from sqlalchemy.exc import ArgumentError

from sceneprint.atomic_files import make_folder
from sceneprint.decoders import Decoders, LocalDecoders
from sceneprint.errors import StoreAway, UnusableStore
from sceneprint.store.blobs.folder import Blobs, FileLocks, FolderBlobs, Locks
from sceneprint.store.blobs.object_client import open_objects
from sceneprint.store.blobs.object_store import ObjectBlobs
from sceneprint.store.database import Database, is_there, open_database
from sceneprint.store.database_errors import unusable
from sceneprint.store.geometry_cache import GeometryCache
from sceneprint.store.opaque_ids import OpaqueIds
from sceneprint.store.postgres.connection import SessionLocks
from sceneprint.store.postgres.replica import Replica, current
from sceneprint.store.sqlite import is_read_only

__all__ = [
    "Blobs", "Database", "FolderBlobs", "Store", "open_blobs", "open_database", "open_store",
]  # fmt: skip

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Store:
    """Database and blobs, opened.

    Parameters
    ----------
    database, blobs, replica : see there
    geometry_bytes : see GeometryCache
    decoders : that bytes of uploads are decoded by
    """

    database: Database
    blobs: Blobs
    replica: Replica | None = None
    geometry_bytes: int = 0
    decoders: Decoders = field(default_factory=lambda: LocalDecoders(1))

    @property
    def queried(self) -> Database:
        """What the query in hand is answered from: a replica, or `database`; see `asked`."""
        near = current()
        return self.database if near is None else near.database

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
        if self.replica is not None:
            self.replica.close()
        self.blobs.close()
        self.database.close()


def open_store(
    url: str, blobs: Path | str, replica_url: str | None = None, replica_lag_s: float = 0.0,
    geometry_bytes: int = 0, decoders: Decoders | None = None,
) -> Store:  # fmt: skip
    """Open both, made where both are missing.

    The folder of a database that is there is never made: its disk is not mounted, and what was
    written in its place would be gone when it is.

    Parameters
    ----------
    url : of the database
    blobs : folder, or URL of an object store
    replica_url, replica_lag_s : see Replica; it need not be there
    geometry_bytes : see GeometryCache
    decoders : see Store; default: one upload at a time in this process

    Raises
    ------
    UnusableStore, NewerSchema : see `open_database`, `open_blobs` and Replica.
    """
    opened = replace(
        _open_store(url, blobs), geometry_bytes=geometry_bytes,
        decoders=decoders or LocalDecoders(1),
    )  # fmt: skip
    if replica_url is None:
        return opened
    try:
        return replace(opened, replica=Replica(opened.database, replica_url, replica_lag_s))
    except BaseException:
        opened.close()
        raise


def _open_store(url: str, blobs: Path | str) -> Store:
    new = not is_read_only(url) and not is_there(url)
    if isinstance(blobs, Path):
        kept = FolderBlobs(blobs, make=new)
        if new:  # its folder need not be that of the blobs: `file:///folder`
            _make_folder_of(url)
        return Store(open_database(url), kept)
    if new:
        _make_folder_of(url)
    database = open_database(url)
    try:
        return Store(database, open_blobs(blobs, database))
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
    claim : mark a prefix of an object store that is nobody's yet; else it is looked at alone

    Raises
    ------
    UnusableStore : they cannot be opened, or are another database's.
    """
    if isinstance(blobs, Path):
        return FolderBlobs(blobs, make=make)
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
        found.claim(anew=claim and not database.read_only)
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
