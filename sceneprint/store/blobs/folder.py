"""Blobs in a folder: written, synced and renamed, so that they survive the loss of power."""

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

# Who needs blobs kept, and who may remove some: one lock for all processes that share them.
#
# The lock of a process that dies is free at once: the kernel releases that of a file, and the
# server that of a connection.


#: Seconds to wait for the end of a removal: for who has a turn, and for who has none.
TURN_S, REMOVAL_S = 5.0, 25.0
#: Seconds after which a removal is over, whatever became of who removes: it begins no request after
#: REMOVAL_S, and each ends within `object_client.TRIED_S` and `SMALL_S`.
LONGEST_S = 90.0
#: Seconds between two looks at the lock of a folder.
_LOOK_S = 0.01


class Locks(ABC):
    """The lock of some blobs; see `Blobs.kept` and `Blobs.removing`."""

    @abstractmethod
    def kept(self) -> AbstractContextManager[None]:
        """Hold it with others who need all blobs kept."""

    @abstractmethod
    def removing(self) -> AbstractContextManager[bool]:
        """Hold it alone, if that can be had at once."""

    @property
    def outlast_turns(self) -> bool:
        """Whether a removal may go on after the turn in which it began."""
        return False

    def removals(self) -> int | None:
        """A number that any removal changes; None where it cannot be told, or one is under way."""
        return None

    def doubt(self) -> None:  # noqa: B027  (a folder does what it is asked, or does not)
        """Have the removal of this thread stay under way: what was asked for may be done later."""

    def wait(self, digest: str | None, seconds: float) -> None:  # noqa: B027  (most have none)
        """Wait for the end of a removal that outlasts its turn, whether it may or lost it, and not
        for who has died.

        Parameters
        ----------
        digest : the only blob whose removal is waited for; None: any is
        seconds : to wait at most

        Raises
        ------
        StoreLocked : it takes longer.
        UnusableStore : it cannot be told.
        """

    def close(self) -> None:  # noqa: B027  (most hold nothing)
        """Give back what it holds open."""


class FileLocks(Locks):
    """Of the processes of one machine: the lock of a folder, or of a file that is made.

    Parameters
    ----------
    make : make a file there where there is none
    """

    def __init__(self, path: Path, *, make: bool = False) -> None:
        self._path = path
        self._flags = os.O_RDWR | os.O_CREAT if make else os.O_RDONLY | os.O_DIRECTORY

    @contextmanager
    def kept(self) -> Iterator[None]:
        """See `Locks`; UnusableStore where it cannot be locked."""
        try:
            descriptor = self._lock(fcntl.LOCK_SH)
        except OSError as error:
            kind = "folder" if self._flags & os.O_DIRECTORY else "file"
            raise UnusableStore(
                f"{self._path}: the {kind} cannot be locked ({error.strerror}). Stop the "
                "service and copy the data folder as it is."
            ) from error
        try:
            yield
        finally:
            os.close(descriptor)

    @contextmanager
    def removing(self) -> Iterator[bool]:
        """See `Locks`."""
        try:
            descriptor = self._lock(fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:  # held by another, or there are no locks: what stays does no harm
            yield False
            return
        try:
            yield True
        finally:
            os.close(descriptor)

    def wait(self, digest: str | None, seconds: float) -> None:  # noqa: ARG002  (one lock for all)
        """See `Locks`: who removes in its turn may lose that, to a server that waits no longer."""
        until = time.monotonic() + seconds
        while True:
            try:
                os.close(self._lock(fcntl.LOCK_SH | fcntl.LOCK_NB))
            except BlockingIOError:
                pass
            except OSError:  # there are no locks, and so no removals
                return
            else:
                return
            if time.monotonic() > until:
                raise StoreLocked(
                    f"{self._path}: another process removes blobs for longer than {seconds:.0f} s, "
                    "and nothing was stored. Come back later."
                )
            time.sleep(_LOOK_S)

    def _lock(self, how: int) -> int:
        # of this call alone: flock then keeps out other threads as well as other processes
        descriptor = os.open(self._path, self._flags | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, how)
        except BaseException:
            os.close(descriptor)
            raise
        return descriptor


# Blobs: bytes kept under the SHA-256 of their content, durable before anything refers to them.
#
# bytes  --put-->  digest  --get-->  the same bytes, or an error
#
# In a folder (folder.py), or in an object store (object_store.py).

# A blob that comes in parts, such as one that does not fit into memory.


class IncomingBlob:
    """A blob that comes in parts; see `Blobs.incoming`.

    Parameters
    ----------
    file : that it is written to
    what : to say where that fails
    keep : makes it durable under its digest
    """

    def __init__(self, file: BinaryIO | FileIO, what: str, keep: Callable[[str], None]) -> None:
        self._file, self._what, self._keep = file, what, keep
        self._hashed = hashlib.sha256()
        #: Bytes so far.
        self.size = 0

    def write(self, data: bytes) -> None:
        """Add to it."""
        try:
            left = memoryview(data)
            while left:  # a file without a buffer may take a part alone
                left = left[self._file.write(left) or 0 :]
        except OSError as error:
            raise unusable(self._what, error) from error
        self._hashed.update(data)
        self.size += len(data)

    def keep(self) -> str:
        """End it; when this returns it survives the loss of power. Returns its digest."""
        digest = self._hashed.hexdigest()
        try:
            self._keep(digest)
        except OSError as error:
            raise unusable(self._what, error) from error
        return digest


#: What a blob is found to be.
Condition = Literal["sound", "missing", "damaged"]
DIGEST = re.compile(r"[0-9a-f]{64}")
#: Note of whose the blobs are; see `object_store.BucketOwner`.
MARK = "sceneprint.json"


def is_digest(given: object) -> bool:
    """Whether it is the name of a blob, whatever of."""
    return isinstance(given, str) and DIGEST.fullmatch(given) is not None


def require_digest(given: str) -> None:
    """ValueError for what is no digest: it must not become part of a path or a key."""
    if not DIGEST.fullmatch(given):
        raise ValueError(f"{given!r} is no digest")


@dataclass(frozen=True)
class BlobEntry:
    """What lies where blobs are kept.

    Parameters
    ----------
    place : file or key, for people
    digest : of the blob that it is; None where it is none
    changed_at : seconds since 1970
    unfinished : whether a writer writes it, or has left it
    """

    place: str
    digest: str | None
    changed_at: float
    unfinished: bool = False


class Blobs(ABC):
    """Where blobs are kept; safe to share between threads."""

    def __init__(self, locks: Locks) -> None:
        self._locks = locks

    @abstractmethod
    def put(self, data: bytes) -> str:
        """Keep bytes; when this returns nothing that the store promises to survive loses them.

        Returns
        -------
        digest : 64 hexadecimal digits

        Raises
        ------
        StoreFull : there is no room; nothing is left behind.
        UnusableStore : it may not be written, or is not there.
        """

    @abstractmethod
    def incoming(self) -> AbstractContextManager[IncomingBlob]:
        """Take a blob in parts, such as one that does not fit into memory.

        What is not kept by the end of it is removed.

        Raises
        ------
        StoreFull, UnusableStore : as `put`, also from `write` and `keep`.
        """

    @abstractmethod
    def get(self, digest: str) -> bytes:
        """The bytes of a digest, checked against it.

        Raises
        ------
        DamagedBlob : they are missing, or others than were stored.
        UnusableStore : the store is away.
        """

    @abstractmethod
    def open(self, digest: str) -> BinaryIO:
        """A blob as a file that can be sought in, unchecked; FileNotFoundError where it is missing.

        Raises
        ------
        OSError, UnusableStore : it cannot be read, now or later.
        """

    @abstractmethod
    def holds(self, digest: str) -> bool:
        """Whether there is a blob of that digest, and will be for who refers to it.

        Ask in the transaction that refers to it: no removal begins before its commit, and the end
        of one that goes on is waited for.

        Raises
        ------
        StoreLocked : such a removal takes too long.
        UnusableStore : the store is away.
        """

    def ensure(self, digest: str, data: bytes) -> None:
        """Put a blob once more where a removal took it before the commit of what refers to it.

        After that commit, no removal begins that takes it.

        Raises
        ------
        StoreLocked, UnusableStore : see `holds`; also from `put`.
        """
        if not self.holds(digest):
            self.put(data)

    @abstractmethod
    def size(self, digest: str) -> int | None:
        """Bytes of a blob as it lies there, unchecked; None where it is missing."""

    def kept(self) -> AbstractContextManager[None]:
        """See that no blob is removed meanwhile; waits for who is removing some.

        The lock of a process that dies is free at once, however it dies.

        Raises
        ------
        UnusableStore : it cannot be locked.
        """
        return self._locks.kept()

    def removing(self) -> AbstractContextManager[bool]:
        """Hold the right to remove blobs; False where somebody needs them kept, or removes some.

        Ask for it within a writing transaction: removers then come one after the other, and leave
        room between them for who waits in `kept`. Hold it beyond that transaction only where
        `outlast_turns`, and for blobs that it has doomed.
        """
        return self._locks.removing()

    @property
    def outlast_turns(self) -> bool:
        """Whether blobs can be removed after the turn that found nothing to refer to them: who
        comes to refer to one meanwhile waits for that in `holds`.
        """
        return self._locks.outlast_turns

    def wait_for_removal(self, digest: str | None = None, seconds: float = REMOVAL_S) -> None:
        """Wait for the end of a removal that is under way; see `Locks.wait`."""
        if self._locks.removals() is None:
            self._locks.wait(digest, seconds)

    @abstractmethod
    def remove(self, *digests: str) -> None:
        """Forget blobs that nothing refers to; only within `removing`."""

    @abstractmethod
    def condition(self, digest: str, *, quick: bool = False) -> Condition:
        """Whether a blob is as it was stored; read in parts, so that memory is bounded.

        Parameters
        ----------
        digest : of the blob; what is no digest names none
        quick : see only whether it is there

        Raises
        ------
        UnusableStore : it may not be read by this user, or the store is away.
        """

    @abstractmethod
    def quarantine(self, digest: str, folder: Path) -> Path | None:
        """Move what lies under a digest out of the way, durably; None where there is nothing.

        Parameters
        ----------
        digest : of a blob that was found damaged; only within `removing`
        folder : to move it to; made where missing
        """

    @abstractmethod
    def place(self, digest: str) -> str:
        """Where a blob lies, for people to look at."""

    @abstractmethod
    def digests(self) -> Iterator[str]:
        """All blobs, in no order."""

    @abstractmethod
    def entries(self) -> Iterator[BlobEntry]:
        """All that lies where blobs are kept, in no order."""

    @property
    def read_only(self) -> bool:
        """Whether blobs may be read alone, as far as that can be seen without writing."""
        return False

    def check(self) -> None:  # noqa: B027
        """See that a store on the network answers, or did two seconds ago; a folder has nothing
        to be asked.

        Raises
        ------
        UnusableStore : it does not.
        """

    def close(self) -> None:
        """Give back what it holds open."""
        self._locks.close()


#: What a writer that was killed leaves behind.
PART = re.compile(r"\.[0-9a-f]{12}\.part")


class FolderBlobs(Blobs):
    """A folder of blobs, in 256 folders by their first two digits.

    Parameters
    ----------
    folder : made where missing
    make : whether it is

    Raises
    ------
    UnusableStore : it cannot be made.
    """

    def __init__(self, folder: Path, *, make: bool = True) -> None:
        # the folder itself is the lock, so that there is none to make or to clear away
        super().__init__(FileLocks(folder))
        self._folder = folder
        self._durable: set[str] = set()  # folders in it that this process has synced it for
        try:
            if make:
                make_folder(folder)
        except OSError as error:
            raise unusable(f"{folder}: the folder cannot be made", error) from error

    @property
    def read_only(self) -> bool:
        """Whether the folder is there and may not be written, as of a disk that was remounted."""
        return self._folder.is_dir() and not os.access(self._folder, os.W_OK)

    def put(self, data: bytes) -> str:
        """Keep bytes; when this returns they survive the loss of power. See `Blobs.put`."""
        digest = hashlib.sha256(data).hexdigest()
        path = self.path(digest)
        try:  # also where it is there: that one may be damaged, not yet durable, or being removed
            new = self._made(path.parent)
            write_durable(path, data, folder_is_new=new)
        except OSError as error:
            raise unusable(f"{self._folder}: a blob cannot be written", error) from error
        self._durable.add(path.parent.name)
        return digest

    @contextmanager
    def incoming(self) -> Iterator[IncomingBlob]:
        """Take a blob in parts; see `Blobs.incoming`."""
        part = self._folder / f".{secrets.token_hex(6)}.part"
        what = f"{self._folder}: a blob cannot be written"
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
        """Sync a file that is written, and give it the name of its content."""
        os.fsync(file.fileno())
        path = self.path(digest)
        self._made(path.parent)
        os.replace(part, path)  # noqa: PTH105  (the one call that is atomic by contract)
        sync_folder(path.parent)
        sync_folder(self._folder)

    def _made(self, folder: Path) -> bool:
        """See that a folder is there; whether it may not be durable yet."""
        try:
            folder.mkdir(PRIVATE_FOLDER)
        except FileExistsError:
            return folder.name not in self._durable
        return True

    def get(self, digest: str) -> bytes:
        """The bytes of a digest, checked against it; see `Blobs.get`."""
        try:
            data = self.path(digest).read_bytes()
        except OSError as error:
            raise DamagedBlob(
                f"The blob {digest[:12]} cannot be read ({error.strerror}). Restore the data "
                "folder from a copy, or delete the frame and upload it again."
            ) from error
        if hashlib.sha256(data).hexdigest() != digest:
            raise DamagedBlob(
                f"The blob {digest[:12]} is damaged: its content has another hash. Restore the "
                "data folder from a copy, or delete the frame and upload it again."
            )
        return data

    def holds(self, digest: str) -> bool:
        """Whether there is a blob of that digest; see `Blobs.holds`."""
        self._locks.wait(digest, TURN_S)  # a remover that lost its turn may still be at it
        return self.path(digest).exists()

    def size(self, digest: str) -> int | None:
        """Bytes of a blob as it lies there, unchecked; None where it is missing."""
        try:
            return self.path(digest).stat().st_size
        except OSError:
            return None

    def open(self, digest: str) -> BinaryIO:
        """A blob as a file that can be sought in; see `Blobs.open`."""
        return self.path(digest).open("rb")

    def remove(self, *digests: str) -> None:
        """Forget blobs that nothing refers to; only within `removing`."""
        for digest in digests:
            self.path(digest).unlink(missing_ok=True)

    def condition(self, digest: str, *, quick: bool = False) -> Condition:
        """Whether a blob is as it was stored; see `Blobs.condition`."""
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
                f"{self.path(digest)}: may not be read. Run it as the user who owns the data "
                "folder."
            ) from error
        except OSError:  # the disk cannot read it, or a folder has its name
            pass
        return "damaged"

    def quarantine(self, digest: str, folder: Path) -> Path | None:
        """Move what lies under a digest out of the way; see `Blobs.quarantine`."""
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
        """As `path`, whatever keeps the blobs."""
        return str(self._folder / digest[:2] / digest)

    def digests(self) -> Iterator[str]:
        """All blobs, in no order."""
        for folder in self._folder.iterdir():
            if folder.is_dir():
                for name in os.listdir(folder):  # noqa: PTH208  (a path for each would cost)
                    if DIGEST.fullmatch(name):
                        yield name

    def entries(self) -> Iterator[BlobEntry]:
        """All files below the folder, in no order; those that vanish meanwhile are left out."""
        folders = [self._folder]
        while folders:
            with os.scandir(folders.pop()) as found:
                for one in found:
                    path = Path(one.path)
                    if one.is_dir(follow_symlinks=False):
                        folders.append(path)
                        continue
                    if path == self._folder / MARK:
                        continue
                    try:
                        changed_at = one.stat(follow_symlinks=False).st_mtime
                    except FileNotFoundError:
                        continue
                    own = DIGEST.fullmatch(one.name) and self.path(one.name) == path
                    part = PART.fullmatch(one.name) is not None
                    yield BlobEntry(one.path, one.name if own else None, changed_at, part)

    def path(self, digest: str) -> Path:
        """Where a blob lies; ValueError for what is no digest."""
        require_digest(digest)
        return self._folder / digest[:2] / digest
