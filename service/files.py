"""Files sent in parts, whole or a range of them: memory does not grow with their size."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any, BinaryIO

from fastapi import Request, Response
from fastapi.responses import StreamingResponse
from starlette.background import BackgroundTask

from service.conditions import is_known
from service.problems import declared, problem

#: Bytes that are read at once.
_CHUNK = 1 << 18
_RANGE = re.compile(r"\s*bytes\s*=\s*(\d{0,18})\s*-\s*(\d{0,18})\s*", re.IGNORECASE | re.ASCII)


def files(
    media_types: Sequence[str], description: str, *statuses: int
) -> dict[int | str, dict[str, Any]]:
    """Responses of a route that sends such a file, for the OpenAPI document.

    Parameters
    ----------
    media_types, description : of the file: one of these types
    statuses : of refusals beside 416
    """
    binary = {one: {"schema": {"type": "string", "format": "binary"}} for one in media_types}
    tag = {"description": "Stands for these bytes.", "schema": {"type": "string"}}
    headers = {"ETag": tag, "Accept-Ranges": {"schema": {"type": "string"}}}
    return {
        200: {"description": description, "headers": headers, "content": binary},
        206: {"description": "The range that was asked for.", "headers": headers,
              "content": binary},
        304: {"description": "As the caller has it: its If-None-Match names this ETag."},
        **declared(404, 416, *statuses),
    }  # fmt: skip


def send_file(
    request: Request, open_file: Callable[[], BinaryIO], media_type: str, tag: str, name: str
) -> Response:
    """A file, or the one range of it that the request asks for (RFC 9110, section 14).

    It is opened at once: that it is removed meanwhile changes nothing.

    Parameters
    ----------
    request : with Range, If-Range and If-None-Match
    open_file : gives the file, which can be sought in
    media_type, tag, name : of its content; its ETag; what to call it when it is saved

    Raises
    ------
    OSError : it cannot be opened.
    """
    headers = {"ETag": f'"{tag}"', "Cache-Control": "private, no-cache", "Accept-Ranges": "bytes"}
    if is_known(request, tag):
        return Response(None, 304, headers)
    file = open_file()
    size = file.seek(0, 2)
    first, last = _wanted(request, tag, size)
    if first > last or first >= size > 0:
        file.close()
        refused = problem(
            str(getattr(request.state, "request_id", "")), "RangeNotSatisfiable", 416,
            f"The file has {size} bytes, and the range begins behind them. Ask for less.",
        )  # fmt: skip
        refused.headers["Content-Range"] = f"bytes */{size}"
        return refused
    headers["Content-Length"] = str(last - first + 1)
    headers["Content-Disposition"] = f'inline; filename="{name}"'
    partial = (first, last) != (0, size - 1)
    if partial:
        headers["Content-Range"] = f"bytes {first}-{last}/{size}"
    return StreamingResponse(
        _chunks(file, first, last), 206 if partial else 200, headers, media_type,
        background=BackgroundTask(file.close),
    )  # fmt: skip


def _wanted(request: Request, tag: str, size: int) -> tuple[int, int]:
    """First and last byte; all of them where Range asks for several ranges, or is not understood,
    or If-Range names another state of the file.
    """
    whole = 0, size - 1
    condition = request.headers.get("if-range")
    if condition is not None and condition.strip() != f'"{tag}"':
        return whole
    found = _RANGE.fullmatch(request.headers.get("range", ""))
    if found is None or not (found[1] or found[2]) or size == 0:
        return whole
    if not found[1]:  # the last so many
        return (size - min(int(found[2]), size), size - 1) if int(found[2]) else (size, size - 1)
    first = int(found[1])
    last = min(int(found[2]), size - 1) if found[2] else size - 1
    if found[2] and int(found[2]) < first:
        return whole
    return first, last


def _chunks(file: BinaryIO, first: int, last: int) -> Iterator[bytes]:
    with file:
        file.seek(first)
        left = last - first + 1
        while left > 0 and (chunk := file.read(min(_CHUNK, left))):
            left -= len(chunk)
            yield chunk
