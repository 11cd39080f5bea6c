"""Interface of blob storage, and durable storage in a folder."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import re
import secrets
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import BinaryIO, Literal

from sceneprint.atomic_files import (
    PRIVATE_FOLDER,
    create_private,
    make_folder,
    sync_folder,
    write_durable,
)
from sceneprint.errors import DamagedBlob, StoreLocked, UnusableStore
from sceneprint.store.database_errors import unusable

# All processes that share the blobs use one lock: shared while blobs must not be removed, exclusive
# during removals. The kernel or the server releases the lock of a process that dies.

#: Maximum seconds to wait for a removal during a write turn, and maximum duration of a removal.
TURN_S, REMOVAL_S = 5.0, 25.0
#: Seconds after which any removal has ended, even if its process died: a removal sends no request
#: after REMOVAL_S, and each request ends within `object_client.TRIED_S` and `SMALL_S`.
LONGEST_S = 90.0
#: Seconds between attempts to acquire the lock of a folder.
_LOOK_S = 0.01


class Locks(ABC):
    """Lock on blob storage; shared while blobs must not be removed."""

    #: Seconds for which a removal may continue after its process has lost the lock.
    late_s = 0.0

    @abstractmethod
    def block_removals(self) -> AbstractContextManager[None]:
        """Hold a shared lock that prevents removals; first wait for a removal in progress.

        Raises
        ------
        UnusableStore : If the lock cannot be acquired.
        """

    @abstractmethod
    def removing(self) -> AbstractContextManager[bool]:
        """Acquire the exclusive lock without waiting; yield False if another process holds it.

        Begin this within a write transaction: removals then run one at a time, and do not starve
        `block_removals`. After the transaction, remove only blobs that it doomed.
        """

    def removals(self) -> int | None:
        """Return the value of the counter of removals; None if unknown, or during a removal."""
        return None

    def mark_uncertain(self) -> None:  # noqa: B027  (removals from a folder end at once)
        """Mark the removal by this thread as unfinished: its requests may still be executed."""

    def await_removal(self, digest: str | None = None, seconds: float = REMOVAL_S) -> None:
        """Wait for the end of a removal in progress; see `wait` for the parameters and errors."""
        if self.removals() is None:
            self.wait(digest, seconds)

    def wait(self, digest: str | None, seconds: float) -> None:  # noqa: B027  (most have none)
        """Wait for a removal that continues after its write turn, unless its process has died.

        Parameters
        ----------
        digest : blob that is being removed; None waits for all removals
        seconds : maximum duration of the wait

        Raises
        ------
        StoreLocked : If the removal takes longer.
        UnusableStore : If the state of the removal is unknown.
        """

    def close(self) -> None:  # noqa: B027  (most hold nothing)
        """Close open files and connections."""


class FileLocks(Locks):
    """Lock for the processes of one machine, on a folder or a file.

    Parameters
    ----------
    make : whether to create a file at the path
    """

    def __init__(self, path: Path, *, make: bool = False) -> None:
        self._path = path
        self._flags = os.O_RDWR | os.O_CREAT if make else os.O_RDONLY | os.O_DIRECTORY

    @contextmanager
    def block_removals(self) -> Iterator[None]:
        """Hold a lock that prevents removals. Raise UnusableStore if it cannot be acquired."""
        try:
            descriptor = self._lock(fcntl.LOCK_SH)
        except OSError as error:
            kind = "folder" if self._flags & os.O_DIRECTORY else "file"
            raise UnusableStore(
                f"{self._path}: The {kind} cannot be locked ({error.strerror}). Stop the "
                "service, and copy the data folder."
            ) from error
        try:
            yield
        finally:
            os.close(descriptor)

    @contextmanager
    def removing(self) -> Iterator[bool]:
        """Acquire the exclusive lock without waiting; yield whether this succeeded."""
        try:
            descriptor = self._lock(fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:  # in use or not supported; blobs that remain are harmless
            yield False
            return
        try:
            yield True
        finally:
            os.close(descriptor)

    def wait(self, digest: str | None, seconds: float) -> None:  # noqa: ARG002  (one lock for all)
        """Wait for a removal in progress; see `Locks.wait`."""
        until = time.monotonic() + seconds
        while True:
            try:
                os.close(self._lock(fcntl.LOCK_SH | fcntl.LOCK_NB))
            except BlockingIOError:
                pass
            except OSError:  # without file locks, there are no removals
                return
            else:
                return
            if time.monotonic() > until:
                raise StoreLocked(
                    f"{self._path}: Another process has been removing blobs for more than "
                    f"{seconds:.0f} s. Nothing was stored. Try again later."
                )
            time.sleep(_LOOK_S)

    def _lock(self, how: int) -> int:
        # flock excludes other threads only with a separate descriptor for each call
        descriptor = os.open(self._path, self._flags | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, how)
        except BaseException:
            os.close(descriptor)
            raise
        return descriptor


# Blobs are bytes under the SHA-256 of their content, in a folder (folder.py) or an object store
# (object_store.py). They are durable before a row refers to them.
#
# bytes  --put-->  digest  --get-->  the same bytes, or an error


class IncomingBlob:
    """A blob that is written in chunks; see `Blobs.incoming`.

    Parameters
    ----------
    what : prefix of error messages
    keep : function that stores the file durably under its digest
    """

    def __init__(self, file: BinaryIO | FileIO, what: str, keep: Callable[[str], None]) -> None:
        self._file, self._what, self._keep = file, what, keep
        self._hashed = hashlib.sha256()
        #: Number of written bytes.
        self.size = 0

    def write(self, data: bytes) -> None:
        """Append bytes."""
        try:
            rest = memoryview(data)
            while rest:  # unbuffered files may write only part of the data
                rest = rest[self._file.write(rest) or 0 :]
        except OSError as error:
            raise unusable(self._what, error) from error
        self._hashed.update(data)
        self.size += len(data)

    def keep(self) -> str:
        """Store the blob durably, and return its digest."""
        digest = self._hashed.hexdigest()
        try:
            self._keep(digest)
        except OSError as error:
            raise unusable(self._what, error) from error
        return digest


Condition = Literal["sound", "missing", "damaged"]
DIGEST = re.compile(r"[0-9a-f]{64}")
#: Name of the file that names the owner of the blobs; see `object_store.BucketOwner`.
MARK = "sceneprint.json"


def is_digest(value: object) -> bool:
    """Return whether a value is a digest: 64 hexadecimal digits."""
    return isinstance(value, str) and DIGEST.fullmatch(value) is not None


def require_digest(text: str) -> None:
    """Raise ValueError if a text is not a digest; only digests may become part of a path or key."""
    if not DIGEST.fullmatch(text):
        raise ValueError(f"{text!r} is not a digest")


@dataclass(frozen=True)
class BlobEntry:
    """A file or object in blob storage.

    Parameters
    ----------
    place : path or URL, for messages
    digest : digest of the blob; None for other files
    changed_at : time of modification, seconds since 1970
    unfinished : whether the file is incomplete: being written, or abandoned
    """

    place: str
    digest: str | None
    changed_at: float
    unfinished: bool = False


class Blobs(ABC):
    """Storage of blobs; safe to share between threads."""

    def __init__(self, locks: Locks) -> None:
        #: Lock of all processes that share the blobs.
        self.locks = locks

    @abstractmethod
    def put(self, data: bytes) -> str:
        """Store bytes durably.

        Returns
        -------
        digest : 64 hexadecimal digits

        Raises
        ------
        StoreFull : If the disk is full; partial files are removed.
        UnusableStore : If the storage is missing or not writable.
        """

    @abstractmethod
    def incoming(self) -> AbstractContextManager[IncomingBlob]:
        """Store a blob in chunks, for example if it does not fit into memory.

        The blob is removed at the end unless `keep` has been called.

        Raises
        ------
        StoreFull, UnusableStore : See `put`; also raised by `write` and `keep`.
        """

    def get(self, digest: str) -> bytes:
        """Return the verified bytes of a blob.

        Raises
        ------
        DamagedBlob : If the blob is missing or damaged.
        UnusableStore : If the storage is unreachable.
        """
        advice = "Restore it from a copy, or delete the frame and upload it again."
        try:
            data = self.read(digest)
        except OSError as error:
            reason = error.strerror or "it does not exist"
            raise DamagedBlob(
                f"The blob {digest[:12]} cannot be read ({reason}). {advice}"
            ) from error
        if hashlib.sha256(data).hexdigest() != digest:
            raise DamagedBlob(
                f"The blob {digest[:12]} is damaged: its content has a different hash. {advice}"
            )
        return data

    @abstractmethod
    def read(self, digest: str) -> bytes:
        """Return the unverified bytes of a blob; raise OSError if it is missing or unreadable."""

    @abstractmethod
    def open(self, digest: str) -> BinaryIO:
        """Return an unverified blob as a seekable file.

        Raises
        ------
        FileNotFoundError : If the blob is missing.
        OSError, UnusableStore : If the blob cannot be read; also raised when the file is read.
        """

    @abstractmethod
    def holds(self, digest: str, seconds: float = TURN_S) -> bool:
        """Return whether a blob exists and will exist until the transaction is committed.

        Call this in the transaction that writes a reference to the blob: no removal begins before
        the commit, and the call waits up to `seconds` for a removal in progress.

        Raises
        ------
        StoreLocked : If such a removal takes too long.
        UnusableStore : If the storage is unreachable.
        """

    def ensure(self, digest: str, data: bytes) -> None:
        """Store a blob again if it was removed before a reference to it was committed.

        Removals that begin after that commit spare the blob.

        Raises
        ------
        StoreLocked, UnusableStore : See `holds` and `put`.
        """
        if not self.holds(digest, REMOVAL_S):
            self.put(data)

    @abstractmethod
    def size(self, digest: str) -> int | None:
        """Return the size of a blob, in bytes, without verifying it; None if it is missing."""

    @abstractmethod
    def remove(self, *digests: str) -> None:
        """Remove blobs without references; call it within `removing`."""

    @abstractmethod
    def condition(self, digest: str, *, quick: bool = False) -> Condition:
        """Check the content of a blob, and return its condition.

        Parameters
        ----------
        digest : digest of the blob; other texts count as missing blobs
        quick : whether to check only that the blob exists

        Raises
        ------
        UnusableStore : If this user cannot read the blob, or the storage is unreachable.
        """

    @abstractmethod
    def quarantine(self, digest: str, folder: Path) -> Path | None:
        """Move a damaged blob to a folder durably; return its new path, or None if it is missing.

        Call this within `removing`.

        Parameters
        ----------
        folder : destination, which is created if missing
        """

    @abstractmethod
    def place(self, digest: str) -> str:
        """Return the path or URL of a blob for messages."""

    def digests(self) -> Iterator[str]:
        """Yield the digests of all blobs in arbitrary order."""
        return (entry.digest for entry in self.entries() if entry.digest is not None)

    @abstractmethod
    def entries(self) -> Iterator[BlobEntry]:
        """Yield all files or objects in the blob storage in arbitrary order."""

    @property
    def read_only(self) -> bool:
        """Return whether the storage is read-only, as far as can be checked without writing."""
        return False

    def check(self) -> None:  # noqa: B027
        """Check that network storage was reachable within the last two seconds.

        Raises
        ------
        UnusableStore : If the storage is unreachable.
        """

    def close(self) -> None:
        """Close open files and connections."""
        self.locks.close()


#: Pattern of the names of unfinished files, which killed writers leave behind.
PART = re.compile(r"\.[0-9a-f]{12}\.part")


class FolderBlobs(Blobs):
    """Blobs in 256 subfolders of a folder, named after the first two digits of the digests.

    Parameters
    ----------
    folder : parent of the subfolders
    make : whether to create a missing folder

    Raises
    ------
    UnusableStore : If the folder cannot be created.
    """

    def __init__(self, folder: Path, *, make: bool = True) -> None:
        # lock the folder itself, to avoid a lock file
        super().__init__(FileLocks(folder))
        self._folder = folder
        self._durable: set[str] = set()  # names of subfolders that are known to be durable
        try:
            if make:
                make_folder(folder)
        except OSError as error:
            raise unusable(f"{folder}: The folder cannot be created", error) from error

    @property
    def read_only(self) -> bool:
        """Return whether the folder exists and is not writable, for example on a remounted disk."""
        return self._folder.is_dir() and not os.access(self._folder, os.W_OK)

    def put(self, data: bytes) -> str:
        """Store bytes durably, and return their digest; see `Blobs.put`."""
        digest = hashlib.sha256(data).hexdigest()
        path = self.path(digest)
        try:  # replace an existing file too: it may be damaged, not durable, or about to be removed
            new = self._ensure_folder(path.parent)
            write_durable(path, data, folder_is_new=new)
        except OSError as error:
            raise unusable(f"{self._folder}: A blob cannot be written", error) from error
        self._durable.add(path.parent.name)
        return digest

    @contextmanager
    def incoming(self) -> Iterator[IncomingBlob]:
        """Yield a blob to write in chunks; see `Blobs.incoming`."""
        part = self._folder / f".{secrets.token_hex(6)}.part"
        what = f"{self._folder}: A blob cannot be written"
        try:
            file = FileIO(create_private(part), "wb")
        except OSError as error:
            raise unusable(what, error) from error
        try:
            with file:
                yield IncomingBlob(file, what, lambda digest: self._keep(file, part, digest))
        finally:
            with suppress(OSError):
                part.unlink(missing_ok=True)

    def _keep(self, file: FileIO, part: Path, digest: str) -> None:
        """Sync a written file, and rename it to its digest."""
        os.fsync(file.fileno())
        path = self.path(digest)
        self._ensure_folder(path.parent)
        os.replace(part, path)  # noqa: PTH105  (the one call that is atomic by contract)
        sync_folder(path.parent)
        sync_folder(self._folder)

    def _ensure_folder(self, folder: Path) -> bool:
        """Create a missing folder; return whether its entry must still be synced."""
        try:
            folder.mkdir(PRIVATE_FOLDER)
        except FileExistsError:
            return folder.name not in self._durable
        return True

    def read(self, digest: str) -> bytes:
        """Return the unverified bytes of a blob; see `Blobs.read`."""
        return self.path(digest).read_bytes()

    def holds(self, digest: str, seconds: float = TURN_S) -> bool:
        """Return whether a blob exists; see `Blobs.holds`."""
        self.locks.wait(digest, seconds)
        return self.path(digest).exists()

    def size(self, digest: str) -> int | None:
        """Return the size of a blob in bytes, unverified; None if it is missing."""
        try:
            return self.path(digest).stat().st_size
        except OSError:
            return None

    def open(self, digest: str) -> BinaryIO:
        """Return an unverified blob as a seekable file; see `Blobs.open`."""
        return self.path(digest).open("rb")

    def remove(self, *digests: str) -> None:
        """Remove blobs without references; see `Blobs.remove`."""
        for digest in digests:
            self.path(digest).unlink(missing_ok=True)
        for folder in {self.path(digest).parent for digest in digests}:
            if folder.is_dir():
                sync_folder(folder)  # otherwise, a power failure could restore deleted frames

    def condition(self, digest: str, *, quick: bool = False) -> Condition:
        """Check a blob, and return its condition; see `Blobs.condition`."""
        if not DIGEST.fullmatch(digest):
            return "missing"
        try:
            with self.path(digest).open("rb") as file:
                if quick or hashlib.file_digest(file, "sha256").hexdigest() == digest:
                    return "sound"
        except FileNotFoundError:
            return "missing"
        except PermissionError as error:
            raise UnusableStore(
                f"{self.path(digest)}: This user cannot read the blob. Run the command as the "
                "user who owns the data folder."
            ) from error
        except OSError:  # a disk error, or a folder with the name of the blob
            pass
        return "damaged"

    def quarantine(self, digest: str, folder: Path) -> Path | None:
        """Move a damaged blob to a folder, and return its path; see `Blobs.quarantine`."""
        path, place = self.path(digest), folder / f"blob-{digest}"
        make_folder(folder)
        try:
            os.replace(path, place)  # noqa: PTH105  (the one call that is atomic by contract)
        except FileNotFoundError:
            return None
        except OSError as error:
            if error.errno != errno.EXDEV:
                raise
            write_durable(place, path.read_bytes())
            path.unlink()
        for each in (folder, folder.parent, path.parent):
            sync_folder(each)
        return place

    def place(self, digest: str) -> str:
        """Return the path or URL of a blob for messages."""
        return str(self._folder / digest[:2] / digest)

    def entries(self) -> Iterator[BlobEntry]:
        """Yield all files in arbitrary order, except files removed meanwhile."""
        folders = [self._folder]
        while folders:
            with os.scandir(folders.pop()) as entries:
                for entry in entries:
                    path = Path(entry.path)
                    if entry.is_dir(follow_symlinks=False):
                        folders.append(path)
                        continue
                    if path == self._folder / MARK:
                        continue
                    try:
                        changed_at = entry.stat(follow_symlinks=False).st_mtime
                    except FileNotFoundError:
                        continue
                    own = DIGEST.fullmatch(entry.name) and self.path(entry.name) == path
                    part = PART.fullmatch(entry.name) is not None
                    yield BlobEntry(entry.path, entry.name if own else None, changed_at, part)

    def path(self, digest: str) -> Path:
        """Return the path of a blob. Raise ValueError for a text that is not a digest."""
        require_digest(digest)
        return self._folder / digest[:2] / digest
