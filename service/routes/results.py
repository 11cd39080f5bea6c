"""Past queries, and what can be looked at while an answer is stored."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from fastapi import Query, Request, Response
from pydantic import AwareDatetime

from sceneprint.engine.maps.map_frames import PLY, PNG
from sceneprint.engine.maps.map_lifecycle import get_map
from sceneprint.store.query_rows import WantedQueries
from sceneprint_client.api import Answer, Page
from sceneprint_client.api.base import Label
from sceneprint_client.api.results import (
    RECORD_STATUSES,
    WIDTH,
    WIDTHS,
    KeepOptions,
    MatchDetails,
    OverlayColour,
    OverlayTransform,
    QueryRecord,
    RecordStatus,
    Similarities,
    StoredQuery,
    View,
)
from service.auth import Asking, Caller, MatchMap, require_readable, v1_router
from service.bodies import json_body, read_record
from service.problems import declared
from service.running_service import Here, Service

router = v1_router("/queries/{query_id}", "queries")


def _ply(description: str, *statuses: int) -> dict[int | str, dict[str, Any]]:
    content = {PLY: {"schema": {"type": "string", "format": "binary"}}}
    return {200: {"description": description, "content": content}, **declared(*statuses)}


@router.get("", responses=declared(404, 422))
def get_answer(query_id: str, here: Here, asking: Asking) -> Answer:
    """The answer once more, as it was given.

    Answers are stored for 30 days by default, and while there is room; not with `keep` false.
    """
    require_readable(query_id, here, asking)
    return here.inspection.answer(query_id)


@router.get(
    "/cloud.ply",
    response_class=Response,
    responses=_ply("Points and normals in the query's sensor's frame.", 404, 409, 422),
)
async def get_query_cloud(query_id: str, here: Here, asking: Asking) -> Response:
    """The surface that the query saw, as validation compares it: binary PLY, metres."""
    await here.run(require_readable, query_id, here, asking)
    data = await here.gate.enter(lambda: here.inspection.cloud(query_id))
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
    await here.run(require_readable, query_id, here, asking)
    return await here.gate.enter(lambda: here.inspection.similarities(query_id, limit))


@router.get("/matches/{frame_id}", responses=declared(404, 409, 422))
async def get_match(
    query_id: str, frame_id: str, here: Here, asking: Asking, map_name: MatchMap = None
) -> MatchDetails:
    """One match with what it rests on: its rival, patches that coincide, points for and against.

    It is validated once more, with the seed and the options of the query; one that the query
    passed over is validated now.
    """
    await here.run(require_readable, query_id, here, asking)
    return await here.gate.enter(lambda: here.inspection.match(query_id, frame_id, map_name))


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
    map_name: MatchMap = None,
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
    await here.run(require_readable, query_id, here, asking)
    data = await here.gate.enter(
        lambda: here.inspection.overlay(query_id, frame_id, map_name, color, transform)
    )
    return Response(data, media_type=PLY)


_PNG: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "What its colours mean is in the tEXt chunks.",
        "content": {PNG: {"schema": {"type": "string", "format": "binary"}}},
    },
    **declared(404, 409, 422),
}


@router.get("/question", responses=declared(404, 422))
def get_question(query_id: str, here: Here, asking: Asking) -> StoredQuery:
    """How the query was sent: to which maps, with which frame and options."""
    require_readable(query_id, here, asking)
    return here.inspection.question(query_id)


@router.get("/preview.png", response_class=Response, responses=_PNG)
async def get_query_preview(
    query_id: str,
    here: Here,
    asking: Asking,
    view: Annotated[
        View, Query(description="As of a frame; `patches` are not stored of a query, and refused.")
    ] = "depth",
    width: Annotated[int, Query(ge=WIDTHS[0], le=WIDTHS[1], description="Columns.")] = WIDTH,
) -> Response:
    """A picture of what the query saw, for people."""
    await here.run(require_readable, query_id, here, asking)
    data = await here.gate.enter(lambda: here.inspection.preview(query_id, view, width))
    return Response(data, 200, {"Cache-Control": "private, no-cache"}, PNG)


@router.put(
    "/keep", responses=declared(400, 404, 413, 415, 422),
    openapi_extra=json_body("KeepOptions", required=False),
)  # fmt: skip
async def keep_answer(query_id: str, request: Request, here: Here, asking: Asking) -> QueryRecord:
    """Keep the answer until it is released.

    It goes earlier with a map that was searched, and with a frame that it shows. Another `title`
    replaces the former. It requires the scope `write` for every map that was searched.
    """
    await here.run(_require_write, query_id, here, asking)
    options = await read_record(request, KeepOptions, "The request to keep it", optional=True)
    return await here.run(here.context.query_log.keep, query_id, options.title)


@router.delete("/keep", status_code=204, responses=declared(404, 422))
def release_answer(query_id: str, here: Here, asking: Asking) -> None:
    """Let the answer expire. It requires the scope `write` for every map that was searched."""
    _require_write(query_id, here, asking)
    here.context.query_log.release(query_id)


def _require_write(query_id: str, here: Service, asking: Caller) -> None:
    for name in require_readable(query_id, here, asking).searched:
        asking.require(name, "write")


# Past queries.

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
    robot: Annotated[Label | None, Query(description="Who sent them.")] = None,
    since: Annotated[
        AwareDatetime | None, Query(description="That came then or later; with a time zone.")
    ] = None,
    until: Annotated[AwareDatetime | None, Query(description="That came before then.")] = None,
    kept: Annotated[bool, Query(description="Only those whose answers somebody keeps.")] = False,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> Page[QueryRecord]:
    """Past queries, the newest first: who sent them, their outcome, and how long they took.

    A query is listed within a second, for 30 days by default; not with `record` false. Requests
    that were refused before a query began are not. With a key, queries of the maps that it may
    read.
    """
    names = asking.named
    if map_name is not None:
        asking.require(map_name, "read")
        get_map(here.context.store, map_name)
        names = (map_name,)
    wanted = WantedQueries(
        statuses=tuple(status), robot=robot, kept=kept,
        since=None if since is None else since.timestamp(),
        until=None if until is None else until.timestamp(),
    )  # fmt: skip
    return here.context.query_log.page(wanted, names, cursor, limit, partial(asking.may, "read"))


@history_router.delete("", status_code=204, responses=declared(404, 422))
def delete_queries(
    here: Here,
    asking: Asking,
    map_name: Annotated[str, Query(alias="map", description="Whose queries are removed.")],
) -> None:
    """Remove all past queries of a map with their answers. Requires `admin` of the map."""
    asking.require(map_name, "admin")
    here.audit.record("queries.removed", map_name)
    here.context.query_log.remove_of_map(map_name)
