"""Sample from the server's locks for how long writers of a fleet exclude each other."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import psycopg

from sceneprint.store.postgres.connection import LOCKS, MAP_LOCKS, TURN

#: Seconds between two samples, and until a server that does not answer is tried again.
EVERY_S, AGAIN_S = 0.02, 0.25
#: Seconds for the last answer.
PATIENCE_S = 10.0
_QUERY = (
    "SELECT count(*) FILTER (WHERE classid = %s AND objid = %s AND mode = 'ExclusiveLock'),"
    " count(*) FILTER (WHERE classid = %s AND mode = 'ExclusiveLock')"
    " FROM pg_locks WHERE locktype = 'advisory' AND granted"
)


@dataclass
class LockShares:
    """The sums over all samples.

    Parameters
    ----------
    samples : their number
    seconds : that they stand for; a server that does not answer is not sampled
    everybody, one_map : seconds in which all writers of the fleet had to wait for one, and those of
        a map for one of that map, maps added up
    """

    samples: int = 0
    seconds: float = 0.0
    everybody: float = 0.0
    one_map: float = 0.0


class LockSampler(threading.Thread):
    """A thread that samples the locks of whichever server is the primary.

    Parameters
    ----------
    url : returns the address of the primary
    """

    def __init__(self, url: Callable[[], str]) -> None:
        super().__init__(name="locks", daemon=True)
        self._url, self._ending = url, threading.Event()
        self.shares = LockShares()

    def stop(self) -> None:
        """Stop sampling."""
        self._ending.set()
        self.join(PATIENCE_S)  # a frozen server never answers

    def run(self) -> None:
        """Sample until `stop`."""
        while not self._ending.wait(AGAIN_S):
            try:
                with psycopg.connect(self._url(), autocommit=True, connect_timeout=3) as connection:
                    self._sample(connection)
            except psycopg.Error:  # the server was killed
                continue

    def _sample(self, connection: psycopg.Connection[tuple[int, int]]) -> None:
        last = time.monotonic()
        while not self._ending.wait(EVERY_S):
            row = connection.execute(_QUERY, (LOCKS, TURN, MAP_LOCKS)).fetchone()
            now = time.monotonic()
            # after a pause of the machine, or of the server, a sample stands for itself alone
            spent, last = min(now - last, 2 * EVERY_S), now
            if row is not None:
                self.shares.samples += 1
                self.shares.seconds += spent
                self.shares.everybody += spent * min(row[0], 1)
                self.shares.one_map += spent * row[1]
