"""Middleware of all requests: ids, checks of headers, body limits, response headers and logs."""

from __future__ import annotations

import logging
import re
import time
import uuid
from collections.abc import Callable

from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from sceneprint.errors import AmbiguousKey, Busy, SceneprintError, UnsupportedType
from sceneprint.process import NOBODY, name_request, set_actor, set_tenant
from sceneprint.settings import Settings
from service.auth import REFUSED, address_of, record_refusal
from service.browser_security import (
    PREFLIGHT_HEADERS,
    Headers,
    Origins,
    foreign_request_error,
    forwarded,
    security_headers,
)
from service.limits import Broken, RefusalDelays, RequestBody, is_import, network_of, too_large
from service.metrics import Metrics
from service.problems import error_problem

log = logging.getLogger(__name__)

_ID = re.compile(rb"[\w.-]{1,64}")
#: Methods with separate metrics.
_METHODS = frozenset(("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"))
#: Status code in the log if the client disconnected before the response.
_HUNG_UP = 499
#: Status codes of refusals, see `RefusalDelays`.
_HELD_BACK = (401, 403, 429)
#: Paths that are requested every few seconds or without a key, logged at level DEBUG.
_PROBES = ("/healthz", "/readyz", "/metrics", "/openapi.json")
#: Maximum number of concurrent requests, including waiting requests and streams.
_MOST_AT_ONCE = 900


class RequestMiddleware:
    """Middleware that gives each request an id, refuses foreign requests, limits bodies, adds
    headers to responses, and logs the request.

    Parameters
    ----------
    app : application
    settings : see Settings
    origins : origins whose pages may send requests
    metrics : metrics of the process
    """

    def __init__(
        self, app: ASGIApp, settings: Settings, origins: Origins, metrics: Metrics
    ) -> None:
        self._app, self._origins, self._metrics = app, origins, metrics
        self._most, self._most_of_import = settings.max_upload_bytes, settings.max_import_bytes
        self._alone = not settings.asks_for_keys
        self._delays = RefusalDelays()
        self._at_once = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers: dict[bytes, bytes] = dict(scope["headers"])
        sent_id = headers.get(b"x-request-id", b"")
        request_id = sent_id.decode() if _ID.fullmatch(sent_id) else uuid.uuid4().hex
        name_request(request_id)
        set_tenant(NOBODY)  # no tenant until `auth.authenticate` checks the key
        set_actor(None)
        own: Headers = [(b"x-request-id", request_id.encode())]
        own += self._origins.headers(headers.get(b"origin"))
        state = scope.setdefault("state", {})
        body = RequestBody(receive, self._limit(scope))
        at_answer: list[Callable[[], None]] = []
        at_end: list[Callable[[], None]] = [body.close]
        state.update(request_id=request_id, headers=own, forwarded=forwarded(headers))
        state.update(body=body, at_answer=at_answer, at_end=at_end)
        status, start = 0, time.perf_counter()

        async def send_message(message: Message) -> None:
            nonlocal status
            if body.fault is not None and status == 0:
                return  # drop the response of the application to the broken body; ours follows
            if message["type"] == "http.response.start":
                status = message["status"]
                complete = [*message["headers"], *own]
                message["headers"] = complete + security_headers(complete)
                _call(at_answer)  # release turns before the audit line below needs one
                if status in _HELD_BACK and not self._alone:
                    whose = state.get("tenant") or network_of(address_of(Request(scope)))
                    await self._delays.wait(whose)
                if status in REFUSED:
                    await record_refusal(scope, status)
            await send(message)

        self._at_once += 1
        try:
            early = self._early(scope, headers)
            if isinstance(early, SceneprintError):
                await _refusal(request_id, early)(scope, receive, send_message)
            elif early is not None:
                await early(scope, receive, send_message)
            else:
                await self._app(scope, body.next, send_message)
        except Broken:
            pass
        except ClientDisconnect:
            status = _HUNG_UP
        except Exception:
            self._note(scope, request_id, 500, time.perf_counter() - start, body.received)
            raise
        finally:
            self._at_once -= 1
            _call(at_answer + at_end)
        if body.fault is not None and status == 0:
            fault, body.fault = body.fault, None
            await _refusal(request_id, fault)(scope, receive, send_message)
        self._note(scope, request_id, status, time.perf_counter() - start, body.received)

    def _early(
        self, scope: Scope, headers: dict[bytes, bytes]
    ) -> SceneprintError | Response | None:
        """Return an early response, or an error that refuses the request; None to continue."""
        origin, length = headers.get(b"origin"), headers.get(b"content-length", b"")
        is_allowed = origin is not None and self._origins.allows(origin)
        if self._alone:
            refusal = foreign_request_error(scope["headers"], self._origins.allows, scope["path"])
            if refusal is not None:
                return refusal
        preflight = scope["method"] == "OPTIONS" and b"access-control-request-method" in headers
        if is_allowed and preflight:
            return Response(status_code=204, headers=PREFLIGHT_HEADERS)
        if self._at_once > _MOST_AT_ONCE:
            return Busy(
                "The service has reached its limit of concurrent requests. Retry in a second."
            )
        if sum(name == b"authorization" for name, _ in scope["headers"]) > 1:
            return AmbiguousKey(
                "The request has more than one Authorization header, so its key is ambiguous. "
                "Send one."
            )
        encoding = headers.get(b"content-encoding", b"identity").strip().lower()
        # Some clients declare the compression of archives in this header.
        if encoding not in (b"identity", b"") and not is_import(scope):
            return UnsupportedType(
                f"The body has Content-Encoding {encoding.decode('latin-1')!r:.40}, which is not "
                "supported. Send the body uncompressed, without this header."
            )
        most = self._limit(scope)
        if length.isdigit() and (len(length) > 18 or int(length) > most):
            return too_large(most)
        return None

    def _limit(self, scope: Scope) -> int:
        """Return the maximum size of the body, bytes. Imports have their own limit."""
        return self._most_of_import if is_import(scope) else self._most

    def _note(
        self, scope: Scope, request_id: str, status: int, seconds: float, received: int
    ) -> None:
        """Count and log a request."""
        route = getattr(scope.get("route"), "path", "other")
        if scope["path"].startswith("/v1/") and not route.startswith(("/v1", "other")):
            route = f"/v1{route}"  # the pattern lacks the prefix of the mount point
        method = scope["method"] if scope["method"] in _METHODS else "other"
        tenant = scope["state"].get("tenant", NOBODY)
        self._metrics.request(method, route, status, seconds, received, tenant)
        extra = {
            "request_id": request_id, "method": scope["method"], "path": scope["path"],
            "status": status, "milliseconds": round(1e3 * seconds, 1),
        }  # fmt: skip
        level = logging.DEBUG if route in _PROBES else logging.INFO
        if status in REFUSED:
            level = logging.WARNING
            extra["key"] = scope["state"].get("caller", "")
            extra["address"] = address_of(Request(scope)) or None
        log.log(level, "request", extra=extra)


def _call(callbacks: list[Callable[[], None]]) -> None:
    """Call each callback once."""
    while callbacks:
        callbacks.pop()()


def _refusal(request_id: str, error: SceneprintError) -> Response:
    """Return an error response that closes the connection, since the body was not read."""
    response = error_problem(request_id, error)
    response.headers["Connection"] = "close"
    return response
