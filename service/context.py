"""What the routes share: the engine, the gate, the figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, TypeVar, cast

from anyio import CapacityLimiter, to_thread
from fastapi import Depends, Request

from sceneprint.engine import Engine
from sceneprint.store.tenants import NOBODY, current_tenant
from service.event_stream import Feed
from service.limits import BodySpool, Gate, Holdings, RateLimits, Turns, take_turn
from service.metrics import Metrics

T = TypeVar("T")

#: Threads that look keys up, beside those that all other work shares.
LOOKUPS = 4
#: Turns of requests that work in shared threads, such as lists: they compete for one interpreter,
#: so that one beside another tenant has one.
READS, READS_BESIDE = 8, 1


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
    places : of requests that a tenant may have in progress three quarters of
    wait_s : seconds to wait for a turn
    requests : that tenants have in progress
    reads : turns of requests that work in shared threads
    spool : bodies that are kept on disk until they are read
    lookups : threads that look keys up
    """

    engine: Engine
    gate: Gate
    uploads: Gate
    metrics: Metrics
    keys: bool
    feed: Feed
    limits: RateLimits
    places: int
    wait_s: float
    requests: Holdings = field(default_factory=Holdings)
    reads: Turns = field(default_factory=lambda: Turns(READS, READS_BESIDE))
    spool: BodySpool = field(default_factory=BodySpool)
    lookups: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(LOOKUPS))

    async def run(self, do: Callable[..., T], *given: object, patient: bool = False) -> T:
        """Do it in a shared thread, when it is the tenant's turn; not while a turn is held.

        Parameters
        ----------
        do, given : the work, and its arguments
        patient : wait for as long as it takes

        Raises
        ------
        Busy : its turn did not come in time; nothing was begun.
        """
        tenant = current_tenant()
        if tenant == NOBODY:  # nobody to share with
            return await to_thread.run_sync(do, *given)
        held = await take_turn(self.reads, tenant, None if patient else self.wait_s)
        try:
            return await to_thread.run_sync(do, *given)
        finally:
            self.reads.release(tenant, held)


async def _context(request: Request) -> Context:
    return cast(Context, request.app.state.context)


Here = Annotated[Context, Depends(_context)]
