"""SQLite: connections, transactions, and the order of writers."""

from __future__ import annotations

import fcntl
import os
import sqlite3
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, Engine, NullPool, create_engine, event, make_url
from sqlalchemy.exc import ArgumentError, OperationalError

from sceneprint.atomic_files import PRIVATE_FILE
from sceneprint.errors import ReadOnlyStore, UnusableStore

# Read-only SQLite files: on a read-only disk, or of another user.
#
# To read a database with a log (`-wal`), SQLite needs the index of the log (`-shm`), which it
# cannot create on a read-only disk. Without a log, the file is complete and is read without locks.
# Another process may still write to it, for example through another mount, so each transaction
# checks the file at its end.


def read_only_file(url: URL) -> Path | None:
    """Return the file of a SQLite database if the file or its folder is read-only, else None."""
    name = url.database or ""
    if url.get_backend_name() != "sqlite" or name in ("", ":memory:") or name.startswith("file:"):
        return None
    path = Path(name).absolute()
    writable = os.access(path, os.W_OK) and os.access(path.parent, os.W_OK)
    return path if path.exists() and not writable else None


def is_read_only(url: str) -> bool:
    """Return whether a URL refers to a read-only SQLite file."""
    try:
        return read_only_file(make_url(url)) is not None
    except (ArgumentError, ValueError):
        return False


class ReadOnlyFile:
    """Reader of a read-only SQLite file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def connect(self) -> sqlite3.Connection:
        """Open the file; use locks only if it has a log.

        Raises
        ------
        UnusableStore : If the file was not closed, so that it needs a recovery, that is, a write.
        """
        has_log, has_index = self._log(), self._beside("-shm").exists()
        if (has_log and not has_index) or self._beside("-journal").exists():
            raise UnusableStore(
                f"{self._path} was not closed properly, and cannot be recovered on a read-only "
                "disk. Open the data folder once from a writable disk, or use a copy."
            )
        how = "mode=ro" if has_log else "mode=ro&immutable=1"
        return sqlite3.connect(f"{self._path.as_uri()}?{how}", uri=True, check_same_thread=False)

    def state(self) -> tuple[object, ...]:
        """Return values that change if another process writes during a transaction."""
        if self._log():
            return ()  # the transaction has locks
        try:
            status = self._path.stat()
        except OSError:
            return ("gone",)
        return status.st_mtime_ns, status.st_size, status.st_ino

    def check(self, before: object) -> None:
        """Check at the end of a transaction that no process has written to the file.

        Raises
        ------
        UnusableStore : If `state` has changed from `before`.
        """
        if self.state() != before:
            raise UnusableStore(
                f"Another process wrote to {self._path} while it was read without locks. Try again."
            )

    def refusal(self) -> ReadOnlyStore:
        """Return the error for attempts to write."""
        return ReadOnlyStore(
            f"{self._path} or its folder is read-only, so nothing can be stored. Make both "
            "writable for this user, and start again."
        )

    def _log(self) -> bool:
        """Return whether the log has content or is new."""
        try:
            size = self._beside("-wal").stat().st_size
        except OSError:
            return False
        return size > 0 or self._beside("-shm").exists()

    def _beside(self, end: str) -> Path:
        return self._path.with_name(self._path.name + end)


#: Maximum seconds that a writer waits for other writers: usually, and after one has timed out.
BUSY_S, HELD_S = 10.0, 0.1
#: Seconds between attempts to acquire the lock, and maximum seconds that a writer stays in line.
LOOK_S, LINE_S = 0.0005, 1.0
#: Maximum seconds that emptying the log waits for readers; meanwhile, writers wait.
SHRINKING_S = 0.5


def open_sqlite(url: URL) -> tuple[Engine, ReadOnlyFile | None]:
    """Return a configured engine, and the file if it is read-only."""
    path, sealed = read_only_file(url), None
    if path is not None:
        sealed = ReadOnlyFile(path)
        # open the file for each transaction, with or without locks
        engine = create_engine(url, creator=sealed.connect, poolclass=NullPool)
    else:
        engine = create_engine(url, connect_args={"timeout": BUSY_S}, pool_size=16, max_overflow=-1)
        event.listen(engine, "do_connect", _create_file)
    event.listen(engine, "connect", configure_sqlite if sealed is None else configure_read_only)
    event.listen(engine, "begin", begin_sqlite)
    return engine, sealed


def _create_file(_dialect: Any, _record: Any, arguments: list[Any], _named: Any) -> None:
    """Create a missing file that only this user can read; SQLite copies the mode to the log.

    The file is not opened, because closing it would release the locks of this process on it.
    """
    path = arguments[0] if arguments else ""
    if path in ("", ":memory:") or path.startswith("file:"):
        return
    with suppress(OSError):  # SQLite reports errors later
        os.mknod(path, stat.S_IFREG | PRIVATE_FILE)


def configure_sqlite(connection: Any, _record: Any) -> None:
    """Configure a connection that may write."""
    connection.isolation_level = None  # `begin_sqlite` begins transactions
    for pragma in (
        "journal_mode = WAL",
        "synchronous = FULL",  # an acknowledged commit survives a power failure
        "foreign_keys = ON",
        "secure_delete = ON",  # deleted data is overwritten
        f"busy_timeout = {_milliseconds(BUSY_S)}",
        "cache_size = -32000",
    ):
        connection.execute(f"PRAGMA {pragma}").close()


def shrink_log(connection: Any) -> bool:
    """Empty the log with a checkpoint; return False if another process prevents it.

    Otherwise, the log contains old versions of pages until they are overwritten.
    """
    connection.execute(f"PRAGMA busy_timeout = {_milliseconds(SHRINKING_S)}").close()
    try:
        busy, _, _ = connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
    finally:
        connection.execute(f"PRAGMA busy_timeout = {_milliseconds(BUSY_S)}").close()
    return not busy


def configure_read_only(connection: Any, _record: Any) -> None:
    """Configure a connection to a read-only file."""
    connection.isolation_level = None


def begin_sqlite(connection: Connection) -> None:
    """Begin a transaction; if it writes, first wait for the lock and acquire it."""
    wait_s: float | None = connection.get_execution_options().get("sceneprint_write")
    if wait_s is None:
        connection.exec_driver_sql("BEGIN")
        return
    if connection.get_execution_options().get("sceneprint_unchecked"):
        connection.exec_driver_sql("PRAGMA foreign_keys = OFF")  # no effect within a transaction
    # lock at once: after a read, a write fails if another process has written in between
    line: WriterLine | None = connection.get_execution_options().get("sceneprint_line")
    with nullcontext() if line is None else line.first(min(wait_s, LINE_S)):
        _begin_immediate(connection, wait_s)


def _begin_immediate(connection: Connection, wait_s: float) -> None:
    """Acquire the lock by frequent attempts, since SQLite waits up to 0.1 s between attempts."""
    until = time.monotonic() + wait_s
    connection.exec_driver_sql("PRAGMA busy_timeout = 0")
    try:
        while True:
            try:
                connection.exec_driver_sql("BEGIN IMMEDIATE")
            except OperationalError as error:
                busy = getattr(error.orig, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_BUSY
                if not busy or time.monotonic() >= until:
                    raise
            else:
                return
            time.sleep(LOOK_S)
    finally:
        connection.exec_driver_sql(f"PRAGMA busy_timeout = {_milliseconds(BUSY_S)}")


class WriterLine:
    """Line of writing processes; only the first in line waits for the lock of SQLite.

    Without the line, a service that writes continuously would usually get the lock, and a worker
    would wait for seconds. Processes that do not use the line are safe, but not fair.

    Parameters
    ----------
    folder : folder of the database; its file lock is the first place in the line
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._descriptor: int | None = None

    @contextmanager
    def first(self, longest_s: float) -> Iterator[None]:
        """Hold the first place in line; continue without it if it stays taken for `longest_s`."""
        descriptor = self._open()
        if descriptor is None or not _acquire(descriptor, longest_s):
            yield
            return
        try:
            yield
        finally:
            fcntl.flock(descriptor, fcntl.LOCK_UN)

    def close(self) -> None:
        """Close the descriptor of the folder."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)

    def _open(self) -> int | None:
        if self._descriptor is None:
            with suppress(OSError):
                flags = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
                self._descriptor = os.open(self._folder, flags)
        return self._descriptor


def _acquire(descriptor: int, longest_s: float) -> bool:
    until = time.monotonic() + longest_s
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= until:
                return False
            time.sleep(LOOK_S)
        except OSError:  # the file system does not support locks
            return False
        else:
            return True


def _milliseconds(seconds: float) -> int:
    return int(1000 * seconds)
