"""Event streams, all fed by one poller per process.

    database  --Feed-->  the newest events in memory  -->  streams, each at its own position

A stream that lags behind the events in memory reads the database itself until it catches up, so
that slow readers need no memory, and idle streams no database queries.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing, suppress
from itertools import islice

from anyio import to_thread
from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from sceneprint.engine.admin.operations import begin, missed, next_events
from sceneprint.errors import Busy, RateLimited, SceneprintError
from sceneprint.process import NOBODY
from sceneprint.store import Database
from sceneprint.store.events import EventFilter, EventRow, list_events, newest_number, number_events
from sceneprint_client.api.admin import Event
from service.limits import Holdings, share

log = logging.getLogger(__name__)

#: Seconds between polls of the database (half of that after new events), and after an error.
POLL_S, TROUBLE_S = 0.1, 1.0
#: Interval of keep-alive messages on a silent stream, seconds.
ALIVE_S = 3.0
#: Maximum number of events in memory, and per read.
HELD, MOST = 4096, 500


class Feed:
    """The event streams of one process.

    Parameters
    ----------
    database : database, polled while streams are open
    most : maximum number of open streams
    retained : number of newest events of each map that the database never deletes
    """

    def __init__(self, database: Database, most: int, retained: int) -> None:
        self._database, self._most, self._retained = database, most, retained
        self._streams = Holdings()
        self._closed = False
        self._poller: asyncio.Task[None] | None = None
        self._held: deque[EventRow] = deque()
        # All events after `_since` are in memory; None before the first poll.
        self._since: int | None = None
        self._newest = 0
        self._last: EventRow | None = None  # the event with the number `_newest`
        # History of the database, and how often it was replaced by a history without known events:
        # a standby that lagged behind assigns the same numbers to other events.
        self._history, self._rewinds = database.history, 0
        self._news = asyncio.Event()

    @property
    def streams(self) -> int:
        """Number of open streams."""
        return self._streams.total

    def join(self, tenant: str = NOBODY) -> None:
        """Reserve a stream until `leave`. Raise Busy if all streams are in use, and RateLimited if
        the tenant has reached its share.
        """
        if self._closed or self._streams.total >= self._most:
            raise Busy(
                "The service has reached its limit of open event streams. Close one, request a "
                "page of events instead, or retry later."
            )
        if not self._streams.take(tenant, 1, self._most):
            raise RateLimited(
                f"{share(self._most)} event streams of this key's tenant are open, which is the "
                "limit. Close one, or request a page of events instead."
            )

    def leave(self, tenant: str = NOBODY) -> None:
        """Release a stream. The poller stops with the last stream."""
        self._streams.give(tenant, 1)
        if self._streams.total == 0 and self._poller is not None:
            self._poller.cancel()
            self._poller = None
            self._since = None
            self._held.clear()

    def close(self) -> None:
        """End all streams."""
        self._closed = True
        self._wake()

    async def batches(
        self, criteria: EventFilter, after: int | None, has_access: Callable[[], bool]
    ) -> AsyncGenerator[tuple[list[EventRow], int], None]:
        """Yield lists of new events, each with the number of the last event that the reader may
        read.

        The first list may be empty, and empty lists follow at least every ALIVE_S seconds.

        Parameters
        ----------
        criteria : filter of the events
        after : number of the event to continue after; None starts with new events
        has_access : function that is called every ALIVE_S seconds in a thread; if it returns False,
            the stream ends
        """
        try:
            async for batch in self._batches(criteria, after, has_access):
                yield batch
        except SceneprintError as error:  # the client reconnects and receives the error
            log.error("event stream failed", extra={"error": str(error)})

    async def _batches(
        self, criteria: EventFilter, after: int | None, has_access: Callable[[], bool]
    ) -> AsyncGenerator[tuple[list[EventRow], int], None]:
        if self._poller is None or self._poller.done():
            self._poller = asyncio.create_task(self._poll())
        rewinds = self._rewinds
        first, place, last = await to_thread.run_sync(
            begin, self._database, criteria, self._retained, after
        )
        yield first, last  # even an empty list, since the reader needs its position
        clock = asyncio.get_running_loop().time
        due = clock() + ALIVE_S
        while not self._closed:
            if clock() >= due:
                if not await to_thread.run_sync(has_access) or self._poller.done():
                    return  # the poller has stopped
                yield [], last
                due = clock() + ALIVE_S
            news = self._news
            if rewinds != self._rewinds:
                rewinds = self._rewinds
                _, place, last = await to_thread.run_sync(
                    begin, self._database, criteria, self._retained, None
                )
                yield [missed(last)], last
                continue
            if self._since is None or place < self._since:
                rows, place, last = await to_thread.run_sync(
                    next_events, self._database, criteria, place, MOST
                )
                if rows:
                    yield rows, last
                    continue
                if self._since is not None and place < self._since:
                    continue
            if self._since is not None and place < self._newest:
                held, place = self._after(place)
                last = max((event.number for event in held if criteria.sees(event)), default=last)
                rows = [event for event in held if criteria(event)]
                if rows:
                    yield rows, last
                continue
            with suppress(TimeoutError):
                await asyncio.wait_for(news.wait(), max(due - clock(), 0.0))

    def _after(self, place: int) -> tuple[list[EventRow], int]:
        """Return the next events in memory after `place`, and the number of the last known
        event.
        """
        newer = sum(1 for event in reversed(self._held) if event.number > place)
        start = len(self._held) - newer
        rows = list(islice(self._held, start, start + MOST))
        return rows, rows[-1].number if rows else self._newest

    def _is_behind(self) -> bool:
        """Return whether the last known event is missing or different in the database."""
        if self._last is None:
            return False
        with self._database.read() as connection:
            after = self._last.number - 1
            return list_events(connection, EventFilter(), after=after, limit=1) != [self._last]

    async def _begin(self) -> None:
        """Continue from the newest event of the database."""
        newest = await to_thread.run_sync(self._read, None)
        self._last = newest[0] if newest else None
        self._history = self._database.history
        self._held.clear()
        self._newest = self._since = 0 if self._last is None else self._last.number

    def _read(self, after: int | None) -> list[EventRow]:
        """Return the events after a number; None returns the newest event."""
        number_events(self._database)
        with self._database.read() as connection:
            after = newest_number(connection) - 1 if after is None else after
            return list_events(connection, EventFilter(), after=after, limit=MOST)

    async def _poll(self) -> None:
        """Poll the database while streams are open."""
        pause = 0.0
        while True:
            await asyncio.sleep(pause)
            try:
                if self._since is None:
                    await self._begin()
                    self._wake()
                rows = await to_thread.run_sync(self._read, self._newest)
                if self._history != self._database.history:
                    history = self._database.history
                    if await to_thread.run_sync(self._is_behind):
                        await self._begin()
                        self._rewinds += 1
                        self._wake()
                    else:  # a synchronous standby has all known events
                        self._history = history
                    pause = 0.0
                    continue
            except SceneprintError as error:
                log.error("events cannot be read", extra={"error": str(error)})
                pause = TROUBLE_S
                continue
            pause = 0.0 if len(rows) == MOST else POLL_S / (2 if rows else 1)
            if rows:
                self._held.extend(rows)
                while len(self._held) > HELD:
                    self._since = self._held.popleft().number
                self._newest, self._last = rows[-1].number, rows[-1]
                self._wake()

    def _wake(self) -> None:
        self._news.set()
        self._news = asyncio.Event()


# Server-sent events.
#
#     Event  --message-->  text of the stream  --EventStream-->  client

MEDIA_TYPE = "text/event-stream"
#: Delay before a client reconnects after a lost stream, milliseconds.
RETRY_MS = 1000
BEGIN = f"retry: {RETRY_MS}\n\n".encode()


def message(event: Event) -> bytes:
    """Return an event as a server-sent message; its JSON contains no line breaks."""
    return f"id: {event.id}\ndata: {event.model_dump_json()}\n\n".encode()


def alive(place: str) -> bytes:
    """Return a keep-alive message with the id of the event to continue after."""
    return f": alive\nid: {place}\n\n".encode()


class EventStream(StreamingResponse):
    """A response that ends with its source or when the client disconnects, and then calls
    `on_end`.
    """

    def __init__(self, source: AsyncGenerator[bytes, None], on_end: Callable[[], None]) -> None:
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        super().__init__(source, 200, headers, MEDIA_TYPE)
        self._source, self._on_end = source, on_end

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the response."""
        try:
            async with aclosing(self._source):
                await super().__call__(scope, receive, send)
        finally:
            self._on_end()
