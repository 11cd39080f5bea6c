"""Snapshots: one state of database and blobs in one archive, taken while the service runs.

data folder, or PostgreSQL and blobs  --take_snapshot-->  archive

The database is copied first, in one transaction; then the blobs that this copy refers to. Blobs
never change, and none is removed from before the first until after the second, so the archive
holds one state, and all of it.
"""

from __future__ import annotations

import hashlib
import os
import sqlite3
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Literal

from sceneprint.atomic_files import create_private
from sceneprint.errors import DamagedBlob, SnapshotError, UnusableStore
from sceneprint.maintenance.fsck.findings import opened_blobs
from sceneprint.maintenance.snapshot import database_copy
from sceneprint.maintenance.snapshot.files import (
    BLOBS,
    DAMAGED,
    DATABASE,
    MANIFEST,
    MANIFEST_BYTES,
    ArchiveMember,
    ArchiveWriter,
    BlobSection,
    Damaged,
    LostBlob,
    SnapshotManifest,
    check_room,
    chunks_of,
    full_disk_explained,
    manifest_bytes,
    put_new,
    staging,
)
from sceneprint.settings import Settings
from sceneprint.store import Blobs
from sceneprint.store.blobs.folder import is_digest

#: Blobs that are read at once, and bytes above which one is read alone and in parts.
_AT_ONCE, _LARGE = 8, 8 << 20
_CHUNK = 1 << 20
#: Blobs of which the size is asked; of more, the rest is taken to be like them.
_MEASURED = 10_000


@dataclass(frozen=True)
class CopiedBlob:
    """A blob, and its bytes in parts: to be read to their end before the next is taken."""

    digest: str
    size: int
    chunks: Iterator[bytes]


@dataclass(frozen=True)
class Untaken:
    """A blob that could not be taken along."""

    digest: str
    why: Literal["missing", "damaged"]


def copied_blobs(blobs: Blobs, digests: Iterable[str]) -> Iterator[CopiedBlob | Untaken]:
    """Blobs, each checked against its digest before anything of it is given.

    Raises
    ------
    SnapshotError : a large one was changed while it was read.
    UnusableStore : they cannot be read.
    """
    wanted = iter(digests)
    with ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="take") as pool:
        waiting: deque[Future[CopiedBlob | Untaken]] = deque()
        try:
            for digest in islice(wanted, 2 * _AT_ONCE):
                waiting.append(pool.submit(_take, blobs, digest))
            while waiting:
                yield waiting.popleft().result()
                for digest in islice(wanted, 1):
                    waiting.append(pool.submit(_take, blobs, digest))
        finally:
            for one in waiting:
                one.cancel()


def total_bytes(blobs: Blobs, digests: Iterable[str], count: int) -> int:
    """Bytes of all blobs, missing ones left out; about, where there are many.

    Parameters
    ----------
    blobs, digests : which
    count : of the digests
    """
    step = max(-(-count // _MEASURED), 1)
    with ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="measure") as pool:
        sizes = pool.map(blobs.size, filter(is_digest, islice(digests, 0, None, step)))
        return step * sum(size or 0 for size in sizes)


def _take(blobs: Blobs, digest: str) -> CopiedBlob | Untaken:
    if not is_digest(digest):  # of a database that somebody has edited
        return Untaken(digest, "missing")
    size = blobs.size(digest)
    if size is not None and size > _LARGE:
        condition = blobs.condition(digest)
        if condition == "sound":
            return CopiedBlob(digest, size, _parts(blobs, digest))
        return Untaken(digest, condition)
    try:
        data = blobs.get(digest)
    except DamagedBlob:
        return Untaken(digest, "damaged" if blobs.holds(digest) else "missing")
    return CopiedBlob(digest, len(data), iter([data]))


def _parts(blobs: Blobs, digest: str) -> Iterator[bytes]:
    hashed = hashlib.sha256()
    with closing(blobs.open(digest)) as file:
        while chunk := file.read(_CHUNK):
            hashed.update(chunk)
            yield chunk
    if hashed.hexdigest() != digest:
        raise SnapshotError(f"The blob {digest[:12]} was changed while it was read. Try again.")


#: Bytes done, and bytes in all.
Progress = Callable[[int, int], None]
_PREFIX = ".sceneprint-snapshot-"


@dataclass(frozen=True)
class Snapshot:
    """What is in an archive.

    Parameters
    ----------
    damaged : the blobs that are not in it
    """

    path: Path
    manifest: SnapshotManifest
    damaged: list[LostBlob]


def take_snapshot(settings: Settings, path: Path, progress: Progress | None = None) -> Snapshot:
    """Write all that must not be lost into one archive; service and workers may go on.

    It holds what was acknowledged before this was called, and perhaps some that came later. A blob
    that is missing or damaged is left out and named: what else there is can still be saved.

    Parameters
    ----------
    settings : whose database and blobs are taken
    path : of the archive; nothing is overwritten
    progress : told of bytes done and bytes in all

    Raises
    ------
    SnapshotError : the path is taken, or there is no room.
    UnusableStore, NewerSchema : the database is missing, damaged, or a later version's.
    OSError : the archive's folder is missing or cannot be written.
    """
    with database_copy.open_source(settings.database) as source:
        if path.exists():
            raise _exists_error(path)
        with opened_blobs(settings) as blobs:
            return _create(source, blobs, path, progress or (lambda _done, _total: None))


def _create(source: database_copy.Source, blobs: Blobs, path: Path, progress: Progress) -> Snapshot:
    folder = path.absolute().parent
    with (
        full_disk_explained(path),
        staging(folder, _PREFIX) as workplace,
        blobs.kept(),  # before the copy: what it refers to must not go
    ):
        begun = datetime.now(UTC)
        check_room(folder, 2 * source.bytes, "a snapshot of the database alone")
        database = workplace / "database"
        ahead = 0  # bytes of the copy, where to write it takes long

        def written(done: int) -> None:
            nonlocal ahead
            ahead = done
            progress(done, max(2 * source.bytes, done))

        source.copy(database, written)
        database_copy.forget_answers(database)
        with database_copy.open_copy(database) as copy:
            draft = _draft(copy, source.place, begun, database.stat().st_size)
            count = database_copy.count_referred(copy)
            wanted = database_copy.referred(copy)
            total = draft.database.bytes + total_bytes(blobs, wanted, count)
            check_room(folder, total, "the snapshot")  # room for the copy is taken already
            archive = workplace / "archive"
            # private: it has all pictures, and the hashes of keys
            with os.fdopen(create_private(archive), "wb") as file:
                writer = ArchiveWriter(
                    file, int(begun.timestamp()),
                    lambda done: progress(ahead + min(done, total), ahead + total),
                )  # fmt: skip
                manifest, damaged = _write(writer, draft, database, copy, blobs)
        try:
            put_new(archive, path)
        except FileExistsError as error:
            raise _exists_error(path) from error
    return Snapshot(path, manifest, damaged)


def _draft(copy: sqlite3.Connection, source: str, begun: datetime, size: int) -> SnapshotManifest:
    """The manifest, as far as it is known before the archive is written."""
    revision = database_copy.check_schema(copy, source)
    wrong = database_copy.check_copy(copy)
    if wrong is not None:
        raise UnusableStore(
            f"{source}: the database is damaged ({wrong}), and a snapshot of it could not be "
            "restored. Run `sceneprint fsck`, or restore an earlier snapshot."
        )
    none = "0" * 64
    return SnapshotManifest(
        created_at=begun,
        sceneprint=version("sceneprint"),
        schema_revision=revision,
        **database_copy.counts(copy),
        database=ArchiveMember(bytes=size, sha256=none),
        blobs=BlobSection(count=0, bytes=0),
        damaged=Damaged(count=0, bytes=0, sha256=none),
        bytes=0,
    )


def _write(
    writer: ArchiveWriter, draft: SnapshotManifest, database: Path, copy: sqlite3.Connection,
    blobs: Blobs,
) -> tuple[SnapshotManifest, list[LostBlob]]:  # fmt: skip
    """All members; the manifest's place is kept until its content is known."""
    writer.add(MANIFEST, MANIFEST_BYTES, iter([bytes(MANIFEST_BYTES)]))
    hashed = hashlib.sha256()

    def hashing() -> Iterator[bytes]:
        for chunk in chunks_of(database):
            hashed.update(chunk)
            yield chunk

    writer.add(DATABASE, draft.database.bytes, hashing())
    damaged, count, size = [], 0, 0
    for one in copied_blobs(blobs, database_copy.referred(copy)):
        if isinstance(one, Untaken):
            damaged.append(LostBlob(digest=one.digest, why=one.why))
            continue
        writer.add(BLOBS + one.digest, one.size, one.chunks)
        count, size = count + 1, size + one.size
    lines = "".join(one.model_dump_json(exclude_none=True) + "\n" for one in damaged).encode()
    writer.add(DAMAGED, len(lines), iter([lines]))
    manifest = draft.model_copy(
        update={
            "database": ArchiveMember(bytes=draft.database.bytes, sha256=hashed.hexdigest()),
            "blobs": BlobSection(count=count, bytes=size),
            "damaged": Damaged(
                count=len(damaged), bytes=len(lines), sha256=hashlib.sha256(lines).hexdigest()
            ),
            "bytes": writer.size,
        }
    )
    writer.finish(manifest_bytes(manifest))
    return manifest, damaged


def _exists_error(path: Path) -> SnapshotError:
    return SnapshotError(f"{path} is there, and nothing is overwritten. Name another with --out.")
