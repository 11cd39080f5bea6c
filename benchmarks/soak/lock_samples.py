"""Sampling of database locks, to measure how long writers of a fleet exclude each other."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import psycopg

from sceneprint.store.postgres.connection import LOCKS, MAP_LOCKS, TURN

#: Interval of samples, and delay before the next attempt if the server does not answer, seconds.
EVERY_S, AGAIN_S = 0.02, 0.25
#: Timeout of the last sample, seconds.
PATIENCE_S = 10.0
_QUERY = (
    "SELECT count(*) FILTER (WHERE classid = %s AND objid = %s AND mode = 'ExclusiveLock'),"
    " count(*) FILTER (WHERE classid = %s AND mode = 'ExclusiveLock')"
    " FROM pg_locks WHERE locktype = 'advisory' AND granted"
)


@dataclass
class LockShares:
    """Totals over all samples.

    Parameters
    ----------
    samples : number of samples
    seconds : duration that they represent; a server that does not answer is not sampled
    everybody, one_map : total time, seconds, in which one writer blocked all others of the fleet,
        or those of its map (summed over maps)
    """

    samples: int = 0
    seconds: float = 0.0
    everybody: float = 0.0
    one_map: float = 0.0


class LockSampler(threading.Thread):
    """A thread that samples the locks of the current primary.

    `url`: function that returns the address of the primary.
    """

    def __init__(self, url: Callable[[], str]) -> None:
        super().__init__(name="locks", daemon=True)
        self._url, self._ending = url, threading.Event()
        self.shares = LockShares()

    def stop(self) -> None:
        """Stop sampling."""
        self._ending.set()
        self.join(PATIENCE_S)  # a frozen server does not answer

    def run(self) -> None:
        """Sample until `stop` is called."""
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
            # After a pause of the machine or the server, a sample represents a short interval.
            spent, last = min(now - last, 2 * EVERY_S), now
            if row is not None:
                self.shares.samples += 1
                self.shares.seconds += spent
                self.shares.everybody += spent * min(row[0], 1)
                self.shares.one_map += spent * row[1]
