"""What the routes share: the engine, the gate, the figures."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Annotated, TypeVar, cast

import anyio
from anyio import to_thread
from fastapi import Depends, Request

from sceneprint.engine import Engine
from sceneprint.errors import Busy
from service.event_stream import Feed
from service.metrics import Metrics
from service.rate_limits import RateLimits

T = TypeVar("T")


class Gate:
    """Lets a few pieces of heavy work run at once, some wait, and sends the rest away.

    Parameters
    ----------
    running : at once
    waiting : at most, be it for their bodies or for their turn
    longest_s : seconds to wait for a turn: an answer that comes later helps no robot
    """

    def __init__(self, running: int, waiting: int, longest_s: float) -> None:
        self._turns, self._threads = (anyio.CapacityLimiter(running) for _ in range(2))
        self._longest_s = longest_s
        self._places = running + waiting
        self._taken = 0

    @asynccontextmanager
    async def place(self) -> AsyncIterator[None]:
        """A place inside. Take it before the body is read: who is sent away has spooled nothing.

        Raises
        ------
        Busy : as many are inside as may.
        """
        if self._taken >= self._places:
            raise Busy("The queue of uploads and queries is full. Retry in a second.")
        self._taken += 1
        try:
            yield
        finally:
            self._taken -= 1

    async def run(self, do: Callable[[], T], *, patient: bool = False) -> T:
        """Do it in a thread, off the event loop, when it is its turn; for who has a place.

        Parameters
        ----------
        do : the work
        patient : wait for as long as it takes: much would have to be sent again

        Raises
        ------
        Busy : its turn did not come in time; nothing was begun.
        """
        turn = object()
        try:
            with anyio.fail_after(None if patient else self._longest_s):
                await self._turns.acquire_on_behalf_of(turn)
        except TimeoutError:
            raise Busy(
                f"The service cannot start this request within {self._longest_s:g} s. Nothing "
                "was stored. Retry in a second."
            ) from None
        try:
            return await to_thread.run_sync(do, limiter=self._threads)
        finally:
            self._turns.release_on_behalf_of(turn)


@dataclass(frozen=True, eq=False)
class Context:
    """Of one running service.

    Parameters
    ----------
    engine, gate, metrics : see there
    uploads : the gate of uploads, which wait for the disk and for other writers: of their own, so
        that no query waits behind them
    keys : whether callers must show one
    feed : of events
    limits : how often callers may ask
    """

    engine: Engine
    gate: Gate
    uploads: Gate
    metrics: Metrics
    keys: bool
    feed: Feed
    limits: RateLimits


async def _context(request: Request) -> Context:
    return cast(Context, request.app.state.context)


Here = Annotated[Context, Depends(_context)]
