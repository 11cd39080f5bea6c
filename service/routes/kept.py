"""What can be looked at after a query, for about an hour."""

from __future__ import annotations

from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Query, Response

from sceneprint.engine.kept import unknown_query
from sceneprint.engine.made import PLY
from sceneprint.schemas import Answer
from sceneprint.schemas.kept import MatchDetails, OverlayColour, OverlayTransform, Similarities
from service.access import Asking, Caller
from service.context import Context, Here
from service.problems import declared

router = APIRouter(prefix="/queries/{query_id}", tags=["queries"])

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


def seen(query_id: str, here: Context, asking: Caller) -> Answer:
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
    return seen(query_id, here, asking)


@router.get(
    "/cloud.ply",
    response_class=Response,
    responses=_ply("Points and normals in the query's sensor's frame.", 404, 409, 422),
)
async def get_query_cloud(query_id: str, here: Here, asking: Asking) -> Response:
    """The surface that the query saw, as validation compares it: binary PLY, metres."""
    inspection = here.engine.inspection
    await to_thread.run_sync(seen, query_id, here, asking)
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
    await to_thread.run_sync(seen, query_id, here, asking)
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
    await to_thread.run_sync(seen, query_id, here, asking)
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
    await to_thread.run_sync(seen, query_id, here, asking)
    async with here.gate.place():
        data = await here.gate.run(
            lambda: inspection.overlay(query_id, frame_id, map_name, color, transform)
        )
    return Response(data, media_type=PLY)
