"""Queries as they come: a stored frame named in JSON, or a frame sent with its options."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from fastapi import Request
from pydantic import BaseModel, ValidationError

from sceneprint.errors import InvalidRequest, MalformedBody
from sceneprint.schemas import Query
from service import raw
from service.bodies import FORM, Upload, media_type, read_json, uploaded
from service.problems import invalid
from service.routes.frames import BODY as FRAME

Asked = TypeVar("Asked", bound=Query)
Record = TypeVar("Record", bound=BaseModel)

JSON = "application/json"
TEMPLATE = "#/components/schemas/{model}"


@dataclass(frozen=True, eq=False)
class Question(Generic[Asked]):
    """A query as it came.

    Parameters
    ----------
    query : how to ask
    upload : the frame that was sent; None where a stored one is named
    named : what JSON had beside the query, by name
    """

    query: Asked
    upload: Upload | None
    named: Mapping[str, Any]


@asynccontextmanager
async def question(
    request: Request, kind: type[Asked], named: str
) -> AsyncIterator[Question[Asked]]:
    """Read a query, however it came.

    Parameters
    ----------
    request : with JSON, or with a frame as `uploaded` reads it
    kind : of the query
    named : field of JSON that names a stored frame; others have none

    Raises
    ------
    UnsupportedType, MalformedBody, InvalidRequest, StoreFull, UnusableStore : see `uploaded`.
    """
    if media_type(request) == JSON:
        given = await read_object(request)
        own = {} if named in kind.model_fields else {named: given.pop(named, None)}
        yield Question(checked(kind, given), None, own)
        return
    options = [name for name in kind.model_fields if name != named]
    async with uploaded(request, *options) as upload:
        yield Question(checked(kind, upload.fields), upload, {})


async def read_object(request: Request) -> dict[str, Any]:
    """The body as a JSON object; MalformedBody where it is none."""
    given = await read_json(request)
    if not isinstance(given, dict):
        raise MalformedBody("The body is not a JSON object. Send an object.")
    return given


def checked(kind: type[Record], fields: Mapping[str, Any], what: str = "The query") -> Record:
    """A record of the API, or what is wrong with its fields."""
    try:
        return kind.model_validate(fields)
    except ValidationError as error:
        raise invalid(error, what) from error


def unnamed(name: str) -> InvalidRequest:
    """That a query has no frame: neither a file nor the name of a stored one."""
    return InvalidRequest(
        f"The query names no frame. Give `{name}`, or send a frame as a form.",
        ((name, "missing"),),
    )


def described(kind: type[BaseModel], named: Mapping[str, Any], required: list[str]) -> Any:
    """The ways to ask, for the OpenAPI document: `requestBody` and `parameters`.

    Parameters
    ----------
    kind : of the query
    named : schemas of what JSON has beside it, by name
    required : fields that JSON must have
    """
    form = FRAME["content"][FORM]["schema"]
    own = kind.model_json_schema(ref_template=TEMPLATE)["properties"]
    texts = {n: as_text(one) for n, one in own.items() if n not in form["properties"]}
    needed = sorted({*form["required"], *(name for name in required if name in texts)})
    parts = {**form["properties"], **texts}
    body = {"type": "object", "required": required, "properties": {**named, **own}}
    return {
        "requestBody": {
            "required": True,
            "content": {
                FORM: {"schema": {**form, "required": needed, "properties": parts}},
                JSON: {"schema": body},
                **raw.content(),
            },
        },
        "parameters": raw.parameters() + [_parameter(name, one) for name, one in texts.items()],
    }


def _parameter(name: str, option: Mapping[str, Any]) -> dict[str, Any]:
    """An option as the query string has it, where the frame is the body."""
    schema = {key: one for key, one in option.items() if key not in ("description", "title")}
    told = f"Where the frame is the body: {option.get('description', 'as in JSON')}"
    return {"name": name, "in": "query", "required": False, "schema": schema, "description": told}


def as_text(option: Mapping[str, Any]) -> dict[str, Any]:
    """An option as a form has it: an object as JSON text, a list with commas between."""
    kinds = option.get("anyOf", [])
    reference = next((one for one in kinds if "$ref" in one), None)
    told = {name: option[name] for name in ("description", "title") if name in option}
    if reference is not None:
        content = {"contentMediaType": JSON, "contentSchema": reference}
        return {"type": "string", **content, **told}
    if any(one.get("type") == "array" for one in kinds):
        given = option.get("default")
        default = {} if given is None else {"default": ",".join(given)}
        return {"type": "string", **default, **told}
    one = next((one for one in kinds if one.get("type") != "null"), None)
    return dict(option) if one is None else {**one, **told}
