"""An archive read once from end to end, each part of it checked against all others.

The manifest vouches for the database, the database names the blobs, their names are checksums.
So nothing in the archive chooses where anything is written: what is not expected is refused.
"""

from __future__ import annotations

import hashlib
import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pydantic import ValidationError

from sceneprint.errors import DamagedSnapshot, SnapshotError
from sceneprint.maintenance import copies
from sceneprint.maintenance.archives import ArchiveReader
from sceneprint.maintenance.manifests import (
    BLOBS,
    DAMAGED,
    DATABASE,
    LONGEST,
    MANIFEST,
    LostBlob,
    Manifest,
    read_manifest,
)
from sceneprint.maintenance.snapshots import Progress, Snapshot
from sceneprint.maintenance.staging import check_room
from sceneprint.maintenance.syncing import DurableFiles
from sceneprint.store.blobs import is_digest
from sceneprint.writing import sync_folder


def unpack(archive: Path, folder: Path, progress: Progress | None, *, with_blobs: bool) -> Snapshot:
    """Verify an archive, and write what is in it into a folder, durable.

    Parameters
    ----------
    archive : of `take_snapshot`
    folder : empty; where this raises, what is in it is of no use
    progress : told of bytes done and bytes in all
    with_blobs : whether to write them; they are verified all the same

    Raises
    ------
    SnapshotError : it is none, of a later version, or damaged; or there is no room.
    NewerSchema : a later version wrote its database.
    """
    if not archive.is_file():
        raise SnapshotError(f"{archive}: there is no such file. Name a snapshot.")
    with archive.open("rb") as file:
        total = os.fstat(file.fileno()).st_size
        reader = ArchiveReader(
            file, archive, lambda done: None if progress is None else progress(done, total)
        )
        manifest = _manifest(reader, archive)
        wanted = manifest.database.bytes + (manifest.blobs.bytes if with_blobs else 0)
        check_room(folder.parent, wanted, "what is in the snapshot")
        _write_database(reader, manifest, folder / DATABASE)
        with _checked(reader, manifest, archive, folder / DATABASE) as copy:
            missing = _blobs(reader, manifest, copy, folder / BLOBS if with_blobs else None)
            damaged = _damaged(reader, manifest, missing)
        if reader.next() is not None:
            raise reader.damaged("a member follows the last one")
    sync_folder(folder)
    return Snapshot(archive, manifest, damaged)


def blobs_of(archive: Path, progress: Progress) -> Iterator[tuple[str, int, Iterator[bytes]]]:
    """The blobs in an archive that `unpack` has verified: digest, size, and bytes in parts.

    Parameters
    ----------
    archive : see `unpack`
    progress : told of bytes done and bytes in all

    Raises
    ------
    DamagedSnapshot : it is not what was verified.
    """
    with archive.open("rb") as file:
        total = os.fstat(file.fileno()).st_size
        reader = ArchiveReader(file, archive, lambda done: progress(done, total))
        while (member := reader.next()) is not None:
            name, size = member
            chunks = reader.content(size)
            if name.startswith(BLOBS):
                yield name.removeprefix(BLOBS), size, chunks
            for _ in chunks:  # to its end, whoever has read how much
                pass


def _manifest(reader: ArchiveReader, archive: Path) -> Manifest:
    try:
        member = reader.next()
    except DamagedSnapshot:
        member = None
    if member is None or member[0] != MANIFEST or member[1] > LONGEST:
        raise DamagedSnapshot(
            f"{archive}: no snapshot of sceneprint, or damaged at its start. Name another file, "
            "or take another copy of it."
        )
    manifest = read_manifest(b"".join(reader.content(member[1])), str(archive))
    if reader.size != manifest.bytes:
        raise reader.damaged(f"it has {reader.size} bytes, where {manifest.bytes} were written")
    if manifest.database.bytes + manifest.blobs.bytes + manifest.damaged.bytes > reader.size:
        raise reader.damaged("its manifest promises more than it holds")
    return manifest


def _write_database(reader: ArchiveReader, manifest: Manifest, path: Path) -> None:
    if reader.next() != (DATABASE, manifest.database.bytes):
        raise reader.damaged("its database is not where it should be")
    hashed = hashlib.sha256()
    with path.open("xb") as file:
        for chunk in reader.content(manifest.database.bytes):
            hashed.update(chunk)
            file.write(chunk)
        file.flush()
        os.fsync(file.fileno())
    if hashed.hexdigest() != manifest.database.sha256:
        raise reader.damaged("the bytes of its database are not those that were written")


@contextmanager
def _checked(
    reader: ArchiveReader, manifest: Manifest, archive: Path, path: Path
) -> Iterator[sqlite3.Connection]:
    """The database, after it has been looked through: one that is whole may not be sound."""
    told = {"maps": manifest.maps, "frames": manifest.frames, "signatures": manifest.signatures}
    with copies.open_copy(path) as copy:
        try:
            wrong = copies.check_plain(copy)
            if wrong is not None:
                raise reader.damaged(f"its database is none of sceneprint's ({wrong})")
            revision = copies.check_schema(copy, str(archive))
            wrong = copies.check_copy(copy)
            if wrong is not None:
                raise reader.damaged(f"its database is not sound ({wrong})")
            if revision != manifest.schema_revision or copies.counts(copy) != told:
                raise reader.damaged("its database is another than its manifest says")
            yield copy
        except sqlite3.Error as error:
            raise reader.damaged(f"its database cannot be read ({error})") from error


def _blobs(
    reader: ArchiveReader, manifest: Manifest, copy: sqlite3.Connection, folder: Path | None
) -> list[str]:
    """Take the blobs that the database refers to, in its order; returns those that are missing."""
    missing, count, size = [], 0, 0
    with DurableFiles(folder) as files:
        member = reader.next()
        for digest in copies.referred(copy):
            # what is no digest would choose where it is written: nothing is there for it
            if member is None or member[0] != f"{BLOBS}{digest}" or not is_digest(digest):
                missing.append(digest)
                if len(missing) > manifest.damaged.count:
                    raise reader.damaged("a blob is missing, or another one is there")
                continue
            path = Path(digest[:2], digest)
            if files.write(path, reader.content(member[1])) != digest:
                raise reader.damaged(f"the blob {digest[:12]} has other bytes than were written")
            count, size = count + 1, size + member[1]
            member = reader.next()
    if member != (DAMAGED, manifest.damaged.bytes):
        raise reader.damaged("a blob is there that nothing refers to")
    if (count, size) != (manifest.blobs.count, manifest.blobs.bytes):
        raise reader.damaged("its blobs are others than its manifest says")
    return missing


def _damaged(reader: ArchiveReader, manifest: Manifest, missing: list[str]) -> list[LostBlob]:
    """What the archive says of the blobs that are not in it: these, and no others."""
    data = b"".join(reader.content(manifest.damaged.bytes))
    if hashlib.sha256(data).hexdigest() != manifest.damaged.sha256:
        raise reader.damaged("its list of damaged blobs is not the one that was written")
    try:
        lost = [LostBlob.model_validate_json(line) for line in data.splitlines()]
    except ValidationError as error:
        raise reader.damaged("its list of damaged blobs is none") from error
    if [one.digest for one in lost] != missing:
        raise reader.damaged("other blobs are missing than it says")
    return lost
