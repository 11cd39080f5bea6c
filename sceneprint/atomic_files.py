"""Atomic and durable file writes, and the permissions of the store's files."""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

log = logging.getLogger(__name__)


#: Permissions of the store's folders and files, regardless of the umask: frames show private rooms,
#: and the database contains hashes of keys.
PRIVATE_FOLDER, PRIVATE_FILE = 0o700, 0o600


def create_private(path: Path) -> int:
    """Create a file that only its owner may read; return a descriptor for reading and writing.

    Raises
    ------
    OSError : If the file exists or cannot be created
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
    return os.open(path, flags, PRIVATE_FILE)


def public_mode(folder: Path) -> int | None:
    """Return a folder's mode if users outside its group may access it, else None."""
    try:
        mode = stat.S_IMODE(folder.stat().st_mode)
    except OSError:
        return None
    return mode if mode & stat.S_IRWXO else None


def nearest_folder(folder: Path) -> Path:
    """Return the folder or its nearest existing parent, to examine the disk of a future folder.

    Raises
    ------
    OSError : If the process has no permission to enter a parent folder
    """
    folder = folder.absolute()
    return next(parent for parent in (folder, *folder.parents) if parent.is_dir())


def warn_if_public(folder: Path) -> None:
    """Log a warning if users outside the group of a data folder may read it."""
    mode = public_mode(folder)
    if mode is not None:
        log.warning(
            "all users of this machine may read the data folder; `chmod -R o-rwx` prevents this",
            extra={"data": str(folder), "permissions": f"{mode:o}"},
        )


def check_writable(path: Path) -> None:
    """Check, before a long computation, that `write_whole` will be able to write a file.

    Raises
    ------
    OSError : If the path is a folder, or no file can be created in its parent folder
    """
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    part = _temporary_path(path)
    try:
        part.touch()
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(path)) from error
    part.unlink()


def write_whole(path: Path, data: bytes, *, private: bool = False) -> None:
    """Write a file atomically: if the process is killed, any previous file is unchanged.

    Parameters
    ----------
    path : path of the file; its folder must exist
    data : content of the file
    private : whether only the owner may read the file; otherwise the umask applies

    Raises
    ------
    OSError : If the file cannot be written. No partial file remains.
    """
    _write_file(path, data, private=private, durable=False)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path for a library that writes files itself; then move its file to `path`.

    If the block writes no file or raises an exception, any previous file is unchanged.

    Raises
    ------
    OSError : If the file cannot be replaced
    """
    part = _temporary_path(path)
    try:
        yield part
        if part.exists():
            os.replace(part, path)  # noqa: PTH105  (the one call that is atomic by contract)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def write_durable(path: Path, data: bytes, *, folder_is_new: bool = True) -> None:
    """Write a private file atomically and durably: once this returns, it survives a loss of power.

    Parameters
    ----------
    path : path of the file; its folder must exist
    data : content of the file
    folder_is_new : whether the folder may be new, so that its parent must be synced too

    Raises
    ------
    OSError : If the file cannot be written, or its folder cannot be synced. In the latter case the
        file exists, but may be lost.
    """
    _write_file(path, data, private=True, durable=True)
    sync_folder(path.parent)
    if folder_is_new:
        sync_folder(path.parent.parent)


def make_folder(folder: Path) -> None:
    """Create a folder and its missing parents durably.

    Only the owner may read new folders; the permissions of existing folders are not changed.

    Raises
    ------
    OSError : If the folder cannot be created or is a file
    """
    if folder.is_dir():
        return
    missing = [parent for parent in (folder, *folder.parents) if not parent.exists()]
    for parent in reversed(missing):
        parent.mkdir(PRIVATE_FOLDER, exist_ok=True)
    folder.mkdir(PRIVATE_FOLDER, exist_ok=True)  # raises FileExistsError for a file
    for parent in missing:
        sync_folder(parent.parent)


def put_new(part: Path, path: Path) -> None:
    """Move a file, durably, to a path that must not exist.

    Raises
    ------
    FileExistsError : If the path exists
    """
    try:
        os.link(part, path)
    except FileExistsError:
        raise
    except OSError as error:  # the file system has no hard links
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from error
        part.rename(path)
    else:
        part.unlink()
    sync_folder(path.parent)


@contextmanager
def folder_turn(folder: Path) -> Iterator[bool]:
    """Lock a folder, created if missing, during the block; yield False if it is already locked."""
    make_folder(folder)
    # flock on a new descriptor also excludes other threads of this process
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC
    descriptor = os.open(folder / ".lock", flags, PRIVATE_FILE)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        else:
            yield True
    finally:
        os.close(descriptor)


def _write_file(path: Path, data: bytes, *, private: bool, durable: bool) -> None:
    part = _temporary_path(path)
    try:
        with os.fdopen(create_private(part), "wb") if private else part.open("wb") as file:
            file.write(data)
            if durable:  # the content must be durable before its name
                file.flush()
                os.fsync(file.fileno())
        os.replace(part, path)  # noqa: PTH105  (the one call that is atomic by contract)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise type(error)(error.errno, error.strerror, str(path)) from error
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def sync_folder(folder: Path) -> None:
    """Sync a folder, so that its entries survive a loss of power.

    Raises
    ------
    OSError : If the folder cannot be synced
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(folder)) from error
    finally:
        os.close(descriptor)


def _temporary_path(path: Path) -> Path:
    return path.with_name(
        f".{secrets.token_hex(6)}.part"
    )  # a suffix could make the name of `path` too long
