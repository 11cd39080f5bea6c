"""Rates that hold over all services of a database: each tells the others what its callers spent.

TokenBucket.take  -->  spent  --SharedRates.exchange, a row a second-->  others' TokenBucket.charge

Requests wait for none of it. What a caller spends at several services within one exchange may
exceed its rate; it is owed from then on, so that over a longer time the rate holds. Clocks of hosts
are not compared. Where the database is away, each service holds its callers to the rate alone.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from anyio import to_thread

from sceneprint.errors import SceneprintError
from sceneprint.store import Database
from sceneprint.store.store_counts import add_sample, newest_sample, other_samples
from sceneprint.store.wakeup import process_name
from service.limits import RateLimits

log = logging.getLogger(__name__)

#: Seconds between two exchanges.
EXCHANGE_S = 1.0
#: What samples are kept of, and how far behind the newest one may be committed.
RATES, BEHIND = "rates", 500
#: Seconds that they are kept: every service hears of them in the next one.
KEPT_S = 60.0
#: Callers of each limit of whom one sample tells: a row stays some ten kilobytes.
MOST_TOLD = 500


class SharedRates:
    """What one service tells the others, and hears from them.

    Parameters
    ----------
    database : that they share
    limits : of this service; from now on it notes what is spent
    process : name of this service, which no other has
    """

    def __init__(self, database: Database, limits: RateLimits, process: str | None = None) -> None:
        self._database, self._process = database, process or process_name()
        self._buckets = {one.name: one for one in (limits.requests, limits.failed_keys)}
        for bucket in self._buckets.values():
            bucket.note_spending()
        self._first: int | None = None  # number of the newest sample when this service began
        self._newest = 0
        self._seen: set[int] = set()  # of those up to BEHIND before the newest
        self._is_away = False

    def exchange(self) -> None:
        """Tell what was spent here since the last time, and charge callers for what they spent
        elsewhere; what cannot be told now is told the next time.
        """
        spent = {name: bucket.take_spent(MOST_TOLD) for name, bucket in self._buckets.items()}
        try:
            if self._first is None:
                with self._database.read() as connection:
                    self._first = self._newest = newest_sample(connection)
            if any(spent.values()):
                with self._database.write(turn=False) as connection:
                    add_sample(connection, RATES, self._process, spent, kept_s=KEPT_S)
        except SceneprintError as error:
            for name, bucket in self._buckets.items():
                bucket.return_spent(spent[name])
            self._note_away(error)
            return
        try:
            self._hear(self._first)
        except SceneprintError as error:
            self._note_away(error)
            return
        self._is_away = False

    def _hear(self, first: int) -> None:
        with self._database.read() as connection:
            after = max(self._newest - BEHIND, first)
            found = other_samples(connection, RATES, self._process, after)
        for number, data in found.items():
            if number not in self._seen:
                for name in self._buckets.keys() & data.keys():
                    self._buckets[name].charge(data[name])
        self._newest = max([self._newest, *found])
        self._seen = {number for number in found if number > self._newest - BEHIND}

    def _note_away(self, error: SceneprintError) -> None:
        if not self._is_away:
            log.warning("rates not shared", extra={"error": str(error)})
        self._is_away = True


@asynccontextmanager
async def sharing(rates: SharedRates) -> AsyncIterator[None]:
    """Exchange once in EXCHANGE_S, as long as it lasts."""
    task = asyncio.create_task(_exchange(rates))
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


async def _exchange(rates: SharedRates) -> None:
    while True:
        await to_thread.run_sync(rates.exchange)
        await asyncio.sleep(EXCHANGE_S)
