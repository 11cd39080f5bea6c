"""Queries."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from pydantic import ValidationError

from sceneprint.errors import InvalidRequest, UnsupportedType
from sceneprint.schemas import Answer, Query
from service.bodies import FORM, media_type, read_json, uploaded
from service.context import Here
from service.problems import declared, invalid
from service.routes.frames import BODY as FRAME

router = APIRouter(prefix="/maps/{map_name}/queries", tags=["queries"])

_OPTIONS = tuple(Query.model_fields)


def _body() -> dict[str, Any]:
    """The two ways to ask, for the OpenAPI document."""
    form = FRAME["content"][FORM]["schema"]
    options = Query.model_json_schema()["properties"]
    stages = {"type": "string", "default": "retrieve,diversify,validate"}
    of_form = {**options, "stages": options["stages"] | stages}
    for keyword in ("items", "prefixItems"):
        of_form["stages"].pop(keyword, None)
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
    engine = here.engine
    if media_type(request) == "application/json":
        given = await read_json(request)
        frame_id = given.pop("frame_id", None)
        if not isinstance(frame_id, str):
            raise InvalidRequest(
                "The query names no frame. Give `frame_id`, or send a frame as a form.",
                (("frame_id", "missing"),),
            )
        query = _query(given)
        answer = await here.gate.run(lambda: engine.query_frame(map_name, frame_id, query))
    elif media_type(request) == FORM:
        async with uploaded(request, *_OPTIONS) as upload:
            fields: dict[str, Any] = dict(upload.fields)
            if "stages" in fields:
                fields["stages"] = [one.strip() for one in fields["stages"].split(",")]
            query = _query(fields)
            answer = await here.gate.run(
                lambda: engine.query_upload(map_name, upload.file.read(), upload.meta, query)
            )
    else:
        raise UnsupportedType(
            f"The body is {media_type(request) or 'of no type'!r:.80}. Send a frame as {FORM}, or "
            "the id of one as application/json."
        )
    here.metrics.answer(answer)
    return answer


def _query(fields: dict[str, Any]) -> Query:
    try:
        return Query.model_validate(fields)
    except ValidationError as error:
        raise invalid(error, "The query") from error
