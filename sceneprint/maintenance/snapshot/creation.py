"""Snapshots: one state of database and blobs in one archive, taken while the service runs.

data folder, or PostgreSQL and blobs  --take_snapshot-->  archive
job of kind snapshot  --snapshot_handler-->  an archive and its record

The database is copied first, in one transaction; then the blobs that this copy refers to. Blobs
never change, and none is removed from before the first until after the second, so the archive
holds one state, and all of it. Those taken over the service are kept, a few of them, beside the
data or in an object store.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import secrets
import sqlite3
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Literal

from pydantic import ValidationError

from sceneprint.atomic_files import create_private, make_folder, sync_folder, write_durable
from sceneprint.engine.jobs.tasks import Handler, IsOver, LongJob, SliceResult
from sceneprint.errors import DamagedBlob, SnapshotError, UnknownSnapshot, UnusableStore
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
from sceneprint.store import Blobs as Store
from sceneprint.store import Blobs as StoredBlobs
from sceneprint.store.blobs.folder import is_digest
from sceneprint_client.api.admin import SnapshotFile

if TYPE_CHECKING:
    from sceneprint.store.blobs.object_client import Objects

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


def copied_blobs(blobs: StoredBlobs, digests: Iterable[str]) -> Iterator[CopiedBlob | Untaken]:
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


def total_bytes(blobs: StoredBlobs, digests: Iterable[str], count: int) -> int:
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


def _take(blobs: StoredBlobs, digest: str) -> CopiedBlob | Untaken:
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


def _parts(blobs: StoredBlobs, digest: str) -> Iterator[bytes]:
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
    path : of the archive
    manifest : of it
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


def _create(source: database_copy.Source, blobs: Store, path: Path, progress: Progress) -> Snapshot:
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
    blobs: Store,
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
            of = database_copy.uses(copy, one.digest)
            damaged.append(LostBlob(digest=one.digest, why=one.why, of=of))
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


# Snapshots that are taken over the service.

_BELOW = "snapshots/"


def open_snapshot_storage(settings: Settings) -> _Folder | _Objects:
    """The one of a node's settings; nothing is asked of it yet."""
    if settings.snapshot_url is None:
        return _Folder(settings.snapshot_dir)
    from sceneprint.store.blobs.object_client import open_objects

    return _Objects(open_objects(settings.snapshot_url, "SCENEPRINT_SNAPSHOT_URL"))


class _Folder:
    """Files of a folder, which is made with the first of them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def ids(self, kind: str) -> Iterator[tuple[str, float]]:
        """Ids of what there is of a kind, `tar` or `json`, each with when it was written."""
        for path in self._folder.glob(f"*.{kind}"):
            with suppress(FileNotFoundError):  # removed meanwhile
                yield path.stem, path.stat().st_mtime

    def record(self, snapshot_id: str) -> bytes:
        return self._path(snapshot_id, "json").read_bytes()

    def holds(self, snapshot_id: str) -> bool:
        return self._path(snapshot_id, "tar").is_file()

    def open(self, snapshot_id: str) -> BinaryIO:
        return self._path(snapshot_id, "tar").open("rb")

    def local(self, snapshot_id: str, folder: Path) -> Path:
        """A file of this machine that is the archive; where it has to be fetched, in a folder."""
        del folder
        return self._path(snapshot_id, "tar")

    def put(self, snapshot_id: str, archive: Path, record: bytes) -> None:
        make_folder(self._folder)
        self._folder.chmod(0o700)  # archives have all frames, and the hashes of keys
        archive.replace(self._path(snapshot_id, "tar"))
        write_durable(self._path(snapshot_id, "json"), record)

    def remove(self, snapshot_id: str) -> None:
        for kind in ("json", "tar"):
            self._path(snapshot_id, kind).unlink(missing_ok=True)
        sync_folder(self._folder)

    def _path(self, snapshot_id: str, kind: str) -> Path:
        return self._folder / f"{snapshot_id}.{kind}"


class _Objects:
    """Objects below a prefix, for all hosts of a fleet."""

    def __init__(self, objects: Objects) -> None:
        self._objects = objects

    def ids(self, kind: str) -> Iterator[tuple[str, float]]:
        for one in self._objects.list(_BELOW):
            name, _, end = one.key.rpartition("/")[2].rpartition(".")
            if end == kind:
                yield name, one.changed_at

    def record(self, snapshot_id: str) -> bytes:
        return self._objects.get(_key(snapshot_id, "json"))

    def holds(self, snapshot_id: str) -> bool:
        return self._objects.size(_key(snapshot_id, "tar")) is not None

    def open(self, snapshot_id: str) -> BinaryIO:
        return self._objects.open(_key(snapshot_id, "tar"))

    def local(self, snapshot_id: str, folder: Path) -> Path:
        path = folder / "archive"
        self._objects.get_file(_key(snapshot_id, "tar"), path)
        return path

    def put(self, snapshot_id: str, archive: Path, record: bytes) -> None:
        self._objects.put_file(_key(snapshot_id, "tar"), archive)
        self._objects.put(_key(snapshot_id, "json"), record)
        archive.unlink()

    def remove(self, snapshot_id: str) -> None:
        for kind in ("json", "tar"):
            self._objects.delete(_key(snapshot_id, kind))


def _key(snapshot_id: str, kind: str) -> str:
    return f"{_BELOW}{snapshot_id}.{kind}"


log = logging.getLogger(__name__)

#: Kind of the jobs.
SNAPSHOT = "snapshot"
#: Longest time for one, seconds: what a terabyte takes.
LONGEST_S = 6 * 3600.0
#: Seconds after which an archive without a record is of a worker that died.
_ABANDONED_S = 3600.0
_STAGING = ".taking-"
_ID = re.compile(r"[0-9]{8}T[0-9]{6}Z-[0-9a-f]{8}")


class SnapshotCatalog:
    """The snapshots of a data folder, or of a fleet.

    Parameters
    ----------
    settings : see Settings
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    @cached_property
    def _rack(self) -> _Folder | _Objects:
        return open_snapshot_storage(self._settings)

    def list(self) -> tuple[SnapshotFile, ...]:
        """All snapshots, the newest first."""
        found = []
        for name, _ in self._rack.ids("json"):
            with suppress(UnknownSnapshot):  # removed meanwhile, or no record of ours
                found.append(self.find(name))
        return tuple(sorted(found, key=lambda one: one.snapshot_id, reverse=True))

    def find(self, snapshot_id: str) -> SnapshotFile:
        """A snapshot; UnknownSnapshot where there is none."""
        if is_snapshot_id(snapshot_id) and self._rack.holds(snapshot_id):
            with suppress(OSError, ValidationError):
                return SnapshotFile.model_validate_json(self._rack.record(snapshot_id))
        raise _unknown(snapshot_id)

    def open(self, snapshot_id: str) -> BinaryIO:
        """An archive as a file that can be sought in; UnknownSnapshot where there is none."""
        self.find(snapshot_id)
        try:
            return self._rack.open(snapshot_id)
        except FileNotFoundError as error:  # removed meanwhile
            raise _unknown(snapshot_id) from error

    @contextmanager
    def local(self, snapshot_id: str, folder: Path) -> Iterator[Path]:
        """The archive as a file of this machine, in the end perhaps no more.

        Parameters
        ----------
        snapshot_id : UnknownSnapshot where there is none
        folder : in which it may be put meanwhile; made where missing
        """
        found = self.find(snapshot_id)
        make_folder(folder)
        with staging(folder, _STAGING) as place:
            check_room(place, found.bytes, "the snapshot")
            yield self._rack.local(snapshot_id, place)

    def delete(self, snapshot_id: str) -> None:
        """Remove a snapshot; UnknownSnapshot where there is none."""
        self.find(snapshot_id)
        self._rack.remove(snapshot_id)

    def take(self, snapshot_id: str, progress: Progress | None = None) -> SnapshotFile:
        """Take a snapshot, and remove the oldest of those that are too many.

        Parameters
        ----------
        snapshot_id : that it gets; one of that id that is there already is left as it is
        progress : told of bytes done and bytes in all

        Raises
        ------
        SnapshotError : it cannot be taken.
        """
        with suppress(UnknownSnapshot):
            return self.find(snapshot_id)
        place = self._settings.snapshot_dir
        try:
            make_folder(place)
            # archives have all frames, and the hashes of keys
            with staging(place, _STAGING) as folder:
                taken = take_snapshot(self._settings, folder / "archive", progress)
                with taken.path.open("rb") as file:
                    digest = hashlib.file_digest(file, "sha256").hexdigest()
                made = SnapshotFile(
                    snapshot_id=snapshot_id,
                    created_at=taken.manifest.created_at,
                    bytes=taken.path.stat().st_size,
                    sha256=digest,
                    maps=taken.manifest.maps,
                    frames=taken.manifest.n_frames,
                    blobs=taken.manifest.blobs.count,
                    damaged=len(taken.damaged),
                )
                self._rack.put(snapshot_id, taken.path, made.model_dump_json().encode())
            self._tidy()
        except UnusableStore as error:  # in the words of a snapshot: another try finds the same
            raise SnapshotError(str(error)) from error
        except OSError as error:
            raise SnapshotError(
                f"{place}: no snapshot can be written ({error.strerror or error}). See "
                "that the service may write there."
            ) from error
        return made

    def _tidy(self) -> None:
        """Remove what is too much, and archives that nobody will finish."""
        for one in self.list()[self._settings.snapshots_kept :]:
            log.info("snapshot removed", extra={"snapshot": one.snapshot_id})
            self._rack.remove(one.snapshot_id)
        known = {name for name, _ in self._rack.ids("json")}
        for name, written_at in self._rack.ids("tar"):
            if (
                written_at + _ABANDONED_S < time.time()
                and is_snapshot_id(name)
                and name not in known
            ):
                self._rack.remove(name)


def is_snapshot_id(given: str) -> bool:
    """Whether it can be the id of a snapshot that was taken over the service."""
    return _ID.fullmatch(given) is not None


def new_snapshot_id() -> str:
    """An id for a snapshot that is taken now, and not by a job."""
    return f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{secrets.token_hex(4)}"


def snapshot_handler(settings: Settings) -> Handler:
    """What does jobs of kind `snapshot`, in one slice each."""

    def handle(task: LongJob, is_over: IsOver) -> SliceResult:
        del is_over
        job = task.job
        begun = datetime.fromtimestamp(job.created_at, UTC)
        made = SnapshotCatalog(settings).take(f"{begun:%Y%m%dT%H%M%SZ}-{job.id[:8]}")
        return SliceResult(
            over=True, progress={"done": made.bytes, "total": made.bytes},
            result=made.model_dump(mode="json"),
        )  # fmt: skip

    return handle


def _unknown(snapshot_id: str) -> UnknownSnapshot:
    return UnknownSnapshot(
        f"There is no snapshot {snapshot_id!r:.80}, or no longer: only the newest are kept. List "
        "them with GET /v1/snapshots."
    )
