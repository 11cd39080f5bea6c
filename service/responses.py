"""Responses with files and derived data: ETags, content negotiation and byte ranges."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from typing import Any, BinaryIO

from fastapi import Request, Response
from fastapi.responses import StreamingResponse
from starlette.background import BackgroundTask

from sceneprint.engine.maps.map_frames import Output
from sceneprint.errors import DamagedBlob, InvalidRequest
from sceneprint.store.queue import JobFile
from service.problems import problem, refusals
from service.running_service import Service

# The headers Accept, If-Match and If-None-Match (RFC 9110, sections 12.5.1 and 13.1).

_TAG = re.compile(r'(W/)?"([\x21\x23-\x7e\x80-\xff]*)"')
_TYPE = re.compile(r"\s*([\w.+*-]+/[\w.+*-]+)\s*((?:;[^,]*)?)", re.ASCII)
_QUALITY = re.compile(r";\s*q\s*=\s*(\d+(?:\.\d*)?)", re.ASCII)


def expected_tags(request: Request) -> Collection[str] | None:
    """Return the entity tags of If-Match; None if any tag matches. Raise InvalidRequest if the
    header is not valid.
    """
    header = ", ".join(request.headers.getlist("if-match")).strip()
    if header in ("", "*"):
        return None
    tags = _TAG.findall(header)
    if not tags:
        raise InvalidRequest(
            f"The header If-Match is {header!r:.80}. Send the ETag that you received with the "
            "resource, including its quotes.",
            (("If-Match", "not an entity tag"),),
        )
    return frozenset(tag for weak, tag in tags if not weak)


def is_known(request: Request, tag: str) -> bool:
    """Return whether If-None-Match contains an entity tag, so that the client has the content."""
    header = ", ".join(request.headers.getlist("if-none-match")).strip()
    return header == "*" or any(value == tag for _, value in _TAG.findall(header))


def preferred_media_type(request: Request, offers: Sequence[str]) -> str:
    """Return the offered media type that Accept prefers; by default, the first."""
    ranges: dict[str, float] = {}
    for kind, parameters in _TYPE.findall(", ".join(request.headers.getlist("accept"))[:1000]):
        match = _QUALITY.search(parameters)
        quality = min(float(match[1]), 1.0) if match else 1.0
        ranges[kind.lower()] = max(quality, ranges.get(kind.lower(), 0.0))

    def quality_of(offer: str) -> float:
        specific = (offer, f"{offer.partition('/')[0]}/*", "*/*")
        return next((ranges[rule] for rule in specific if rule in ranges), 0.0)

    return max(offers, key=quality_of)


_STRING = {"type": "string"}
_BINARY = {"type": "string", "format": "binary"}
_TAG_HEADER = {"description": "Entity tag of the bytes, for If-None-Match.", "schema": _STRING}
_UNCHANGED = {"description": "Not modified: If-None-Match names this ETag."}


def file_responses(
    *kinds: str, description: str, model: Any = None, statuses: tuple[int, ...] = (404, 409),
    tagged: bool = True, ranges: bool = False,
) -> dict[int | str, dict[str, Any]]:  # fmt: skip
    """Return the responses of a route that returns files, for the OpenAPI document.

    Parameters
    ----------
    kinds : media types of the file
    description : description of a successful response
    model : class of the response if it is JSON
    statuses : status codes of errors
    tagged : whether the file has an entity tag
    ranges : whether the route supports byte ranges; see `send_file`
    """
    content = {kind: {"schema": _STRING if kind.startswith("text/") else _BINARY} for kind in kinds}
    done: dict[str, Any] = {"description": description, "content": content}
    if tagged:
        done["headers"] = {"ETag": _TAG_HEADER}
    responses: dict[int | str, dict[str, Any]] = {304: _UNCHANGED} if tagged else {}
    if ranges:
        done["headers"]["Accept-Ranges"] = {"schema": _STRING}
        responses[206] = {**done, "description": "The requested range."}
        statuses += (416,)
    responses[200] = done if model is None else {**done, "model": model}
    return responses | refusals(*statuses)


def tag_headers(output: Output[Any]) -> dict[str, str]:
    """Return the response headers with the entity tag of an output."""
    return {"ETag": f'"{output.tag}"', "Cache-Control": "private, no-cache"}


async def send_output(
    request: Request, here: Service, output: Output[bytes], kind: str,
    name: str | None = None, **headers: str,
) -> Response:  # fmt: skip
    """Return a response with an output; compute it at the gate unless the client has it already."""
    headers |= tag_headers(output)
    if is_known(request, output.tag):
        return Response(None, 304, headers)
    data = await here.gate.enter(output.make)
    if name is not None:
        headers["Content-Disposition"] = f'inline; filename="{safe(name)}"'
    return Response(data, 200, headers, kind)


def safe(name: str) -> str:
    """Return an id with `_` for each character that is not allowed in headers."""
    return "".join(c if c.isascii() and c.isprintable() and c not in '"\\/' else "_"
                   for c in name)  # fmt: skip


# Files sent in chunks, which limits memory.

#: Number of bytes per read.
_CHUNK = 1 << 18
_RANGE = re.compile(r"\s*bytes\s*=\s*(\d{0,18})\s*-\s*(\d{0,18})\s*", re.IGNORECASE | re.ASCII)


def send_file(
    request: Request, open_file: Callable[[], BinaryIO], media_type: str, tag: str, name: str
) -> Response:
    """Return a response with a file, or with the requested range of it (RFC 9110, section 14).

    The file is opened before this returns, so that it can be deleted meanwhile.

    Parameters
    ----------
    request : request with the headers Range, If-Range and If-None-Match
    open_file : function that opens the file; the file must be seekable
    tag : entity tag of the file
    name : suggested name for saving the file

    Raises
    ------
    OSError : If the file cannot be opened.
    """
    headers = {"ETag": f'"{tag}"', "Cache-Control": "private, no-cache", "Accept-Ranges": "bytes"}
    if is_known(request, tag):
        return Response(None, 304, headers)
    file = open_file()
    size = file.seek(0, 2)
    first, last = _requested_range(request, tag, size)
    if first > last or first >= size > 0:
        file.close()
        refused = problem(
            str(getattr(request.state, "request_id", "")), "RangeNotSatisfiable", 416,
            f"The file has {size} bytes, and the range starts after them. Request an earlier "
            "range.",
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


def send_product_file(
    request: Request, here: Service, find: Callable[[], JobFile], name: str
) -> Response:
    """Return a response with a result file of a job; see `send_file`.

    Parameters
    ----------
    find : function that returns the file; it raises UnknownJob if the job was deleted
    name : suggested name for saving the file

    Raises
    ------
    DamagedBlob : If the bytes of the file are lost.
    """
    file, blobs = find(), here.context.store.blobs
    if is_known(request, file.blob) or blobs.condition(file.blob) == "sound":
        with suppress(FileNotFoundError):
            return send_file(
                request, lambda: blobs.open(file.blob), file.media_type, file.blob, name
            )
    find()  # raise an error if the job was deleted
    raise DamagedBlob(f"{file.name} of the job is damaged. Delete the job, and start another.")


def _requested_range(request: Request, tag: str, size: int) -> tuple[int, int]:
    """Return the first and the last byte of the requested range, or those of the whole file if
    Range is not valid or has several ranges, or If-Range has another entity tag.
    """
    whole = 0, size - 1
    condition = request.headers.get("if-range")
    if condition is not None and condition.strip() != f'"{tag}"':
        return whole
    match = _RANGE.fullmatch(request.headers.get("range", ""))
    if match is None or not (match[1] or match[2]) or size == 0:
        return whole
    if not match[1]:  # a suffix range
        return (size - min(int(match[2]), size), size - 1) if int(match[2]) else (size, size - 1)
    first, last = int(match[1]), int(match[2] or size - 1)
    return whole if match[2] and last < first else (first, min(last, size - 1))


def _chunks(file: BinaryIO, first: int, last: int) -> Iterator[bytes]:
    with file:
        file.seek(first)
        remaining = last - first + 1
        while remaining > 0 and (chunk := file.read(min(_CHUNK, remaining))):
            remaining -= len(chunk)
            yield chunk
