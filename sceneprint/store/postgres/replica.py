"""A read replica: queries are answered from it while it is not too far behind.

Replica.near  -->  UsableReplica  --read_through-->  reads go to the replica, or else the primary

How far behind it is, is measured by positions of the log: what the primary had written at a time
is in every answer of a replica that has replayed as much. So one that nothing is written to is not
behind, clocks of hosts do not matter, and a replica that lost its primary grows old at once.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TypeVar

from sqlalchemy import text
from sqlalchemy.exc import SQLAlchemyError

from sceneprint.errors import FrameError, SceneprintError, StoreAway, StoreError, UnusableStore
from sceneprint.store.database import Database, known_revisions, reach_database

log = logging.getLogger(__name__)

T = TypeVar("T")

#: Seconds between two measurements, and after one that failed.
EVERY_S, AGAIN_S = 1.0, 3.0
#: Measurements of the primary that are kept: farther behind it is not known by how much.
KEPT = 120
_WRITTEN = text(
    "SELECT pg_current_wal_flush_lsn()::text, (pg_control_system()).system_identifier::text"
)
_REPLAYED = text(
    "SELECT pg_is_in_recovery(), pg_last_wal_replay_lsn()::text, "
    "(pg_control_system()).system_identifier::text, (SELECT version_num FROM alembic_version)"
)


class Behind(StoreError):
    """The replica does not know yet what is held of the primary."""


@dataclass(frozen=True)
class UsableReplica:
    """A replica that may be asked now.

    Parameters
    ----------
    database : the replica
    behind_s : all that was committed as long ago is in it
    """

    database: Database
    behind_s: float


@dataclass(frozen=True)
class ReplicaState:
    """How a replica does.

    Parameters
    ----------
    used : whether queries are answered from it
    behind_s : see Near; None where that is not known
    reason : why it is not used
    """

    used: bool
    behind_s: float | None
    reason: str | None


#: What the query in hand is answered from; None: the primary.
_near: ContextVar[UsableReplica | None] = ContextVar("near", default=None)


class Replica:
    """A replica of a primary, measured by a thread of its own from its first use on.

    Parameters
    ----------
    primary : see Database
    url : of the replica
    lag_s : seconds that it may be behind

    Raises
    ------
    UnusableStore : the URL is none of PostgreSQL.
    """

    def __init__(self, primary: Database, url: str, lag_s: float) -> None:
        self._primary, self._lag_s = primary, lag_s
        self._database = reach_database(url)
        if self._database.is_sqlite or primary.is_sqlite:
            raise UnusableStore(
                "SCENEPRINT_REPLICA_URL is no URL of PostgreSQL, which alone has replicas. Leave "
                "it out, or set it and SCENEPRINT_DATABASE_URL to postgresql+psycopg://..."
            )
        self._every_s = min(EVERY_S, max(lag_s / 4, 0.05))
        self._written: deque[tuple[float, int]] = deque(maxlen=KEPT)
        self._caught_up_at = -math.inf  # what was committed until then is in it
        self._reason: str | None = "it was not asked yet"
        self._identifier: str | None = None  # of the primary and all that follow it
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._thread: threading.Thread | None = None

    def near(self) -> UsableReplica | None:
        """The replica, if it may be asked; costs nothing."""
        self._begin()
        behind_s = time.monotonic() - self._caught_up_at
        if self._reason is not None or behind_s > self._lag_s:
            return None
        return UsableReplica(self._database, behind_s)

    def standing(self) -> ReplicaState:
        """How it does."""
        self._begin()
        behind_s = time.monotonic() - self._caught_up_at
        reason = self._reason
        if reason is None and behind_s > self._lag_s:
            reason = f"it is farther behind than {self._lag_s:g} s"
        known = None if math.isinf(behind_s) else behind_s
        return ReplicaState(reason is None, known, reason)

    def fell(self, error: SceneprintError) -> None:
        """It did not answer a query: it is not asked until it is measured anew."""
        self._reason = str(error)

    def close(self) -> None:
        """Give its connections back."""
        self._stop.set()
        with self._lock:
            thread, self._thread = self._thread, None
        if thread is not None:
            thread.join()
        self._database.close()

    def measure(self) -> None:
        """See how far behind it is.

        Raises
        ------
        StoreError : it does not answer, or is no replica that can be used.
        """
        self._ask_primary()
        with self._database.read() as connection:
            found = connection.execute(_REPLAYED).one()
        recovers, replayed, own, schema = found
        if not recovers or replayed is None:
            raise UnusableStore(f"{self._database.shown}: it is no replica that follows another.")
        if own != self._identifier:
            raise UnusableStore(f"{self._database.shown}: it is a replica of another database.")
        if schema != known_revisions()[0]:
            raise UnusableStore(f"{self._database.shown}: it has schema {schema}, not yet ours.")
        has = _number(replayed)
        self._caught_up_at = max(
            (at for at, written in self._written if written <= has), default=-math.inf
        )
        self._reason = None

    def _ask_primary(self) -> None:
        at = time.monotonic()  # before: what it answers may be newer, and never older
        try:
            with self._primary.read() as connection:
                position, self._identifier = connection.execute(_WRITTEN).one()
        except SceneprintError as error:  # until it is too old, the replica is as good as it was
            log.debug("the primary is not measured", extra={"error": str(error)})
            return
        self._written.append((at, _number(position)))

    def _begin(self) -> None:
        if self._thread is not None or self._stop.is_set():
            return
        with self._lock:
            if self._thread is None and not self._stop.is_set():
                self._thread = threading.Thread(target=self._watch, name="replica", daemon=True)
                self._thread.start()

    def _watch(self) -> None:
        pause_s = 0.0
        while not self._stop.wait(pause_s):
            before, pause_s = self._reason, self._every_s
            try:
                self.measure()
            except (SceneprintError, SQLAlchemyError) as error:
                self._reason, pause_s = str(error), AGAIN_S
            if (before is None) != (self._reason is None):
                about = {"replica": self._database.shown, "reason": self._reason}
                log.warning("replica %s", "is not used" if self._reason else "is used", extra=about)


def current() -> UsableReplica | None:
    """What the query in hand is answered from; None: the primary."""
    return _near.get()


def behind_s() -> float | None:
    """How far what the query in hand is answered from may be behind; None: it is the primary."""
    near = _near.get()
    return None if near is None else round(near.behind_s, 3)


def require_primary(what: str) -> None:
    """See that the query in hand is answered from the primary.

    Parameters
    ----------
    what : is newer than the replica

    Raises
    ------
    Behind : it is not; it is asked again there.
    """
    if _near.get() is not None:
        raise Behind(f"The replica does not have {what} yet.")


def read_through(replica: Replica | None, ask: Callable[[], T]) -> T:
    """Answer a query from the replica, and from the primary what the replica does not know yet,
    or cannot answer.

    Parameters
    ----------
    replica : if there is one
    ask : reads `Store.queried`; may be called twice
    """
    near = None if replica is None or _near.get() is not None else replica.near()
    if near is None or replica is None:
        return ask()
    token = _near.set(near)
    try:
        return ask()
    except FrameError:  # it is wrong wherever it is compared
        raise
    except SceneprintError as error:
        if isinstance(error, StoreAway):
            replica.fell(error)
        log.debug("asked of the primary", extra={"error": str(error)})
    finally:
        _near.reset(token)
    return ask()


def _number(position: str) -> int:
    """A position of the log as a number of bytes."""
    high, _, low = position.partition("/")
    return (int(high, 16) << 32) + int(low, 16)
