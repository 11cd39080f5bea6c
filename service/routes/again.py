"""A kept query once more: how it was asked, its picture, and another answer to it."""

from __future__ import annotations

import time
from functools import partial
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Query, Request, Response

from sceneprint.engine.made import PNG
from sceneprint.errors import UnsupportedType
from sceneprint.schemas import Answer, SeveralQuery
from sceneprint.schemas import Query as Options
from sceneprint.schemas.again import Question
from sceneprint.schemas.outputs import WIDTH, WIDTHS, View
from service.access import Asking
from service.bodies import media_type
from service.context import Here
from service.problems import declared
from service.questions import JSON, TEMPLATE, checked, read_object
from service.routes.kept import seen

router = APIRouter(prefix="/queries/{query_id}", tags=["queries"])

_PNG: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "What its colours mean is in the tEXt chunks.",
        "content": {PNG: {"schema": {"type": "string", "format": "binary"}}},
    },
    **declared(404, 409, 422),
}


def _changes() -> dict[str, Any]:
    """The body of `again`, for the OpenAPI document."""
    names = {**Options.model_fields, "maps": None}
    properties = SeveralQuery.model_json_schema(ref_template=TEMPLATE)["properties"]
    own = {
        name: {"anyOf": [one, {"type": "null"}]}
        for name, one in properties.items()
        if name in names
    }
    schema = {"type": "object", "additionalProperties": False, "properties": own}
    return {"requestBody": {"required": True, "content": {JSON: {"schema": schema}}}}


@router.get("/question", responses=declared(404, 422))
def get_question(query_id: str, here: Here, asking: Asking) -> Question:
    """How the query was asked: of which maps, with which frame and options."""
    seen(query_id, here, asking)
    return here.engine.again.question(query_id)


@router.get("/preview.png", response_class=Response, responses=_PNG)
async def get_query_preview(
    query_id: str,
    here: Here,
    asking: Asking,
    view: Annotated[
        View,
        Query(description="As of a frame; `patches` are not kept of a query, and refused."),
    ] = "depth",
    width: Annotated[int, Query(ge=WIDTHS[0], le=WIDTHS[1], description="Columns.")] = WIDTH,
) -> Response:
    """A picture of what the query saw, for people."""
    again = here.engine.again
    await to_thread.run_sync(seen, query_id, here, asking)
    async with here.gate.place():
        data = await here.gate.run(lambda: again.preview(query_id, view, width))
    return Response(data, 200, {"Cache-Control": "private, no-cache"}, PNG)


@router.post("/again", responses=declared(400, 404, 409, 413, 415, 422), openapi_extra=_changes())
async def ask_again(query_id: str, request: Request, here: Here, asking: Asking) -> Answer:
    """Ask a kept query once more with other options, an upload without its file.

    What the body leaves out is as it was asked, null puts back the default, and `maps` asks others.
    The answer has an id of its own.
    """
    since, engine = time.perf_counter(), here.engine
    answer = await to_thread.run_sync(seen, query_id, here, asking)
    if media_type(request) != JSON:
        raise UnsupportedType(
            f"The body is {media_type(request) or 'of no type'!r:.80}. Send options as {JSON}; "
            "{} asks as before."
        )
    given = await read_object(request)
    maps = given.pop("maps", None)
    fields = engine.again.options(query_id, given)
    query = checked(SeveralQuery, {**fields, "maps": answer.maps if maps is None else maps})
    async with here.gate.place():
        names = await to_thread.run_sync(engine.queries.maps_of, query, partial(asking.may, "read"))
        # which also refuses `frame`, that SeveralQuery has: it is the kept one
        options = checked(Options, fields)
        told = await here.gate.run(lambda: engine.again.ask(query_id, names, options, since))
    here.metrics.answer(told)
    return told
