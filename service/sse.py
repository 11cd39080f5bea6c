"""Server-sent events: what a stream looks like on the wire, and how it ends.

Events  --message-->  text of the stream  --EventStream-->  who listens, until either side ends it
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing

import anyio
from starlette.requests import ClientDisconnect
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from sceneprint.schemas.events import Event
from service.slowness import Broken

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
    """A body that goes on until its source ends or nobody listens any more.

    Parameters
    ----------
    source : of the parts of the body
    left : called when it is over
    """

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
