"""Snapshots put back: every byte is verified before anything of it gets its name.

archive  --verify_snapshot-->  Snapshot
archive  --restore_snapshot-->  data folder
"""

from __future__ import annotations

import hashlib
import os
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from pydantic import ValidationError

from sceneprint.atomic_files import create_private, make_folder, sync_folder
from sceneprint.errors import DamagedSnapshot, SnapshotError
from sceneprint.maintenance.snapshot import database_copy
from sceneprint.maintenance.snapshot.creation import Progress, Snapshot
from sceneprint.maintenance.snapshot.files import (
    BLOBS,
    DAMAGED,
    DATABASE,
    LONGEST,
    MANIFEST,
    ArchiveReader,
    DurableFiles,
    LostBlob,
    SnapshotManifest,
    check_room,
    full_disk_explained,
    left_behind,
    put_new,
    read_manifest,
    staging,
)
from sceneprint.store.blobs.folder import is_digest

# An archive read once from end to end, each part of it checked against all others.
#
# The manifest vouches for the database, the database names the blobs, their names are checksums.
# So nothing in the archive chooses where anything is written: what is not expected is refused.


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
    SnapshotError : it is none, of another version, or damaged; or there is no room.
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
            place = folder / BLOBS if with_blobs else None
            missing = _blobs(reader, manifest, copy, place)
            damaged = _damaged(reader, manifest, missing)
        if reader.next() is not None:
            raise reader.damaged("a member follows the last one")
    sync_folder(folder)
    return Snapshot(archive, manifest, damaged)


def blobs_of(
    archive: Path, wanted: Iterable[str], progress: Progress
) -> Iterator[tuple[str, int, Iterator[bytes]]]:
    """Yield digest, size and bytes in parts of the blobs of an archive that `unpack` has verified.

    Parameters
    ----------
    archive : see `unpack`
    wanted : the digests of all that it refers to, in order
    progress : told of bytes done and bytes in all

    Raises
    ------
    DamagedSnapshot : it is not what was verified.
    """
    with archive.open("rb") as file:
        total = os.fstat(file.fileno()).st_size
        reader = ArchiveReader(file, archive, lambda done: progress(done, total))
        member = reader.next()
        while member is not None and member[0] in (MANIFEST, DATABASE):
            reader.skip(member[1])
            member = reader.next()
        for digest in wanted:
            if member is None or member[0] != f"{BLOBS}{digest}":
                raise DamagedSnapshot(f"{archive} was changed while it was restored. Try again.")
            chunks = reader.content(member[1])
            yield digest, member[1], chunks
            for _ in chunks:  # to its end, whoever has read how much
                pass
            member = reader.next()


def _manifest(reader: ArchiveReader, archive: Path) -> SnapshotManifest:
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


def _write_database(reader: ArchiveReader, manifest: SnapshotManifest, path: Path) -> None:
    if reader.next() != (DATABASE, manifest.database.bytes):
        raise reader.damaged("its database is not where it should be")
    hashed = hashlib.sha256()
    with os.fdopen(create_private(path), "wb") as file:
        for chunk in reader.content(manifest.database.bytes):
            hashed.update(chunk)
            file.write(chunk)
        file.flush()
        os.fsync(file.fileno())
    if hashed.hexdigest() != manifest.database.sha256:
        raise reader.damaged("the bytes of its database are not those that were written")


@contextmanager
def _checked(
    reader: ArchiveReader, manifest: SnapshotManifest, archive: Path, path: Path
) -> Iterator[sqlite3.Connection]:
    """The database, after it has been looked through: one that is whole may not be sound."""
    told = {"maps": manifest.maps, "frames": manifest.frames, "signatures": manifest.signatures}
    with database_copy.open_copy(path) as copy:
        try:
            wrong = database_copy.check_plain(copy)
            if wrong is not None:
                raise reader.damaged(f"its database is none of sceneprint's ({wrong})")
            revision = database_copy.check_schema(copy, str(archive))
            wrong = database_copy.check_copy(copy)
            if wrong is not None:
                raise reader.damaged(f"its database is not sound ({wrong})")
            if revision != manifest.schema_revision or database_copy.counts(copy) != told:
                raise reader.damaged("its database is another than its manifest says")
            yield copy
        except sqlite3.Error as error:
            raise reader.damaged(f"its database cannot be read ({error})") from error


def _blobs(
    reader: ArchiveReader, manifest: SnapshotManifest, copy: sqlite3.Connection,
    folder: Path | None,
) -> list[str]:  # fmt: skip
    """Take the blobs that the database refers to, in its order; returns those that are missing."""
    missing, count, size = [], 0, 0
    with DurableFiles(folder) as files:
        member = reader.next()
        for digest in database_copy.referred(copy):
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


def _damaged(
    reader: ArchiveReader, manifest: SnapshotManifest, missing: list[str]
) -> list[LostBlob]:
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


# Where a snapshot is restored to: nothing is overwritten, and nothing is removed.

_STAGING = ".restoring-"


class RestoreTarget:
    """A data folder to be made.

    Parameters
    ----------
    folder : missing or empty

    Raises
    ------
    SnapshotError : it holds something, or is no folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = Path(os.path.realpath(folder))  # a link stays one
        self._exists = self._folder.is_dir()
        if not self._exists and os.path.lexists(self._folder):
            raise SnapshotError(f"{folder} is no folder. Name another with --data.")
        found = self._contents()
        if found:
            shown = ", ".join(found[:3])
            more = "" if len(found) <= 3 else f" and {len(found) - 3} more"
            raise SnapshotError(
                f"{folder} holds {shown}{more}, and nothing is overwritten. Name another folder "
                "with --data, or move away what is there."
            )

    @contextmanager
    def staging(self) -> Iterator[Path]:
        """Make a folder on the same file system to unpack into; it is gone at the end."""
        parent = self._folder if self._exists else self._folder.parent
        make_folder(parent)
        prefix = _STAGING if self._exists else f"{self._folder.name}{_STAGING}"
        with staging(parent, prefix) as folder:
            yield folder

    def put(self, made: Path) -> None:
        """Let a folder of `staging` be the target, in one step as far as anybody can see."""
        try:
            if self._exists:  # it may be a mount, or another user's: it stays
                self._fill(made)
            else:
                made.rename(self._folder)  # fails where somebody has put something there
                sync_folder(self._folder.parent)
        except OSError as error:
            raise SnapshotError(
                f"{self._folder}: the snapshot cannot be put there ({error.strerror}). Nothing was "
                "changed; see what has come to be there, and its permissions."
            ) from error

    def _fill(self, made: Path) -> None:
        """Move blobs and database into the folder.

        The database comes last: without it a service would take the folder for an empty one.
        """
        blobs = BLOBS.rstrip("/")
        (made / blobs).rename(self._folder / blobs)
        try:
            put_new(made / DATABASE, self._folder / DATABASE)
        except OSError:
            (self._folder / blobs).rename(made / blobs)
            raise

    def _contents(self) -> list[str]:
        """Return what is in the folder, but for what killed restores have left there."""
        if not self._exists:
            return []
        ours = {*left_behind(self._folder, _STAGING)}
        if os.path.ismount(self._folder):
            ours.add("lost+found")
        return sorted(set(os.listdir(self._folder)) - ours)  # noqa: PTH208


def verify_snapshot(archive: Path, progress: Progress | None = None) -> Snapshot:
    """Read all of an archive and check it; its database is unpacked in a temporary folder.

    Parameters
    ----------
    archive : of `take_snapshot`
    progress : told of bytes done and bytes in all

    Raises
    ------
    SnapshotError : it is none, of another version, or damaged; or there is no room to check it.
    NewerSchema : a later version wrote its database.
    """
    with TemporaryDirectory(prefix="sceneprint-verify-") as name:
        folder = Path(name)
        with full_disk_explained(folder):
            return unpack(archive, folder, progress, with_blobs=False)


def restore_snapshot(archive: Path, folder: Path, progress: Progress | None = None) -> Snapshot:
    """Make a data folder of an archive, all of it or nothing.

    Parameters
    ----------
    archive : of `take_snapshot`
    folder : missing or empty
    progress : told of bytes done and bytes in all

    Raises
    ------
    SnapshotError : as for `verify_snapshot`; or the folder holds something.
    NewerSchema : a later version wrote its database.
    OSError : the folder cannot be made.
    """
    target = RestoreTarget(folder)
    with full_disk_explained(folder), target.staging() as made:
        snapshot = unpack(archive, made, progress, with_blobs=True)
        target.put(made)
        return snapshot
