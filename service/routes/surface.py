"""Routes for the fused surface of a map: tiles, frames at a point, and a plan."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Query, Request, Response

from sceneprint.engine.maps.map_surface import FARTHEST_M
from sceneprint.errors import InvalidRequest
from sceneprint_client.api import Page
from sceneprint_client.api.base import Label
from sceneprint_client.api.surface import (
    PLAN_WIDTH,
    PLAN_WIDTHS,
    MapSurface,
    SurfaceSighting,
    SurfaceTile,
)
from service.auth import Cursor, Limit, may_read, may_write, v1_router
from service.problems import refusals
from service.responses import file_responses, is_known, send_output
from service.running_service import Here

router = v1_router("/maps/{map_name}/surface", "surface", may_read)

_PNG, _BYTES = "image/png", "application/octet-stream"
#: Cache header for content that is addressed by digest, and therefore never changes.
_FOREVER = "private, max-age=31536000, immutable"
Parent = Annotated[
    Label | None, Query(description="Parent frame; default: the parent frame with the most frames.")
]


@router.get("", responses=refusals(404))
def get_surface(map_name: str, here: Here) -> MapSurface:
    """Return the state, the levels of tiles and the sessions of a map's fused surface."""
    return here.surfaces.get(map_name)


@router.post(
    "",
    status_code=202,
    responses={
        200: {"model": MapSurface, "description": "The surface is up to date."},
        **refusals(404, 422),
    },
    dependencies=[Depends(may_write)],
)
def begin_surface(map_name: str, here: Here, response: Response) -> MapSurface:
    """Build the surface of a map now, or add new frames to it.

    Workers do this automatically for new frames, unless `SCENEPRINT_BUILD_SURFACES` is
    `on_request`. GET the path in `Location` until `state` is `ready`; existing tiles remain
    available in the meantime. Requires the scope `write`.
    """
    surface, begun = here.surfaces.begin(map_name)
    response.headers["Location"] = f"/v1/maps/{map_name}/surface"
    response.status_code = 202 if begun else 200
    return surface


@router.delete("", status_code=204, responses=refusals(404), dependencies=[Depends(may_write)])
def delete_surface(map_name: str, here: Here) -> None:
    """Delete the surface of a map. Workers build it again only on request."""
    here.surfaces.remove(map_name)


@router.get("/tiles", responses=refusals(404, 422))
def list_surface_tiles(
    map_name: str,
    here: Here,
    parent: Parent = None,
    level: Annotated[int, Query(ge=0, le=7, description="Level; 0 has the finest cells.")] = 0,
    cursor: Cursor = None,
    limit: Limit = 1000,
) -> Page[SurfaceTile]:
    """List the tiles of a level, sorted by column, row and floor."""
    return here.surfaces.tiles(map_name, parent, level, cursor, limit)


@router.get(
    "/tiles/{digest}",
    response_class=Response,
    responses=file_responses(
        _BYTES, description="8 bytes per cell; see docs/surface.md.", statuses=(404,)
    ),
)
def get_surface_tile(map_name: str, digest: str, request: Request, here: Here) -> Response:
    """Return the cells of a tile. Tiles with different cells have different digests."""
    output = here.surfaces.tile(map_name, digest)
    headers = {"ETag": f'"{output.tag}"', "Cache-Control": _FOREVER}
    if is_known(request, output.tag):
        return Response(None, 304, headers)
    return Response(output.make(), 200, headers, _BYTES)


@router.get("/frames", responses=refusals(404, 422))
def list_surface_frames(
    map_name: str,
    here: Here,
    parent: Parent = None,
    at: Annotated[
        str | None, Query(max_length=200, description="Only frames that saw point x,y,z, metres.")
    ] = None,
    radius: Annotated[
        float | None,
        Query(gt=0, le=1e6, description="Maximum distance from `at`, metres; default: two cells."),
    ] = None,
    box: Annotated[
        str | None,
        Query(
            max_length=400,
            description="Only frames with a viewpoint in this box x0,y0,z0,x1,y1,z1, metres.",
        ),
    ] = None,
    cursor: Cursor = None,
    limit: Limit = 20,
) -> Page[SurfaceSighting]:
    """List frames that saw a point, nearest viewpoint first, or frames that were taken in a box.

    Specify either `at` or `box`. A frame saw the point if one of its own points is within `radius`.
    Pages before the last may have fewer than `limit` items.
    """
    if (at is None) == (box is None):
        raise InvalidRequest(
            "Specify either `at` or `box`.", (("at", "either this or box is required"),)
        )
    if at is not None:
        spot = _numbers("at", at, 3)
        return here.surfaces.sightings(map_name, spot, radius, parent, cursor, limit)
    ends = _numbers("box", box or "", 6)
    return here.surfaces.frames_in(map_name, ends[:3], ends[3:], parent, cursor, limit)


@router.get(
    "/plan.png",
    response_class=Response,
    responses=file_responses(
        _PNG,
        description="View from above, transparent where there is no surface.",
        statuses=(404, 422),
    ),
)
async def get_surface_plan(
    map_name: str,
    request: Request,
    here: Here,
    parent: Parent = None,
    width: Annotated[
        int,
        Query(
            ge=PLAN_WIDTHS[0], le=PLAN_WIDTHS[1], description="Length of the longer side, pixels."
        ),
    ] = PLAN_WIDTH,
    low: Annotated[
        float | None,
        Query(ge=-FARTHEST_M, le=FARTHEST_M, description="Only cells above this height, metres."),
    ] = None,
    high: Annotated[
        float | None,
        Query(ge=-FARTHEST_M, le=FARTHEST_M, description="Only cells below this height, metres."),
    ] = None,
) -> Response:
    """Return a plan of a surface. Its position is `plan` in GET /v1/maps/{map_name}/surface."""
    output = await here.run(lambda: here.surfaces.picture(map_name, parent, width, low, high))
    return await send_output(request, here, output, _PNG, "surface.png")


def _numbers(name: str, text: str, count: int) -> list[float]:
    """Return the comma-separated numbers of a parameter; raise InvalidRequest unless they are
    `count` valid numbers.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(abs(x) <= FARTHEST_M for x in numbers):  # excludes NaN
        raise InvalidRequest(
            f"`{name}` is {text!r:.80}. Specify {count} numbers in metres, separated by commas.",
            ((name, f"not {count} numbers"),),
        )
    return numbers
