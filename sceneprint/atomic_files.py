"""Files that are written whole or not at all."""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


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


def write_whole(path: Path, data: bytes) -> None:
    """Put a file there in one step: a process killed here leaves the old one or none.

    Parameters
    ----------
    path : of the file; its folder must exist
    data : all of it

    Raises
    ------
    OSError : it cannot be written; nothing is left behind.
    """
    _put(path, data, durable=False)


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
    """As `write_whole`, and when it returns the file survives the loss of power.

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
    _put(path, data, durable=True)
    sync_folder(path.parent)
    if folder_is_new:
        sync_folder(path.parent.parent)


def make_folder(folder: Path) -> None:
    """Make a folder where it is missing, and those above it; they survive the loss of power.

    Raises
    ------
    OSError : it cannot be made, or is a file.
    """
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for made in missing:
        sync_folder(made.parent)


def _put(path: Path, data: bytes, *, durable: bool) -> None:
    part = _beside(path)
    try:
        with part.open("wb") as file:
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
