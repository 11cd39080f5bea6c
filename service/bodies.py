"""Bodies of requests: forms with a frame, or JSON."""

from __future__ import annotations

import re
from collections.abc import AsyncIterator, Collection, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any, BinaryIO

from fastapi import Request
from pydantic import ValidationError
from pydantic_core import from_json
from starlette.datastructures import FormData, UploadFile
from starlette.exceptions import HTTPException
from starlette.formparsers import MultiPartException

from sceneprint.errors import (
    InvalidRequest,
    MalformedBody,
    TooLarge,
    UnsupportedType,
)
from sceneprint.schemas import FrameMeta
from sceneprint.schemas.frames import MOST_PRIORITY
from service import raw
from service.problems import invalid

#: Most bytes of a form field that is no file, and of a JSON body.
FIELD_BYTES = 1 << 18
FORM = "multipart/form-data"


@dataclass(frozen=True, eq=False)
class Upload:
    """A frame that came in a form, or as the body.

    Parameters
    ----------
    file : its bytes, large ones on disk until they are read
    meta : what is known of it
    fields : what else the form or the query string says
    """

    file: BinaryIO
    meta: FrameMeta
    fields: dict[str, str]


def media_type(request: Request) -> str:
    """Type of the body, without its parameters."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


@asynccontextmanager
async def uploaded(request: Request, *fields: str) -> AsyncIterator[Upload]:
    """Read a frame: a form with a file part `frame`, a field `meta`, and others that are named; or
    the frame alone, with the same in the query string.

    Raises
    ------
    UnsupportedType : neither.
    MalformedBody : a form or JSON that cannot be parsed.
    InvalidRequest : a part is missing or unknown, or `meta` is not as it should be.
    StoreFull, UnusableStore : the machine cannot keep it until it is read.
    """
    if media_type(request) in raw.TYPES:
        file, meta, others = await raw.received(request, fields)
        try:
            yield Upload(file.file, meta, others)
        finally:
            await file.close()
        return
    async with form_of(request, most_files=1) as form:
        known = {"frame", "meta", *fields}
        check_parts(form, known)
        frame = form.get("frame")
        if not isinstance(frame, UploadFile) or len(form.getlist("frame")) != 1:
            raise InvalidRequest(
                "The form has no file part `frame`, or more than one part of that name. Send the "
                "depth image or point cloud in it, with a file name.",
                (("frame", "not one file"),),
            )
        texts = texts_of(form)
        yield Upload(frame.file, _meta(texts.pop("meta", None)), texts)


@asynccontextmanager
async def form_of(request: Request, most_files: int) -> AsyncIterator[FormData]:
    """Read a form; its files are gone afterwards.

    Raises
    ------
    UnsupportedType, MalformedBody, StoreFull, UnusableStore : as `uploaded`.
    """
    if media_type(request) != FORM:
        raise UnsupportedType(
            f"The body is {media_type(request) or 'of no type'!r:.80}, and a frame comes as "
            f"{FORM}: a file part `frame` and a field `meta` with JSON. One frame may also be the "
            f"whole body, as {', '.join(raw.TYPES)}."
        )
    try:
        form = await request.form(max_files=most_files, max_fields=16, max_part_size=FIELD_BYTES)
        for name, value in form.multi_items():  # some charsets have halves of surrogate pairs
            f"{name}{value if isinstance(value, str) else ''}".encode()
    except (HTTPException, MultiPartException, UnicodeError) as error:  # of a strange charset
        raise MalformedBody(
            f"The form cannot be parsed ({getattr(error, 'detail', error)}). Send a file part "
            "`frame` and a field `meta`, with a boundary as in RFC 7578."
        ) from error
    except OSError as error:  # what is too large for memory is spooled to a file meanwhile
        raise raw.unspoolable(error) from error
    try:
        yield form
    finally:
        await form.close()


def check_parts(form: FormData, known: Collection[str]) -> None:
    """See that a form has no part that would have no effect; InvalidRequest."""
    for name in form:
        if name not in known:
            raise InvalidRequest(
                f"The form has a part {name!r:.80} that is not known. Its parts are "
                f"{', '.join(sorted(known))}.",
                ((name[:80], "not known"),),
            )


def texts_of(form: FormData) -> dict[str, str]:
    """The parts of a form that are no files, each once; InvalidRequest."""
    return {name: _text(form.getlist(name), name) for name in form if name != "frame"}


def priority_of(fields: Mapping[str, str]) -> int:
    """The field `priority` of an upload; 0 where there is none.

    Raises
    ------
    InvalidRequest : no whole number within MOST_PRIORITY of 0.
    """
    text = fields.get("priority", "0")
    number = int(text) if re.fullmatch(r"[+-]?[0-9]{1,3}", text.strip(), re.ASCII) else None
    if number is None or abs(number) > MOST_PRIORITY:
        raise InvalidRequest(
            f"The priority is {text!r:.40}. Send a whole number from {-MOST_PRIORITY} to "
            f"{MOST_PRIORITY}, or leave it out for 0.",
            (("priority", "no whole number in its range"),),
        )
    return number


async def read_json(request: Request) -> Any:
    """What the body is as JSON.

    Raises
    ------
    MalformedBody : no JSON.
    TooLarge : more than anyone has to say; no more of it is read.
    """
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > FIELD_BYTES:
            raise TooLarge(
                f"The JSON has more than {FIELD_BYTES} bytes, the most that is taken. Send only "
                "the fields in /docs."
            )
    try:
        return from_json(bytes(body))  # unlike `json`, no text that is not Unicode
    except ValueError as error:
        raise MalformedBody(f"The body is not JSON ({error}). Send a JSON object.") from error


def _meta(text: str | None) -> FrameMeta:
    if text is None:
        raise InvalidRequest(
            "The form has no field `meta`. Send JSON in it: of a depth image at least the camera's "
            "intrinsics, of a point cloud {}.",
            (("meta", "missing"),),
        )
    try:
        return FrameMeta.model_validate_json(text)
    except ValidationError as error:
        if error.errors(include_url=False)[0]["type"] == "json_invalid":
            raise MalformedBody("The field `meta` is not JSON. Send a JSON object.") from error
        raise invalid(error, "The field `meta`") from error


def _text(values: list[UploadFile | str], name: str) -> str:
    if len(values) != 1 or not isinstance(values[0], str):
        raise InvalidRequest(
            f"The form has the part {name!r} more than once, or as a file. Send it once, as text.",
            ((name, "not one text"),),
        )
    return values[0]
