"""Two frames to compare: each named, or sent as a part of a form."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import BinaryIO

from fastapi import Request
from pydantic import ValidationError
from starlette.datastructures import FormData, UploadFile

from sceneprint.errors import InvalidRequest, MalformedBody
from sceneprint.schemas import Comparison, FrameMeta, NamedFrame
from service.bodies import form_of, media_type
from service.problems import invalid
from service.questions import JSON, checked, read_object

_SIDES = ("a", "b")


@dataclass(frozen=True, eq=False)
class Sent:
    """A frame that came in a form; its bytes are on disk until they are read."""

    file: BinaryIO
    meta: FrameMeta

    def read(self) -> tuple[bytes, FrameMeta]:
        """Its bytes, and what is known of it."""
        return self.file.read(), self.meta


@dataclass(frozen=True, eq=False)
class Pair:
    """Two frames, and how to compare them."""

    a: NamedFrame | Sent
    b: NamedFrame | Sent
    how: Comparison


@asynccontextmanager
async def pair(request: Request) -> AsyncIterator[Pair]:
    """Read two frames: from JSON, or from a form with parts `a` and `b`.

    Raises
    ------
    UnsupportedType : neither JSON nor a form.
    MalformedBody : it cannot be parsed.
    InvalidRequest : a frame is missing or there twice, or a field is not as it should be.
    StoreFull, UnusableStore : the machine cannot keep a file until it is read.
    """
    if media_type(request) == JSON:
        how = checked(Comparison, await read_object(request), "The comparison")
        a, b = (_side(name, how, {}, {}) for name in _SIDES)
        yield Pair(a, b, how)
        return
    async with form_of(request, most_files=2) as form:
        files, texts = _parts(form)
        own = {name: value for name, value in texts.items() if not name.startswith("meta_")}
        how = checked(Comparison, own, "The comparison")
        a, b = (_side(name, how, files, texts) for name in _SIDES)
        yield Pair(a, b, how)


def _parts(form: FormData) -> tuple[dict[str, BinaryIO], dict[str, str]]:
    """Files and texts of a form by their names."""
    files: dict[str, BinaryIO] = {}
    texts: dict[str, str] = {}
    for name, value in form.multi_items():
        if name in files or name in texts:
            raise _wrong(name, "there more than once")
        if isinstance(value, UploadFile) != (name in _SIDES):
            raise _wrong(name, "a file where a text belongs, or a text where a file does")
        if isinstance(value, UploadFile):
            files[name] = value.file
        else:
            texts[name] = value
    for name in texts:
        if name.startswith("meta_") and name.removeprefix("meta_") not in files:
            raise _wrong(name, "of no file")
    return files, texts


def _side(
    name: str, how: Comparison, files: Mapping[str, BinaryIO], texts: Mapping[str, str]
) -> NamedFrame | Sent:
    """One of the two, as it came."""
    named: NamedFrame | None = getattr(how, f"frame_{name}")
    if (named is None) == (name not in files):
        raise _wrong(
            f"frame_{name}",
            f"neither it nor a file part `{name}` is there" if named is None
            else f"there, and a file part `{name}` as well",
        )  # fmt: skip
    if named is not None:
        return named
    field = f"meta_{name}"
    if field not in texts:
        raise _wrong(field, "missing")
    try:
        return Sent(files[name], FrameMeta.model_validate_json(texts[field]))
    except ValidationError as error:
        if error.errors(include_url=False)[0]["type"] == "json_invalid":
            raise MalformedBody(f"The field `{field}` is not JSON. Send a JSON object.") from error
        raise invalid(error, f"The field `{field}`") from error


def _wrong(name: str, how: str) -> InvalidRequest:
    return InvalidRequest(
        f"The frames to compare are not as they should be: {name[:80]!r} is {how}. Give each of "
        "them once: as a file part `a` or `b` with `meta_a` or `meta_b`, or named in `frame_a` "
        "or `frame_b`.",
        ((name[:80], how),),
    )
