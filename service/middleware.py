"""Around every request: its id, whom it is for, its size, its time."""

from __future__ import annotations

import logging
import re
import time
import uuid

from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.hosts import stranger
from service.metrics import Metrics
from service.problems import problem, status_of

log = logging.getLogger(__name__)

_ID = re.compile(rb"[\w.-]{1,64}")
#: What is counted by its name: a caller may invent others without end.
_METHODS = frozenset(("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"))
#: As noted where the caller hung up before there was an answer.
_HUNG_UP = 499


class _TooLargeWhileStreaming(Exception):
    """Stops the reading of a body; nobody but `Around` sees it."""


class Around:
    """Gives each request an id, sends strangers away, stops too large bodies, and notes it.

    Parameters
    ----------
    app : the application
    limit : bytes of a body
    metrics : to count in
    alone : whether only this machine is served; then by any other name it is not
    """

    def __init__(self, app: ASGIApp, limit: int, metrics: Metrics, alone: bool) -> None:
        self._app, self._limit, self._metrics, self._alone = app, limit, metrics, alone

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = dict(scope["headers"])
        given = headers.get(b"x-request-id", b"")
        request_id = given.decode() if _ID.fullmatch(given) else uuid.uuid4().hex
        scope.setdefault("state", {})["request_id"] = request_id
        seen, status, too_large, start = 0, 0, False, time.perf_counter()

        async def counted() -> Message:
            nonlocal seen, too_large
            message = await receive()
            seen += len(message.get("body", b""))
            if seen > self._limit:
                too_large = True
                raise _TooLargeWhileStreaming
            return message

        async def answered(message: Message) -> None:
            nonlocal status
            if too_large and status == 0:
                return  # whatever the application makes of the broken body; ours follows
            if message["type"] == "http.response.start":
                status = message["status"]
                message["headers"] = [
                    *message["headers"],
                    (b"x-request-id", request_id.encode()),
                    (b"x-content-type-options", b"nosniff"),
                ]
            await send(message)

        length = headers.get(b"content-length", b"")
        unwelcome = stranger(scope["headers"]) if self._alone else None
        try:
            if unwelcome is not None:
                kind = type(unwelcome).__name__
                told = problem(request_id, kind, status_of(unwelcome), str(unwelcome))
                told.headers["Connection"] = "close"  # what is still coming is not read
                await told(scope, receive, answered)
            elif length.isdigit() and len(length) < 19 and int(length) > self._limit:
                too_large = True  # said beforehand: not a byte is read
            else:
                await self._app(scope, counted, answered)
        except _TooLargeWhileStreaming:
            pass
        except ClientDisconnect:
            status = _HUNG_UP  # nobody is left to be answered
        except Exception:  # answered further out, with 500
            self._note(scope, request_id, 500, time.perf_counter() - start)
            raise
        if too_large and status == 0:
            detail = (
                f"The body has more than {self._limit} bytes, the most that is taken. "
                "Send the image at a lower resolution, or one frame at a time."
            )
            too_large = False
            refused = problem(request_id, "TooLarge", 413, detail)
            refused.headers["Connection"] = "close"  # what is still coming is not read
            await refused(scope, receive, answered)
        self._note(scope, request_id, status, time.perf_counter() - start)

    def _note(self, scope: Scope, request_id: str, status: int, seconds: float) -> None:
        route = getattr(scope.get("route"), "path", "other")
        if scope["path"].startswith("/v1/") and not route.startswith(("/v1", "other")):
            route = f"/v1{route}"  # a router's own pattern lacks the prefix it is mounted under
        method = scope["method"] if scope["method"] in _METHODS else "other"
        self._metrics.request(method, route, status, seconds)
        level = logging.DEBUG if route in ("/healthz", "/readyz", "/metrics") else logging.INFO
        log.log(
            level,
            "request",
            extra={
                "request_id": request_id,
                "method": scope["method"],
                "path": scope["path"],
                "status": status,
                "milliseconds": round(1e3 * seconds, 1),
            },
        )
