"""Points as bytes that a page draws as they are; `sceneprint.points` says what they mean."""

from __future__ import annotations

from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Depends, Query, Request, Response

from sceneprint.points import LIMIT, MEDIA_TYPE, MOST
from sceneprint.schemas.kept import OverlayTransform, PointsSide
from sceneprint.schemas.outputs import CloudFrame
from service.access import Asking, may_read
from service.context import Here
from service.made import look, made_files, sent
from service.routes.kept import MapName, seen

router = APIRouter()

Limit = Annotated[
    int, Query(ge=1, le=MOST, description="Most points; of more, always the same ones are told.")
]
_BYTES = "12 bytes a point after a header of 48: docs/reference.md, Points. "


@router.get(
    "/maps/{map_name}/frames/{frame_id}/points",
    tags=["frames"],
    dependencies=[Depends(may_read)],
    response_class=Response,
    responses=made_files(
        MEDIA_TYPE,
        description=f"{_BYTES}With normals and validation patches.",
        statuses=(404, 409, 422),
    ),
)
async def get_frame_points(
    map_name: str,
    frame_id: str,
    request: Request,
    here: Here,
    frame: Annotated[CloudFrame, Query(description="Coordinates, as of `cloud.ply`.")] = "optical",
    limit: Limit = LIMIT,
) -> Response:
    """The points of `cloud.ply` in a third of its bytes, for a page to draw."""
    clouds = here.engine.points
    found = await look(lambda: clouds.frame(map_name, frame_id, frame, limit))
    return await sent(request, here, found, MEDIA_TYPE)


@router.get(
    "/queries/{query_id}/points",
    tags=["queries"],
    response_class=Response,
    responses=made_files(
        MEDIA_TYPE,
        description=f"{_BYTES}With normals and validation patches.",
        statuses=(404, 409, 422),
    ),
)
async def get_query_points(
    query_id: str, request: Request, here: Here, asking: Asking, limit: Limit = LIMIT
) -> Response:
    """The surface that a query saw, for a page to draw, in the query's sensor's frame."""
    await to_thread.run_sync(seen, query_id, here, asking)
    found = await look(lambda: here.engine.points.query(query_id, limit))
    return await sent(request, here, found, MEDIA_TYPE)


@router.get(
    "/queries/{query_id}/matches/{frame_id}/points",
    tags=["queries"],
    response_class=Response,
    responses=made_files(
        MEDIA_TYPE,
        description=f"{_BYTES}With normals, validation patches and, where there is a transform, "
        "residuals.",
        statuses=(404, 409, 422),
    ),
)
async def get_match_points(
    query_id: str,
    frame_id: str,
    request: Request,
    here: Here,
    asking: Asking,
    map_name: MapName = None,
    side: Annotated[PointsSide, Query(description="Whose points.")] = "query",
    transform: Annotated[
        OverlayTransform,
        Query(
            description="Under which they are compared: `aligned` as the match was found, `rival` "
            "the other transform that fits best, `none` both as their cameras saw them."
        ),
    ] = "aligned",
    limit: Limit = LIMIT,
) -> Response:
    """The query or a match of it, for a page to draw, each in its own sensor's frame; every point
    says how far it is from the surface that the other saw.
    """
    await to_thread.run_sync(seen, query_id, here, asking)
    clouds = here.engine.points
    found = await look(lambda: clouds.match(query_id, frame_id, map_name, side, transform, limit))
    return await sent(request, here, found, MEDIA_TYPE)
