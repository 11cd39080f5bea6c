"""What this process counted in the last seconds, written to the database now and then.

requests, answers  -->  Sampler  --flush-->  table `samples`  -->  GET /v1/stats of any process
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import threading
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any

from anyio import to_thread

from sceneprint.engine import Engine
from sceneprint.engine.latencies import Latencies
from sceneprint.engine.statistics import SERVICE
from sceneprint.errors import SceneprintError
from sceneprint.schemas import Answer
from sceneprint.store import Database
from sceneprint.store.samples import add_sample

log = logging.getLogger(__name__)

#: Seconds between two samples.
EVERY_S = 10.0


class Sampler:
    """Counts requests and answers; safe to share between threads."""

    def __init__(self) -> None:
        self._process = f"{socket.gethostname()}:{os.getpid()}"
        self._lock = threading.Lock()
        self._begin()

    def _begin(self) -> None:
        self._statuses: Counter[str] = Counter()
        self._queries: Counter[str] = Counter()
        self._latencies = Latencies()

    def request(self, status: int) -> None:
        """Count a request."""
        with self._lock:
            self._statuses[str(status)] += 1

    def answer(self, answer: Answer) -> None:
        """Count a query that was answered."""
        with self._lock:
            self._queries[answer.status] += 1
            if "total" in answer.milliseconds:
                self._latencies.add(answer.milliseconds["total"] / 1e3)

    def flush(self, database: Database) -> bool:
        """Write down what was counted since the last time; whether anything was written.

        A store that is read-only, or has no turn for us, loses the sample and nothing else.
        """
        with self._lock:
            data: dict[str, Any] = {
                "statuses": dict(self._statuses),
                "queries": dict(self._queries),
                "latencies": self._latencies.as_json(),
            }
            self._begin()
        if not any(data.values()) or database.read_only:
            return False
        try:
            with database.write(turn=False) as connection:
                add_sample(connection, SERVICE, self._process, data)
        except SceneprintError as error:
            log.info("no sample kept", extra={"error": str(error)})
            return False
        return True


@asynccontextmanager
async def housekeeping(engine: Engine, sampler: Sampler) -> AsyncIterator[None]:
    """What a service does now and then, as long as it lasts; and once more at its end."""
    task = asyncio.create_task(_keep(engine, sampler))
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
        await to_thread.run_sync(sampler.flush, engine.store.database)


async def _keep(engine: Engine, sampler: Sampler) -> None:
    while True:
        await asyncio.sleep(EVERY_S)
        await to_thread.run_sync(sampler.flush, engine.store.database)
        try:
            await to_thread.run_sync(engine.forget_gone)
        except SceneprintError as error:
            log.info("the store does not answer", extra={"error": str(error)})
