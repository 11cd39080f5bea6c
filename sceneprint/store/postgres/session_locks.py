"""Session locks: of a fleet's blobs, and of the processes that build an index.

The server releases them when the connection ends, however its process dies.
"""

from __future__ import annotations

import logging
import math
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from sceneprint.errors import StoreLocked, UnusableStore
from sceneprint.store.blobs.folder import LONGEST_S, Locks
from sceneprint.store.postgres.connection import LOCK_BITS, LOCKS

if TYPE_CHECKING:
    import psycopg

    from sceneprint.store.database import Database

#: Number within `LOCKS` of the lock of blobs (see `blobs/`).
BLOBS = 2
#: First number of the locks of index builds; the second is the map's.
INDEX_LOCKS = 0x5CE80

log = logging.getLogger(__name__)

#: Counts removals, and is odd during one. Sequences are not rolled back, so removals of dead
#: processes count as well.
_COUNTER = "sceneprint_removals"
_MAKE = f"CREATE SEQUENCE IF NOT EXISTS {_COUNTER}"
_READ = f"SELECT CASE WHEN is_called THEN last_value ELSE 0 END FROM {_COUNTER}"
#: Used instead of `nextval`, which after a crash skips up to 32 numbers, so that odd and even would
#: mix. Only the holder of the lock counts.
_NEXT = (
    f"SELECT setval('{_COUNTER}', CASE WHEN is_called THEN last_value ELSE 0 END + 1)"
    f" FROM {_COUNTER}"
)
_SHARE = "SELECT pg_advisory_lock_shared(%s, %s)"
_TAKE = "SELECT pg_try_advisory_lock(%s, %s)"
_GIVE = "SELECT pg_advisory_unlock(%s, %s)"
#: Seconds since a blob was doomed; infinity if it is not.
_DOOMED = (
    "SELECT coalesce(extract(epoch FROM clock_timestamp()) - max(at), 'infinity')::float"
    " FROM doomed WHERE blob = %s"
)
#: The lock is released as soon as it is granted.
_WAIT = "SELECT set_config('lock_timeout', %s, true), pg_advisory_xact_lock_shared(%s, %s)"


class SessionLocks(Locks):
    """The lock of all hosts that share a PostgreSQL database.

    A pooler that assigns one connection to several clients breaks it: connect to the server itself,
    or let the pooler assign whole sessions.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._alone = threading.Lock()  # of the removing thread
        self._remover, self._reader = _Connection(database), _Connection(database)
        self._uncertain = False
        # an odd number of `_COUNTER`, and the time since this process has seen it
        self._odd: tuple[int, float] | None = None

    def close(self) -> None:
        """Close the connections."""
        self._remover.close()
        self._reader.close()

    @contextmanager
    def kept(self) -> Iterator[None]:
        """See `Locks`; raise UnusableStore if the lock cannot be taken, or was lost meanwhile."""
        # another connection than that of removals, for which its own lock would be free
        connection = self._database.driver_connection()
        try:
            with self._database.explained():
                connection.execute(_SHARE, (LOCKS, BLOBS))
            yield
            self._require(connection)
        finally:
            connection.close()

    def _require(self, connection: psycopg.Connection[Any]) -> None:
        import psycopg

        try:
            connection.execute("SELECT 1")
        except psycopg.Error as error:
            raise UnusableStore(
                f"{self._database.shown}: the connection was lost that prevented removals of "
                "blobs, and needed blobs may be missing. Run the command again."
            ) from error

    @contextmanager
    def removing(self) -> Iterator[bool]:
        """See `Locks`."""
        if not self._alone.acquire(blocking=False):
            yield False
            return
        try:
            allowed, self._uncertain = self._begin(), False
            try:
                yield allowed
            finally:
                if allowed:
                    self._end()
        finally:
            self._alone.release()

    def mark_uncertain(self) -> None:
        """See `Locks`: no removal begins, and this one does not count as over, for LONGEST_S."""
        self._uncertain = True

    @property
    def outlast_turns(self) -> bool:
        """See `Locks`."""
        return True

    def removals(self) -> int | None:
        """See `Locks`."""
        number = self._reader.query(_READ)
        return number if number is not None and number % 2 == 0 else None

    def wait(self, digest: str | None, seconds: float) -> None:
        """See `Locks`: a dead process loses the lock, although the counter stays odd."""
        # a blob that is removed after the turn is doomed until the removal has ended
        if digest is not None and self._reader.query(_DOOMED, digest) == math.inf:
            return
        # another connection, as other threads call `removals` meanwhile
        connection = self._database.driver_connection()
        try:
            with self._database.explained():
                connection.execute(_WAIT, (f"{seconds * 1e3:.0f}", LOCKS, BLOBS))
        finally:
            connection.close()
        if digest is not None and self.removals() is None:
            # the removing process has lost its lock: it is dead or disconnected, and its requests
            # may still arrive
            age_s = self._reader.query(_DOOMED, digest)
            if age_s is None or age_s < LONGEST_S:
                raise StoreLocked(
                    f"{self._database.shown}: a process that removes the same bytes lost its "
                    "connection, and may still remove them. Nothing was stored. Try again in a "
                    "minute or two."
                )

    def _begin(self) -> bool:
        if not self._remover.query(_TAKE, LOCKS, BLOBS):
            return False
        if not self._is_over(self._remover.query(_READ, same=True)):
            self._remover.close()
            return False
        # without the counter, no removal begins: writers of the same blobs would not notice it
        for _ in range(2):  # the number is odd already after the death of a remover
            number = self._remover.query(_NEXT, same=True)
            if number is None:  # the connection is lost, and so is the lock
                break
            if number % 2 == 1:
                return True
        self._remover.close()
        return False

    def _is_over(self, number: int | None) -> bool:
        """Return whether the former removal is over.

        An odd number remains of a process that died or was disconnected, or whose requests failed:
        these may still be carried out.
        """
        if number is None:
            return False
        if number % 2 == 0:
            return True
        if self._odd is None or self._odd[0] != number:
            self._odd = number, time.monotonic()
        return time.monotonic() - self._odd[1] >= LONGEST_S

    def _end(self) -> None:
        if self._uncertain:  # leave the number odd
            self._remover.close()
            return
        # only on the same connection: on another, this would count the present holder's removal
        ended = self._remover.query(_NEXT, same=True) is not None
        if not ended or not self._remover.query(_GIVE, LOCKS, BLOBS, same=True):
            log.warning("blob lock lost")
            self._remover.close()


@contextmanager
def index_turn(database: Database, map_number: int) -> Iterator[Callable[[], None] | None]:
    """Hold the turn to build a map's index for the fleet, as long as a connection lasts.

    On SQLite, the lock of the index's folder is enough.

    Yields
    ------
    check : function that raises UnusableStore if the turn was lost; None if another process has it

    Raises
    ------
    UnusableStore : the database cannot be reached.
    """
    import psycopg

    if database.is_sqlite:
        yield lambda: None
        return
    connection = database.driver_connection()

    def require() -> None:
        try:
            connection.execute("SELECT 1")
        except psycopg.Error as error:
            raise UnusableStore(
                f"{database.shown}: the connection was lost that prevented others from building "
                "the same index. It is built again."
            ) from error

    try:
        with database.explained():
            values = (INDEX_LOCKS, map_number & LOCK_BITS)
            mine = bool(_one(connection, _TAKE, values))
        yield require if mine else None
    finally:
        connection.close()


class _Connection:
    """A lasting connection, opened on demand, and again after it broke."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._lock = threading.Lock()
        self._held: list[psycopg.Connection[Any]] = []  # at most one
        # not in __del__: the driver warns of open connections that are collected
        weakref.finalize(self, _close, self._held)

    def query(self, statement: str, *values: int | str, same: bool = False) -> Any:
        """Return the value of a query; None if there is none, for whatever reason.

        Parameters
        ----------
        statement, values : query and its parameters
        same : whether to use only the former connection, which holds locks
        """
        import psycopg

        with self._lock:
            try:
                if not self._held or self._held[0].closed:
                    if same:
                        return None
                    self._held[:] = [self._database.driver_connection()]
                connection = self._held[0]
                try:
                    return _one(connection, statement, values)
                except psycopg.errors.UndefinedTable:
                    # another process may create the sequence at the same time
                    with suppress(psycopg.errors.UniqueViolation, psycopg.errors.DuplicateTable):
                        connection.execute(_MAKE)
                    return _one(connection, statement, values)
            except (psycopg.Error, UnusableStore) as error:
                log.info("blob lock unavailable", extra={"error": str(error)})
                _close(self._held)
                return None

    def close(self) -> None:
        """Close the connection, which releases its locks."""
        with self._lock:
            _close(self._held)


def _one(connection: psycopg.Connection[Any], statement: str, values: tuple[int | str, ...]) -> Any:
    row = connection.execute(statement.encode(), values).fetchone()
    return None if row is None else row[0]


def _close(held: list[psycopg.Connection[Any]]) -> None:
    while held:
        held.pop().close()
