"""Limits on the body of a request while it arrives: its size, and the time that it takes."""

from __future__ import annotations

import asyncio
import math
import os
import re
import tempfile
import time

from starlette.types import Message, Receive, Scope

from sceneprint.errors import RateLimited, SceneprintError, SlowBody, TooLarge
from service.gate import Holdings, share

#: Longest silence within a body, seconds.
IDLE_S = 10.0
#: Seconds that each MiB adds to the time for a body: 2 Mbit/s, a poor radio link.
S_PER_MIB = 4.0


_IMPORTS = re.compile(r"/v1/maps/[^/]+/imports")
#: Bytes of a body that are kept in memory until they are read; the rest waits on disk. Also
#: those by which tenants are charged for that.
IN_MEMORY = 1 << 20


class Broken(Exception):
    """Stops the reading of a body; nobody but `RequestMiddleware` sees it."""


class Spool:
    """The temporary folder, where bodies wait to be read, and what each tenant holds of it."""

    def __init__(self) -> None:
        self._held = Holdings()

    def require_room(self, tenant: str, size: int) -> None:
        """See that a tenant may have a body of so many bytes here; RateLimited."""
        if size > IN_MEMORY and not self._held.allows(tenant, size - IN_MEMORY, self._room()):
            raise self._full(self._room())

    def take(self, tenant: str, size: int) -> None:
        """Charge a tenant for bytes that are about to be written; RateLimited beyond its share."""
        room = self._room()
        if not self._held.take(tenant, size, room):
            raise self._full(room)

    def give(self, tenant: str, size: int) -> None:
        """Take them off its account: they are removed."""
        self._held.give(tenant, size)

    def _room(self) -> int:
        """Bytes that all bodies together may have."""
        found = os.statvfs(tempfile.gettempdir())
        return found.f_bavail * found.f_frsize + self._held.total

    @staticmethod
    def _full(room: int) -> RateLimited:
        return RateLimited(
            f"Bodies of this key's tenant would take more than {share(room) >> 20} MiB of the "
            "service's temporary folder, which is its share. Wait for their answers, or send "
            "smaller bodies."
        )


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
        self._spool: Spool | None = None
        self._tenant, self._charged = "", 0

    def charge(self, spool: Spool, tenant: str) -> None:
        """Charge a tenant for what is written of it to disk, before it is."""
        self._spool, self._tenant = spool, tenant

    def close(self) -> None:
        """Give back what it took: it was read, or is read no more."""
        if self._spool is not None and self._charged:
            self._spool.give(self._tenant, self._charged)
            self._charged = 0

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
        if self._spool is not None:
            self._pay(self._spool)
        return message

    def _pay(self, spool: Spool) -> None:
        more = IN_MEMORY * math.ceil(self._bytes / IN_MEMORY - 1) - self._charged
        if more <= 0:
            return
        try:
            spool.take(self._tenant, more)
        except RateLimited as error:
            self.fault = error
            raise Broken from None
        self._charged += more

    def _slow(self, left: float) -> SlowBody:
        why = (
            f"no data arrived for {IDLE_S:g} s" if left >= IDLE_S else "the transfer took too long"
        )
        return SlowBody(
            f"The body arrived too slowly: {why}, after {self._bytes} bytes. The limit is "
            f"{self._body_s:g} s plus {S_PER_MIB:g} s for each MiB. Send less at once, or use a "
            "faster link."
        )


def is_import(scope: Scope) -> bool:
    """Whether the body of a request is an archive, which is written where it stays."""
    return scope["method"] == "POST" and _IMPORTS.fullmatch(scope["path"]) is not None


def too_large(most: int) -> TooLarge:
    """A body of more bytes than are taken."""
    return TooLarge(
        f"The body exceeds the limit of {most} bytes. Send the image at a lower resolution, or "
        "fewer frames at a time."
    )
