"""Files that are written whole or not at all, and who may read what the store makes."""

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


#: Permissions of all that the store makes, whatever the umask: frames are pictures of somebody's
#: rooms, and the database has the hashes of keys.
PRIVATE_FOLDER, PRIVATE_FILE = 0o700, 0o600


def create_private(path: Path) -> int:
    """Create a file that only its owner may read, and open it for reading and writing.

    Returns
    -------
    descriptor : of the empty file

    Raises
    ------
    OSError : it exists, or cannot be created.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
    return os.open(path, flags, PRIVATE_FILE)


def public_mode(folder: Path) -> int | None:
    """The permissions of a folder that users outside its group may read or enter; else None."""
    try:
        mode = stat.S_IMODE(folder.stat().st_mode)
    except OSError:
        return None
    return mode if mode & stat.S_IRWXO else None


def nearest_folder(folder: Path) -> Path:
    """The folder, or the first above it that is there: both are on one disk, once it is made.

    Raises
    ------
    OSError : a folder above it may not be entered.
    """
    folder = folder.absolute()
    return next(one for one in (folder, *folder.parents) if one.is_dir())


def warn_if_public(folder: Path) -> None:
    """Log a warning if users outside the group of a data folder may read it."""
    mode = public_mode(folder)
    if mode is not None:
        log.warning(
            "every user of this machine may read the data folder; `chmod -R o-rwx` ends that",
            extra={"data": str(folder), "permissions": f"{mode:o}"},
        )


def check_writable(path: Path) -> None:
    """See before long work that `write_whole` will be able to write there.

    Raises
    ------
    OSError : it is a folder, or its folder takes no files.
    """
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    part = _beside(path)
    try:
        part.touch()
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(path)) from error
    part.unlink()


def write_whole(path: Path, data: bytes, *, private: bool = False) -> None:
    """Put a file there in one step: a process killed here leaves the old one or none.

    Parameters
    ----------
    path : of the file; its folder must exist
    data : all of it
    private : only its owner may read it; else the umask says who may

    Raises
    ------
    OSError : it cannot be written; nothing is left behind.
    """
    _put(path, data, private=private, durable=False)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A path beside it for a library that writes files itself, such as in several steps.

    What lies there when the block ends takes the file's place; where nothing does, or the block
    fails, all stays as it was, and nothing is left behind.

    Raises
    ------
    OSError : it cannot be put there.
    """
    part = _beside(path)
    try:
        yield part
        if part.exists():
            os.replace(part, path)  # noqa: PTH105  (the one call that is atomic by contract)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def write_durable(path: Path, data: bytes, *, folder_is_new: bool = True) -> None:
    """As `write_whole` of a private file, which survives the loss of power when this returns.

    Parameters
    ----------
    path : of the file; its folder must exist
    data : all of it
    folder_is_new : whether the folder may not be durable itself yet

    Raises
    ------
    OSError : it cannot be written, and nothing is left behind; or the folder cannot be synced, and
        the file is there, but might not survive.
    """
    _put(path, data, private=True, durable=True)
    sync_folder(path.parent)
    if folder_is_new:
        sync_folder(path.parent.parent)


def make_folder(folder: Path) -> None:
    """Make a folder where it is missing, and those above it; they survive the loss of power.

    Only their owner may read what is made here; the permissions of others stay as they are.

    Raises
    ------
    OSError : it cannot be made, or is a file.
    """
    if folder.is_dir():
        return
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    for one in reversed(missing):
        one.mkdir(PRIVATE_FOLDER, exist_ok=True)
    folder.mkdir(PRIVATE_FOLDER, exist_ok=True)  # FileExistsError where it is a file
    for made in missing:
        sync_folder(made.parent)


def put_new(part: Path, path: Path) -> None:
    """Give a file its name where nothing has it; it survives the loss of power after that.

    Raises
    ------
    FileExistsError : something has it.
    """
    try:
        os.link(part, path)
    except FileExistsError:
        raise
    except OSError as error:  # a file system without links
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from error
        part.rename(path)
    else:
        part.unlink()
    sync_folder(path.parent)


@contextmanager
def folder_turn(folder: Path) -> Iterator[bool]:
    """Hold the right to write in a folder, which is made if need be; False where another has it.

    The kernel releases the lock of a process that dies, however it dies.
    """
    make_folder(folder)
    # of this call alone: flock then keeps out other threads as well as other processes
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


def _put(path: Path, data: bytes, *, private: bool, durable: bool) -> None:
    part = _beside(path)
    try:
        with os.fdopen(create_private(part), "wb") if private else part.open("wb") as file:
            file.write(data)
            if durable:  # before its name: a name must never lead to half a file
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
    """Make the names in a folder survive the loss of power.

    Raises
    ------
    OSError : it cannot; names the folder.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(folder)) from error
    finally:
        os.close(descriptor)


def _beside(path: Path) -> Path:
    return path.with_name(f".{secrets.token_hex(6)}.part")  # short: the name may be long already
