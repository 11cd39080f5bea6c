"""Who asks, and what they may: one path for all routes.

    request  --caller-->  Caller, with the Service  --may_read | may_write-->  a map
    refusal  --record_refusal-->  a line of the audit log

What depends on nothing slow is asked in the event loop: a thread's turn comes late where many
are at work.

What a caller may not read is not there: the same answer, word for word, as where there is none.
"""

from __future__ import annotations

import logging
import math
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import partial, wraps
from inspect import iscoroutinefunction
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.routing import APIRoute
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.types import Scope as AsgiScope

from sceneprint.engine.results.query_entry import unknown_query
from sceneprint.errors import Forbidden, KeyRequired, SceneprintError
from sceneprint.process import NOBODY, Actor, set_actor, set_tenant
from sceneprint.store.maps import unknown_map
from sceneprint.store.query_rows import QueryRow
from sceneprint.store.queue import unknown_job
from sceneprint_client.api import Job, Page
from sceneprint_client.api.admin import EVERY, SCOPES, Scope
from service.limits import (
    ROWS_PER_COST,
    TokenBucket,
    enforce_rate_limit,
    is_import,
    network_of,
    page_rows,
    request_cost,
    share,
    take_turn,
    too_many_requests,
)
from service.running_service import Here, Service

log = logging.getLogger(__name__)


def allows(grants: Mapping[str, Scope], scope: Scope, map_name: str = EVERY) -> bool:
    """Return whether grants, by names of maps and `*` for all, include a scope for a map, by
    default for all maps.
    """
    least = SCOPES.index(scope)
    held = [grants[name] for name in (EVERY, map_name) if name in grants]
    return any(SCOPES.index(one) >= least for one in held)


#: The map of a match, in requests for one.
MatchMap = Annotated[
    str | None,
    Query(
        alias="map",
        max_length=128,
        description="Where matches of several maps have the same id; default: the first of them.",
    ),
]


# Who asks, and what they may.

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
    created_at : of the key, seconds since 1970; None where none is asked for
    """

    name: str
    grants: Mapping[str, Scope]
    expires_at: float | None = None
    key_id: str | None = None
    tenant: str = NOBODY
    created_at: float | None = None

    def may(self, scope: Scope, map_name: str = EVERY) -> bool:
        """Whether the caller may do that with a map; default: with all and what is of none."""
        return allows(self.grants, scope, map_name)

    def require(self, map_name: str, scope: Scope) -> None:
        """Check that the caller may use a map in this scope. Raise UnknownMap if it may not read
        the map, and Forbidden if it may only read it.
        """
        if not self.may("read", map_name):
            raise unknown_map(map_name)
        if not self.may(scope, map_name):
            raise _forbidden(self, scope, f"map {map_name!r:.80}")

    def require_new(self, map_name: str) -> None:
        """See that the caller may make a map of a name; Forbidden, be it there or not."""
        if not self.may("admin", map_name):
            raise _forbidden(self, "admin", f"a map named {map_name!r:.80}")

    def require_every(self, scope: Scope) -> None:
        """See that the caller may do that with all maps, and with what is of none; Forbidden."""
        if not self.may(scope):
            raise _forbidden(self, scope, "all maps")

    def require_job(self, job: Job, scope: Scope = "read") -> Job:
        """Return the job if the caller may use it in this scope. Raise UnknownJob if it may not see
        the job, and Forbidden if it may only see it.
        """
        of = EVERY if job.map is None else job.map
        if not self.may("read" if job.map is not None else "admin", of):
            raise unknown_job(job.job_id)
        if not self.may(scope, of):
            raise _forbidden(self, scope, f"job {job.job_id}")
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


def require_readable(query_id: str, here: Service, asking: Caller) -> QueryRow:
    """Return the row of a query. Raise UnknownQuery, with the same text, if its answer is not
    stored or the caller may not read all maps that it names.
    """
    row = here.context.query_log.find_row(query_id)
    maps = [*row.searched, *([] if row.frame_map is None else [row.frame_map])]
    if len(asking.readable(maps)) < len(maps):
        raise unknown_query(query_id)
    return row


def anybody() -> Caller:
    """Where no key is asked for: whoever reaches the service is on its machine."""
    return Caller("", {EVERY: "admin"})


async def caller(
    request: Request, here: Here,
    given: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
) -> Caller:  # fmt: skip
    """Return the caller by the key in the request. A key is checked even if none is required: a
    wrong one would otherwise go unnoticed. Raise KeyRequired if it is missing, unknown, revoked or
    expired, and RateLimited or Busy if its tenant sends too many requests.
    """
    if given is None:
        if requires_key(request, here):
            raise KeyRequired(_why(request, here))
        set_actor(Actor("", address_of(request) or None))
        return anybody()
    key = await to_thread.run_sync(here.find_key, given.credentials, limiter=here.lookups)
    if key is None or (key.expires_at is not None and key.expires_at <= time.time()):
        enforce_rate_limit(request, here.limits.failed_keys, network_of(address_of(request)))
        raise KeyRequired(_REFUSED_KEY)
    request.state.caller, request.state.tenant = key.name, key.tenant
    set_actor(Actor(key.name, address_of(request) or None))
    await _admit(request, here, key.tenant)
    return Caller(
        key.name, key.grants, key.expires_at, key.id, key.tenant, created_at=key.created_at
    )


async def _admit(request: Request, here: Service, tenant: str) -> None:
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


async def hold_read(request: Request, here: Service, tenant: str) -> None:
    """Wait for a turn of the shared threads, several for a page of many rows, held until the answer
    begins. Raise Busy if none comes in time; requests without a key share with nobody.
    """
    if tenant == NOBODY:
        return
    weight = max(math.ceil(page_rows(request) / ROWS_PER_COST), 1)
    held = await take_turn(here.reads, tenant, here.wait_s, weight)
    request.state.at_answer.append(partial(here.reads.release, tenant, held))


def v1_router(
    prefix: str = "", tag: str | None = None, *depends: Callable[..., object]
) -> APIRouter:
    """Return a router of paths below /v1, each of which checks the caller and `depends`. `tag`
    names its operations in the OpenAPI document.
    """
    dependencies = [Depends(one) for one in (caller, *depends)]
    tags: list[str | Enum] | None = None if tag is None else [tag]
    return APIRouter(
        prefix=f"/v1{prefix}", tags=tags, dependencies=dependencies, route_class=ListRoute
    )


class ListRoute(APIRoute):
    """A route whose page of a list is written as JSON by the thread that made it, item by item.

    FastAPI would write it in the event loop, in one call that lets no other thread compute: 1000
    rows keep every other request waiting for 10 ms.
    """

    def __init__(self, path: str, endpoint: Callable[..., Any], **options: Any) -> None:
        super().__init__(path, _write_pages_of(endpoint), **options)


def _write_pages_of(endpoint: Callable[..., Any]) -> Callable[..., Any]:
    if iscoroutinefunction(endpoint):
        return endpoint

    @wraps(endpoint)
    def answer(*given: Any, **named: Any) -> Any:
        found = endpoint(*given, **named)
        return page_response(found) if isinstance(found, Page) else found

    return answer


def page_response(page: Page[Any]) -> Response:
    """A page as JSON, the same text as pydantic writes in one go."""
    items = ",".join([one.model_dump_json(by_alias=True) for one in page.items])
    rest = page.model_dump_json(by_alias=True, exclude={"items"})
    return Response(f'{{"items":[{items}],{rest[1:]}', media_type="application/json")


Asking = Annotated[Caller, Depends(caller)]


async def guest(
    request: Request, here: Here,
    given: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
) -> Caller | None:  # fmt: skip
    """Return the caller of a route that anybody may use; None without a key. Raise KeyRequired if
    the key is unknown, revoked or expired.
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


#: The same of all three: who tries keys learns of none that it was one.
_REFUSED_KEY = (
    "The key that was sent is unknown, revoked or expired. Check that it is complete, or ask the "
    "operator for another; `sceneprint keys --create NAME` creates one."
)


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


# Refused requests in the audit log.

#: Statuses of what was refused for who asked.
REFUSED = (401, 403)
#: Refusals of one caller from one address that are noted at once, and how long one more takes.
AT_ONCE, AGAIN_S = 10, 600.0
#: Refusals of all callers together that are noted at once, and each second: each is a commit.
ALL_AT_ONCE, ALL_PER_S = 20, 1.0


class RefusalFilter:
    """Decides which refusals are logged: however many there are, they fill neither log nor disk. It
    remembers the `most` latest callers and addresses.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, most: int = 10_000) -> None:
        self._each = TokenBucket("refusals", 1 / AGAIN_S, AT_ONCE, most, clock)
        self._all = TokenBucket("refusals", ALL_PER_S, ALL_AT_ONCE, most, clock)
        self._passed_over: OrderedDict[str, int] = OrderedDict()
        self._most = most

    def count(self, caller: str, address: str) -> int | None:
        """How many refusals alike were passed over before this one; None: it is passed over."""
        whose = f"{network_of(address)} {caller}"
        for bucket, of in ((self._each, whose), (self._all, "")):
            state = bucket.take(of)
            if state is not None and not state.allowed:
                self._passed_over[whose] = self._passed_over.pop(whose, 0) + 1
                if len(self._passed_over) > self._most:
                    self._passed_over.popitem(last=False)
                return None
        return self._passed_over.pop(whose, 0)


async def record_refusal(scope: AsgiScope, status: int) -> None:
    """Write a line of the audit log for a refused request before it is answered, unless there were
    too many. An answer is not held back by a log that cannot be written.
    """
    state: dict[str, Any] = scope["state"]
    client = scope.get("client")
    actor = Actor(state.get("caller", ""), None if client is None else client[0])
    missed = scope["app"].state.refusals.count(actor.name, actor.address or "")
    if missed is None:
        return
    path: dict[str, str] = scope.get("path_params", {})
    targets = [value for name, value in path.items() if name != "map_name"]
    data: dict[str, Any] = {"status": status}
    data["operation"] = getattr(scope.get("route"), "name", None) or "request"
    if missed:
        data["not_noted_before"] = missed
    service: Service = scope["app"].state.service
    write = partial(
        service.audit.record_refusal, actor, state.get("tenant", NOBODY),
        path.get("map_name"), targets[-1] if targets else None, state["request_id"], **data,
    )  # fmt: skip
    try:
        # however long its turn takes: who asks much must not get rid of what is noted
        await service.run(write, patient=True)
    except SceneprintError as error:
        log.error("audit entry not written", extra={"action": "refused", "error": str(error)})
