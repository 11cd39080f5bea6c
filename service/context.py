"""What the routes share: the engine, the gate, the figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, TypeVar, cast

import anyio
from anyio import to_thread
from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from sceneprint.engine import Engine
from sceneprint.errors import Busy, KeyRequired
from service.metrics import Metrics

T = TypeVar("T")


class Gate:
    """Lets a few pieces of heavy work run at once, some wait, and sends the rest away.

    Parameters
    ----------
    running : at once
    waiting : at most
    """

    def __init__(self, running: int, waiting: int) -> None:
        self._limiter = anyio.CapacityLimiter(running)
        self._waiting = waiting

    async def run(self, do: Callable[[], T]) -> T:
        """Do it in a thread, off the event loop.

        Raises
        ------
        Busy : as many wait as may.
        """
        seen = self._limiter.statistics()
        if seen.borrowed_tokens >= seen.total_tokens and seen.tasks_waiting >= self._waiting:
            raise Busy(
                "The service is working on as many uploads and queries as it lets wait. "
                "Come back in a second."
            )
        return await to_thread.run_sync(do, limiter=self._limiter)


@dataclass(frozen=True, eq=False)
class Context:
    """Of one running service.

    Parameters
    ----------
    engine, gate, metrics : see there
    keys : whether callers must show one
    """

    engine: Engine
    gate: Gate
    metrics: Metrics
    keys: bool


def _context(request: Request) -> Context:
    return cast(Context, request.app.state.context)


Here = Annotated[Context, Depends(_context)]

_bearer = HTTPBearer(auto_error=False, description="A key made by `sceneprint keys`.")


def key_holder(
    here: Here, given: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]
) -> str | None:
    """Name of the key that was shown; None where none is asked for.

    Raises
    ------
    KeyRequired : none was shown, or an unknown one.
    """
    if not here.keys:
        return None
    name = None if given is None else here.engine.key_name(given.credentials)
    if name is None:
        raise KeyRequired(
            "This service listens beyond its own machine, and asks for a key. Send the header "
            "Authorization: Bearer KEY; `sceneprint keys --create NAME` makes one."
        )
    return name
