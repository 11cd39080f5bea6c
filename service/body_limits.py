"""Limits on the body of a request while it arrives: its size, and the time that it takes."""

from __future__ import annotations

import asyncio
import time

from starlette.types import Message, Receive

from sceneprint.errors import SceneprintError, SlowBody, TooLarge

#: Longest silence within a body, seconds.
IDLE_S = 10.0
#: Seconds that each MiB adds to the time for a body: 2 Mbit/s, a poor radio link.
S_PER_MIB = 4.0


class Broken(Exception):
    """Stops the reading of a body; nobody but `RequestMiddleware` sees it."""


class RequestBody:
    """The body of one request.

    The time for it grows with what has come, not with what was announced. Only time in which we
    wait for the caller counts.

    Parameters
    ----------
    receive : gives the next part
    most : bytes
    body_s : seconds for a body of hardly any bytes
    """

    def __init__(self, receive: Receive, most: int, body_s: float) -> None:
        self._receive, self._most, self._body_s = receive, most, body_s
        self._waited_s, self._bytes, self._whole = 0.0, 0, False
        #: Why no more of it is read.
        self.fault: SceneprintError | None = None

    @property
    def received(self) -> int:
        """Bytes that have come."""
        return self._bytes

    async def next(self) -> Message:
        """The next part; after the last, whatever else is told.

        Raises
        ------
        Broken : `fault` says why.
        """
        if self._whole:
            return await self._receive()
        start = time.monotonic()
        left = self._body_s + S_PER_MIB * self._bytes / (1 << 20) - self._waited_s
        try:
            async with asyncio.timeout(min(IDLE_S, max(left, 0.0))):
                message = await self._receive()
        except TimeoutError:
            self.fault = self._slow(left)
            raise Broken from None
        self._waited_s += time.monotonic() - start
        self._bytes += len(message.get("body", b""))
        self._whole = not message.get("more_body", False)
        if self._bytes > self._most:
            self.fault = too_large(self._most)
            raise Broken
        return message

    def _slow(self, left: float) -> SlowBody:
        why = (
            f"no data arrived for {IDLE_S:g} s" if left >= IDLE_S else "the transfer took too long"
        )
        return SlowBody(
            f"The body arrived too slowly: {why}, after {self._bytes} bytes. The limit is "
            f"{self._body_s:g} s plus {S_PER_MIB:g} s for each MiB. Send less at once, or use a "
            "faster link."
        )


def too_large(most: int) -> TooLarge:
    """A body of more bytes than are taken."""
    return TooLarge(
        f"The body exceeds the limit of {most} bytes. Send the image at a lower resolution, or "
        "fewer frames at a time."
    )
