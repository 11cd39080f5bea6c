"""Backups of a running store as bundles.

    database and blobs  --take_backup-->  bundle in a place

A backup reads all rows in one transaction, and then copies the blobs that they refer to. Blobs
never change, and none is removed during a backup, so the bundle is consistent. Parts that exist
in the place are not written again.
"""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from itertools import islice
from typing import IO, Any, Literal, NamedTuple, TypeVar

from sqlalchemy import Connection

from sceneprint.bundle.place import BundleManifest, BundlePlace, Part
from sceneprint.bundle.rows import (
    Row,
    cut_rows,
    fetch_rows,
    last_numbers,
    read_rows,
    read_table,
    table_part,
    tables,
    write_part,
)
from sceneprint.errors import BundleError, DamagedBlob, UnusableStore
from sceneprint.settings import Settings
from sceneprint.store import Blobs, Database
from sceneprint.store.blobs.folder import is_digest
from sceneprint.store.database import database_exists, known_revisions, reach_database
from sceneprint.store.opaque_ids import OpaqueIds
from sceneprint.store.postgres.connection import allow
from sceneprint.store.read_only import inspect_blobs, require_present_schema
from sceneprint_client.api import FrameState

#: Number of threads that write parts and blobs; they mostly wait for the disk or the network.
THREADS = 8
#: Number of blobs per task of a thread; most of them are already in the place.
_BATCH = 256
#: Size, in bytes, above which blobs are streamed instead of read into memory.
LARGE = 8 << 20
#: Callback that receives the number of finished rows and blobs, and their total number.
Progress = Callable[[int, int], None]
#: Columns of a list of blobs; see ListedBlob.
BLOB_COLUMNS = ("digest", "bytes", "lost")

#: SQL query for the digests of all blobs that must exist.
_REFERRED = (
    "SELECT blob AS digest FROM frames WHERE deletion IS NOT NULL OR state NOT IN"
    f" ('{FrameState.DELETED}', '{FrameState.REDUNDANT}')"
    " UNION ALL SELECT geometry FROM signatures"
    " UNION ALL SELECT blob FROM job_files"
    " UNION ALL SELECT blob FROM surface_tiles WHERE blob IS NOT NULL"
    " UNION ALL SELECT draft FROM surface_tiles WHERE draft IS NOT NULL"
)

A = TypeVar("A")
B = TypeVar("B")


class ListedBlob(NamedTuple):
    """An entry in a bundle's list of blobs: `why` is the reason for its loss, if any."""

    digest: str
    bytes: int
    why: Literal["missing", "damaged"] | None = None


@dataclass(frozen=True)
class Bundle:
    """The result of writing, verifying or restoring a bundle.

    Parameters
    ----------
    manifest : manifest of the bundle
    lost : blobs that were missing or damaged in the store, and are not in the bundle
    written : number of bytes that the backup added to the place
    """

    manifest: BundleManifest
    lost: tuple[ListedBlob, ...]
    written: int = 0


def take_backup(
    settings: Settings, place: str, progress: Progress | None = None, *, keep: int | None = None
) -> Bundle:
    """Write a bundle of a store; the service and workers may run in the meantime.

    The bundle contains all changes that were acknowledged before the call, and possibly later
    changes. Missing or damaged blobs are reported; all other blobs are backed up.

    Parameters
    ----------
    settings : settings with the addresses of the database and the blobs
    place : folder, or URL of an object store; a missing folder is created
    progress : see Progress
    keep : number of newest bundles to retain, including this one; older bundles and parts that only
        they need are removed. None retains all bundles

    Raises
    ------
    BundleError : If the place belongs to another store, or another process is writing there.
    UnusableStore, NewerSchema : If the database or the place cannot be used, or is damaged.
    """
    with (
        _open(settings.database) as database,
        inspect_blobs(settings.blobs, database) as blobs,
    ):
        target = BundlePlace.open(place, create=True)
        target.claim(OpaqueIds(database).owner)
        with target.turn(), blobs.locks.block_removals():  # referenced blobs must not be removed
            backup = _Backup(target, progress or (lambda _done, _total: None))
            bundle = backup.write(database, blobs)
            if keep is not None:
                needed_parts = set[str]()
                for name in target.names()[:keep]:
                    needed_parts |= set(part_digests(target, target.read(name)))
                target.prune(needed_parts, keep)
    return bundle


@contextmanager
def _open(url: str) -> Iterator[Database]:
    """Open a database that may be in use, without changing it; check its schema."""
    database = reach_database(url)
    with closing(database):
        if database.is_sqlite and database.file is None:
            raise BundleError("An in-memory database cannot be backed up. Use a database file.")
        if not database_exists(url):
            shown = database.file or database.shown
            raise UnusableStore(f"{shown}: the database does not exist. Pass --data FOLDER.")
        require_present_schema(database)
        yield database


class _Backup:
    def __init__(self, place: BundlePlace, progress: Progress) -> None:
        self._place, self._progress = place, progress
        self._done = self._total = self._written = self._blob_bytes = 0
        self._lost = list[ListedBlob]()
        self._reusable = _reusable_parts(place)

    def write(self, database: Database, blobs: Blobs) -> Bundle:
        """Write all rows and blobs, and then the manifest; return the bundle."""
        started_at, parts = datetime.now(UTC), list[Part]()
        with tempfile.TemporaryFile() as digests:
            with database.read() as connection:
                allow(connection, 0)  # no timeout: copying may take hours
                check_sound(connection, database.shown)
                self._total = sum(_count_rows(connection, table.name) for table in tables())
                for digest in referred(connection):
                    digests.write(f"{digest}\n".encode())
                    self._total += 1
                for table in tables():
                    keys = [i for i, column in enumerate(table.columns) if column.primary_key]
                    rows = cut_rows(read_table(connection, table), keys)
                    parts += self._parts(f"rows/{table.name}", rows, partial(table_part, table))
                summary = summary_of(connection)
            digests.seek(0)
            rows = cut_rows(map(tuple, self._blobs(blobs, digests)), [0])
            lists = [*self._parts("blobs", rows, partial(write_part, BLOB_COLUMNS))]
        manifest = BundleManifest(
            created_at=started_at, sceneprint=version("sceneprint"),
            schema_revision=known_revisions()[0],
            blobs=sum(part.rows for part in lists) - len(self._lost), blob_bytes=self._blob_bytes,
            lost=len(self._lost), parts=(*parts, *lists), **summary,
        )  # fmt: skip
        self._place.publish(manifest)
        return Bundle(manifest, tuple(self._lost), self._written)

    def _parts(
        self, kind: str, groups: Iterable[tuple[list[Row], str]],
        write: Callable[[list[Row]], bytes],
    ) -> Iterator[Part]:  # fmt: skip
        """Yield the parts of all groups of rows; write those that the previous bundle lacks."""

        def put(group: tuple[list[Row], str]) -> tuple[Part, int]:
            rows, source = group
            part = self._reusable.get((kind, source))
            if part is not None and self._place.size(part.digest) == part.bytes:
                return part, 0
            data = write(rows)
            digest, new = self._place.put(data)
            size = len(data)
            part = Part(kind=kind, digest=digest, bytes=size, rows=len(rows), source=source)
            return part, size if new else 0

        for part, new in in_order(put, groups):
            self._written += new
            if kind != "blobs":
                self._advance(part.rows)
            yield part

    def _blobs(self, blobs: Blobs, digests: IO[bytes]) -> Iterator[ListedBlob]:
        """Copy the blobs of a file of digests, and yield their entries in the list of blobs."""
        names = (line.decode().rstrip("\n") for line in digests)
        batches = iter(lambda: list(islice(names, _BATCH)), [])

        def copy(batch: list[str]) -> list[tuple[ListedBlob, int]]:
            return [self._copy(blobs, digest) for digest in batch]

        for entries in in_order(copy, batches):
            for listed, new in entries:
                if listed.why is not None:
                    self._lost.append(listed)
                self._blob_bytes += listed.bytes
                self._written += new
                yield listed
            self._advance(len(entries))

    def _copy(self, blobs: Blobs, digest: str) -> tuple[ListedBlob, int]:
        """Copy a blob unless it is in the place; return its list entry and the written bytes."""
        if not is_digest(digest):  # the database was edited by hand
            return ListedBlob(digest, 0, "missing"), 0
        stored_size = self._place.size(digest)
        if stored_size is not None:
            return ListedBlob(digest, stored_size), 0
        size = blobs.size(digest)
        if size is not None and size > LARGE:
            condition = blobs.condition(digest)
            if condition != "sound":
                return ListedBlob(digest, 0, condition), 0
            with closing(blobs.open(digest)) as file:
                self._place.put_file(digest, file)
            return ListedBlob(digest, size), size
        try:
            data = blobs.get(digest)
        except DamagedBlob:
            return ListedBlob(digest, 0, "damaged" if blobs.holds(digest) else "missing"), 0
        self._place.put(data)
        return ListedBlob(digest, len(data)), len(data)

    def _advance(self, rows: int) -> None:
        self._done += rows
        self._progress(self._done, max(self._total, self._done))


def _reusable_parts(place: BundlePlace) -> dict[tuple[str, str], Part]:
    """Return the reusable parts of the newest bundle by kind and source.

    Parts of another version of sceneprint are not reusable: it may encode rows differently.
    """
    with suppress(BundleError):  # there is no bundle, or the newest is damaged
        manifest, own = place.read(), (version("sceneprint"), known_revisions()[0])
        if (manifest.sceneprint, manifest.schema_revision) == own:
            return {(part.kind, part.source): part for part in manifest.parts}
    return {}


def in_order(work: Callable[[A], B], items: Iterable[A]) -> Iterator[B]:
    """Apply `work` to items in a pool of threads; yield the results in the order of the items.

    Closing the iterator early does not wait for the threads: the garbage collector may close it in
    a thread that is starting and could not join another thread without a deadlock.
    """
    pool, wait = ThreadPoolExecutor(THREADS, thread_name_prefix="bundle"), True
    waiting: deque[Future[B]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) >= 2 * THREADS:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    except GeneratorExit:
        wait = False
        raise
    finally:
        pool.shutdown(wait, cancel_futures=True)


def referred(connection: Connection) -> Iterator[str]:
    """Yield the distinct digests of all blobs that must exist, in ascending order."""
    # the cast covers databases that were edited by hand and may contain values of other types
    order = ' COLLATE "C"' if connection.dialect.name == "postgresql" else ""
    text = f"CAST(digest AS TEXT){order}"
    statement = f"SELECT DISTINCT {text} AS d FROM ({_REFERRED}) AS found ORDER BY d"
    yield from (digest for (digest,) in fetch_rows(connection, statement))


def listed_blobs(place: BundlePlace, manifest: BundleManifest) -> Iterator[ListedBlob]:
    """Yield the entries of a bundle's lists of blobs.

    Raise DamagedBundle if an entry is invalid.
    """
    lists = (part for part in manifest.parts if part.kind == "blobs")
    for data in in_order(lambda part: place.get(part.digest), lists):
        for digest, size, why in read_rows(data, BLOB_COLUMNS):
            if not is_digest(digest) or not isinstance(size, int) or why not in (
                None, "missing", "damaged",
            ):  # fmt: skip
                raise place.damaged(str(digest)[:64], "has an invalid entry in the list of blobs")
            yield ListedBlob(digest, size, why)


def part_digests(place: BundlePlace, manifest: BundleManifest) -> Iterator[str]:
    """Yield the digests of all parts of a bundle, including its blobs."""
    yield from (part.digest for part in manifest.parts)
    yield from (digest for digest, _, why in listed_blobs(place, manifest) if why is None)


def summary_of(connection: Connection) -> dict[str, Any]:
    """Return the counts of rows and the last row numbers for a manifest."""
    states = connection.exec_driver_sql(
        "SELECT state, count(*) FROM frames GROUP BY state ORDER BY state"
    )
    return {
        "maps": _count_rows(connection, "maps"),
        "frames": dict(tuple(row) for row in states),
        "signatures": _count_rows(connection, "signatures"),
        "numbers": last_numbers(connection),
    }


def check_sound(connection: Connection, shown: str) -> None:
    """Check the integrity of a SQLite database: inconsistent rows could not be restored.

    Raises
    ------
    UnusableStore : If the database is damaged.
    """
    if connection.dialect.name != "sqlite":
        return  # PostgreSQL enforces its constraints
    defect = str(connection.exec_driver_sql("PRAGMA quick_check(1)").scalar_one())
    orphan = connection.exec_driver_sql("PRAGMA foreign_key_check").first()
    if orphan is not None:
        defect = f"a row of {orphan[0]} refers to a missing row of {orphan[2]}"
    if defect != "ok":
        raise UnusableStore(
            f"{shown}: the database is damaged ({' '.join(defect.split())}), and a backup of it "
            "could not be restored. Run `sceneprint fsck`, or restore an earlier bundle."
        )


def _count_rows(connection: Connection, name: str) -> int:
    return int(connection.exec_driver_sql(f"SELECT count(*) FROM {name}").scalar_one())
