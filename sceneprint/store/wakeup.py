"""The bell: who commits a job wakes the workers that wait, as SQLite tells nobody (PostgreSQL
does: NOTIFY rings it there, and who waits has asked to LISTEN).

Every waiting worker makes a FIFO in a folder, and who rings writes one byte to each. It is a hint
and never the truth: where none can be made, or the other is on another machine, workers look
again after a while. So nothing here raises, and no upload fails for it.
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
from contextlib import AbstractContextManager, closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from sqlalchemy import Connection, text

from sceneprint.atomic_files import make_folder
from sceneprint.errors import SceneprintError
from sceneprint.store.database import Database

if TYPE_CHECKING:
    import psycopg


#: Seconds after which a FIFO that nobody reads is removed, and between two signs of life.
STALE_S, ALIVE_S = 300.0, 60.0
#: Longest wait of a worker that has no FIFO, seconds.
DEAF_S = 0.25
#: Longest wait that the system knows of, milliseconds.
MOST_MS = 2**31 - 1
#: Characters of a host's name that its processes are called by, the last ones: a server cuts
#: names of connections, and clouds name hosts alike at their beginning.
HOST = 44


class Listening(Protocol):
    """Who has asked to be woken."""

    def wait(self, timeout_s: float, *others: int) -> bool:
        """Until it rings, one of other descriptors is readable, or the time is over.

        Returns
        -------
        whether it rang, or may have rung while it could not be heard
        """

    def close(self) -> None:
        """Listen no more."""


def process_name() -> str:
    """What this process is called among those of all hosts: `host:pid`."""
    return f"{socket.gethostname()[-HOST:]}:{os.getpid()}"


def wait_for(timeout_s: float, *descriptors: int) -> set[int]:
    """Those of some descriptors that are readable, waited for so long; negative ones are none."""
    waiting = select.poll()
    for descriptor in descriptors:
        if descriptor >= 0:
            waiting.register(descriptor, select.POLLIN)
    return {one for one, _ in waiting.poll(min(max(1e3 * timeout_s, 0.0), MOST_MS))}


class Wakeup:
    """A folder of FIFOs.

    Parameters
    ----------
    folder : made by the first who listens
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def ring(self) -> None:
        """Wake who waits; after the commit, so that they find what they are woken for."""
        try:
            names = os.listdir(self._folder)  # noqa: PTH208  (a path for each would cost)
        except OSError:
            return  # nobody has ever listened
        for name in names:
            self._ring(self._folder / name)

    def listeners(self, _connection: Connection | None = None) -> list[str]:
        """Host and process id, as `host:pid`, of every process of this machine that listens.

        Parameters
        ----------
        _connection : of the database, where there is one at hand: a server knows who listens
        """
        try:
            names = sorted(os.listdir(self._folder))  # noqa: PTH208
        except OSError:
            return []
        read = [name for name in names if self._is_read(self._folder / name)]
        return [":".join(name.rsplit("-", 2)[:2]) for name in read]

    def listen(self) -> AbstractContextManager[Listening]:
        """Be woken from now on; what is rung before the wait begins ends it at once."""
        return closing(Listener(self._folder))

    def close(self) -> None:
        """Ring no more."""

    def _is_read(self, path: Path) -> bool:
        """Whether somebody has a FIFO open: one that was left behind cannot be written to."""
        try:
            opened = os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
        except OSError:
            return False
        try:
            return stat.S_ISFIFO(os.fstat(opened).st_mode)
        finally:
            os.close(opened)

    def _ring(self, path: Path) -> None:
        try:
            opened = os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
        except OSError:  # nobody reads it: just made, or left behind by the dead
            with suppress(OSError):
                if path.is_fifo() and time.time() - path.stat().st_mtime > STALE_S:
                    path.unlink()
            return
        try:
            if stat.S_ISFIFO(os.fstat(opened).st_mode):
                with suppress(OSError):  # full: it is awake, or about to be
                    os.write(opened, b"!")
        finally:
            os.close(opened)


class Listener:
    """One FIFO, open; made by `Wakeup.listen`."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / f"{process_name().replace(':', '-')}-{uuid.uuid4().hex[:8]}"
        self._fifo = -1
        self._alive = 0.0
        self._open()

    def wait(self, timeout_s: float, *others: int) -> bool:
        """See `Listening.wait`."""
        if self._fifo < 0:
            timeout_s = min(timeout_s, DEAF_S)
        rung = self._fifo in wait_for(timeout_s, self._fifo, *others)
        if rung:
            with suppress(BlockingIOError):
                while os.read(self._fifo, 4096):
                    pass
        if time.monotonic() - self._alive > ALIVE_S:
            self._stay()
        return rung

    def close(self) -> None:
        """Listen no more."""
        with suppress(OSError):
            self._path.unlink()
        if self._fifo >= 0:
            os.close(self._fifo)
            self._fifo = -1

    def _open(self) -> None:
        self._alive = time.monotonic()
        try:
            make_folder(self._path.parent)
            os.mkfifo(self._path, 0o600)
            # to write as well: without a writer it would be at its end, and always readable
            self._fifo = os.open(self._path, os.O_RDWR | os.O_NONBLOCK)
        except OSError:
            self._fifo = -1

    def _stay(self) -> None:
        """Show that the FIFO is not left behind; one that was removed is made anew."""
        self._alive = time.monotonic()
        try:
            os.utime(self._path)
        except OSError:
            self.close()
            self._open()


# The bell of a database that has many hosts. As with FIFOs, this is a hint and never the truth:
# where the server is away, or a pooler in between forgets who listens, workers look again later.

log = logging.getLogger(__name__)

CHANNEL = "sceneprint"
#: What connections that listen are called, before the name of their process: others are called
#: `sceneprint` alone.
LISTENS = "sceneprint "
#: Seconds between two rings: of a crowd of uploads one is enough.
REST_S = 0.02
#: Seconds that closing waits for a ring under way: to a server that does not answer it takes long.
CLOSING_S = 2.0
#: Seconds after which who could not connect tries again.
AGAIN_S = 2.0


class Notices(Wakeup):
    """The bell of a PostgreSQL database."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._lock = threading.Lock()
        self._rung, self._closed = threading.Event(), False
        self._ringer: threading.Thread | None = None

    def ring(self) -> None:
        """Wake who waits, on every host; this thread waits for nothing."""
        with self._lock:
            if self._ringer is None and not self._closed:
                self._ringer = threading.Thread(target=self._keep_ringing, name="bell", daemon=True)
                self._ringer.start()
        self._rung.set()

    def listeners(self, connection: Connection | None = None) -> list[str]:
        """Host and process id, as `host:pid`, of every process that listens, on every host."""
        if connection is None:
            with self._database.read() as own:
                return self.listeners(own)
        asked = text(
            "SELECT application_name FROM pg_stat_activity WHERE datname = current_database() "
            "AND application_name LIKE :like ORDER BY application_name"
        )
        found = connection.execute(asked, {"like": f"{LISTENS}%"}).scalars()
        return [name.removeprefix(LISTENS) for name in found]

    def listen(self) -> AbstractContextManager[Listening]:
        """See `Wakeup.listen`."""
        return closing(Ear(self._database))

    def close(self) -> None:
        """Ring no more."""
        with self._lock:
            self._closed = True
            ringer, self._ringer = self._ringer, None
        self._rung.set()
        if ringer is not None:
            ringer.join(CLOSING_S)

    def _keep_ringing(self) -> None:
        """Tell the server of what was rung, over one connection."""
        connection: psycopg.Connection[Any] | None = None
        while self._rung.wait() and not self._closed:
            self._rung.clear()
            for _ in range(2):  # the server may have closed the one that was good the last time
                try:
                    if connection is None:
                        connection = self._database.driver_connection()
                        # nothing is lost with a ring: it need not wait for disk and standby
                        connection.execute("SET synchronous_commit = off")
                    with self._database.explained():
                        connection.execute(f"NOTIFY {CHANNEL}")
                    break
                except SceneprintError as error:
                    log.debug("not rung", extra={"error": str(error)})
                    _close(connection)
                    connection = None
            time.sleep(REST_S)
        _close(connection)


class Ear:
    """One connection that listens; made by `Notices.listen`."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._connection: psycopg.Connection[Any] | None = None
        self._again_at = time.monotonic()
        self._missed = False
        self._connect()

    def wait(self, timeout_s: float, *others: int) -> bool:
        """See `Listening.wait`."""
        self._connect()
        if self._missed:
            self._missed = False
            return True
        if self._connection is None:
            timeout_s = min(timeout_s, AGAIN_S)
            wait_for(timeout_s, *others)
            return False
        own = self._connection.fileno()
        return own in wait_for(timeout_s, own, *others) and self._heard()

    def close(self) -> None:
        """Listen no more."""
        _close(self._connection)
        self._connection = None

    def _connect(self) -> None:
        if self._connection is not None or time.monotonic() < self._again_at:
            return
        self._again_at = time.monotonic() + AGAIN_S
        connection = None
        try:
            connection = self._database.driver_connection()
            with self._database.explained():
                named = "SELECT set_config('application_name', %s, false)"
                connection.execute(named, [LISTENS + process_name()])
                connection.execute(f"LISTEN {CHANNEL}")
        except SceneprintError as error:
            log.debug("the bell cannot be heard", extra={"error": str(error)})
            _close(connection)
            return
        self._connection, self._missed = connection, True

    def _heard(self) -> bool:
        """Whether what came is a ring, and not the end of the connection."""
        if self._connection is None:
            return False
        heard = False
        try:
            with self._database.explained():
                self._connection.pgconn.consume_input()
                while self._connection.pgconn.notifies() is not None:
                    heard = True
        except SceneprintError as error:
            log.debug("the bell cannot be heard", extra={"error": str(error)})
            self.close()
            self._again_at = time.monotonic()  # it may be back, or elsewhere
        return heard


def _close(connection: psycopg.Connection[Any] | None) -> None:
    if connection is not None:
        with suppress(Exception):  # whatever it was, nobody has it any more
            connection.close()
