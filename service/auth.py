"""Authentication and authorisation of all routes, and the audit log of refused requests.

    request  --authenticate-->  Caller, with the Service  --may_read | may_write-->  a map
    refused request  --record_refusal-->  a line of the audit log

Dependencies that do not block run in the event loop, since a thread may not be free under load. For
a map that the caller cannot read, the response is the same, word for word, as for a map that does
not exist.
"""

from __future__ import annotations

import logging
import math
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
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
    """Return whether grants include a scope for a map, by default for all maps. Grants are scopes
    by map name; `*` stands for all maps.
    """
    least = SCOPES.index(scope)
    held = [grants[name] for name in (EVERY, map_name) if name in grants]
    return any(SCOPES.index(grant) >= least for grant in held)


# Query parameters of several routes.

Cursor = Annotated[str | None, Query(description="`next_cursor` of the previous page.")]
Limit = Annotated[int, Query(ge=1, le=1000)]
OnlyMap = Annotated[str | None, Query(alias="map", description="Only this map.")]
MatchMap = Annotated[
    str | None,
    Query(
        alias="map",
        max_length=128,
        description="Map of the match, if several maps contain a frame with this id; default: the "
        "first map.",
    ),
]


# Callers and their scopes.

_bearer = HTTPBearer(auto_error=False, description="A key that `sceneprint keys` created.")


@dataclass(frozen=True)
class Caller:
    """The sender of a request, with the data of its key.

    Parameters
    ----------
    name : name of the key; "" if no key is required
    grants : scope by map name; `*` stands for all maps
    expires_at : expiry of the key, seconds since 1970; None for no expiry
    key_id : id of the key; None if no key is required
    tenant : tenant of the key; NOBODY if no key is required
    created_at : creation time of the key, seconds since 1970; None if no key is required
    """

    name: str
    grants: Mapping[str, Scope]
    expires_at: float | None = None
    key_id: str | None = None
    tenant: str = NOBODY
    created_at: float | None = None

    def may(self, scope: Scope, map_name: str = EVERY) -> bool:
        """Return whether the caller has a scope for a map; default: for all maps."""
        return allows(self.grants, scope, map_name)

    def require(self, map_name: str, scope: Scope) -> None:
        """Check that the caller has a scope for a map. Raise UnknownMap if it cannot read the map,
        and Forbidden if it can only read it.
        """
        if not self.may("read", map_name):
            raise unknown_map(map_name)
        if not self.may(scope, map_name):
            raise _forbidden(self, scope, f"map {map_name!r:.80}")

    def require_new(self, map_name: str) -> None:
        """Raise Forbidden if the caller may not create a map of this name."""
        if not self.may("admin", map_name):
            raise _forbidden(self, "admin", f"a map named {map_name!r:.80}")

    def require_every(self, scope: Scope) -> None:
        """Raise Forbidden if the caller does not have the scope for all maps."""
        if not self.may(scope):
            raise _forbidden(self, scope, "all maps")

    def require_job(self, job: Job, scope: Scope = "read") -> Job:
        """Return a job for which the caller has a scope. Raise UnknownJob if it cannot read the
        job, and Forbidden if it can only read it.
        """
        of = EVERY if job.map is None else job.map
        if not self.may("read" if job.map is not None else "admin", of):
            raise unknown_job(job.job_id)
        if not self.may(scope, of):
            raise _forbidden(self, scope, f"job {job.job_id}")
        return job

    @property
    def reads_every(self) -> bool:
        """Return whether the caller may read all maps."""
        return self.may("read")

    @property
    def named(self) -> tuple[str, ...] | None:
        """Names of the maps that the caller may read; None if it may read all maps."""
        return None if self.reads_every else tuple(sorted(set(self.grants) - {EVERY}))


def require_readable(query_id: str, here: Service, caller: Caller) -> QueryRow:
    """Return the row of a query. Raise UnknownQuery, with the same text, if its answer is not
    stored, or the caller cannot read all its maps.
    """
    row = here.context.query_log.find_row(query_id)
    maps = [*row.searched, *([] if row.frame_map is None else [row.frame_map])]
    if not all(caller.may("read", name) for name in maps):
        raise unknown_query(query_id)
    return row


async def authenticate(
    request: Request, here: Here,
    credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
) -> Caller:  # fmt: skip
    """Return the caller of a request. A key is checked even if no key is required. Raise
    KeyRequired if the key is missing, unknown, revoked or expired, and RateLimited or Busy if its
    tenant sends too many requests.
    """
    if credentials is None:
        if (is_other := "authorization" in request.headers) or requires_key(request, here):
            header = request.state.forwarded
            reason = (
                "This service requires a key."
                if here.keys
                else "The Authorization header contains no key in the scheme Bearer."
                if is_other
                else (
                    f"The request came through a proxy (it has the header {header}), so anyone may "
                    "have sent it, and a key is required."
                )
            )
            raise KeyRequired(
                f"{reason} Send the header Authorization: Bearer KEY; create a key with "
                "`sceneprint keys --create NAME`."
            )
        set_actor(Actor("", address_of(request) or None))
        return Caller("", {EVERY: "admin"})
    key = await to_thread.run_sync(here.find_key, credentials.credentials, limiter=here.lookups)
    if key is None or (key.expires_at is not None and key.expires_at <= time.time()):
        enforce_rate_limit(request, here.wrong_keys, network_of(address_of(request)))
        raise KeyRequired(_REFUSED_KEY)
    request.state.caller, request.state.tenant = key.name, key.tenant
    set_actor(Actor(key.name, address_of(request) or None))
    await _admit(request, here, key.tenant)
    return Caller(
        key.name, key.grants, key.expires_at, key.id, key.tenant, created_at=key.created_at
    )


async def _admit(request: Request, here: Service, tenant: str) -> None:
    """Count a request and its body for its tenant until the response ends; raise RateLimited beyond
    a limit, and Busy without a turn.
    """
    set_tenant(tenant)
    enforce_rate_limit(request, here.request_rate, tenant, request_cost(request))
    if not here.requests.take(tenant, 1, here.places):
        raise too_many_requests(share(here.places))
    request.state.place = partial(here.requests.give, tenant, 1)
    request.state.at_end.append(request.state.place)
    if not is_import(request.scope):  # bodies of imports are not spooled
        length = request.headers.get("content-length", "")
        is_number = length.isascii() and length.isdigit()
        here.spool.require_room(tenant, int(length) if is_number else 0)
        request.state.body.charge(here.spool, tenant)
    here.reads.order.record_request(tenant)
    endpoint = getattr(request.scope.get("route"), "endpoint", None)
    if not iscoroutinefunction(endpoint):
        await hold_read(request, here, tenant)


def release_place(request: Request) -> None:
    """Stop counting a request as in progress, for streams, which may last for hours."""
    place = getattr(request.state, "place", None)
    if place is not None:
        request.state.at_end.remove(place)
        place()


async def hold_read(request: Request, here: Service, tenant: str) -> None:
    """Hold a turn in the shared threads until the response begins. A page of many rows needs
    several turns. Raise Busy if no turn becomes free in time. Requests without a key need no turn.
    """
    if tenant == NOBODY:
        return
    weight = max(math.ceil(page_rows(request) / ROWS_PER_COST), 1)
    held = await take_turn(here.reads, tenant, here.wait_s, weight)
    request.state.at_answer.append(partial(here.reads.release, tenant, held))


def v1_router(
    prefix: str = "", tag: str | None = None, *depends: Callable[..., object]
) -> APIRouter:
    """Return a router for paths below /v1 whose routes authenticate the caller and call `depends`.
    `tag` is the tag of the operations in the OpenAPI document.
    """
    dependencies = [Depends(dependency) for dependency in (authenticate, *depends)]
    tags: list[str | Enum] | None = None if tag is None else [tag]
    return APIRouter(
        prefix=f"/v1{prefix}", tags=tags, dependencies=dependencies, route_class=ListRoute
    )


class ListRoute(APIRoute):
    """A route that serialises a page of a list item by item, in the thread that read it.

    FastAPI would serialise the page in one call in the event loop, which blocks all requests for 10
    ms per 1000 rows.
    """

    def __init__(self, path: str, endpoint: Callable[..., Any], **options: Any) -> None:
        super().__init__(path, _serialize_pages_of(endpoint), **options)


def _serialize_pages_of(endpoint: Callable[..., Any]) -> Callable[..., Any]:
    if iscoroutinefunction(endpoint):
        return endpoint

    @wraps(endpoint)
    def answer(*arguments: Any, **options: Any) -> Any:
        result = endpoint(*arguments, **options)
        return page_response(result) if isinstance(result, Page) else result

    return answer


def page_response(page: Page[Any]) -> Response:
    """Return a page as a JSON response, the same bytes as pydantic writes in one call."""
    items = ",".join([item.model_dump_json(by_alias=True) for item in page.items])
    rest = page.model_dump_json(by_alias=True, exclude={"items"})
    return Response(f'{{"items":[{items}],{rest[1:]}', media_type="application/json")


Sender = Annotated[Caller, Depends(authenticate)]


async def guest(
    request: Request, here: Here,
    credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
) -> Caller | None:  # fmt: skip
    """Return the caller of a public route, or None without a key. Raise as `authenticate` does."""
    if credentials is None and requires_key(request, here):
        return None
    return await authenticate(request, here, credentials)


Guest = Annotated[Caller | None, Depends(guest)]


def requires_key(request: Request, here: Here) -> bool:
    """Return whether a request needs a key, because it may come from another machine."""
    return here.keys or request.state.forwarded is not None


def address_of(request: Request) -> str:
    """Return the network address of the client; headers cannot forge it."""
    return "" if request.client is None else request.client.host


#: The same text for all causes, so that it does not reveal whether a guessed key once existed.
_REFUSED_KEY = (
    "The key that was sent is unknown, revoked or expired. Check that it is complete, or ask the "
    "operator for another key, which `sceneprint keys --create NAME` creates."
)


async def may_read(map_name: str, caller: Sender) -> None:
    """Raise UnknownMap if the caller cannot read the map."""
    caller.require(map_name, "read")


async def may_write(map_name: str, caller: Sender) -> None:
    """Raise UnknownMap or Forbidden if the caller cannot change the content of the map."""
    caller.require(map_name, "write")


async def may_admin(map_name: str, caller: Sender) -> None:
    """Raise UnknownMap or Forbidden if the caller cannot change the map itself."""
    caller.require(map_name, "admin")


async def reads_every(caller: Sender) -> None:
    """Raise Forbidden if the caller cannot read all maps."""
    caller.require_every("read")


async def administers(caller: Sender) -> None:
    """Raise Forbidden if the caller is not an administrator of all maps."""
    caller.require_every("admin")


def _forbidden(caller: Caller, scope: Scope, what: str) -> Forbidden:
    return Forbidden(
        f"The key {caller.name!r:.80} does not have the scope {scope!r} for {what}. Ask the "
        "operator for a key with this scope."
    )


# Refused requests in the audit log.

#: Status codes of responses that refuse a request because of who sent it.
REFUSED = (401, 403)
#: Number of refusals per caller and address to log at once, and seconds until one more is logged.
AT_ONCE, AGAIN_S = 10, 600.0
#: Number of refusals of all callers to log at once, and per second. Each takes a transaction.
ALL_AT_ONCE, ALL_PER_S = 20, 1.0


class RefusalFilter:
    """Rate limiter of logged refusals. It remembers the `most` latest callers and addresses."""

    def __init__(self, clock: Callable[[], float] = time.monotonic, most: int = 10_000) -> None:
        self._each = TokenBucket("refusals", 1 / AGAIN_S, AT_ONCE, most, clock)
        self._all = TokenBucket("refusals", ALL_PER_S, ALL_AT_ONCE, most, clock)
        self._skipped: OrderedDict[str, int] = OrderedDict()
        self._most = most

    def count(self, caller: str, address: str) -> int | None:
        """Return the number of refusals skipped since the last logged one; None to skip this
        one.
        """
        whose = f"{network_of(address)} {caller}"
        for bucket, of in ((self._each, whose), (self._all, "")):
            if bucket.take(of):
                self._skipped[whose] = self._skipped.pop(whose, 0) + 1
                if len(self._skipped) > self._most:
                    self._skipped.popitem(last=False)
                return None
        return self._skipped.pop(whose, 0)


async def record_refusal(scope: AsgiScope, status: int) -> None:
    """Write an audit line for a refused request before the response, unless there were too many.
    Errors are logged.
    """
    state: dict[str, Any] = scope["state"]
    client = scope.get("client")
    actor = Actor(state.get("caller", ""), None if client is None else client[0])
    skipped = scope["app"].state.refusals.count(actor.name, actor.address or "")
    if skipped is None:
        return
    path: dict[str, str] = scope.get("path_params", {})
    targets = [value for name, value in path.items() if name != "map_name"]
    data: dict[str, Any] = {"status": status}
    data["operation"] = getattr(scope.get("route"), "name", None) or "request"
    if skipped:
        data["not_noted_before"] = skipped
    service: Service = scope["app"].state.service
    write = partial(
        service.audit.record_refusal, actor, state.get("tenant", NOBODY),
        path.get("map_name"), targets[-1] if targets else None, state["request_id"], **data,
    )  # fmt: skip
    try:
        # Wait without a limit, so that a flood of requests cannot suppress audit lines.
        await service.run(write, patient=True)
    except SceneprintError as error:
        log.error("audit entry not written", extra={"action": "refused", "error": str(error)})
