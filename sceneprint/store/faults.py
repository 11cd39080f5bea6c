"""What a fault of the machine means for the store, and what to do about it.

OSError | error of SQLite  -->  StoreFull, ReadOnlyStore, StoreLocked or UnusableStore
"""

from __future__ import annotations

import errno
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sqlalchemy import Engine
from sqlalchemy.exc import DBAPIError, OperationalError

from sceneprint.errors import ReadOnlyStore, StoreFull, StoreLocked, UnusableStore

#: Free space below which a write that failed is taken to have failed for want of it, bytes.
NO_ROOM = 1 << 20
_FULL = (errno.ENOSPC, errno.EDQUOT)


def unusable(what: str, error: OSError) -> UnusableStore:
    """A file or folder that cannot be written, in our words.

    Parameters
    ----------
    what : happened, with the place
    error : of the system
    """
    text = f"{what} ({error.strerror})."
    if error.errno in _FULL:
        return StoreFull(f"{text} The disk is full: free some space.")
    if error.errno == errno.EROFS:
        return ReadOnlyStore(f"{text} It is read-only: make it writable, or name another folder.")
    return UnusableStore(f"{text} Check the folder and its permissions.")


@contextmanager
def explained(engine: Engine) -> Iterator[None]:
    """Say which database a fault is about, of what kind it is, and what to do."""
    try:
        yield
    except OperationalError as error:
        raise _of_database(engine, error) from error
    except DBAPIError as error:
        if "malformed" in str(error.orig) or "not a database" in str(error.orig):
            raise UnusableStore(
                f"{engine.url!r}: {_said(error)}. Restore the data folder from a copy."
            ) from error
        raise


def _of_database(engine: Engine, error: OperationalError) -> UnusableStore:
    what = f"{engine.url!r}: {_said(error)}."
    code = getattr(error.orig, "sqlite_errorcode", 0) & 0xFF  # without what it adds in detail
    if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
        return StoreLocked(
            f"{what} Another process has been writing for long, and nothing was stored. Come "
            "back later; `fuser` on the file says who it is."
        )
    if code == sqlite3.SQLITE_READONLY:
        return ReadOnlyStore(
            f"{what} The database or its folder is read-only. Make both writable, and start again."
        )
    no_room = code == sqlite3.SQLITE_IOERR and _no_room(engine.url.database)
    if code == sqlite3.SQLITE_FULL or no_room:
        return StoreFull(f"{what} Nothing was stored. Free some space on its disk.")
    return UnusableStore(
        f"{what} Check that the database is there, that it may be written, and that the disk has "
        "room."
    )


def _no_room(path: str | None) -> bool:
    """Whether the disk of a file is full: SQLite says only of some writes that this is why."""
    try:
        return path is not None and shutil.disk_usage(Path(path).parent).free < NO_ROOM
    except OSError:
        return False


def _said(error: DBAPIError) -> str:
    """What the database said, on one line: it may quote the statement that made a table."""
    return " ".join(str(error.orig).split())
