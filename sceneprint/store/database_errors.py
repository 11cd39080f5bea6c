"""Translation of system and database errors to store errors, and the wait for a starting server.

OSError | error of SQLite or PostgreSQL  -->  StoreFull, ReadOnlyStore, StoreLocked or
UnusableStore
"""

from __future__ import annotations

import errno
import logging
import os
import re
import sqlite3
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from sqlalchemy import URL, Engine
from sqlalchemy.exc import DBAPIError, OperationalError
from sqlalchemy.exc import TimeoutError as AllInUse

from sceneprint.errors import ReadOnlyStore, StoreAway, StoreFull, StoreLocked, UnusableStore

#: Free space, in bytes, below which a failed write is attributed to a full disk.
NO_ROOM = 1 << 20
_FULL = (errno.ENOSPC, errno.EDQUOT)


def unusable(what: str, error: OSError) -> UnusableStore:
    """Return the error for a file or folder that cannot be written.

    Parameters
    ----------
    what : prefix of the message, with the path
    error : system error
    """
    text = f"{what} ({error.strerror})."
    if error.errno in _FULL:
        return StoreFull(f"{text} The disk is full. Free some space.")
    if error.errno == errno.EROFS:
        return ReadOnlyStore(f"{text} It is read-only. Make it writable, or use another folder.")
    return UnusableStore(f"{text} Check the folder and its permissions.")


def database_label(url: URL) -> str:
    """Return the name of a database for messages, without a password."""
    if url.get_backend_name() == "sqlite":
        return repr(url)
    named = url.query.get("host", ())
    hosts = [url.host] if url.host else [named] if isinstance(named, str) else list(named)
    if url.port and url.host:
        hosts = [f"{url.host}:{url.port}"]
    of = f"{url.username}@" if url.username else ""
    return f"postgresql://{of}{','.join(hosts)}/{url.database or ''}"


def fault_of(engine: Engine, error: Exception) -> UnusableStore | None:
    """Return the store error for a database error; None if the error is a bug of the caller."""
    if isinstance(error, DBAPIError):
        translate = _of_sqlite if engine.dialect.name == "sqlite" else _of_server
        return translate(engine.url, error)
    if isinstance(error, AllInUse):
        return StoreLocked(
            f"{database_label(engine.url)}: All connections of this process are in use. "
            "Try again later."
        )
    driver = sys.modules.get("psycopg")  # imported only for PostgreSQL
    if driver is None or not isinstance(error, driver.Error):
        return None
    return explain_error(engine.url, error, isinstance(error, driver.OperationalError))


def _of_server(url: URL, error: DBAPIError) -> UnusableStore | None:
    connecting = error.statement is None
    broken = isinstance(error, OperationalError) or error.connection_invalidated or connecting
    return explain_error(url, error.orig, broken)


def _of_sqlite(url: URL, error: DBAPIError) -> UnusableStore | None:
    """Return the store error for an error of SQLite; None if it is a bug of the caller."""
    if not isinstance(error, OperationalError):
        if "malformed" in str(error.orig) or "not a database" in str(error.orig):
            return UnusableStore(
                f"{url!r}: {_database_message(error)}. Restore the data folder from a copy."
            )
        return None
    what = f"{url!r}: {_database_message(error)}."
    code = getattr(error.orig, "sqlite_errorcode", 0) & 0xFF  # primary error code
    if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
        return StoreLocked(
            f"{what} Another process has been writing for too long. Nothing was stored. Try again "
            "later. Use `fuser` on the file to find the process."
        )
    if code == sqlite3.SQLITE_READONLY:
        return ReadOnlyStore(
            f"{what} The database or its folder is read-only. Make both writable, and start again."
        )
    # SQLite does not report a read-only or full disk for all operations
    disk = _disk_of(url.database) if code in _OF_DISK else None
    if disk is not None and disk.f_flag & os.ST_RDONLY:
        return ReadOnlyStore(
            f"{what} The disk is mounted read-only, possibly after a disk error. Check the system "
            "log, make the disk writable, and start again."
        )
    no_room = disk is not None and disk.f_bavail * disk.f_frsize < NO_ROOM
    if code == sqlite3.SQLITE_FULL or (code == sqlite3.SQLITE_IOERR and no_room):
        return StoreFull(f"{what} The disk is full. Nothing was stored. Free some space.")
    return UnusableStore(
        f"{what} Check that the database exists and is writable, and that the disk has free space."
    )


_OF_DISK = (sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN)


def _disk_of(path: str | None) -> os.statvfs_result | None:
    try:
        return None if path is None else os.statvfs(Path(path).parent)
    except OSError:
        return None


def _database_message(error: DBAPIError) -> str:
    """Return the message of an error on one line."""
    return " ".join(str(error.orig).split())


#: Store error and advice for each PostgreSQL error, by SQLSTATE, SQLSTATE class, or a name that
#: only this module uses.
_FAULTS: dict[str, tuple[type[UnusableStore], str]] = {
    "55P03": (
        StoreLocked,
        "Another process has been writing for too long. Nothing was stored. Try again later. To "
        "find the process, run `SELECT a.pid, a.client_addr, a.state, a.query FROM "
        "pg_stat_activity a JOIN pg_locks l USING (pid) WHERE l.locktype = 'advisory' AND "
        "l.granted`.",
    ),
    "40": (StoreLocked, "The transaction conflicted with another. Nothing was stored. Try again."),
    "53100": (StoreFull, "Nothing was stored. Free some space on the disk of the server."),
    "53300": (
        StoreAway,
        "The server has no free connections. Increase its max_connections, or run fewer "
        "processes. The service tries again.",
    ),
    "53": (UnusableStore, "The server lacks resources. Check its log."),
    "25006": (
        ReadOnlyStore,
        "The server is a standby, or is read-only. Set SCENEPRINT_DATABASE_URL to the primary, or "
        "to all servers with `target_session_attrs=read-write`.",
    ),
    "26": (
        StoreLocked,
        "A prepared statement no longer exists. Nothing was stored. Try again. If the error "
        "persists, a pooler shares connections among clients: connect directly to the server.",
    ),
    "25P03": (UnusableStore, "The transaction was idle for too long. Nothing was stored."),
    "57014": (UnusableStore, "The server took too long. Nothing was stored. Try again later."),
    "57": (StoreAway, "The server was stopped, or is starting. The service tries again."),
    "08": (
        StoreAway,
        "The connection was lost. Check that the server runs. The service tries again.",
    ),
    "28": (UnusableStore, "Check user and password in SCENEPRINT_DATABASE_URL, and pg_hba.conf."),
    "3D000": (UnusableStore, "Create the database, or correct SCENEPRINT_DATABASE_URL."),
    "URL": (UnusableStore, "Correct SCENEPRINT_DATABASE_URL."),
    "plan": (
        StoreLocked,
        "The tables were changed meanwhile. Nothing was stored. Try again.",
    ),
    "42P01": (UnusableStore, "Tables are missing. Restore the database from a copy."),
    "42501": (UnusableStore, "The user does not own the tables. Make it their owner."),
    "58": (UnusableStore, "The server cannot use its files. Check its log."),
    "XX001": (UnusableStore, "Files of the server are damaged. Restore a bundle or a backup."),
    "XX002": (UnusableStore, "An index of the server is damaged. REINDEX the database."),
}
#: Patterns of permanent connection errors, with their key in `_FAULTS`.
_REFUSALS = {
    r"database .+ does not exist": "3D000",
    r"authentication failed|no pg_hba\.conf entry|role .+ does not exist|no password": "28000",
    r"bad value for|invalid (connection option|.+ value|integer value|port number)": "URL",
}
_AWAY = (
    "Check that the server is running and reachable from this machine, and that "
    "SCENEPRINT_DATABASE_URL is correct. The service tries again."
)


def explain_error(url: URL, error: object, broken: bool) -> UnusableStore | None:
    """Return the store error for an error of PostgreSQL; None if it is a bug of the caller.

    Parameters
    ----------
    error : error of psycopg
    broken : whether the connection is broken
    """
    message = " ".join(str(error).split()).rstrip(".")
    state = getattr(error, "sqlstate", None) or ""
    if not state and broken:  # libpq reports no SQLSTATE for a failed connection
        matching = (name for pattern, name in _REFUSALS.items() if re.search(pattern, message))
        state = next(matching, "")
    state = "plan" if is_of_old_plan(error) else state
    kind, what = _FAULTS.get(state) or _FAULTS.get(state[:2]) or (StoreAway, _AWAY)
    if what == _AWAY and not broken:
        return None
    return kind(f"{database_label(url)}: {message:.400}. {what}")


def is_conflict(error: UnusableStore) -> bool:
    """Return whether PostgreSQL aborted a transaction because of a conflict, such as a deadlock."""
    cause = error.__cause__
    state = getattr(getattr(cause, "orig", cause), "sqlstate", None)
    return state is not None and str(state).startswith("40")


def is_of_old_plan(error: object) -> bool:
    """Return whether a prepared statement failed because its tables have changed.

    The SQLSTATE of this error is unspecific, and its text depends on the locale of the server.
    """
    diagnosis = getattr(error, "diag", None)
    return getattr(diagnosis, "source_function", None) == "RevalidateCachedQuery"


log = logging.getLogger(__name__)

T = TypeVar("T")

#: Maximum seconds that a starting process waits for its server.
PATIENCE_S = 60.0
#: Seconds between attempts to connect.
AGAIN_S = 1.0


def open_patiently(
    attempt: Callable[[], T], patience_s: float = PATIENCE_S,
    may_go_on: Callable[[float], bool] | None = None,
) -> T:  # fmt: skip
    """Call `attempt` until the server is reachable, and return the result; log the first failure.

    Parameters
    ----------
    attempt : function that opens the store
    patience_s : maximum duration of all attempts, seconds
    may_go_on : function that waits for a number of seconds, and returns whether to retry; default:
        sleep, and always retry

    Raises
    ------
    StoreAway : If the server is still unreachable after `patience_s`, or `may_go_on` returns False.
    """
    until, logged = time.monotonic() + patience_s, False
    while True:
        try:
            return attempt()
        except StoreAway as error:
            if time.monotonic() + AGAIN_S > until:
                raise
            if not logged:
                log.warning("waiting for the database", extra={"error": str(error)})
                logged = True
            if may_go_on is None:
                time.sleep(AGAIN_S)
            elif not may_go_on(AGAIN_S):
                raise
