"""The bell of a database that has many hosts: NOTIFY rings it, who waits has asked to LISTEN.

As with the FIFOs of `wakeup`, this is a hint and never the truth: where the server is away, or a
pooler in between forgets who listens, workers look again after a while.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, text

from sceneprint.errors import SceneprintError
from sceneprint.store.database import Database
from sceneprint.store.wakeup import Wakeup, process_name, wait_for

if TYPE_CHECKING:
    import psycopg

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
    """The bell of a PostgreSQL database.

    Parameters
    ----------
    database : see Database
    """

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

    @contextmanager
    def listen(self) -> Iterator[Ear]:
        """Be woken from now on; what is rung before the wait begins ends it at once."""
        ear = Ear(self._database)
        try:
            yield ear
        finally:
            ear.close()

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
        """Until it rings, one of other descriptors is readable, or the time is over.

        Returns
        -------
        whether it rang, or may have rung while it could not be heard
        """
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
