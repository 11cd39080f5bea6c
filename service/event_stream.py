"""One poller a process, and the streams of events that it feeds.

    database  --Feed-->  the newest events in memory  -->  every stream, each at its own place

A stream that is further behind than memory reaches reads the database itself until it has caught
up. So nobody who reads slowly costs memory, and nobody who waits costs a look at the database.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing, suppress
from itertools import islice

import anyio
from anyio import to_thread
from starlette.requests import ClientDisconnect
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from sceneprint.engine.admin.operations import begin, missed, next_events
from sceneprint.errors import Busy, RateLimited, SceneprintError
from sceneprint.process import NOBODY
from sceneprint.store import Database
from sceneprint.store.events import (
    EventFilter,
    EventRow,
    list_events,
    newest_number,
    number_events,
)
from sceneprint_client.api.admin import Event
from service.limits import Broken, Holdings, share

log = logging.getLogger(__name__)

#: Seconds between two looks at the database, half of them where there was something; and after one
#: that failed.
POLL_S, TROUBLE_S = 0.1, 1.0
#: Seconds of silence after which a stream says that it lives.
ALIVE_S = 3.0
#: Events held in memory, and read or told at once.
HELD, MOST = 4096, 500


class Feed:
    """The streams of one process.

    Parameters
    ----------
    database : that is looked at while anybody listens
    most : streams at once
    kept : newest events of each map that are kept for sure
    """

    def __init__(self, database: Database, most: int, kept: int) -> None:
        self._database, self._most, self._kept = database, most, kept
        self._streams = Holdings()
        self._closed = False
        self._poller: asyncio.Task[None] | None = None
        self._held: deque[EventRow] = deque()
        # all that is newer than `_since` and known is held; None: nobody has looked yet
        self._since: int | None = None
        self._newest = 0
        self._last: EventRow | None = None  # the one of the number `_newest`
        # which line of history these are of, and how often one took its place that lacks what was
        # told: a standby that was behind gives numbers out again that readers know of others
        self._history, self._turned = database.history, 0
        self._news = asyncio.Event()

    @property
    def streams(self) -> int:
        """How many there are."""
        return self._streams.total

    def join(self, tenant: str = NOBODY) -> None:
        """Take a place, to be given back by `leave`. Raise Busy if all are taken, and RateLimited
        if the tenant has its share.
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
        """Give the place back; the last one who leaves stops the poller."""
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
        self, wanted: EventFilter, after: int | None, may_go_on: Callable[[], bool]
    ) -> AsyncGenerator[tuple[list[EventRow], int], None]:
        """Events as they come, each time with the number of the last one that the reader may know
        and needs no more.

        At first, and once in ALIVE_S whatever else there is, the list is empty: others' events are
        no silence to the poller, and are to who waits for his own. Nor do they move the number.

        Parameters
        ----------
        wanted : the others are passed over
        after : number from which to go on; None: from now on
        may_go_on : asked once in ALIVE_S, in a thread; False ends the stream
        """
        try:
            async for batch in self._batches(wanted, after, may_go_on):
                yield batch
        except SceneprintError as error:  # who listens comes back, and is told what is wrong
            log.error("event stream failed", extra={"error": str(error)})

    async def _batches(
        self, wanted: EventFilter, after: int | None, may_go_on: Callable[[], bool]
    ) -> AsyncGenerator[tuple[list[EventRow], int], None]:
        if self._poller is None or self._poller.done():
            self._poller = asyncio.create_task(self._poll())
        turned = self._turned
        first, place, seen = await to_thread.run_sync(
            begin, self._database, wanted, self._kept, after
        )
        yield first, seen  # also where it is empty: the reader learns its place
        clock = asyncio.get_running_loop().time
        due = clock() + ALIVE_S
        while not self._closed:
            if clock() >= due:
                if not await to_thread.run_sync(may_go_on) or self._poller.done():
                    return  # without a poller it would be silent for ever
                yield [], seen
                due = clock() + ALIVE_S
            news = self._news
            if turned != self._turned:
                turned = self._turned
                _, place, seen = await to_thread.run_sync(
                    begin, self._database, wanted, self._kept, None
                )
                yield [missed(seen)], seen
                continue
            if self._since is None or place < self._since:
                found, place, seen = await to_thread.run_sync(
                    next_events, self._database, wanted, place, MOST
                )
                if found:
                    yield found, seen
                    continue
                if self._since is not None and place < self._since:
                    continue
            if self._since is not None and place < self._newest:
                held, place = self._after(place)
                seen = max((event.number for event in held if wanted.sees(event)), default=seen)
                found = [event for event in held if wanted(event)]
                if found:
                    yield found, seen
                continue
            with suppress(TimeoutError):
                await asyncio.wait_for(news.wait(), max(due - clock(), 0.0))

    def _after(self, place: int) -> tuple[list[EventRow], int]:
        """The next of the events held, and the number up to which these are all."""
        newer = sum(1 for event in reversed(self._held) if event.number > place)
        start = len(self._held) - newer
        found = list(islice(self._held, start, start + MOST))
        return found, found[-1].number if found else self._newest

    def _look(self) -> EventRow | None:
        number_events(self._database)
        with self._database.read() as connection:
            newest = newest_number(connection)
            found = list_events(connection, EventFilter(), after=newest - 1, limit=1)
        return found[0] if found else None

    def _is_behind(self) -> bool:
        """Whether the database lacks the last event that is known, or has another in its place."""
        if self._last is None:
            return False
        with self._database.read() as connection:
            after = self._last.number - 1
            return list_events(connection, EventFilter(), after=after, limit=1) != [self._last]

    async def _begin(self) -> None:
        """Go on from the newest event that there is."""
        self._last = await to_thread.run_sync(self._look)
        self._history = self._database.history
        self._held.clear()
        self._newest = self._since = 0 if self._last is None else self._last.number

    def _more(self, place: int) -> list[EventRow]:
        number_events(self._database)
        with self._database.read() as connection:
            return list_events(connection, EventFilter(), after=place, limit=MOST)

    async def _poll(self) -> None:
        """Look for what is new, as long as anybody listens."""
        pause = 0.0
        while True:
            await asyncio.sleep(pause)
            try:
                if self._since is None:
                    await self._begin()
                    self._wake()
                found = await to_thread.run_sync(self._more, self._newest)
                if self._history != self._database.history:
                    history = self._database.history
                    if await to_thread.run_sync(self._is_behind):
                        await self._begin()
                        self._turned += 1
                        self._wake()
                    else:  # as a synchronous standby: it has all that was told
                        self._history = history
                    pause = 0.0
                    continue
            except SceneprintError as error:
                log.error("events cannot be read", extra={"error": str(error)})
                pause = TROUBLE_S
                continue
            pause = 0.0 if len(found) == MOST else POLL_S / (2 if found else 1)
            if found:
                self._held.extend(found)
                while len(self._held) > HELD:
                    self._since = self._held.popleft().number
                self._newest, self._last = found[-1].number, found[-1]
                self._wake()

    def _wake(self) -> None:
        self._news.set()
        self._news = asyncio.Event()


# Server-sent events: what a stream looks like on the wire, and how it ends.
#
# Events  --message-->  text of the stream  --EventStream-->  who listens, until either side ends it

MEDIA_TYPE = "text/event-stream"
#: Milliseconds after which a listener who lost the stream comes back.
RETRY_MS = 1000
BEGIN = f"retry: {RETRY_MS}\n\n".encode()


def message(event: Event) -> bytes:
    """An event as a message of the stream; JSON has no line break within it."""
    return f"id: {event.id}\ndata: {event.model_dump_json()}\n\n".encode()


def alive(place: str) -> bytes:
    """A comment, and the id to come back with: there was nothing to be told."""
    return f": alive\nid: {place}\n\n".encode()


class EventStream(Response):
    """A body that goes on until its source ends or nobody listens; then `left` is called."""

    media_type = MEDIA_TYPE

    def __init__(self, source: AsyncGenerator[bytes, None], left: Callable[[], None]) -> None:
        super().__init__(
            headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"}, media_type=MEDIA_TYPE
        )
        del self.headers["content-length"]
        self._source, self._left = source, left

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it."""
        del scope
        try:
            await send(
                {
                    "type": "http.response.start",
                    "status": self.status_code,
                    "headers": self.raw_headers,
                }
            )
            async with anyio.create_task_group() as group:
                group.start_soon(_until_gone, receive, group.cancel_scope)
                await self._send_all(send)
                group.cancel_scope.cancel()
        finally:
            self._left()

    async def _send_all(self, send: Send) -> None:
        async with aclosing(self._source) as parts:
            async for part in parts:
                await send({"type": "http.response.body", "body": part, "more_body": True})
        await send({"type": "http.response.body", "body": b"", "more_body": False})


async def _until_gone(receive: Receive, scope: anyio.CancelScope) -> None:
    try:
        while (await receive())["type"] != "http.disconnect":
            pass  # a body that nobody asked for
    except (ClientDisconnect, Broken):
        pass
    scope.cancel()
