"""Archives: an uncompressed tar of which every byte is accounted for, and folders to make them in.

name, bytes  --ArchiveWriter-->  file  --ArchiveReader-->  the same, or DamagedSnapshot

`tarfile` passes over much that is odd: links, sparse files, a header that ends the archive early.
Nothing of that can be in a snapshot, so the reader knows plain files only, and zeros between them.
What is large is made in a folder beside its place before it gets its name.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import re
import secrets
import shutil
import tarfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import datetime
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sceneprint.atomic_files import PRIVATE_FOLDER, create_private, sync_folder
from sceneprint.errors import DamagedSnapshot, SnapshotError

#: Bytes read or written at once.
CHUNK = 1 << 20
#: Bytes of the archive that are done.
Progress = Callable[[int], None]


def chunks_of(path: Path) -> Iterator[bytes]:
    """The bytes of a file, a part at a time."""
    with path.open("rb") as file:
        while chunk := file.read(CHUNK):
            yield chunk


def padded(size: int) -> int:
    """Bytes that a member of that size takes without its header."""
    return -(-size // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE


class ArchiveWriter:
    """Members one after the other; the first can be written again in its place.

    Parameters
    ----------
    file : open for writing, at its start
    mtime : of all members, seconds since 1970
    progress : told of the bytes written so far
    """

    def __init__(self, file: BinaryIO, mtime: int, progress: Progress) -> None:
        self._file, self._mtime, self._progress = file, mtime, progress

    def add(self, name: str, size: int, chunks: Iterator[bytes]) -> None:
        """Append a member.

        Raises
        ------
        ValueError : the chunks are not of that size.
        """
        member = tarfile.TarInfo(name)
        member.size, member.mtime, member.mode = size, self._mtime, 0o600
        self._file.write(member.tobuf(tarfile.GNU_FORMAT))
        written = 0
        for chunk in chunks:
            self._file.write(chunk)
            written += len(chunk)
            self._progress(self._file.tell())
        if written != size:
            raise ValueError(f"{name}: {written} bytes, where {size} were promised")
        self._file.write(bytes(padded(size) - size))

    @property
    def size(self) -> int:
        """Bytes of the archive, if it is finished now."""
        return self._file.tell() + 2 * tarfile.BLOCKSIZE

    def finish(self, first: bytes) -> None:
        """End the archive, and write the content of its first member again.

        Parameters
        ----------
        first : as many bytes as it has
        """
        self._file.write(bytes(2 * tarfile.BLOCKSIZE))
        self._file.seek(tarfile.BLOCKSIZE)
        self._file.write(first)
        self._file.flush()
        os.fsync(self._file.fileno())


class ArchiveReader:
    """Members one after the other, each read to its end.

    Parameters
    ----------
    file : open for reading, at its start
    path : of the file, for messages
    progress : told of the bytes read so far
    """

    def __init__(self, file: BinaryIO, path: Path, progress: Progress) -> None:
        self._file, self._path, self._progress = file, path, progress
        #: Bytes of the whole file.
        self.size = os.fstat(file.fileno()).st_size

    def next(self) -> tuple[str, int] | None:
        """Name and size of the next member; None at the end of the archive.

        Raises
        ------
        DamagedSnapshot : neither is there, or the member is no plain file.
        """
        block = self._read(tarfile.BLOCKSIZE)
        if not any(block):
            self._end()
            return None
        try:
            member = tarfile.TarInfo.frombuf(block, "ascii", "strict")
        except (tarfile.HeaderError, ValueError) as error:
            raise self.damaged("no member begins where one should") from error
        if member.type != tarfile.REGTYPE or member.size < 0:
            raise self.damaged("a member is no plain file")
        return member.name, member.size

    def content(self, size: int) -> Iterator[bytes]:
        """The bytes of the member that `next` has told of, to be read to their end."""
        left = size
        while left:
            chunk = self._read(min(left, CHUNK))
            left -= len(chunk)
            self._progress(self._file.tell())
            yield chunk
        if any(self._read(padded(size) - size)):
            raise self.damaged("there is something between two members")

    def skip(self, size: int) -> None:
        """Go over the bytes of the member that `next` has told of."""
        self._file.seek(padded(size), os.SEEK_CUR)

    def damaged(self, what: str) -> DamagedSnapshot:
        """An error that says where the archive is damaged."""
        return DamagedSnapshot(
            f"{self._path}: the snapshot is damaged near byte {self._file.tell()}: {what}. "
            "Nothing was restored; take another snapshot, or another copy of this one."
        )

    def _end(self) -> None:
        while chunk := self._file.read(CHUNK):
            if any(chunk):
                raise self.damaged("something follows its end")

    def _read(self, size: int) -> bytes:
        data = self._file.read(size)
        if len(data) != size:
            raise self.damaged("it is cut short")
        return data


# The manifest of a snapshot: what is in it, and the checksums of what does not name its own.
#
# manifest.json   this; as many bytes as MANIFEST_BYTES, so that it can be written last
# sceneprint.db   the database, SQLite, in one file
# blobs/DIGEST    every blob it refers to, ordered by digest, which is the SHA-256 of the content;
# damaged.jsonl   the blobs that were missing or damaged when it was taken

#: Of the archive and of what it means. Raise it when either changes.
VERSION = 1
MANIFEST_BYTES = 2048
#: Most bytes of a manifest that are read, of whatever version.
LONGEST = 1 << 20
MANIFEST, DATABASE, DAMAGED, BLOBS = (
    "manifest.json", "sceneprint.db", "damaged.jsonl", "blobs/",
)  # fmt: skip


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class ArchiveMember(_Record):
    """A member that does not name its own checksum."""

    bytes: int = Field(ge=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class BlobSection(_Record):
    """All blobs together."""

    count: int = Field(ge=0)
    bytes: int = Field(ge=0)


class Damaged(ArchiveMember):
    """The list of what could not be taken along."""

    count: int = Field(ge=0)


class LostBlob(_Record):
    """A line of `damaged.jsonl`: a blob that could not be taken along."""

    digest: str
    why: Literal["missing", "damaged"]


class SnapshotManifest(_Record):
    """What is in a snapshot."""

    format: Literal["sceneprint-snapshot"] = "sceneprint-snapshot"
    version: Literal[1] = 1
    #: When it was begun; its state is not older.
    created_at: datetime
    #: The version that wrote it.
    sceneprint: str
    #: Of the database.
    schema_revision: str
    maps: int
    #: How many are in each state.
    frames: dict[str, int]
    signatures: int
    database: ArchiveMember
    blobs: BlobSection
    damaged: Damaged
    #: Of the archive.
    bytes: int

    @property
    def n_frames(self) -> int:
        """Frames that are kept, in whatever state."""
        return sum(n for state, n in self.frames.items() if state != "deleted")


def manifest_bytes(manifest: SnapshotManifest) -> bytes:
    """A manifest as the member of that name: JSON with a checksum of itself, filled with blanks.

    Raises
    ------
    ValueError : it is longer than the place that is kept for it.
    """
    record: dict[str, Any] = json.loads(manifest.model_dump_json())
    text = json.dumps(record | {"sha256": _checksum(record)}, indent=1).encode()
    if len(text) >= MANIFEST_BYTES:
        raise ValueError(f"the manifest has {len(text)} bytes, and room for {MANIFEST_BYTES - 1}")
    return text.ljust(MANIFEST_BYTES - 1) + b"\n"


def read_manifest(data: bytes, place: str) -> SnapshotManifest:
    """A manifest from its bytes.

    Parameters
    ----------
    place : of the archive, for messages

    Raises
    ------
    DamagedSnapshot : no snapshot, or damaged.
    SnapshotError : of another version.
    """
    try:
        record = json.loads(data)
        if not isinstance(record, dict) or record.get("format") != "sceneprint-snapshot":
            raise ValueError("of another format")
        checksum = record.pop("sha256", None)
        if checksum != _checksum(record):
            raise ValueError("its checksum does not fit")
        version = record.get("version")
        if version != VERSION:
            raise SnapshotError(
                f"{place}: a snapshot of version {version!r:.20}, and this sceneprint reads "
                f"{VERSION}. Restore it with the sceneprint that took it."
            )
        return SnapshotManifest.model_validate_json(json.dumps(record))
    except (ValueError, ValidationError, RecursionError) as error:
        raise DamagedSnapshot(
            f"{place}: no snapshot of sceneprint, or its manifest is damaged "
            f"({str(error).partition(chr(10))[0]}). Take another, or another copy of it."
        ) from error


def _checksum(record: dict[str, Any]) -> str:
    text = json.dumps(record, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


# Folders in which something large is made before it gets its name.


@contextmanager
def staging(folder: Path, prefix: str) -> Iterator[Path]:
    """A new private folder within another, removed at the end with what is still in it.

    It is locked, so that those of processes that were killed are known: they are removed first.

    Parameters
    ----------
    folder : in which it is made
    prefix : of its name, and of those that were left behind

    Raises
    ------
    OSError : it cannot be made.
    """
    for name in left_behind(folder, prefix):
        _remove_dead(folder / name)
    path, descriptor = _make(folder, prefix)
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        os.close(descriptor)


def left_behind(folder: Path, prefix: str) -> list[str]:
    """Names of such folders, in use or not."""
    pattern = re.compile(re.escape(prefix) + "[0-9a-f]{12}")
    try:
        return sorted(name for name in os.listdir(folder) if pattern.fullmatch(name))  # noqa: PTH208
    except OSError:
        return []


def check_room(folder: Path, wanted: int, what: str) -> None:
    """See before long work that it will have the room.

    Parameters
    ----------
    folder : on the disk
    wanted : bytes
    what : needs it, for the message

    Raises
    ------
    SnapshotError : the disk has less.
    """
    free = shutil.disk_usage(folder).free
    if free < wanted:
        raise SnapshotError(
            f"{folder}: {what} takes {wanted / 1e6:,.1f} MB, and {free / 1e6:,.1f} MB are free. "
            "Free some space, or choose another place."
        )


@contextmanager
def full_disk_explained(place: Path) -> Iterator[None]:
    """Say that a disk is full, and which."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise
        raise SnapshotError(
            f"{place}: cannot be written ({error.strerror}), and nothing is left of it. Free some "
            "space, or choose another place."
        ) from error


def put_new(made: Path, path: Path) -> None:
    """Give a file its name where nothing has it; it survives the loss of power after that.

    Raises
    ------
    FileExistsError : something has it.
    """
    try:
        os.link(made, path)
    except FileExistsError:
        raise
    except OSError as error:  # a file system without links
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from error
        made.rename(path)
    else:
        made.unlink()
    sync_folder(path.parent)


def _make(folder: Path, prefix: str) -> tuple[Path, int]:
    while True:
        path = folder / f"{prefix}{secrets.token_hex(6)}"
        path.mkdir(PRIVATE_FOLDER)
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except FileNotFoundError:
            continue  # another took it for a dead one's, in the moment before it was locked
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            continue
        except OSError:  # no locks there: then nobody can take it for a dead one's either
            return path, descriptor
        if path.exists():
            return path, descriptor
        os.close(descriptor)


def _remove_dead(path: Path) -> None:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(path, ignore_errors=True)
    except OSError:  # in use
        pass
    finally:
        os.close(descriptor)


# Many files written durably in a row, without waiting for each.

#: Files that are synced together, and threads that wait for it: on ext4 16 are done in the time
#: of five, as one journal commit serves several.
BATCH, THREADS = 64, 8


class DurableFiles:
    """Files of a folder; all are durable after the end of the `with` block.

    Parameters
    ----------
    folder : made here; None: nothing is written
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._open: list[BinaryIO] = []
        self._folders: set[Path] = set()
        self._pool = ThreadPoolExecutor(THREADS, thread_name_prefix="sync")
        if folder is not None:
            folder.mkdir(PRIVATE_FOLDER)

    def __enter__(self) -> DurableFiles:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        with self._pool:
            if self._folder is not None and error is None:
                self._sync()
                list(self._pool.map(sync_folder, [*self._folders, self._folder]))
        for file in self._open:
            file.close()

    def write(self, path: Path, chunks: Iterable[bytes]) -> str:
        """Write a file.

        Parameters
        ----------
        path : in the folder, not there yet
        chunks : its bytes

        Returns
        -------
        digest : the SHA-256 of them
        """
        hashed = hashlib.sha256()
        if self._folder is None:
            for chunk in chunks:
                hashed.update(chunk)
            return hashed.hexdigest()
        whole = self._folder / path
        if whole.parent not in self._folders:
            whole.parent.mkdir(PRIVATE_FOLDER)
            self._folders.add(whole.parent)
        file = FileIO(create_private(whole), "wb")
        self._open.append(file)
        for chunk in chunks:
            hashed.update(chunk)
            _write_all(file, chunk)
        if len(self._open) >= BATCH:
            self._sync()
        return hashed.hexdigest()

    def _sync(self) -> None:
        list(self._pool.map(os.fsync, [file.fileno() for file in self._open]))
        while self._open:
            self._open.pop().close()


def _write_all(file: BinaryIO, data: bytes) -> None:
    left = memoryview(data)
    while left:
        left = left[file.write(left) :]
