"""Backups: a bundle of everything that a store must not lose, taken while the service runs.

    database and blobs  --take_backup-->  bundle in a place

All rows are read in one transaction, and then the blobs that they refer to are copied. Blobs never
change, and none is removed while this runs, so the bundle holds one state, and all of it. Parts
that are in the place already are not written again.
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
from typing import IO, Any, Literal, TypeVar

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

#: Parts and blobs that are written at once: each waits for its disk, or for the network.
THREADS = 8
#: Blobs that one thread copies after the other: most are there already.
_TOGETHER = 256
#: Bytes above which a blob is copied in parts, and not held in memory.
LARGE = 8 << 20
#: Rows and blobs that are done, and all of them.
Progress = Callable[[int, int], None]
#: Columns of a list of blobs: the digest, its bytes, and why it is not in the bundle.
BLOB_COLUMNS = ("digest", "bytes", "lost")

#: The digests of all blobs that have to be there.
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


#: Why a blob is not in a bundle.
Loss = Literal["missing", "damaged"]
#: Digest and bytes of a blob in the list of a bundle, and why it is not in it.
ListedBlob = tuple[str, int, Loss | None]


@dataclass(frozen=True)
class LostBlob:
    """A blob that a backup does not hold, as it was missing or damaged in the store."""

    digest: str
    why: Loss


@dataclass(frozen=True)
class Bundle:
    """A bundle that was written, verified or restored.

    Parameters
    ----------
    manifest : its content
    lost : blobs that it does not hold
    written : bytes that were written for it; the rest was there
    """

    manifest: BundleManifest
    lost: tuple[LostBlob, ...]
    written: int = 0


def take_backup(
    settings: Settings, place: str, progress: Progress | None = None, *, keep: int | None = None
) -> Bundle:
    """Write a bundle of all that must not be lost; service and workers may go on.

    It holds what was acknowledged before this was called, and perhaps some that came later. A blob
    that is missing or damaged is left out and named: what else there is can still be saved.

    Parameters
    ----------
    settings : whose database and blobs are saved
    place : folder or URL of an object store; a folder is made if it is missing
    progress : called with the rows and blobs that are done, and all of them
    keep : number of bundles that stay there, this one among them; default: all

    Raises
    ------
    BundleError : the place is another store's, or another process writes there.
    UnusableStore, NewerSchema : the database or the place cannot be used, or is damaged.
    """
    with _opened(settings.database) as database, inspect_blobs(settings.blobs, database) as blobs:
        there = BundlePlace.open(place, create=True)
        there.claim(OpaqueIds(database).owner)
        with there.turn(), blobs.kept():  # before rows are read: what they refer to must not go
            backup = _Backup(there, progress or (lambda _done, _total: None))
            bundle = backup.write(database, blobs)
            if keep is not None:
                needed = set[str]()
                for name in there.names()[:keep]:
                    needed |= set(part_digests(there, there.read(name)))
                there.prune(needed, keep)
    return bundle


@contextmanager
def _opened(url: str) -> Iterator[Database]:
    """Open a database that may be in use; nothing is written to it.

    Raises
    ------
    UnusableStore, NewerSchema : it is missing, cannot be read, or is of another schema.
    """
    database = reach_database(url)
    with closing(database):
        if database.is_sqlite and database.file is None:
            raise BundleError("A database in memory has no backup. Name one in a file.")
        if not database_exists(url):
            shown = database.file or database.shown
            raise UnusableStore(f"{shown}: there is no database. Name its folder with --data.")
        require_present_schema(database)
        yield database


class _Backup:
    """Writes one bundle."""

    def __init__(self, place: BundlePlace, progress: Progress) -> None:
        self._place, self._progress = place, progress
        self._done = self._total = self._written = self._blob_bytes = 0
        self._lost = list[LostBlob]()
        self._known = _known_parts(place)

    def write(self, database: Database, blobs: Blobs) -> Bundle:
        begun, parts = datetime.now(UTC), list[Part]()
        with tempfile.TemporaryFile() as digests:
            with database.read() as connection:
                allow(connection, 0)  # what is on the way may be large, and the place slow
                check_sound(connection, database.shown)
                self._total = sum(_rows_of(connection, one.name) for one in tables())
                for digest in referred(connection):
                    digests.write(f"{digest}\n".encode())
                    self._total += 1
                for table in tables():
                    keys = [i for i, one in enumerate(table.columns) if one.primary_key]
                    rows = cut_rows(read_table(connection, table), keys)
                    parts += self._parts(f"rows/{table.name}", rows, partial(table_part, table))
                summary = summary_of(connection)
            digests.seek(0)
            rows = cut_rows(self._blobs(blobs, digests), [0])
            lists = [*self._parts("blobs", rows, partial(write_part, BLOB_COLUMNS))]
        manifest = BundleManifest(
            created_at=begun, sceneprint=version("sceneprint"),
            schema_revision=known_revisions()[0],
            blobs=sum(one.rows for one in lists) - len(self._lost), blob_bytes=self._blob_bytes,
            lost=len(self._lost), parts=(*parts, *lists), **summary,
        )  # fmt: skip
        self._place.publish(manifest)
        return Bundle(manifest, tuple(self._lost), self._written)

    def _parts(
        self, kind: str, found: Iterable[tuple[list[Row], str]],
        write: Callable[[list[Row]], bytes],
    ) -> Iterator[Part]:  # fmt: skip
        """Write the parts that are not of the same rows as one of the bundle before."""

        def changed() -> Iterator[Part | tuple[bytes, int, str]]:
            for rows, source in found:
                known = self._known.get((kind, source))
                if known is not None and self._place.size(known.digest) == known.bytes:
                    yield known
                else:
                    yield write(rows), len(rows), source

        def put(one: Part | tuple[bytes, int, str]) -> tuple[Part, bool]:
            if isinstance(one, Part):
                return one, False
            data, rows, source = one
            digest, new = self._place.put(data)
            size = len(data)
            return Part(kind=kind, digest=digest, bytes=size, rows=rows, source=source), new

        for part, new in in_order(put, changed()):
            self._written += part.bytes if new else 0
            if kind != "blobs":
                self._go_on(part.rows)
            yield part

    def _blobs(self, blobs: Blobs, digests: IO[bytes]) -> Iterator[ListedBlob]:
        """Copy blobs, and yield the list of them."""
        names = (line.decode().rstrip("\n") for line in digests)
        some = iter(lambda: list(islice(names, _TOGETHER)), [])
        for found in in_order(lambda block: [self._copy(blobs, one) for one in block], some):
            for listed, new in found:
                digest, size, why = listed
                if why is not None:
                    self._lost.append(LostBlob(digest, why))
                self._blob_bytes += size
                self._written += new
                yield listed
            self._go_on(len(found))

    def _copy(self, blobs: Blobs, digest: str) -> tuple[ListedBlob, int]:
        """Copy a blob unless it is there; return how it is listed, and the bytes written."""
        if not is_digest(digest):  # of a database that somebody has edited
            return (digest, 0, "missing"), 0
        there = self._place.size(digest)
        if there is not None:
            return (digest, there, None), 0
        size = blobs.size(digest)
        if size is not None and size > LARGE:
            condition = blobs.condition(digest)
            if condition != "sound":
                return (digest, 0, condition), 0
            with closing(blobs.open(digest)) as file:
                self._place.put_file(digest, file)
            return (digest, size, None), size
        try:
            data = blobs.get(digest)
        except DamagedBlob:
            return (digest, 0, "damaged" if blobs.holds(digest) else "missing"), 0
        self._place.put(data)
        return (digest, len(data), None), len(data)

    def _go_on(self, rows: int) -> None:
        self._done += rows
        self._progress(self._done, max(self._total, self._done))


def _known_parts(place: BundlePlace) -> dict[tuple[str, str], Part]:
    """Return the parts of the newest bundle by kind and source.

    Another version may have written the same rows in another way: its parts are none of them.
    """
    with suppress(BundleError):  # there is none, or it is damaged
        manifest, own = place.read(), (version("sceneprint"), known_revisions()[0])
        if (manifest.sceneprint, manifest.schema_revision) == own:
            return {(one.kind, one.source): one for one in manifest.parts}
    return {}


def in_order(work: Callable[[A], B], items: Iterable[A]) -> Iterator[B]:
    """Yield what `work` returns for each item, in order; some items are worked at at once.

    An iterator that is not exhausted ends without waiting for its threads: the garbage collector
    may close it in a thread that is just starting, which could then never join another.
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
    """Yield the digests of all blobs that have to be there, each once, in order."""
    # as text, whatever a database that somebody has edited holds
    order = ' COLLATE "C"' if connection.dialect.name == "postgresql" else ""
    text = f"CAST(digest AS TEXT){order}"
    statement = f"SELECT DISTINCT {text} AS d FROM ({_REFERRED}) AS found ORDER BY d"
    yield from (digest for (digest,) in fetch_rows(connection, statement))


def listed_blobs(place: BundlePlace, manifest: BundleManifest) -> Iterator[ListedBlob]:
    """Yield digest, bytes and, where it is not in the bundle, why, of each blob of a bundle."""
    lists = (one for one in manifest.parts if one.kind == "blobs")
    for data in in_order(lambda one: place.get(one.digest), lists):
        for digest, size, why in read_rows(data, BLOB_COLUMNS):
            if not is_digest(digest) or not isinstance(size, int) or why not in (
                None, "missing", "damaged",
            ):  # fmt: skip
                raise place.damaged(str(digest)[:64], "is listed as no blob can be")
            yield digest, size, why


def part_digests(place: BundlePlace, manifest: BundleManifest) -> Iterator[str]:
    """Yield the digests of all parts of a bundle, its blobs among them."""
    yield from (one.digest for one in manifest.parts)
    yield from (digest for digest, _, why in listed_blobs(place, manifest) if why is None)


def summary_of(connection: Connection) -> dict[str, Any]:
    """Return how many maps, signatures and frames in each state there are, and the numbers."""
    states = connection.exec_driver_sql(
        "SELECT state, count(*) FROM frames GROUP BY state ORDER BY state"
    )
    return {
        "maps": _rows_of(connection, "maps"),
        "frames": dict(tuple(one) for one in states),
        "signatures": _rows_of(connection, "signatures"),
        "numbers": last_numbers(connection),
    }


def check_sound(connection: Connection, shown: str) -> None:
    """See that what SQLite reads is whole: rows that contradict each other cannot be restored.

    Raises
    ------
    UnusableStore : it is not.
    """
    if connection.dialect.name != "sqlite":
        return  # PostgreSQL enforces its constraints
    wrong = str(connection.exec_driver_sql("PRAGMA quick_check(1)").scalar_one())
    lost = connection.exec_driver_sql("PRAGMA foreign_key_check").first()
    if lost is not None:
        wrong = f"a row of {lost[0]} refers to one of {lost[2]} that is missing"
    if wrong != "ok":
        raise UnusableStore(
            f"{shown}: the database is damaged ({' '.join(wrong.split())}), and a backup of it "
            "could not be restored. Run `sceneprint fsck`, or restore an earlier bundle."
        )


def _rows_of(connection: Connection, name: str) -> int:
    return int(connection.exec_driver_sql(f"SELECT count(*) FROM {name}").scalar_one())
