"""What can be looked at after a query, for about an hour."""

from __future__ import annotations

import time
from functools import partial
from typing import Annotated, Any

from fastapi import Depends, Query, Request, Response
from pydantic import AwareDatetime

from sceneprint.engine.maps.map_frames import PLY, PNG
from sceneprint.engine.results.query_history import AskedQuery
from sceneprint.engine.results.stored_results import unknown_query
from sceneprint.errors import UnsupportedType
from sceneprint.store.query_records import WantedRecords
from sceneprint_client.api import Answer, Page, SeveralQuery
from sceneprint_client.api import Query as Options
from sceneprint_client.api.base import Label
from sceneprint_client.api.results import (
    RECORD_STATUSES,
    WIDTH,
    WIDTHS,
    AnswerRetention,
    KeepOptions,
    MatchDetails,
    NewQueryRecords,
    OverlayColour,
    OverlayTransform,
    QueryRecord,
    QueryRecordsAdded,
    Question,
    RecordStatus,
    Similarities,
    View,
)
from service.auth import Asking, Caller, Context, Here, may_write, v1_router
from service.bodies import media_type, read_record
from service.problems import declared
from service.routes.queries import JSON, TEMPLATE, checked, read_object, run_query

router = v1_router("/queries/{query_id}", "queries")

MapName = Annotated[
    str | None,
    Query(
        alias="map",
        max_length=128,
        description="Where matches of several maps have the same id; default: the first of them.",
    ),
]


def _ply(description: str, *statuses: int) -> dict[int | str, dict[str, Any]]:
    content = {PLY: {"schema": {"type": "string", "format": "binary"}}}
    return {200: {"description": description, "content": content}, **declared(*statuses)}


def readable_answer(query_id: str, here: Context, asking: Caller) -> Answer:
    """The answer, where the caller may read all that was asked.

    Raises
    ------
    UnknownQuery : it is not kept, or no longer, or the caller may not see it: one text for all.
    """
    answer = here.engine.inspection.answer(query_id)
    maps = [*answer.maps, *([] if answer.frame is None else [answer.frame.map])]
    if not maps or len(asking.readable(maps)) < len(maps):
        raise unknown_query(query_id)
    return answer


@router.get("", responses=declared(404, 422))
def get_answer(query_id: str, here: Here, asking: Asking) -> Answer:
    """The answer once more, as it was given.

    Answers are kept for an hour by default, and while there is room; not with `keep` false.
    """
    return readable_answer(query_id, here, asking)


@router.get(
    "/cloud.ply",
    response_class=Response,
    responses=_ply("Points and normals in the query's sensor's frame.", 404, 409, 422),
)
async def get_query_cloud(query_id: str, here: Here, asking: Asking) -> Response:
    """The surface that the query saw, as validation compares it: binary PLY, metres."""
    inspection = here.engine.inspection
    await here.run(readable_answer, query_id, here, asking)
    async with here.gate.place():
        data = await here.gate.run(lambda: inspection.cloud(query_id))
    return Response(data, media_type=PLY)


@router.get("/similarities", responses=declared(404, 422))
async def get_similarities(
    query_id: str,
    here: Here,
    asking: Asking,
    limit: Annotated[
        int, Query(ge=1, le=200, description="How many of the ranking, the nearest first.")
    ] = 50,
) -> Similarities:
    """How alike the query and its nearest frames are, each to each: what the selection sees."""
    inspection = here.engine.inspection
    await here.run(readable_answer, query_id, here, asking)
    async with here.gate.place():
        return await here.gate.run(lambda: inspection.similarities(query_id, limit))


@router.get("/matches/{frame_id}", responses=declared(404, 409, 422))
async def get_match(
    query_id: str, frame_id: str, here: Here, asking: Asking, map_name: MapName = None
) -> MatchDetails:
    """One match with what it rests on: its rival, patches that coincide, points for and against.

    It is validated once more, with the seed and the options of the query; one that the query
    passed over is validated now.
    """
    inspection = here.engine.inspection
    await here.run(readable_answer, query_id, here, asking)
    async with here.gate.place():
        return await here.gate.run(lambda: inspection.match(query_id, frame_id, map_name))


@router.get(
    "/matches/{frame_id}/overlay.ply",
    response_class=Response,
    responses=_ply("Both clouds in the match's sensor's frame, coloured.", 404, 409, 422),
)
async def get_overlay(
    query_id: str,
    frame_id: str,
    here: Here,
    asking: Asking,
    map_name: MapName = None,
    color: Annotated[
        OverlayColour,
        Query(
            description="`source`: the query orange, the match blue. `normal`: directions. "
            "`residual`: dark green within a fifth of what the model's validation allows between "
            "surfaces (1 cm of 5 cm of rooms near by; more with distance), light green within two "
            "fifths, yellow within all of it, grey where there is nothing to compare with or it "
            "is farther, red where the other saw through."
        ),
    ] = "source",
    transform: Annotated[
        OverlayTransform,
        Query(
            description="`aligned`: as the match was found. `rival`: by the other transform that "
            "fits best. `none`: both as their cameras saw them."
        ),
    ] = "aligned",
) -> Response:
    """The query laid on a match, to see how well they fit: binary PLY, metres."""
    inspection = here.engine.inspection
    await here.run(readable_answer, query_id, here, asking)
    async with here.gate.place():
        data = await here.gate.run(
            lambda: inspection.overlay(query_id, frame_id, map_name, color, transform)
        )
    return Response(data, media_type=PLY)


# A kept query once more: how it was asked, its picture, and another answer to it.


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
    readable_answer(query_id, here, asking)
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
    await here.run(readable_answer, query_id, here, asking)
    async with here.gate.place():
        data = await here.gate.run(lambda: again.preview(query_id, view, width))
    return Response(data, 200, {"Cache-Control": "private, no-cache"}, PNG)


@router.post("/again", responses=declared(400, 404, 409, 413, 415, 422), openapi_extra=_changes())
async def ask_again(query_id: str, request: Request, here: Here, asking: Asking) -> Answer:
    """Ask a kept query once more with other options, an upload without its file.

    What the body leaves out is as it was asked, null puts back the default, and `maps` asks others.
    The answer has an id of its own.
    """
    since, at, engine = time.perf_counter(), time.time(), here.engine
    answer = await here.run(readable_answer, query_id, here, asking)
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
        names = await here.run(engine.queries.maps_of, query, partial(asking.may, "read"))
        # which also refuses `frame`, that SeveralQuery has: it is the kept one
        options = checked(Options, fields)
        asked = AskedQuery(names, options, key_id=asking.key_id, frame=answer.frame, at=at)
        return await run_query(
            here, asked, since, lambda: engine.again.ask(query_id, names, options, since)
        )


# Answers that are kept until somebody releases them.

_KEEP: dict[str, Any] = {
    "requestBody": {
        "required": False,
        "content": {JSON: {"schema": {"$ref": "#/components/schemas/KeepOptions"}}},
    }
}


@router.get("/keep", responses=declared(404, 422))
def get_retention(query_id: str, here: Here, asking: Asking) -> AnswerRetention:
    """For how long the answer can be looked at, and whether somebody keeps it."""
    readable_answer(query_id, here, asking)
    return here.engine.kept_answers.retention(here.engine.kept, query_id)


@router.post("/keep", responses=declared(400, 404, 409, 413, 415, 422), openapi_extra=_KEEP)
async def keep_answer(
    query_id: str, request: Request, here: Here, asking: Asking
) -> AnswerRetention:
    """Keep the answer, and what can be looked at after it, until it is released.

    It goes earlier with a map that was asked, and with a frame that it shows. Once more with
    another `title` or `until` changes these. It takes the scope `write` for every map that was
    asked.
    """
    engine = here.engine
    await here.run(_writable_answer, query_id, here, asking)
    options = await read_record(request, KeepOptions, "The request to keep it", optional=True)
    return await here.run(engine.kept_answers.keep, engine.kept, query_id, options)


@router.delete("/keep", status_code=204, responses=declared(404, 422))
def release_answer(query_id: str, here: Here, asking: Asking) -> None:
    """Keep the answer no longer. It takes the scope `write` for every map that was asked."""
    _writable_answer(query_id, here, asking)
    here.engine.kept_answers.release(query_id)


def _writable_answer(query_id: str, here: Context, asking: Caller) -> None:
    """See that the caller may write to all maps that were asked."""
    for name in readable_answer(query_id, here, asking).maps:
        asking.require(name, "write")


# What is left of queries for longer than their answers.

history_router = v1_router("/queries", "queries")


@history_router.get("", responses=declared(404, 422))
def list_queries(
    here: Here,
    asking: Asking,
    map_name: Annotated[str | None, Query(alias="map", description="Of this map alone.")] = None,
    status: Annotated[
        list[RecordStatus],
        Query(max_length=len(RECORD_STATUSES), description="More than once for several."),
    ] = [],  # noqa: B006  (FastAPI copies it)
    robot: Annotated[Label | None, Query(description="Who asked.")] = None,
    since: Annotated[
        AwareDatetime | None, Query(description="That came then or later; with a time zone.")
    ] = None,
    until: Annotated[AwareDatetime | None, Query(description="That came before then.")] = None,
    kept: Annotated[
        bool,
        Query(
            description="Only those whose answers are kept until they are released, also where "
            "their records are gone; of several maps, only where you may read all of them."
        ),
    ] = False,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> Page[QueryRecord]:
    """Queries that came, the newest first: who asked, what came of it, how long it took.

    Each query leaves a record within a second, for 30 days by default; not with `record` false.
    Requests that were refused before a query began leave none. With a key, queries of the maps
    that it may read.
    """
    names = asking.named
    if map_name is not None:
        asking.require(map_name, "read")
        here.engine.get_map(map_name)
        names = (map_name,)
    wanted = WantedRecords(
        statuses=tuple(status), robot=robot,
        since=None if since is None else since.timestamp(),
        until=None if until is None else until.timestamp(),
    )  # fmt: skip
    if kept:
        return here.engine.kept_answers.page(wanted, asking.named, map_name, cursor, limit)
    return here.engine.history.page(wanted, names, cursor, limit, partial(asking.may, "read"))


@history_router.delete("", status_code=204, responses=declared(404, 422))
def delete_queries(
    here: Here,
    asking: Asking,
    map_name: Annotated[str, Query(alias="map", description="Whose records are removed.")],
) -> None:
    """Remove the records of all queries of a map, for good. Needs `admin` of the map."""
    asking.require(map_name, "admin")
    here.engine.audit.record("queries.removed", map_name)
    here.engine.history.remove_of_map(map_name)


_RECORDS: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {JSON: {"schema": {"$ref": "#/components/schemas/NewQueryRecords"}}},
    }
}

offline_router = v1_router("/maps/{map_name}", "queries")


@offline_router.post(
    "/queries/records", responses=declared(400, 404, 413, 415, 422), openapi_extra=_RECORDS,
    dependencies=[Depends(may_write)],
)  # fmt: skip
async def add_query_records(
    map_name: str, request: Request, here: Here, asking: Asking
) -> QueryRecordsAdded:
    """Store records of queries that a robot answered itself while it was offline, each once.

    The history lists them with `offline`. An invalid record refuses the whole request; the same
    records may be sent again. It takes the scope `write`: the service cannot check what they say.
    """
    given = await read_record(request, NewQueryRecords, "The list of records")
    async with here.uploads.place():
        return await here.uploads.run(
            partial(here.engine.history.add_offline, map_name, given, asking.key_id)
        )
