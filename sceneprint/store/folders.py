"""Blobs in a folder: written, synced and renamed, so that they survive the loss of power."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import BinaryIO

from sceneprint.errors import DamagedBlob, UnusableStore
from sceneprint.store.blobs import DIGEST, BlobEntry, Condition, require_digest
from sceneprint.store.faults import unusable
from sceneprint.store.incoming import IncomingBlob
from sceneprint.store.locks import FileLocks
from sceneprint.writing import make_folder, sync_folder, write_durable

#: What a writer that was killed leaves behind.
PART = re.compile(r"\.[0-9a-f]{12}\.part")


class FolderBlobs:
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
        self._folder = folder
        # the folder itself is the lock, so that there is none to make or to clear away
        self._locks = FileLocks(folder)
        self._durable: set[str] = set()  # folders in it that this process has synced it for
        try:
            if make:
                make_folder(folder)
        except OSError as error:
            raise unusable(f"{folder}: the folder cannot be made", error) from error

    def put(self, data: bytes) -> str:
        """Keep bytes; when this returns they survive the loss of power.

        Returns
        -------
        digest : 64 hexadecimal digits

        Raises
        ------
        StoreFull : the disk is full; nothing is left behind.
        UnusableStore : it may not be written, or is not there.
        """
        digest = hashlib.sha256(data).hexdigest()
        path = self._path(digest)
        try:  # also where it is there: that one may be damaged, not yet durable, or being removed
            new = self._made(path.parent)
            write_durable(path, data, folder_is_new=new)
        except OSError as error:
            raise unusable(f"{self._folder}: a blob cannot be written", error) from error
        self._durable.add(path.parent.name)
        return digest

    @contextmanager
    def incoming(self) -> Iterator[IncomingBlob]:
        """Take a blob in parts, such as one that does not fit into memory.

        What is not kept by the end of it is removed.

        Raises
        ------
        StoreFull, UnusableStore : as `put`, also from `write` and `keep`.
        """
        part = self._folder / f".{secrets.token_hex(6)}.part"
        what = f"{self._folder}: a blob cannot be written"
        try:
            file = part.open("xb", buffering=0)
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
        path = self._path(digest)
        self._made(path.parent)
        os.replace(part, path)  # noqa: PTH105  (the one call that is atomic by contract)
        sync_folder(path.parent)
        sync_folder(self._folder)

    def _made(self, folder: Path) -> bool:
        """See that a folder is there; whether it may not be durable yet."""
        try:
            folder.mkdir()
        except FileExistsError:
            return folder.name not in self._durable
        return True

    def get(self, digest: str) -> bytes:
        """The bytes of a digest, checked against it.

        Raises
        ------
        DamagedBlob : they are missing, or others than were stored.
        """
        try:
            data = self._path(digest).read_bytes()
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
        """Whether there is a blob of that digest."""
        return self._path(digest).exists()

    def size(self, digest: str) -> int | None:
        """Bytes of a blob as it lies there, unchecked; None where it is missing."""
        try:
            return self._path(digest).stat().st_size
        except OSError:
            return None

    def open(self, digest: str) -> BinaryIO:
        """A blob as a file that can be sought in, unchecked; FileNotFoundError where it is missing.

        Raises
        ------
        OSError : it cannot be read.
        """
        return self._path(digest).open("rb")

    def kept(self) -> AbstractContextManager[None]:
        """See that no blob is removed meanwhile; waits for who is removing some.

        Raises
        ------
        UnusableStore : the folder cannot be locked.
        """
        return self._locks.kept()

    def removing(self) -> AbstractContextManager[bool]:
        """Hold the right to remove blobs; see `Blobs.removing`."""
        return self._locks.removing()

    def remove(self, digest: str) -> None:
        """Forget a blob that nothing refers to; only within `removing`."""
        self._path(digest).unlink(missing_ok=True)

    def condition(self, digest: str, *, quick: bool = False) -> Condition:
        """Whether a blob is as it was stored; read in parts, so that memory is bounded.

        Parameters
        ----------
        digest : of the blob; what is no digest names none
        quick : see only whether it is there

        Raises
        ------
        UnusableStore : it may not be read by this user.
        """
        if not DIGEST.fullmatch(digest):
            return "missing"
        try:
            with self._path(digest).open("rb") as file:
                if quick or hashlib.file_digest(file, "sha256").hexdigest() == digest:
                    return "sound"
        except FileNotFoundError:
            return "missing"
        except PermissionError as error:
            raise UnusableStore(
                f"{self._path(digest)}: may not be read. Run it as the user who owns the data "
                "folder."
            ) from error
        except OSError:  # the disk cannot read it, or a folder has its name
            pass
        return "damaged"

    def quarantine(self, digest: str, folder: Path) -> Path | None:
        """Move what lies under a digest out of the way, durably; None where there is nothing.

        Parameters
        ----------
        digest : of a blob that was found damaged; only within `removing`
        folder : to move it to; made where missing
        """
        path, place = self._path(digest), folder / f"blob-{digest}"
        folder.mkdir(parents=True, exist_ok=True)
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

    def path(self, digest: str) -> Path:
        """Where a blob lies, for people to look at."""
        return self._folder / digest[:2] / digest

    def place(self, digest: str) -> str:
        """As `path`, whatever keeps the blobs."""
        return str(self.path(digest))

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
                    try:
                        changed_at = one.stat(follow_symlinks=False).st_mtime
                    except FileNotFoundError:
                        continue
                    own = DIGEST.fullmatch(one.name) and self.path(one.name) == path
                    part = PART.fullmatch(one.name) is not None
                    yield BlobEntry(one.path, one.name if own else None, changed_at, part)

    def check(self) -> None:
        """There is nothing to be asked."""

    def close(self) -> None:
        """Nothing is held open."""

    def _path(self, digest: str) -> Path:
        require_digest(digest)
        return self._folder / digest[:2] / digest
