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
from sceneprint_client.api.base import invalid_request
from service.browser_security import security_headers
from service.problem_types import problem_type

log = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"


def type_of(name: str) -> str:
    """Return the type of a problem document: the name of the error in kebab case."""
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
    headers = {"WWW-Authenticate": "Bearer"} if status == 401 else {}
    return JSONResponse(document, status, headers, MEDIA_TYPE)


def error_problem(request_id: str, error: errors.SceneprintError) -> JSONResponse:
    """Return the problem document of an error as a response."""
    kind = problem_type(type(error))
    fields = error.fields if isinstance(error, errors.InvalidRequest) else ()
    detail = kind.detail or str(error)
    response = problem(request_id, type(error).__name__, kind.status, detail, fields)
    if kind.retry_after_s is not None:
        response.headers["Retry-After"] = str(kind.retry_after_s)
    return response


#: Names from RFC 9110, which the standard library uses from Python 3.13 on.
_PHRASES = {413: "Content Too Large", 416: "Range Not Satisfiable", 422: "Unprocessable Content"}


def phrase(status: int) -> str:
    """Return the name of a status code, independent of the version of Python."""
    return _PHRASES.get(status, HTTPStatus(status).phrase)


def refusals(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return error responses with these status codes, for the OpenAPI document."""
    content = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {
        status: {"description": phrase(status), "content": content}
        for status in (*statuses, 400, 401, 403, 408, 421, 429, 500, 503, 507)
    }


def install(app: FastAPI) -> None:
    """Install exception handlers that convert all errors to problem documents."""

    @app.exception_handler(errors.SceneprintError)
    async def _ours(request: Request, error: errors.SceneprintError) -> JSONResponse:
        answer = error_problem(_id(request), error)
        if answer.status_code >= 500 and not isinstance(error, errors.Busy):
            log.error("request failed", extra={"request_id": _id(request), "error": str(error)})
        wait_s = getattr(request.state, "wait_s", None)
        if wait_s is not None:
            answer.headers["Retry-After"] = str(wait_s)
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
        if error.status_code == 405:  # add methods, since Starlette lists only those of one route
            answer.headers["Allow"] = ", ".join(_allowed(app, request.url.path))
        return answer

    @app.exception_handler(Exception)
    async def _unexpected(request: Request, error: Exception) -> JSONResponse:
        log.error("unexpected error", exc_info=error, extra={"request_id": _id(request)})
        detail = (
            "The service failed to handle this request; nothing was partially written. Its log "
            "contains the traceback under the id of the request. Please report it."
        )
        answer = problem(_id(request), "InternalError", 500, detail)
        # This response does not pass through `RequestMiddleware`.
        for name, value in getattr(request.state, "headers", ()):
            answer.headers[name.decode()] = value.decode()
        for name, value in security_headers(answer.raw_headers):
            answer.headers[name.decode()] = value.decode()
        answer.headers["Connection"] = "close"  # uvicorn closes it after an exception
        return answer


def _allowed(app: FastAPI, path: str) -> list[str]:
    """Return the methods of a path, from the route with the fewest parameters."""
    paths = app.openapi()["paths"]
    matches = [route for route in paths if re.fullmatch(re.sub(r"\{\w+\}", "[^/]+", route), path)]
    if not matches:
        return ["GET"]  # paths outside of the document are read-only
    return sorted(method.upper() for method in paths[min(matches, key=lambda p: p.count("{"))])


def _id(request: Request) -> str:
    return str(getattr(request.state, "request_id", ""))
