"""How SQLite is set up: what a connection is told when it opens, and how a transaction begins."""

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

# A SQLite file that may be read and not written: on a read-only disk, or of another user.
#
# SQLite reads a database with a log (`-wal`) only together with the log's index (`-shm`), which it
# cannot make here. Without a log the file is all there is, and is read as it lies, without locks.
# That would be wrong where somebody can write it after all, as through another mount: whether the
# file stayed as it was is looked at after every transaction.


def read_only_file(url: URL) -> Path | None:
    """The file of a SQLite database, if it is there and it, or what is beside it, is read-only."""
    name = url.database or ""
    if url.get_backend_name() != "sqlite" or name in ("", ":memory:") or name.startswith("file:"):
        return None
    path = Path(name).absolute()
    writable = os.access(path, os.W_OK) and os.access(path.parent, os.W_OK)
    return path if path.exists() and not writable else None


def is_read_only(url: str) -> bool:
    """Whether a database may be read alone; False for what is none."""
    try:
        return read_only_file(make_url(url)) is not None
    except (ArgumentError, ValueError):
        return False


class ReadOnlyFile:
    """Reads such a file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def connect(self) -> sqlite3.Connection:
        """Open it in the way that is right at this moment.

        Raises
        ------
        UnusableStore : it was not closed, and cannot be recovered without writing.
        """
        has_log, has_index = self._log(), self._beside("-shm").exists()
        if (has_log and not has_index) or self._beside("-journal").exists():
            raise UnusableStore(
                f"{self._path} was not closed, and on a read-only disk it cannot be recovered. "
                "Open the data folder once where it may be written, or use a copy."
            )
        how = "mode=ro" if has_log else "mode=ro&immutable=1"
        return sqlite3.connect(f"{self._path.as_uri()}?{how}", uri=True, check_same_thread=False)

    def state(self) -> tuple[object, ...]:
        """What must be the same before and after a transaction."""
        if self._log():
            return ()  # SQLite's own locks tell one transaction from another
        try:
            found = self._path.stat()
        except OSError:
            return ("gone",)
        return found.st_mtime_ns, found.st_size, found.st_ino

    def check(self, before: object) -> None:
        """See at the end of a transaction that nobody has written meanwhile.

        Raises
        ------
        UnusableStore : somebody has.
        """
        if self.state() != before:
            raise UnusableStore(
                f"{self._path} was written by somebody else while it was read as unchanging. "
                "Ask again."
            )

    def refusal(self) -> ReadOnlyStore:
        """What a writer is told."""
        return ReadOnlyStore(
            f"{self._path} or its folder is read-only: it is read, and nothing can be stored. "
            "Make both writable for this user, and start again."
        )

    def _log(self) -> bool:
        """Whether there is a log with something in it, or one that somebody has just begun."""
        try:
            size = self._beside("-wal").stat().st_size
        except OSError:
            return False
        return size > 0 or self._beside("-shm").exists()

    def _beside(self, end: str) -> Path:
        return self._path.with_name(self._path.name + end)


#: Seconds a writer waits for another, and waits after somebody has waited so long in vain.
BUSY_S, HELD_S = 10.0, 0.1
#: Seconds between two looks for the lock, and for which a process waits until it is first in line.
LOOK_S, LINE_S = 0.0005, 1.0
#: Seconds for which emptying the log waits for readers: writers wait for it meanwhile.
SHRINKING_S = 0.5


def open_sqlite(url: URL) -> tuple[Engine, ReadOnlyFile | None]:
    """An engine whose connections are told what all are told, and where the file is read alone."""
    path, sealed = read_only_file(url), None
    if path is not None:
        sealed = ReadOnlyFile(path)
        # each transaction opens the file in the way that is right then
        engine = create_engine(url, creator=sealed.connect, poolclass=NullPool)
    else:
        # SQLite waits for a writer itself, fairly enough; readers never wait in WAL
        engine = create_engine(url, connect_args={"timeout": BUSY_S}, pool_size=16, max_overflow=-1)
        event.listen(engine, "do_connect", _create_file)
    event.listen(engine, "connect", configure_sqlite if sealed is None else configure_read_only)
    event.listen(engine, "begin", begin_sqlite)
    return engine, sealed


def _create_file(_dialect: Any, _record: Any, arguments: list[Any], _named: Any) -> None:
    """Create a file that is missing, which SQLite would let others read; its log is as its file.

    It is not opened: closing it would release the locks that this process has on it.
    """
    path = arguments[0] if arguments else ""
    if path in ("", ":memory:") or path.startswith("file:"):
        return
    with suppress(OSError):  # it is there; or it cannot be made, and SQLite says so
        os.mknod(path, stat.S_IFREG | PRIVATE_FILE)


def configure_sqlite(connection: Any, _record: Any) -> None:
    """Tell a connection that may write what all of them are told."""
    connection.isolation_level = None  # transactions begin where `begin_sqlite` says
    for pragma in (
        "journal_mode = WAL",
        "synchronous = FULL",  # a commit that was acknowledged survives the power
        "foreign_keys = ON",
        "secure_delete = ON",  # what is deleted is written over, in pages that are given up too
        f"busy_timeout = {_milliseconds(BUSY_S)}",
        "cache_size = -32000",
    ):
        connection.execute(f"PRAGMA {pragma}").close()


def shrink_log(connection: Any) -> bool:
    """Empty the log when all that is in it is in the file; False where somebody is in the way.

    Else pages as they once were stay in it for as long as nothing is written over them.
    """
    connection.execute(f"PRAGMA busy_timeout = {_milliseconds(SHRINKING_S)}").close()
    try:
        busy, _, _ = connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
    finally:
        connection.execute(f"PRAGMA busy_timeout = {_milliseconds(BUSY_S)}").close()
    return not busy


def configure_read_only(connection: Any, _record: Any) -> None:
    """Tell a connection to a file that may be read alone."""
    connection.isolation_level = None


def begin_sqlite(connection: Connection) -> None:
    """Begin a transaction: of a writer at once with the lock, for which it waits so long."""
    wait_s: float | None = connection.get_execution_options().get("sceneprint_write")
    if wait_s is None:
        connection.exec_driver_sql("BEGIN")
        return
    if connection.get_execution_options().get("sceneprint_unchecked"):
        connection.exec_driver_sql("PRAGMA foreign_keys = OFF")  # within a transaction it is late
    # a reader that turns writer half way would fail where another wrote in between
    line: WriterLine | None = connection.get_execution_options().get("sceneprint_line")
    with nullcontext() if line is None else line.first(min(wait_s, LINE_S)):
        _begin_immediate(connection, wait_s)


def _begin_immediate(connection: Connection, wait_s: float) -> None:
    """Take the lock. SQLite itself would look for it less and less often, up to 0.1 s apart."""
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
    """Where processes that want to write stand in line: one at a time waits for SQLite's lock.

    Else that would go to whoever looks at the right moment: to a service that writes without a
    pause, and a worker would wait for seconds. What a process does that knows no line is right,
    and not fair.

    Parameters
    ----------
    folder : of the database; its lock is the place at the head of the line
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._descriptor: int | None = None

    @contextmanager
    def first(self, longest_s: float) -> Iterator[None]:
        """Be the first in line, or have waited so long: the first may have been stopped."""
        descriptor = self._open()
        if descriptor is None or not _locked(descriptor, longest_s):
            yield
            return
        try:
            yield
        finally:
            fcntl.flock(descriptor, fcntl.LOCK_UN)

    def close(self) -> None:
        """Leave the folder."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)

    def _open(self) -> int | None:
        if self._descriptor is None:
            with suppress(OSError):  # without a line it works too
                how = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
                self._descriptor = os.open(self._folder, how)
        return self._descriptor


def _locked(descriptor: int, longest_s: float) -> bool:
    until = time.monotonic() + longest_s
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= until:
                return False
            time.sleep(LOOK_S)
        except OSError:  # the file system has no locks
            return False
        else:
            return True


def _milliseconds(seconds: float) -> int:
    return int(1000 * seconds)
