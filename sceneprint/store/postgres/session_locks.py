"""Locks that last as long as a connection: of a fleet's blobs, and of who builds an index.

The server gives them back when a connection ends, however its process dies.
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

#: What of `LOCKS` is locked: uploads that are stored or removed (see `blobs/`).
BLOBS = 2
#: First number of locks of who builds the index of a map for its fleet; the second is that of the
#: map.
INDEX_LOCKS = 0x5CE80

log = logging.getLogger(__name__)

#: Counts removals: odd while one is under way. No transaction takes it back, so it tells of those
#: of removers that died, too.
_COUNTER = "sceneprint_removals"
_MAKE = f"CREATE SEQUENCE IF NOT EXISTS {_COUNTER}"
_READ = f"SELECT CASE WHEN is_called THEN last_value ELSE 0 END FROM {_COUNTER}"
#: As `nextval`, which the server's log has in advance: after a crash it would go on 32 further, and
#: an odd number be an even one. Only who removes counts, and has the lock.
_NEXT = (
    f"SELECT setval('{_COUNTER}', CASE WHEN is_called THEN last_value ELSE 0 END + 1)"
    f" FROM {_COUNTER}"
)
_SHARE = "SELECT pg_advisory_lock_shared(%s, %s)"
_TAKE = "SELECT pg_try_advisory_lock(%s, %s)"
_GIVE = "SELECT pg_advisory_unlock(%s, %s)"
#: Seconds since a blob was doomed; infinity where it is not.
_DOOMED = (
    "SELECT coalesce(extract(epoch FROM clock_timestamp()) - max(at), 'infinity')::float"
    " FROM doomed WHERE blob = %s"
)
#: The lock is released as soon as it is granted.
_WAIT = "SELECT set_config('lock_timeout', %s, true), pg_advisory_xact_lock_shared(%s, %s)"


class SessionLocks(Locks):
    """Of all processes of all hosts that share a database of PostgreSQL.

    A pooler that hands one connection to several clients takes them away: connect to the server
    itself, or let the pooler keep whole sessions."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._alone = threading.Lock()  # of who removes in this process
        self._removes, self._reads = _Line(database), _Line(database)
        self._doubted = False
        # an odd number of `_COUNTER`, and since when this process has seen it
        self._odd: tuple[int, float] | None = None

    def close(self) -> None:
        """Give back the connections."""
        self._removes.drop()
        self._reads.drop()

    @contextmanager
    def kept(self) -> Iterator[None]:
        """See `Locks`; UnusableStore where it cannot be had, or was lost meanwhile."""
        # of its own: a lock of the connection that removes would be no lock to that one
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
                f"{self._database.shown}: the connection was lost that kept blobs from being "
                "removed, and some that were needed may be gone. Do it again."
            ) from error

    @contextmanager
    def removing(self) -> Iterator[bool]:
        """See `Locks`."""
        if not self._alone.acquire(blocking=False):
            yield False
            return
        try:
            allowed, self._doubted = self._begin(), False
            try:
                yield allowed
            finally:
                if allowed:
                    self._end()
        finally:
            self._alone.release()

    def doubt(self) -> None:
        """See `Locks`: nobody begins another one, or takes it to be over, for LONGEST_S."""
        self._doubted = True

    @property
    def outlast_turns(self) -> bool:
        """See `Locks`."""
        return True

    def removals(self) -> int | None:
        """A number that any removal changes; None where it cannot be told, or one is under way."""
        number = self._reads.ask(_READ)
        return number if number is not None and number % 2 == 0 else None

    def wait(self, digest: str | None, seconds: float) -> None:
        """See `Locks`: who dies gives the lock back, although the counter stays odd."""
        # what is removed after its turn is doomed until the removal has ended
        if digest is not None and self._reads.ask(_DOOMED, digest) == math.inf:
            return
        # of its own: other threads ask `removals` meanwhile
        connection = self._database.driver_connection()
        try:
            with self._database.explained():
                connection.execute(_WAIT, (f"{seconds * 1e3:.0f}", LOCKS, BLOBS))
        finally:
            connection.close()
        if digest is not None and self.removals() is None:
            # whoever removed it has lost its lock: it is dead, or cut off, and then its requests
            # may still be on their way
            age_s = self._reads.ask(_DOOMED, digest)
            if age_s is None or age_s < LONGEST_S:
                raise StoreLocked(
                    f"{self._database.shown}: a process that removes the same bytes lost its "
                    "connection, and may still remove them. Nothing was stored. Come back in a "
                    "minute or two."
                )

    def _begin(self) -> bool:
        if not self._removes.ask(_TAKE, LOCKS, BLOBS):
            return False
        if not self._is_over(self._removes.ask(_READ, same=True)):
            self._removes.drop()
            return False
        # who puts a blob while it is removed must find out: without the counter, nothing goes
        for _ in range(2):  # it is odd already after a remover that died
            number = self._removes.ask(_NEXT, same=True)
            if number is None:  # with the connection the lock is gone
                break
            if number % 2 == 1:
                return True
        self._removes.drop()
        return False

    def _is_over(self, number: int | None) -> bool:
        """Whether the removal of before is over: an odd number is of one whose remover died or was
        cut off, or whose requests failed, and these may still be carried out."""
        if number is None:
            return False
        if number % 2 == 0:
            return True
        if self._odd is None or self._odd[0] != number:
            self._odd = number, time.monotonic()
        return time.monotonic() - self._odd[1] >= LONGEST_S

    def _end(self) -> None:
        if self._doubted:  # the number stays odd
            self._removes.drop()
            return
        # another connection has no lock: who has it now would be counted to the end
        ended = self._removes.ask(_NEXT, same=True) is not None
        if not ended or not self._removes.ask(_GIVE, LOCKS, BLOBS, same=True):
            log.warning("blob lock lost")
            self._removes.drop()  # the lock goes with its connection


@contextmanager
def index_turn(database: Database, map_number: int) -> Iterator[Callable[[], None] | None]:
    """Have the turn to build a map's index for the fleet, as long as a connection lasts.

    SQLite is of one machine, whose builders have the lock of the index's folder.

    Yields
    ------
    what sees that the turn was not lost, and raises UnusableStore where it was; None where
    somebody else has the turn

    Raises
    ------
    UnusableStore : the database cannot be asked.
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
                f"{database.shown}: the connection was lost that kept others from building the "
                "same index. It is built again."
            ) from error

    try:
        with database.explained():
            values = (INDEX_LOCKS, map_number & LOCK_BITS)
            mine = bool(_one(connection, _TAKE, values))
        yield require if mine else None
    finally:
        connection.close()


class _Line:
    """A connection that lasts, opened when it is needed and anew where it broke."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._lock = threading.Lock()
        self._held: list[psycopg.Connection[Any]] = []  # at most one
        # not by __del__: the driver warns of what is collected while it is open
        weakref.finalize(self, _close, self._held)

    def ask(self, statement: str, *values: int | str, same: bool = False) -> Any:
        """The value that answers; None where there is none, for whatever reason.

        Parameters
        ----------
        statement, values : to execute
        same : by no other connection than the one of before, which has locks
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
                    # another process may be making it
                    with suppress(psycopg.errors.UniqueViolation, psycopg.errors.DuplicateTable):
                        connection.execute(_MAKE)
                    return _one(connection, statement, values)
            except (psycopg.Error, UnusableStore) as error:
                log.info("blob lock unavailable", extra={"error": str(error)})
                _close(self._held)
                return None

    def drop(self) -> None:
        """Close it; a lock that it holds is free."""
        with self._lock:
            _close(self._held)


def _one(connection: psycopg.Connection[Any], statement: str, values: tuple[int | str, ...]) -> Any:
    row = connection.execute(statement.encode(), values).fetchone()
    return None if row is None else row[0]


def _close(held: list[psycopg.Connection[Any]]) -> None:
    while held:
        held.pop().close()
