"""Folders in which something large is made before it gets its name."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from sceneprint.atomic_files import PRIVATE_FOLDER, create_private, sync_folder
from sceneprint.errors import SnapshotError


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
