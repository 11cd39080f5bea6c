"""Signals that wake workers after a job is committed: FIFOs with SQLite, NOTIFY of PostgreSQL.

Each waiting worker creates a FIFO in a folder, and a ring writes a byte to each FIFO. Rings are
only hints: workers also poll, because a file system may lack FIFOs, and a worker may run on another
machine. Functions of this module therefore raise no errors.
"""

from __future__ import annotations

import logging
import os
import select
import socket
import stat
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from sqlalchemy import Connection, text

from sceneprint.atomic_files import make_folder
from sceneprint.errors import SceneprintError
from sceneprint.store.database import Database

if TYPE_CHECKING:
    import psycopg


#: Seconds after which an abandoned FIFO is removed, and seconds between touches of a FIFO in use.
STALE_S, ALIVE_S = 300.0, 60.0
#: Polling interval of a worker without a FIFO, seconds.
DEAF_S = 0.25
#: Maximum timeout of poll(2), milliseconds.
MOST_MS = 2**31 - 1
#: Number of characters from the end of the host name in the name of a process: servers truncate
#: names of connections, and host names in clouds often differ only at the end.
HOST = 44


class Listening(Protocol):
    """A process that waits for rings."""

    def wait(self, timeout_s: float, *others: int) -> bool:
        """Wait for a ring, for a readable descriptor of `others`, or for the timeout.

        Returns
        -------
        rung : whether there was a ring, or may have been during a disconnection
        """

    def close(self) -> None:
        """Stop listening."""


def process_name() -> str:
    """Return the name of this process, `host:pid`, unique among all hosts."""
    return f"{socket.gethostname()[-HOST:]}:{os.getpid()}"


def wait_for(timeout_s: float, *descriptors: int) -> set[int]:
    """Return the descriptors that become readable within the timeout; ignore negative numbers."""
    waiting = select.poll()
    for descriptor in descriptors:
        if descriptor >= 0:
            waiting.register(descriptor, select.POLLIN)
    events = waiting.poll(min(max(1e3 * timeout_s, 0.0), MOST_MS))
    return {descriptor for descriptor, _ in events}


class Wakeup:
    """Signal to workers of this machine through a folder of FIFOs.

    Parameters
    ----------
    folder : folder of the FIFOs, created by the first listener
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def ring(self) -> None:
        """Wake waiting workers. Call this after the commit, so that they see the change."""
        try:
            names = os.listdir(self._folder)  # noqa: PTH208  (Path objects would take time)
        except OSError:
            return
        for name in names:
            self._ring(self._folder / name)

    def listeners(self, _connection: Connection | None = None) -> list[str]:
        """Return `host:pid` of each listening process of this machine."""
        try:
            names = sorted(os.listdir(self._folder))  # noqa: PTH208
        except OSError:
            return []
        read = [name for name in names if self._is_read(self._folder / name)]
        return [":".join(name.rsplit("-", 2)[:2]) for name in read]

    def listen(self) -> AbstractContextManager[Listening]:
        """Listen for rings. A ring before a wait ends the wait immediately."""
        return closing(Listener(self._folder))

    def close(self) -> None:
        """Stop ringing."""

    def _is_read(self, path: Path) -> bool:
        """Return whether a process reads a FIFO."""
        with suppress(OSError), _opened(path) as descriptor:
            return stat.S_ISFIFO(os.fstat(descriptor).st_mode)
        return False

    def _ring(self, path: Path) -> None:
        try:
            with _opened(path) as descriptor:
                if stat.S_ISFIFO(os.fstat(descriptor).st_mode):
                    with suppress(OSError):  # full: the reader will wake anyway
                        os.write(descriptor, b"!")
        except OSError:  # no reader: the FIFO is new, or its process has died
            with suppress(OSError):
                if path.is_fifo() and time.time() - path.stat().st_mtime > STALE_S:
                    path.unlink()


@contextmanager
def _opened(path: Path) -> Iterator[int]:
    descriptor = os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


class Listener:
    """An open FIFO; see `Wakeup.listen`."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / f"{process_name().replace(':', '-')}-{uuid.uuid4().hex[:8]}"
        self._fifo = -1
        self._alive = 0.0
        self._open()

    def wait(self, timeout_s: float, *others: int) -> bool:
        """Wait for a ring, a readable descriptor or the timeout; see `Listening.wait`."""
        if self._fifo < 0:
            timeout_s = min(timeout_s, DEAF_S)
        rung = self._fifo in wait_for(timeout_s, self._fifo, *others)
        if rung:
            with suppress(BlockingIOError):
                while os.read(self._fifo, 4096):
                    pass
        if time.monotonic() - self._alive > ALIVE_S:
            self._refresh()
        return rung

    def close(self) -> None:
        """Stop listening."""
        with suppress(OSError):
            self._path.unlink()
        if self._fifo >= 0:
            os.close(self._fifo)
            self._fifo = -1

    def _open(self) -> None:
        """Create and open the FIFO; if this is impossible, `wait` polls."""
        self._alive = time.monotonic()
        try:
            make_folder(self._path.parent)
            os.mkfifo(self._path, 0o600)
            # also open for writing: otherwise, the FIFO would be at its end, and thus readable
            self._fifo = os.open(self._path, os.O_RDWR | os.O_NONBLOCK)
        except OSError:
            self._fifo = -1

    def _refresh(self) -> None:
        """Touch the FIFO, so that it is not abandoned; create it again if it was removed."""
        self._alive = time.monotonic()
        try:
            os.utime(self._path)
        except OSError:
            self.close()
            self._open()


# Rings through PostgreSQL, for several hosts. They too are only hints: if the server is
# unreachable, or a pooler drops listeners, workers poll.

log = logging.getLogger(__name__)

CHANNEL = "sceneprint"
#: Prefix of the names of listening connections, before the name of the process.
LISTENS = "sceneprint "
#: Minimum seconds between rings.
REST_S = 0.02
#: Maximum seconds that `close` waits for a ring in progress.
CLOSING_S = 2.0
#: Seconds between attempts to connect.
AGAIN_S = 2.0


class Notices(Wakeup):
    """Signal to workers of all hosts through NOTIFY and LISTEN of PostgreSQL."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._lock = threading.Lock()
        self._rung, self._closed = threading.Event(), False
        self._ringer: threading.Thread | None = None

    def ring(self) -> None:
        """Wake waiting workers on all hosts, from another thread."""
        with self._lock:
            if self._ringer is None and not self._closed:
                self._ringer = threading.Thread(
                    target=self._keep_ringing, name="wakeup", daemon=True
                )
                self._ringer.start()
        self._rung.set()

    def listeners(self, connection: Connection | None = None) -> list[str]:
        """Return `host:pid` of each listening process on all hosts."""
        if connection is None:
            with self._database.read() as own:
                return self.listeners(own)
        statement = text(
            "SELECT application_name FROM pg_stat_activity WHERE datname = current_database() "
            "AND application_name LIKE :like ORDER BY application_name"
        )
        names = connection.execute(statement, {"like": f"{LISTENS}%"}).scalars()
        return [name.removeprefix(LISTENS) for name in names]

    def listen(self) -> AbstractContextManager[Listening]:
        """Listen for rings of all hosts; see `Wakeup.listen`."""
        return closing(NoticeListener(self._database))

    def close(self) -> None:
        """Stop ringing."""
        with self._lock:
            self._closed = True
            ringer, self._ringer = self._ringer, None
        self._rung.set()
        if ringer is not None:
            ringer.join(CLOSING_S)

    def _keep_ringing(self) -> None:
        """Send a NOTIFY after each ring, over one connection."""
        connection: psycopg.Connection[Any] | None = None
        while self._rung.wait() and not self._closed:
            self._rung.clear()
            for _ in range(2):  # twice, since the server may have closed the connection
                try:
                    if connection is None:
                        connection = self._database.driver_connection()
                        # do not wait for disk and standby, since rings may be lost
                        connection.execute("SET synchronous_commit = off")
                    with self._database.translate_errors():
                        connection.execute(f"NOTIFY {CHANNEL}")
                    break
                except SceneprintError as error:
                    log.debug("wakeup not sent", extra={"error": str(error)})
                    _close(connection)
                    connection = None
            time.sleep(REST_S)
        _close(connection)


class NoticeListener:
    """A listening connection; see `Notices.listen`."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._connection: psycopg.Connection[Any] | None = None
        self._again_at = time.monotonic()
        self._missed = False
        self._connect()

    def wait(self, timeout_s: float, *others: int) -> bool:
        """Wait for a ring, a readable descriptor or the timeout; see `Listening.wait`."""
        self._connect()
        if self._missed:
            self._missed = False
            return True
        if self._connection is None:
            timeout_s = min(timeout_s, AGAIN_S)
            wait_for(timeout_s, *others)
            return False
        own = self._connection.fileno()
        return own in wait_for(timeout_s, own, *others) and self._has_rung()

    def close(self) -> None:
        """Stop listening."""
        _close(self._connection)
        self._connection = None

    def _connect(self) -> None:
        """Connect if AGAIN_S have passed since the last attempt; `wait` then reports a ring."""
        if self._connection is not None or time.monotonic() < self._again_at:
            return
        self._again_at = time.monotonic() + AGAIN_S
        connection = None
        try:
            connection = self._database.driver_connection()
            with self._database.translate_errors():
                statement = "SELECT set_config('application_name', %s, false)"
                connection.execute(statement, [LISTENS + process_name()])
                connection.execute(f"LISTEN {CHANNEL}")
        except SceneprintError as error:
            log.debug("wakeup unavailable", extra={"error": str(error)})
            _close(connection)
            return
        self._connection, self._missed = connection, True

    def _has_rung(self) -> bool:
        """Return whether the input is a ring, not the end of the connection."""
        if self._connection is None:
            return False
        rung = False
        try:
            with self._database.translate_errors():
                self._connection.pgconn.consume_input()
                while self._connection.pgconn.notifies() is not None:
                    rung = True
        except SceneprintError as error:
            log.debug("wakeup unavailable", extra={"error": str(error)})
            self.close()
            self._again_at = time.monotonic()  # reconnect at once: the primary may have changed
        return rung


def _close(connection: psycopg.Connection[Any] | None) -> None:
    if connection is not None:
        with suppress(Exception):
            connection.close()
