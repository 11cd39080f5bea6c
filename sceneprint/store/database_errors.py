"""What a fault of the machine means for the store, what to do about it, and waiting for its end.

OSError | error of SQLite or PostgreSQL  -->  StoreFull, ReadOnlyStore, StoreLocked or UnusableStore

A store whose server is away is opened patiently: what is started beside it may be there before it.
"""

from __future__ import annotations

import errno
import logging
import os
import re
import shutil
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


def database_label(url: URL) -> str:
    """Which database a URL is of, to be told: without a password, wherever the URL has it."""
    if url.get_backend_name() == "sqlite":
        return repr(url)
    named = url.query.get("host", ())
    hosts = [url.host] if url.host else [named] if isinstance(named, str) else list(named)
    if url.port and url.host:
        hosts = [f"{url.host}:{url.port}"]
    of = f"{url.username}@" if url.username else ""
    return f"postgresql://{of}{','.join(hosts)}/{url.database or ''}"


def fault_of(engine: Engine, error: Exception) -> UnusableStore | None:
    """What an error of a database means for the store; None: it is no fault of the machine."""
    if isinstance(error, DBAPIError):
        known = _of_sqlite if engine.dialect.name == "sqlite" else _of_server
        return known(engine.url, error)
    if isinstance(error, AllInUse):
        return StoreLocked(
            f"{database_label(engine.url)}: all connections that a process may have are in use. "
            "Come back later."
        )
    driver = sys.modules.get("psycopg")  # over a connection that is not SQLAlchemy's
    if driver is None or not isinstance(error, driver.Error):  # on SQLite it is never loaded
        return None
    return explain_error(engine.url, error, isinstance(error, driver.OperationalError))


def _of_server(url: URL, error: DBAPIError) -> UnusableStore | None:
    connecting = error.statement is None  # what psycopg says of a URL is a mistake of the URL
    broken = isinstance(error, OperationalError) or error.connection_invalidated or connecting
    return explain_error(url, error.orig, broken)


def _of_sqlite(url: URL, error: DBAPIError) -> UnusableStore | None:
    if not isinstance(error, OperationalError):
        if "malformed" in str(error.orig) or "not a database" in str(error.orig):
            return UnusableStore(
                f"{url!r}: {_database_message(error)}. Restore the data folder from a copy."
            )
        return None
    what = f"{url!r}: {_database_message(error)}."
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
    if code in (sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN) and _turned_read_only(url.database):
        return ReadOnlyStore(
            f"{what} Its disk is mounted read-only, as after an error of the disk. Look into the "
            "system's log, make the disk writable, and start again."
        )
    no_room = code == sqlite3.SQLITE_IOERR and _no_room(url.database)
    if code == sqlite3.SQLITE_FULL or no_room:
        return StoreFull(f"{what} Nothing was stored. Free some space on its disk.")
    return UnusableStore(
        f"{what} Check that the database is there, that it may be written, and that the disk has "
        "room."
    )


def _turned_read_only(path: str | None) -> bool:
    """Whether the disk of a file is mounted read-only by now: SQLite says `disk I/O error`."""
    try:
        return path is not None and bool(os.statvfs(Path(path).parent).f_flag & os.ST_RDONLY)
    except OSError:
        return False


def _no_room(path: str | None) -> bool:
    """Whether the disk of a file is full: SQLite says only of some writes that this is why."""
    try:
        return path is not None and shutil.disk_usage(Path(path).parent).free < NO_ROOM
    except OSError:
        return False


def _database_message(error: DBAPIError) -> str:
    """What the database said, on one line: it may quote the statement that made a table."""
    return " ".join(str(error.orig).split())


#: What faults of PostgreSQL mean, by their SQLSTATE or by what it begins with, or by their class.
_MEANT: dict[str, tuple[type[UnusableStore], str]] = {
    "55P03": (
        StoreLocked,
        "Another process has been writing for long, and nothing was stored. Come back later; "
        "`SELECT a.pid, a.client_addr, a.state, a.query FROM pg_stat_activity a JOIN pg_locks l "
        "USING (pid) WHERE l.locktype = 'advisory' AND l.granted` says who it is.",
    ),
    "40": (StoreLocked, "Another transaction was in the way, and nothing was stored. Come back."),
    "53100": (StoreFull, "Nothing was stored. Free some space on the disk of the server."),
    "53300": (
        StoreAway,
        "The server has as many connections as it may. Raise its max_connections, or run fewer "
        "processes; it is tried again.",
    ),
    "53": (UnusableStore, "The server lacks what it needs. Look into its log."),
    "25006": (
        ReadOnlyStore,
        "The server is a standby, or is set to be read alone. Name the one that writes in "
        "SCENEPRINT_DATABASE_URL, or all with `target_session_attrs=read-write`.",
    ),
    "26": (
        StoreLocked,
        "A prepared statement is gone, and nothing was stored. Come back. Where this goes on, a "
        "pooler gives one connection to several clients: connect to the server itself.",
    ),
    "25P03": (UnusableStore, "This transaction was silent for long, and nothing was stored."),
    "57014": (UnusableStore, "The server took too long, and nothing was stored. Come back later."),
    "57": (StoreAway, "The server was stopped, or is starting. It is tried again."),
    "08": (StoreAway, "The connection was lost. See that the server runs; it is tried again."),
    "28": (UnusableStore, "Check user and password in SCENEPRINT_DATABASE_URL, and pg_hba.conf."),
    "3D000": (UnusableStore, "Make the database, or name another in SCENEPRINT_DATABASE_URL."),
    "URL": (UnusableStore, "Correct SCENEPRINT_DATABASE_URL."),
    "plan": (StoreLocked, "Tables were changed meanwhile, and nothing was stored. Come back."),
    # not ours to have asked for: it was there when this process began
    "42P01": (UnusableStore, "Its tables are not there, or no longer. Restore it from a copy."),
    "42501": (UnusableStore, "The user must own the database's tables: grant what is missing."),
    "58": (UnusableStore, "The server has trouble with its files. Look into its log."),
    "XX001": (UnusableStore, "The server's files are damaged. Restore a bundle or a backup."),
    "XX002": (UnusableStore, "An index of the server is damaged. REINDEX the database."),
}
#: What is no good until somebody changes it, of what is said when a connection is opened.
_REFUSALS = {
    r"database .+ does not exist": "3D000",
    r"authentication failed|no pg_hba\.conf entry|role .+ does not exist|no password": "28000",
    r"bad value for|invalid (connection option|.+ value|integer value|port number)": "URL",
}
_AWAY = (
    "See that the server runs and can be reached from here, and that SCENEPRINT_DATABASE_URL is "
    "right; it is tried again."
)


def explain_error(url: URL, error: object, broken: bool) -> UnusableStore | None:
    """A fault of PostgreSQL in our words; None where it is a mistake of whoever asked.

    Parameters
    ----------
    error : of psycopg
    broken : whether it is of a kind that no other statement would have been spared
    """
    said = " ".join(str(error).split()).rstrip(".")
    state = getattr(error, "sqlstate", None) or (_state_of(said) if broken else "")
    state = "plan" if is_of_old_plan(error) else state
    kind, what = _MEANT.get(state) or _MEANT.get(state[:2]) or (StoreAway, _AWAY)
    if what == _AWAY and not broken:
        return None
    return kind(f"{database_label(url)}: {said:.400}. {what}")


def is_conflict(error: UnusableStore) -> bool:
    """Whether PostgreSQL gave up a transaction for the sake of another, such as in a deadlock."""
    cause = error.__cause__
    state = getattr(getattr(cause, "orig", cause), "sqlstate", None)
    return state is not None and str(state).startswith("40")


def is_of_old_plan(error: object) -> bool:
    """Whether a statement was prepared for tables that have other columns by now.

    Its SQLSTATE is that of all that is not supported, and its text in the server's language.
    """
    diagnosis = getattr(error, "diag", None)
    return getattr(diagnosis, "source_function", None) == "RevalidateCachedQuery"


def _state_of(said: str) -> str:
    """The SQLSTATE of what a server said that let nobody in: libpq does not tell it."""
    known = (state for pattern, state in _REFUSALS.items() if re.search(pattern, said))
    return next(known, "")


log = logging.getLogger(__name__)

T = TypeVar("T")

#: Seconds that who is started waits for a server before it gives up, and says why.
PATIENCE_S = 60.0
#: Seconds between two tries.
AGAIN_S = 1.0


def open_patiently(
    attempt: Callable[[], T], patience_s: float = PATIENCE_S,
    may_go_on: Callable[[float], bool] | None = None,
) -> T:  # fmt: skip
    """What an attempt opens, as soon as its server answers; other faults are raised at once.

    Parameters
    ----------
    attempt : opens it
    patience_s : seconds to wait at most
    may_go_on : waits so many seconds, and says whether to try again; default: it always is

    Raises
    ------
    StoreAway : the server is away, and was waited for.
    """
    until, said = time.monotonic() + patience_s, False
    while True:
        try:
            return attempt()
        except StoreAway as error:
            if time.monotonic() + AGAIN_S > until:
                raise
            if not said:
                log.warning("waiting for the database", extra={"error": str(error)})
                said = True
            if may_go_on is None:
                time.sleep(AGAIN_S)
            elif not may_go_on(AGAIN_S):
                raise
