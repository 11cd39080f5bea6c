"""The truth: one database with maps, frames, signatures and jobs, and blobs.

Everything else on disk is a cache of this. Functions take the connection of a transaction, so
that what belongs together is committed together; `Store` opens both parts, a read replica of the
database, and the geometry artifacts that were read lately.

    Replica.near  -->  UsableReplica  --read_through-->  reads go to the replica, or the primary

How far behind a replica is, is measured by positions of the log: what the primary had written at a
time is in every answer of a replica that has replayed as much. So one that nothing is written to is
not behind, clocks of hosts do not matter, and a replica that lost its primary grows old at once.

A query compares itself with ten to twenty frames of the map, and a robot's next query with mostly
the same ones. What depends on a frame alone is kept along with its artifact.
"""

from __future__ import annotations

import logging
import math
import os
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
from sqlalchemy import make_url, text
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from sceneprint.atomic_files import make_folder
from sceneprint.decoders import Decoders, LocalDecoders
from sceneprint.errors import FrameError, SceneprintError, StoreAway, StoreError, UnusableStore
from sceneprint.formats.artifact import read_geometry
from sceneprint.store.blobs.folder import Blobs, FileLocks, FolderBlobs, Locks
from sceneprint.store.blobs.object_client import open_objects
from sceneprint.store.blobs.object_store import BucketOwner, ObjectBlobs
from sceneprint.store.database import (
    Database,
    is_there,
    known_revisions,
    open_database,
    reach_database,
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


# A read replica.

T = TypeVar("T")

#: Seconds between two measurements, and after one that failed.
EVERY_S, AGAIN_S = 1.0, 3.0
#: Measurements of the primary that are kept: farther behind it is not known by how much.
KEPT = 120
_WRITTEN = text(
    "SELECT pg_current_wal_flush_lsn()::text, (pg_control_system()).system_identifier::text"
)
_REPLAYED = text(
    "SELECT pg_is_in_recovery(), pg_last_wal_replay_lsn()::text, "
    "(pg_control_system()).system_identifier::text, (SELECT version_num FROM alembic_version)"
)


class Behind(StoreError):
    """The replica does not know yet what is held of the primary."""


def behind_s() -> float | None:
    """How far what the query in hand is answered from may be behind; None: it is the primary."""
    near = _near.get()
    return None if near is None else round(near.behind_s, 3)


@dataclass(frozen=True)
class UsableReplica:
    """A replica that may be asked now.

    Parameters
    ----------
    database : the replica
    behind_s : all that was committed as long ago is in it
    """

    database: Database
    behind_s: float


@dataclass(frozen=True)
class ReplicaState:
    """How a replica does.

    Parameters
    ----------
    used : whether queries are answered from it
    behind_s : see Near; None where that is not known
    reason : why it is not used
    """

    used: bool
    behind_s: float | None
    reason: str | None


#: What the query in hand is answered from; None: the primary.
_near: ContextVar[UsableReplica | None] = ContextVar("near", default=None)


class Replica:
    """A replica of a primary, measured by a thread of its own from its first use on.

    Parameters
    ----------
    primary : see Database
    url : of the replica
    lag_s : seconds that it may be behind

    Raises
    ------
    UnusableStore : the URL is none of PostgreSQL.
    """

    def __init__(self, primary: Database, url: str, lag_s: float) -> None:
        self._primary, self._lag_s = primary, lag_s
        self._database = reach_database(url)
        if self._database.is_sqlite or primary.is_sqlite:
            raise UnusableStore(
                "SCENEPRINT_REPLICA_URL is no URL of PostgreSQL, which alone has replicas. Leave "
                "it out, or set it and SCENEPRINT_DATABASE_URL to postgresql+psycopg://..."
            )
        self._every_s = min(EVERY_S, max(lag_s / 4, 0.05))
        self._written: deque[tuple[float, int]] = deque(maxlen=KEPT)
        self._caught_up_at = -math.inf  # what was committed until then is in it
        self._reason: str | None = "it was not asked yet"
        self._identifier: str | None = None  # of the primary and all that follow it
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._thread: threading.Thread | None = None

    def near(self) -> UsableReplica | None:
        """The replica, if it may be asked; costs nothing."""
        self._begin()
        behind_s = time.monotonic() - self._caught_up_at
        if self._reason is not None or behind_s > self._lag_s:
            return None
        return UsableReplica(self._database, behind_s)

    def standing(self) -> ReplicaState:
        """How it does."""
        self._begin()
        behind_s = time.monotonic() - self._caught_up_at
        reason = self._reason
        if reason is None and behind_s > self._lag_s:
            reason = f"it is farther behind than {self._lag_s:g} s"
        known = None if math.isinf(behind_s) else behind_s
        return ReplicaState(reason is None, known, reason)

    def fell(self, error: SceneprintError) -> None:
        """It did not answer a query: it is not asked until it is measured anew."""
        self._reason = str(error)

    def close(self) -> None:
        """Give its connections back."""
        self._stop.set()
        with self._lock:
            thread, self._thread = self._thread, None
        if thread is not None:
            thread.join()
        self._database.close()

    def measure(self) -> None:
        """See how far behind it is.

        Raises
        ------
        StoreError : it does not answer, or is no replica that can be used.
        """
        self._ask_primary()
        with self._database.read() as connection:
            found = connection.execute(_REPLAYED).one()
        recovers, replayed, own, schema = found
        if not recovers or replayed is None:
            raise UnusableStore(f"{self._database.shown}: it is no replica that follows another.")
        if own != self._identifier:
            raise UnusableStore(f"{self._database.shown}: it is a replica of another database.")
        if schema != known_revisions()[0]:
            raise UnusableStore(f"{self._database.shown}: it has schema {schema}, not yet ours.")
        has = _number(replayed)
        self._caught_up_at = max(
            (at for at, written in self._written if written <= has), default=-math.inf
        )
        self._reason = None

    def _ask_primary(self) -> None:
        at = time.monotonic()  # before: what it answers may be newer, and never older
        try:
            with self._primary.read() as connection:
                position, self._identifier = connection.execute(_WRITTEN).one()
        except SceneprintError as error:  # until it is too old, the replica is as good as it was
            log.debug("the primary is not measured", extra={"error": str(error)})
            return
        self._written.append((at, _number(position)))

    def _begin(self) -> None:
        if self._thread is not None or self._stop.is_set():
            return
        with self._lock:
            if self._thread is None and not self._stop.is_set():
                self._thread = threading.Thread(target=self._watch, name="replica", daemon=True)
                self._thread.start()

    def _watch(self) -> None:
        pause_s = 0.0
        while not self._stop.wait(pause_s):
            before, pause_s = self._reason, self._every_s
            try:
                self.measure()
            except (SceneprintError, SQLAlchemyError) as error:
                self._reason, pause_s = str(error), AGAIN_S
            if (before is None) != (self._reason is None):
                about = {"replica": self._database.shown, "reason": self._reason}
                log.warning("replica %s", "is not used" if self._reason else "is used", extra=about)


def current() -> UsableReplica | None:
    """What the query in hand is answered from; None: the primary."""
    return _near.get()


def require_primary(what: str) -> None:
    """See that the query in hand is answered from the primary.

    Parameters
    ----------
    what : is newer than the replica

    Raises
    ------
    Behind : it is not; it is asked again there.
    """
    if _near.get() is not None:
        raise Behind(f"The replica does not have {what} yet.")


def read_through(replica: Replica | None, ask: Callable[[], T]) -> T:
    """Answer a query from the replica, and from the primary what the replica does not know yet,
    or cannot answer.

    Parameters
    ----------
    replica : if there is one
    ask : reads `Store.queried`; may be called twice
    """
    near = None if replica is None or _near.get() is not None else replica.near()
    if near is None or replica is None:
        return ask()
    token = _near.set(near)
    try:
        return ask()
    except FrameError:  # it is wrong wherever it is compared
        raise
    except SceneprintError as error:
        if isinstance(error, StoreAway):
            replica.fell(error)
        log.debug("asked of the primary", extra={"error": str(error)})
    finally:
        _near.reset(token)
    return ask()


def _number(position: str) -> int:
    """A position of the log as a number of bytes."""
    high, _, low = position.partition("/")
    return (int(high, 16) << 32) + int(low, 16)


# Database and blobs.


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
