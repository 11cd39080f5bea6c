"""Snapshots: one state of database and blobs in one archive, taken while the service runs.

data folder, or PostgreSQL and blobs  --take_snapshot-->  archive

The database is copied first, in one transaction; then the blobs that this copy refers to. Blobs
never change, and none is removed from before the first until after the second, so the archive
holds one state, and all of it.
"""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from sceneprint.errors import SnapshotError, UnusableStore
from sceneprint.maintenance import copies
from sceneprint.maintenance.archives import ArchiveWriter, chunks_of
from sceneprint.maintenance.keeping import opened_blobs
from sceneprint.maintenance.manifests import (
    BLOBS,
    DAMAGED,
    DATABASE,
    MANIFEST,
    MANIFEST_BYTES,
    Blobs,
    Damaged,
    LostBlob,
    Manifest,
    Member,
    manifest_bytes,
)
from sceneprint.maintenance.staging import check_room, full_disk_explained, put_new, staging
from sceneprint.maintenance.taking import Untaken, taken, total_bytes
from sceneprint.settings import Settings
from sceneprint.store import Blobs as Store

#: Bytes done, and bytes in all.
Progress = Callable[[int, int], None]
_PREFIX = ".sceneprint-snapshot-"


@dataclass(frozen=True)
class Snapshot:
    """What is in an archive.

    Parameters
    ----------
    path : of the archive
    manifest : of it
    damaged : the blobs that are not in it
    """

    path: Path
    manifest: Manifest
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
    with copies.open_source(settings.database) as source:
        if path.exists():
            raise _taken(path)
        with opened_blobs(settings) as blobs:
            return _taken_of(source, blobs, path, progress or (lambda _done, _total: None))


def _taken_of(source: copies.Source, blobs: Store, path: Path, progress: Progress) -> Snapshot:
    folder = path.absolute().parent
    with (
        full_disk_explained(path),
        staging(folder, _PREFIX, 0o700) as workplace,
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
        with copies.open_copy(database) as copy:
            draft = _draft(copy, source.place, begun, database.stat().st_size)
            count = copies.count_referred(copy)
            total = draft.database.bytes + total_bytes(blobs, copies.referred(copy), count)
            check_room(folder, total, "the snapshot")  # room for the copy is taken already
            archive = workplace / "archive"
            with archive.open("xb") as file:
                archive.chmod(0o600)  # it has all pictures, and the hashes of keys
                writer = ArchiveWriter(
                    file, int(begun.timestamp()),
                    lambda done: progress(ahead + min(done, total), ahead + total),
                )  # fmt: skip
                manifest, damaged = _write(writer, draft, database, copy, blobs)
        try:
            put_new(archive, path)
        except FileExistsError as error:
            raise _taken(path) from error
    return Snapshot(path, manifest, damaged)


def _draft(copy: sqlite3.Connection, source: str, begun: datetime, size: int) -> Manifest:
    """The manifest, as far as it is known before the archive is written."""
    revision = copies.check_schema(copy, source)
    wrong = copies.check_copy(copy)
    if wrong is not None:
        raise UnusableStore(
            f"{source}: the database is damaged ({wrong}), and a snapshot of it could not be "
            "restored. Run `sceneprint fsck`, or restore an earlier snapshot."
        )
    none = "0" * 64
    return Manifest(
        created_at=begun,
        sceneprint=version("sceneprint"),
        schema_revision=revision,
        **copies.counts(copy),
        database=Member(bytes=size, sha256=none),
        blobs=Blobs(count=0, bytes=0),
        damaged=Damaged(count=0, bytes=0, sha256=none),
        bytes=0,
    )


def _write(
    writer: ArchiveWriter, draft: Manifest, database: Path, copy: sqlite3.Connection,
    blobs: Store,
) -> tuple[Manifest, list[LostBlob]]:  # fmt: skip
    """All members; the manifest's place is kept until its content is known."""
    writer.add(MANIFEST, MANIFEST_BYTES, iter([bytes(MANIFEST_BYTES)]))
    hashed = hashlib.sha256()

    def hashing() -> Iterator[bytes]:
        for chunk in chunks_of(database):
            hashed.update(chunk)
            yield chunk

    writer.add(DATABASE, draft.database.bytes, hashing())
    damaged, count, size = [], 0, 0
    for one in taken(blobs, copies.referred(copy)):
        if isinstance(one, Untaken):
            of = copies.uses(copy, one.digest)
            damaged.append(LostBlob(digest=one.digest, why=one.why, of=of))
            continue
        writer.add(BLOBS + one.digest, one.size, one.chunks)
        count, size = count + 1, size + one.size
    lines = "".join(one.model_dump_json(exclude_none=True) + "\n" for one in damaged).encode()
    writer.add(DAMAGED, len(lines), iter([lines]))
    manifest = draft.model_copy(
        update={
            "database": Member(bytes=draft.database.bytes, sha256=hashed.hexdigest()),
            "blobs": Blobs(count=count, bytes=size),
            "damaged": Damaged(
                count=len(damaged), bytes=len(lines), sha256=hashlib.sha256(lines).hexdigest()
            ),
            "bytes": writer.size,
        }
    )
    writer.finish(manifest_bytes(manifest))
    return manifest, damaged


def _taken(path: Path) -> SnapshotError:
    return SnapshotError(f"{path} is there, and nothing is overwritten. Name another with --out.")
