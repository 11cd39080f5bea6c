"""Queries."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fastapi import APIRouter, Request
from pydantic import ValidationError

from sceneprint.errors import InvalidRequest, MalformedBody, UnsupportedType
from sceneprint.schemas import Answer, Query
from service.bodies import FORM, media_type, read_json, uploaded
from service.context import Context, Here
from service.problems import declared, invalid
from service.routes.frames import BODY as FRAME

router = APIRouter(prefix="/maps/{map_name}/queries", tags=["queries"])

_OPTIONS = tuple(Query.model_fields)


def _body() -> dict[str, Any]:
    """The two ways to ask, for the OpenAPI document."""
    form = FRAME["content"][FORM]["schema"]
    template = "#/components/schemas/{model}"
    options = Query.model_json_schema(ref_template=template)["properties"]
    stages = {"type": "string", "default": "retrieve,diversify,validate"}
    of_form = {**options, "stages": options["stages"] | stages}
    of_form["stages"].pop("anyOf")  # text or a list; a form has only text
    of_form["filter"] = {
        "type": "string",
        "contentMediaType": "application/json",
        "contentSchema": {"$ref": "#/components/schemas/Filter"},
        "description": options["filter"]["description"],
    }
    by_id = {"frame_id": {"type": "string", "description": "A frame of the map."}, **options}
    return {
        "required": True,
        "content": {
            FORM: {"schema": form | {"properties": {**form["properties"], **of_form}}},
            "application/json": {
                "schema": {"type": "object", "required": ["frame_id"], "properties": by_id}
            },
        },
    }


@router.post(
    "", responses=declared(400, 404, 413, 415, 422), openapi_extra={"requestBody": _body()}
)
async def ask(map_name: str, request: Request, here: Here) -> Answer:
    """Where was this frame taken? Ask with a frame of your own, or with one of the map.

    An uploaded frame is not kept. A frame of the map does not find itself.
    """
    async with here.gate.place():
        answer = await _asked(map_name, request, here)
    here.metrics.answer(answer)
    return answer


async def _asked(map_name: str, request: Request, here: Context) -> Answer:
    engine = here.engine
    if media_type(request) == "application/json":
        given = await read_json(request)
        if not isinstance(given, dict):
            raise MalformedBody("The body is not a JSON object. Send an object.")
        frame_id = given.pop("frame_id", None)
        if not isinstance(frame_id, str):
            raise InvalidRequest(
                "The query names no frame. Give `frame_id`, or send a frame as a form.",
                (("frame_id", "missing"),),
            )
        query = _query(given)
        return await here.gate.run(lambda: engine.query_frame(map_name, frame_id, query))
    if media_type(request) == FORM:
        async with uploaded(request, *_OPTIONS) as upload:
            query = _query(upload.fields)
            return await here.gate.run(
                lambda: engine.query_upload(map_name, upload.file.read(), upload.meta, query)
            )
    raise UnsupportedType(
        f"The body is {media_type(request) or 'of no type'!r:.80}. Send a frame as {FORM}, or "
        "the id of one as application/json."
    )


def _query(fields: Mapping[str, Any]) -> Query:
    try:
        return Query.model_validate(fields)
    except ValidationError as error:
        raise invalid(error, "The query") from error
