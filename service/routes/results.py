"""Routes for past queries and stored answers."""

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
from service.auth import (
    Caller,
    Cursor,
    Limit,
    MatchMap,
    OnlyMap,
    Sender,
    require_readable,
    v1_router,
)
from service.bodies import json_body, read_record
from service.problems import refusals
from service.responses import file_responses
from service.running_service import Here, Service

router = v1_router("/queries/{query_id}", "queries")


def _file(kind: str, description: str) -> dict[int | str, dict[str, Any]]:
    statuses = (404, 409, 422)
    return file_responses(kind, description=description, statuses=statuses, tagged=False)


@router.get("", responses=refusals(404, 422))
def get_answer(query_id: str, here: Here, caller: Sender) -> Answer:
    """Return a stored answer.

    By default, answers are stored for 30 days, or less if space runs out. If `keep` is false, the
    answer is not stored.
    """
    require_readable(query_id, here, caller)
    return here.inspection.answer(query_id)


@router.get(
    "/cloud.ply",
    response_class=Response,
    responses=_file(PLY, "Points and normals in the frame of the query's sensor."),
)
async def get_query_cloud(query_id: str, here: Here, caller: Sender) -> Response:
    """Return the surface of the query that validation compares, as binary PLY in metres."""
    await here.run(require_readable, query_id, here, caller)
    data = await here.gate.enter(lambda: here.inspection.cloud(query_id))
    return Response(data, media_type=PLY)


@router.get("/similarities", responses=refusals(404, 422))
async def get_similarities(
    query_id: str,
    here: Here,
    caller: Sender,
    limit: Annotated[
        int, Query(ge=1, le=200, description="Number of frames of the ranking, nearest first.")
    ] = 50,
) -> Similarities:
    """Return the pairwise similarities of the query and its nearest frames, as used by the
    selection.
    """
    await here.run(require_readable, query_id, here, caller)
    return await here.gate.enter(lambda: here.inspection.similarities(query_id, limit))


@router.get("/matches/{frame_id}", responses=refusals(404, 409, 422))
async def get_match(
    query_id: str, frame_id: str, here: Here, caller: Sender, map_name: MatchMap = None
) -> MatchDetails:
    """Return a match with its evidence: its rival, coincident patches, and supporting and
    contradicting points.

    The match is validated again, with the seed and the options of the query. A match that the query
    skipped is validated now.
    """
    await here.run(require_readable, query_id, here, caller)
    return await here.gate.enter(lambda: here.inspection.match(query_id, frame_id, map_name))


@router.get(
    "/matches/{frame_id}/overlay.ply",
    response_class=Response,
    responses=_file(PLY, "Both clouds, coloured, in the frame of the match's sensor."),
)
async def get_overlay(
    query_id: str,
    frame_id: str,
    here: Here,
    caller: Sender,
    map_name: MatchMap = None,
    color: Annotated[
        OverlayColour,
        Query(
            description="`source`: the query is orange, the match is blue. `normal`: the colours "
            "show normals. `residual`: dark green up to a fifth of the distance that the model's "
            "validation tolerates between surfaces (1 cm of 5 cm for close surfaces in rooms; more "
            "with distance), light green up to two fifths, yellow up to the full tolerance, grey "
            "beyond it or without a counterpart, red for points that the other frame saw through."
        ),
    ] = "source",
    transform: Annotated[
        OverlayTransform,
        Query(
            description="`aligned`: the transform of the match. `rival`: the best alternative "
            "transform. `none`: the identity."
        ),
    ] = "aligned",
) -> Response:
    """Return the clouds of the query and a match in a common frame, as binary PLY in metres."""
    await here.run(require_readable, query_id, here, caller)
    data = await here.gate.enter(
        lambda: here.inspection.overlay(query_id, frame_id, map_name, color, transform)
    )
    return Response(data, media_type=PLY)


@router.get("/question", responses=refusals(404, 422))
def get_question(query_id: str, here: Here, caller: Sender) -> StoredQuery:
    """Return the maps, the frame and the options of a query."""
    require_readable(query_id, here, caller)
    return here.inspection.question(query_id)


@router.get(
    "/preview.png",
    response_class=Response,
    responses=_file(PNG, "The tEXt chunks explain the colours."),
)
async def get_query_preview(
    query_id: str,
    here: Here,
    caller: Sender,
    view: Annotated[
        View, Query(description="As for a frame, except `patches`, which queries do not store.")
    ] = "depth",
    width: Annotated[
        int, Query(ge=WIDTHS[0], le=WIDTHS[1], description="Width in pixels.")
    ] = WIDTH,
) -> Response:
    """Return a picture of the frame of a query."""
    await here.run(require_readable, query_id, here, caller)
    data = await here.gate.enter(lambda: here.inspection.preview(query_id, view, width))
    return Response(data, 200, {"Cache-Control": "private, no-cache"}, PNG)


@router.put(
    "/keep", responses=refusals(400, 404, 413, 415, 422),
    openapi_extra=json_body("KeepOptions", required=False),
)  # fmt: skip
async def keep_answer(query_id: str, request: Request, here: Here, caller: Sender) -> QueryRecord:
    """Keep a stored answer until it is released.

    Deleting a searched map or a frame of the answer also deletes the answer. A new `title` replaces
    the previous one. Requires the scope `write` for every map that was searched.
    """
    await here.run(_require_write, query_id, here, caller)
    options = await read_record(request, KeepOptions, "The request to keep it", optional=True)
    return await here.run(here.context.query_log.keep, query_id, options.title)


@router.delete("/keep", status_code=204, responses=refusals(404, 422))
def release_answer(query_id: str, here: Here, caller: Sender) -> None:
    """Release a kept answer. Requires the scope `write` for every map that was searched."""
    _require_write(query_id, here, caller)
    here.context.query_log.release(query_id)


def _require_write(query_id: str, here: Service, caller: Caller) -> None:
    for name in require_readable(query_id, here, caller).searched:
        caller.require(name, "write")


# Past queries.

history_router = v1_router("/queries", "queries")


@history_router.get("", responses=refusals(404, 422))
def list_queries(
    here: Here,
    caller: Sender,
    map_name: OnlyMap = None,
    status: Annotated[
        list[RecordStatus],
        Query(
            max_length=len(RECORD_STATUSES),
            description="Only queries with this status; repeat the parameter for several statuses.",
        ),
    ] = [],  # noqa: B006  (FastAPI copies it)
    robot: Annotated[Label | None, Query(description="Only queries of this robot.")] = None,
    since: Annotated[
        AwareDatetime | None, Query(description="Earliest time of the query, with time zone.")
    ] = None,
    until: Annotated[
        AwareDatetime | None, Query(description="Latest time of the query, with time zone.")
    ] = None,
    kept: Annotated[bool, Query(description="Only queries with kept answers.")] = False,
    cursor: Cursor = None,
    limit: Limit = 100,
) -> Page[QueryRecord]:
    """List past queries of the maps that the key may read, with sender, outcome and duration,
    newest first.

    A query appears within a second and stays for 30 days by default. Queries whose `record` is
    false and requests that were refused before their query started are not listed.
    """
    names = caller.named
    if map_name is not None:
        caller.require(map_name, "read")
        get_map(here.context.store, map_name)
        names = (map_name,)
    criteria = WantedQueries(
        statuses=tuple(status), robot=robot, kept=kept,
        since=None if since is None else since.timestamp(),
        until=None if until is None else until.timestamp(),
    )  # fmt: skip
    return here.context.query_log.page(criteria, names, cursor, limit, partial(caller.may, "read"))


@history_router.delete("", status_code=204, responses=refusals(404, 422))
def delete_queries(
    here: Here,
    caller: Sender,
    map_name: Annotated[str, Query(alias="map", description="Name of the map.")],
) -> None:
    """Delete all past queries of a map with their answers. Requires `admin` for the map."""
    caller.require(map_name, "admin")
    here.audit.record("queries.removed", map_name)
    here.context.query_log.remove_of_map(map_name)
