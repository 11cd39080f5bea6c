"""Who asks, and what they may: one path for all routes.

What depends on nothing slow is asked in the event loop: a thread's turn comes late where many
are at work.

What a caller may not read is not there: the same answer, word for word, as where there is none.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from inspect import iscoroutinefunction
from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from sceneprint.errors import Forbidden, KeyRequired
from sceneprint.store.maps import unknown_map
from sceneprint.store.queue import unknown_job
from sceneprint.store.tenants import NOBODY, set_tenant
from sceneprint_client.api import Job
from sceneprint_client.api.admin import EVERY, Scope, allows
from service.context import Context, Here
from service.limits import (
    ROWS_PER_COST,
    enforce_rate_limit,
    is_import,
    network_of,
    page_rows,
    request_cost,
    share,
    take_turn,
    too_many_requests,
)

_bearer = HTTPBearer(auto_error=False, description="A key made by `sceneprint keys`.")


@dataclass(frozen=True)
class Caller:
    """Who asks.

    Parameters
    ----------
    name : of the key; "" where none is asked for
    grants : scope by name of a map, `*` for all
    expires_at : of the key, seconds since 1970; None: never
    key_id : of the key; None where none is asked for
    tenant : of the key; NOBODY where none is asked for
    changed : maps of which more than reading was asked, for the audit log
    created_at : of the key, seconds since 1970; None where none is asked for
    """

    name: str
    grants: Mapping[str, Scope]
    expires_at: float | None = None
    key_id: str | None = None
    tenant: str = NOBODY
    changed: set[str] = field(default_factory=set, compare=False)
    created_at: float | None = None

    def may(self, scope: Scope, map_name: str = EVERY) -> bool:
        """Whether the caller may do that with a map; default: with all and what is of none."""
        return allows(self.grants, scope, map_name)

    def require(self, map_name: str, scope: Scope) -> None:
        """See that the caller may do that with a map.

        Raises
        ------
        UnknownMap : it may not even read it.
        Forbidden : it may read it, and not that.
        """
        if not self.may("read", map_name):
            raise unknown_map(map_name)
        if not self.may(scope, map_name):
            raise _forbidden(self, scope, f"map {map_name!r:.80}")
        if scope != "read":
            self.changed.add(map_name)

    def require_new(self, map_name: str) -> None:
        """See that the caller may make a map of a name; Forbidden, be it there or not."""
        if not self.may("admin", map_name):
            raise _forbidden(self, "admin", f"a map named {map_name!r:.80}")
        self.changed.add(map_name)

    def require_every(self, scope: Scope) -> None:
        """See that the caller may do that with all maps, and with what is of none; Forbidden."""
        if not self.may(scope):
            raise _forbidden(self, scope, "all maps")

    def require_job(self, job: Job, scope: Scope = "read") -> Job:
        """The job, where the caller may do that with it.

        Raises
        ------
        UnknownJob : it may not see it.
        Forbidden : it may see it, and not that.
        """
        of = EVERY if job.map is None else job.map
        if not self.may("read" if job.map is not None else "admin", of):
            raise unknown_job(job.job_id)
        if not self.may(scope, of):
            raise _forbidden(self, scope, f"job {job.job_id}")
        if scope != "read" and job.map is not None:
            self.changed.add(job.map)
        return job

    def readable(self, names: Iterable[str]) -> list[str]:
        """Those of some maps that the caller may read."""
        return [name for name in names if self.may("read", name)]

    @property
    def reads_every(self) -> bool:
        """Whether there is no map that the caller may not read."""
        return self.may("read")

    @property
    def named(self) -> tuple[str, ...] | None:
        """Names of the maps that the caller may read, where it may not read all; else None."""
        return None if self.reads_every else tuple(sorted(set(self.grants) - {EVERY}))


def anybody() -> Caller:
    """Where no key is asked for: whoever reaches the service is on its machine."""
    return Caller("", {EVERY: "admin"})


async def caller(
    request: Request, here: Here,
    given: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
) -> Caller:  # fmt: skip
    """Who asks, by the key that was shown.

    Raises
    ------
    KeyRequired : none was shown, or an unknown one, or one that has expired.
    RateLimited, Busy : its tenant asks too often, or too much at once.
    """
    if not requires_key(request, here):
        found = anybody()
        request.state.changed = found.changed
        return found
    if given is None:
        raise KeyRequired(_why(request, here))
    key = await to_thread.run_sync(here.engine.find_key, given.credentials, limiter=here.lookups)
    if key is None or (key.expires_at is not None and key.expires_at <= time.time()):
        enforce_rate_limit(request, here.limits.failed_keys, network_of(address_of(request)))
        raise KeyRequired(_why(request, here) if key is None else _EXPIRED)
    request.state.caller, request.state.tenant = key.name, key.tenant
    found = Caller(
        key.name, key.grants, key.expires_at, key.id, key.tenant, created_at=key.created_at
    )
    request.state.changed = found.changed
    await _admit(request, here, key.tenant)
    return found


async def _admit(request: Request, here: Context, tenant: str) -> None:
    """Count a request for its tenant, before its body is read, until it is answered."""
    set_tenant(tenant)
    enforce_rate_limit(request, here.limits.requests, tenant, request_cost(request))
    if not here.requests.take(tenant, 1, here.places):
        raise too_many_requests(share(here.places))
    request.state.place = partial(here.requests.give, tenant, 1)
    request.state.at_end.append(request.state.place)
    if not is_import(request.scope):  # which is written where it stays
        length = request.headers.get("content-length", "")
        known = length.isascii() and length.isdigit()
        here.spool.require_room(tenant, int(length) if known else 0)
        request.state.body.charge(here.spool, tenant)
    endpoint = getattr(request.scope.get("route"), "endpoint", None)
    if not iscoroutinefunction(endpoint):
        await hold_read(request, here, tenant)


def release_place(request: Request) -> None:
    """Count a request no more as one in progress: it goes on for as long as somebody listens."""
    place = getattr(request.state, "place", None)
    if place is not None:
        request.state.at_end.remove(place)
        place()


async def hold_read(request: Request, here: Context, tenant: str) -> None:
    """Wait for a turn of the shared threads, held until the answer begins; Busy.

    Parameters
    ----------
    request : a page of many rows takes several turns
    here : of the service
    tenant : that asks; where no key is asked for there is nobody to share with
    """
    if tenant == NOBODY:
        return
    weight = max(math.ceil(page_rows(request) / ROWS_PER_COST), 1)
    held = await take_turn(here.reads, tenant, here.wait_s, weight)
    request.state.at_answer.append(partial(here.reads.release, tenant, held))


def v1_router(
    prefix: str = "", tag: str | None = None, *depends: Callable[..., object]
) -> APIRouter:
    """A router of paths below /v1, each of which asks who calls.

    Parameters
    ----------
    prefix : of its paths, below /v1
    tag : of its operations in the OpenAPI document
    depends : what else each of its paths depends on
    """
    dependencies = [Depends(one) for one in (caller, *depends)]
    tags: list[str | Enum] | None = None if tag is None else [tag]
    return APIRouter(prefix=f"/v1{prefix}", tags=tags, dependencies=dependencies)


Asking = Annotated[Caller, Depends(caller)]


async def guest(
    request: Request, here: Here,
    given: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
) -> Caller | None:  # fmt: skip
    """For routes that answer anybody, and tell more to some: None where no key was shown.

    Raises
    ------
    KeyRequired : an unknown one was shown, or one that has expired.
    """
    if given is None and requires_key(request, here):
        return None
    return await caller(request, here, given)


Guest = Annotated[Caller | None, Depends(guest)]


def requires_key(request: Request, here: Here) -> bool:
    """Whether whoever sent a request must show a key: it may have come from another machine."""
    return here.keys or request.state.forwarded is not None


def address_of(request: Request) -> str:
    """Where a request came from: of the connection itself, whatever its headers say."""
    return "" if request.client is None else request.client.host


_EXPIRED = "The key has expired. Ask the operator for a new one."


def _why(request: Request, here: Here) -> str:
    """Why a key is asked for, and how to come by one."""
    reason = "This service requires a key."
    if not here.keys:
        reason = (
            f"The request came through a proxy (it has the header {request.state.forwarded}), so "
            "anybody may have sent it, and it needs a key."
        )
    return (
        f"{reason} Send the header Authorization: Bearer KEY; create one with `sceneprint keys "
        "--create NAME`."
    )


async def may_read(map_name: str, asking: Asking) -> None:
    """For routes of a map: UnknownMap where the caller may not read it."""
    asking.require(map_name, "read")


async def may_write(map_name: str, asking: Asking) -> None:
    """For routes that change what is in a map."""
    asking.require(map_name, "write")


async def may_admin(map_name: str, asking: Asking) -> None:
    """For routes that change a map itself."""
    asking.require(map_name, "admin")


async def reads_every(asking: Asking) -> None:
    """For routes that tell of all maps together."""
    asking.require_every("read")


async def administers(asking: Asking) -> None:
    """For routes that are the operator's."""
    asking.require_every("admin")


def _forbidden(asking: Caller, scope: Scope, what: str) -> Forbidden:
    return Forbidden(
        f"The key {asking.name!r:.80} does not have the scope {scope!r} for {what}. Ask the "
        "operator for a key that has it."
    )
