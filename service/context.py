"""What the routes share: the engine, the gate, the figures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, cast

from anyio import CapacityLimiter
from fastapi import Depends, Request

from sceneprint.engine import Engine
from service.event_stream import Feed
from service.limits import Gate, Holdings, RateLimits, Spool, Turns
from service.metrics import Metrics

#: Threads that look keys up, beside those that all other work shares.
LOOKUPS = 4
#: Turns of requests that work in shared threads, such as lists: they compete for one interpreter.
READS = 8


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
    reads: Turns = field(default_factory=lambda: Turns(READS))
    spool: Spool = field(default_factory=Spool)
    lookups: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(LOOKUPS))


async def _context(request: Request) -> Context:
    return cast(Context, request.app.state.context)


Here = Annotated[Context, Depends(_context)]
