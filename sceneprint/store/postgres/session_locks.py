"""Session locks of PostgreSQL for the blobs of a fleet and for index builds.

The server releases a session lock when the connection ends, for example with its process.
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

#: Second key of the blob lock, after `LOCKS` (see `blobs/`).
BLOBS = 2
#: First key of the locks of index builds; the second is derived from the map number.
INDEX_LOCKS = 0x5CE80

log = logging.getLogger(__name__)

#: Sequence that counts starts and ends of removals, so that it is odd during a removal. Sequences
#: are not rolled back, so removals of dead processes count too.
_COUNTER = "sceneprint_removals"
_MAKE = f"CREATE SEQUENCE IF NOT EXISTS {_COUNTER}"
_READ = f"SELECT CASE WHEN is_called THEN last_value ELSE 0 END FROM {_COUNTER}"
#: Query that increments the sequence; only the holder of the lock uses it. After a crash, `nextval`
#: could skip up to 32 numbers, and confuse odd and even numbers.
_NEXT = (
    f"SELECT setval('{_COUNTER}', CASE WHEN is_called THEN last_value ELSE 0 END + 1)"
    f" FROM {_COUNTER}"
)
_SHARE = "SELECT pg_advisory_lock_shared(%s, %s)"
_TAKE = "SELECT pg_try_advisory_lock(%s, %s)"
_GIVE = "SELECT pg_advisory_unlock(%s, %s)"
#: Query of the seconds since a blob was doomed; infinity for other blobs.
_DOOMED = (
    "SELECT coalesce(extract(epoch FROM clock_timestamp()) - max(at), 'infinity')::float"
    " FROM doomed WHERE blob = %s"
)
#: Query that waits until a lock is free.
_WAIT = "SELECT set_config('lock_timeout', %s, true), pg_advisory_xact_lock_shared(%s, %s)"


class SessionLocks(Locks):
    """Lock on the blobs for all hosts that share a PostgreSQL database.

    The lock does not work with a pooler that shares connections among clients. Connect to the
    server directly, or configure the pooler for session pooling.
    """

    late_s = LONGEST_S

    def __init__(self, database: Database) -> None:
        self._database = database
        self._alone = threading.Lock()  # lock of the thread that removes blobs
        self._remover, self._reader = _Connection(database), _Connection(database)
        self._uncertain = False
        # last odd value of `_COUNTER`, and when this process first read it
        self._odd: tuple[int, float] | None = None

    def close(self) -> None:
        """Close the connections."""
        self._remover.close()
        self._reader.close()

    @contextmanager
    def block_removals(self) -> Iterator[None]:
        """Hold a lock that prevents removals. Raise UnusableStore if it is unavailable or lost."""
        # use a separate connection, since a session does not block itself
        connection = self._database.driver_connection()
        try:
            with self._database.translate_errors():
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
                f"{self._database.shown}: The connection that prevented removals of blobs was "
                "lost, so blobs may be missing. Run the command again."
            ) from error

    @contextmanager
    def removing(self) -> Iterator[bool]:
        """Acquire the exclusive lock without waiting; yield whether this succeeded."""
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
        """Mark this removal as unfinished; for LONGEST_S seconds, no other removal begins."""
        self._uncertain = True

    def removals(self) -> int | None:
        """Return the counter of removals, an even number; None if unknown, or during a removal."""
        number = self._reader.query(_READ)
        return number if number is not None and number % 2 == 0 else None

    def wait(self, digest: str | None, seconds: float) -> None:
        """Wait for a removal that continues after its write turn; see `Locks.wait`."""
        # only doomed blobs are removed after a turn
        if digest is not None and self._reader.query(_DOOMED, digest) == math.inf:
            return
        # use a separate connection, since other threads use the shared one in `removals`
        connection = self._database.driver_connection()
        try:
            with self._database.translate_errors():
                connection.execute(_WAIT, (f"{seconds * 1e3:.0f}", LOCKS, BLOBS))
        finally:
            connection.close()
        if digest is not None and self.removals() is None:
            # if the blob is still doomed, the removing process is dead or disconnected, but its
            # requests may still arrive
            age_s = self._reader.query(_DOOMED, digest)
            if age_s is None or age_s < LONGEST_S:
                raise StoreLocked(
                    f"{self._database.shown}: A process that was removing the same blob lost its "
                    "connection, and may still remove the blob. Nothing was stored. Try again in "
                    "two minutes."
                )

    def _begin(self) -> bool:
        """Acquire the lock, and count the removal; return False if either is impossible."""
        if not self._remover.query(_TAKE, LOCKS, BLOBS):
            return False
        if not self._is_over(self._remover.query(_READ, same=True)):
            self._remover.close()
            return False
        # count the removal, so that writers of the same blobs notice it
        for _ in range(2):  # twice if the number is odd because a removing process has died
            number = self._remover.query(_NEXT, same=True)
            if number is None:  # connection and lock are lost
                break
            if number % 2 == 1:
                return True
        self._remover.close()
        return False

    def _is_over(self, number: int | None) -> bool:
        """Return whether the previous removal is finished.

        The number remains odd if its process died or was disconnected, or if its requests failed;
        its requests may then still be executed.
        """
        if number is None:
            return False
        if number % 2 == 0:
            return True
        if self._odd is None or self._odd[0] != number:
            self._odd = number, time.monotonic()
        return time.monotonic() - self._odd[1] >= LONGEST_S

    def _end(self) -> None:
        """Count the end of the removal, and release the lock; if uncertain, leave the count odd."""
        if self._uncertain:  # leave the number odd
            self._remover.close()
            return
        # only on the same connection: otherwise, this would end the removal of another process
        ended = self._remover.query(_NEXT, same=True) is not None
        if not ended or not self._remover.query(_GIVE, LOCKS, BLOBS, same=True):
            log.warning("blob lock lost")
            self._remover.close()


@contextmanager
def index_turn(database: Database, map_number: int) -> Iterator[Callable[[], None] | None]:
    """Acquire the right to build the index of a map for a fleet.

    On SQLite, the lock of the index folder suffices.

    Yields
    ------
    check : function that raises UnusableStore if the right was lost; None if another process has
        the right

    Raises
    ------
    UnusableStore : If the database cannot be reached.
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
                f"{database.shown}: The connection that prevented other processes from building "
                "the same index was lost. A worker will build the index again."
            ) from error

    try:
        with database.translate_errors():
            values = (INDEX_LOCKS, map_number & LOCK_BITS)
            mine = bool(_scalar(connection, _TAKE, values))
        yield require if mine else None
    finally:
        connection.close()


class _Connection:
    """A permanent connection, opened on demand and again after a failure."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._lock = threading.Lock()
        self._held: list[psycopg.Connection[Any]] = []  # at most one
        # close at collection, since the driver warns about open connections
        weakref.finalize(self, _close, self._held)

    def query(self, statement: str, *values: int | str, same: bool = False) -> Any:
        """Return the value of a query; None if there is no value, or the query fails (logged).

        If `_COUNTER` does not exist, create it first.

        Parameters
        ----------
        statement, values : query and its parameters
        same : whether to use only the existing connection, which holds locks
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
                    return _scalar(connection, statement, values)
                except psycopg.errors.UndefinedTable:
                    with suppress(psycopg.errors.UniqueViolation, psycopg.errors.DuplicateTable):
                        connection.execute(_MAKE)
                    return _scalar(connection, statement, values)
            except (psycopg.Error, UnusableStore) as error:
                log.info("blob lock unavailable", extra={"error": str(error)})
                _close(self._held)
                return None

    def close(self) -> None:
        """Close the connection, which releases its locks."""
        with self._lock:
            _close(self._held)


def _scalar(
    connection: psycopg.Connection[Any], statement: str, values: tuple[int | str, ...]
) -> Any:
    row = connection.execute(statement.encode(), values).fetchone()
    return None if row is None else row[0]


def _close(held: list[psycopg.Connection[Any]]) -> None:
    while held:
        held.pop().close()
