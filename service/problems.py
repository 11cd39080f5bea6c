"""Problem documents (RFC 9457) for all errors, and their status codes."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from sceneprint import errors
from sceneprint_client.api import Problem
from sceneprint_client.api.base import invalid_request
from service.browser_security import security_headers

log = logging.getLogger(__name__)

#: Status code of each error class; other classes have that of their nearest base class.
STATUSES: dict[type[errors.SceneprintError], int] = {
    errors.FrameError: 422,
    errors.NotFound: 404,
    errors.Conflict: 409,
    errors.InvalidRequest: 422,
    errors.MalformedBody: 400,
    errors.UnsupportedType: 415,
    errors.TooLarge: 413,
    errors.SlowBody: 408,
    errors.AmbiguousKey: 400,
    errors.PreconditionFailed: 412,
    errors.KeyRequired: 401,
    errors.Forbidden: 403,
    errors.QuotaExceeded: 403,
    errors.RateLimited: 429,
    errors.Misdirected: 421,
    errors.ForeignOrigin: 403,
    errors.Busy: 503,
    errors.StoreFull: 507,
    errors.UnusableStore: 503,
    errors.SceneprintError: 500,
}
#: Seconds for the header Retry-After. They are short if load is the cause, and longer if a person
#: must act first.
RETRY_AFTER_S = {429: "1", 503: "1", 507: "30"}
LATER_S: dict[type[errors.SceneprintError], str] = {
    errors.ReadOnlyStore: "60", errors.NewerSchema: "60",
}  # fmt: skip
#: Messages for clients if the store cannot be used. The messages of the errors name folders, which
#: only the operator should see.
_LOG = "Its log has the details under the id of the request."
UNUSABLE: dict[type[errors.SceneprintError], str] = {
    errors.StoreFull: "The service's disk is full, so nothing was stored. Queries still work. "
    f"{_LOG} Free some space there, and send the request again.",
    errors.ReadOnlyStore: "The service's store is read-only, so nothing was stored. Queries "
    f"still work. {_LOG} Make the data folder writable there, and restart the service.",
    errors.NewerSchema: "A later version of sceneprint has migrated the service's store, so this "
    f"process stored nothing. {_LOG} Stop the process, and start the later version.",
    errors.StoreLocked: "Another process has locked the service's store for too long, so "
    f"nothing was stored. Queries still work. {_LOG} Retry later.",
    errors.StoreAway: "The service's database or object store does not respond. The request may "
    f"or may not have been stored; it is safe to send it again. {_LOG} Retry later.",
    errors.UnusableStore: "The service cannot use its store at the moment, so nothing was "
    f"stored. {_LOG} Retry later.",
}
MEDIA_TYPE = "application/problem+json"


def status_of(error: errors.SceneprintError) -> int:
    """Return the HTTP status code of an error."""
    return next(STATUSES[kind] for kind in type(error).__mro__ if kind in STATUSES)


def type_of(name: str) -> str:
    """Return the type of a problem: the name of the error in kebab case."""
    return f"/problems/{errors.kebab_case(name)}"


def problem(
    request_id: str, name: str, status: int, detail: str, fields: Sequence[tuple[str, str]] = ()
) -> JSONResponse:
    """Return a problem document as a response."""
    document: dict[str, Any] = {
        "type": type_of(name),
        "title": errors.kebab_case(name).replace("-", " ").capitalize(),
        "status": status,
        "detail": detail,
        "instance": f"/requests/{request_id}",
    }
    if fields:
        document["errors"] = [{"field": place, "reason": reason} for place, reason in fields]
    headers = {"Retry-After": RETRY_AFTER_S[status]} if status in RETRY_AFTER_S else {}
    if status == 401:
        headers["WWW-Authenticate"] = "Bearer"
    return JSONResponse(document, status, headers, MEDIA_TYPE)


#: Names of RFC 9110 that the standard library has since Python 3.13.
_PHRASES = {413: "Content Too Large", 416: "Range Not Satisfiable", 422: "Unprocessable Content"}


def phrase(status: int) -> str:
    """Return the name of a status code, the same in all versions of Python."""
    return _PHRASES.get(status, HTTPStatus(status).phrase)


def declared(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return responses with these status codes for the OpenAPI document."""
    content = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {
        status: {"description": phrase(status), "content": content}
        for status in (*statuses, 400, 401, 403, 408, 421, 429, 500, 503, 507)
    }


def install(app: FastAPI) -> None:
    """Install exception handlers that turn every error into a problem document."""

    @app.exception_handler(errors.SceneprintError)
    async def _ours(request: Request, error: errors.SceneprintError) -> JSONResponse:
        status = status_of(error)
        if status >= 500 and not isinstance(error, errors.Busy):
            log.error("request failed", extra={"request_id": _id(request), "error": str(error)})
        fields = error.fields if isinstance(error, errors.InvalidRequest) else ()
        detail = str(error)
        if isinstance(error, errors.UnusableStore):
            detail = next(UNUSABLE[kind] for kind in type(error).__mro__ if kind in UNUSABLE)
        answer = problem(_id(request), type(error).__name__, status, detail, fields)
        rate = getattr(request.state, "rate", None)
        if rate is not None and isinstance(error, errors.RateLimited):
            answer.headers["Retry-After"] = str(rate.wait_s)
        if type(error) in LATER_S:
            answer.headers["Retry-After"] = LATER_S[type(error)]
        return answer

    @app.exception_handler(RequestValidationError)
    async def _validation(request: Request, error: RequestValidationError) -> JSONResponse:
        ours = invalid_request(error.errors(), "The request")
        return problem(_id(request), "InvalidRequest", 422, str(ours), ours.fields)

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> JSONResponse:
        name = phrase(error.status_code).title().replace(" ", "")
        detail = f"{request.method} {request.url.path}: {error.detail}. See /docs."
        answer = problem(_id(request), name, error.status_code, detail)
        answer.headers.update(error.headers or {})
        if error.status_code == 405:  # Starlette lists only the methods of the first route
            answer.headers["Allow"] = ", ".join(_allowed(app, request.url.path))
        return answer

    @app.exception_handler(Exception)
    async def _unexpected(request: Request, error: Exception) -> JSONResponse:
        log.error("unexpected error", exc_info=error, extra={"request_id": _id(request)})
        detail = (
            "The service failed to handle this request; nothing was partially written. Its log "
            "has the traceback under the request's id. Please report it."
        )
        answer = problem(_id(request), "InternalError", 500, detail)
        # `RequestMiddleware` does not see this response.
        for name, value in getattr(request.state, "headers", ()):
            answer.headers[name.decode()] = value.decode()
        for name, value in security_headers(answer.raw_headers):
            answer.headers[name.decode()] = value.decode()
        answer.headers["Connection"] = "close"  # uvicorn closes it after an exception
        return answer


def _allowed(app: FastAPI, path: str) -> list[str]:
    """Return the methods of a path. `/v1/keys/me` does not have those of `/v1/keys/{key_name}`."""
    paths = app.openapi()["paths"]
    found = [one for one in paths if re.fullmatch(re.sub(r"\{\w+\}", "[^/]+", one), path)]
    if not found:
        return ["GET"]  # paths outside the document are read-only
    return sorted(method.upper() for method in paths[min(found, key=lambda one: one.count("{"))])


def _id(request: Request) -> str:
    return str(getattr(request.state, "request_id", ""))


__all__ = ["Problem", "declared", "install", "problem", "status_of"]
