"""The fused surface of a map: tiles to draw, frames that saw a spot, a plan."""

from __future__ import annotations

import math
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
from service.auth import may_read, may_write, v1_router
from service.problems import declared
from service.responses import file_responses, is_known, sent
from service.running_service import Here

router = v1_router("/maps/{map_name}/surface", "surface", may_read)

_PNG, _BYTES = "image/png", "application/octet-stream"
#: Of what a digest stands for: it never changes.
_FOREVER = "private, max-age=31536000, immutable"
Parent = Annotated[
    Label | None, Query(description="Parent frame; default: the one of most frames.")
]


@router.get("", responses=declared(404))
def get_surface(map_name: str, here: Here) -> MapSurface:
    """What the posed frames of a map saw, fused: levels of tiles, sessions, state."""
    return here.surfaces.get(map_name)


@router.post(
    "",
    status_code=202,
    responses={
        200: {"model": MapSurface, "description": "It is up to date."},
        **declared(404, 422),
    },
    dependencies=[Depends(may_write)],
)
def begin_surface(map_name: str, here: Here, response: Response) -> MapSurface:
    """Build the surface of a map, or add what came since, now.

    Workers do so when frames arrive, unless `SCENEPRINT_BUILD_SURFACES` is `on_request`. Poll
    `Location` until `state` is `ready`; existing tiles can be read meanwhile. It takes the scope
    `write`.
    """
    surface, begun = here.surfaces.begin(map_name)
    response.headers["Location"] = f"/v1/maps/{map_name}/surface"
    if not begun:
        response.status_code = 200
    return surface


@router.delete("", status_code=204, responses=declared(404), dependencies=[Depends(may_write)])
def delete_surface(map_name: str, here: Here) -> None:
    """Delete the surface of a map. Workers build it again only when somebody asks for it."""
    here.surfaces.remove(map_name)


@router.get("/tiles", responses=declared(404, 422))
def list_surface_tiles(
    map_name: str,
    here: Here,
    parent: Parent = None,
    level: Annotated[int, Query(ge=0, le=7, description="0 has the finest cells.")] = 0,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 1000,
) -> Page[SurfaceTile]:
    """Tiles of a level by column, row and floor."""
    return here.surfaces.tiles(map_name, parent, level, cursor, limit)


@router.get(
    "/tiles/{digest}",
    response_class=Response,
    responses=file_responses(
        _BYTES, description="8 bytes a cell; see docs/surface.md.", statuses=(404,)
    ),
)
def get_surface_tile(map_name: str, digest: str, request: Request, here: Here) -> Response:
    """The cells of a tile. They never change: another digest stands for others."""
    found = here.surfaces.tile(map_name, digest)
    headers = {"ETag": f'"{found.tag}"', "Cache-Control": _FOREVER}
    if is_known(request, found.tag):
        return Response(None, 304, headers)
    return Response(found.make(), 200, headers, _BYTES)


@router.get("/frames", responses=declared(404, 422))
def list_surface_frames(
    map_name: str,
    here: Here,
    parent: Parent = None,
    at: Annotated[
        str | None, Query(max_length=200, description="x,y,z of a spot that frames saw, metres.")
    ] = None,
    radius: Annotated[
        float | None,
        Query(gt=0, le=1e6, description="How near to the spot, metres; default: two cells."),
    ] = None,
    box: Annotated[
        str | None,
        Query(max_length=400, description="x0,y0,z0,x1,y1,z1 of a box that frames were taken in."),
    ] = None,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 20,
) -> Page[SurfaceSighting]:
    """Frames that saw a spot, from the nearest viewpoint on; or frames that were taken in a box.

    Give `at` or `box`. A frame saw the spot where a point of its own lies within `radius`. Before
    the last page a page may hold fewer than `limit`.
    """
    if (at is None) == (box is None):
        raise InvalidRequest(
            "Give either `at` or `box`.", (("at", "either this or box is required"),)
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
        _PNG, description="Seen from above, transparent where nothing is.", statuses=(404, 422)
    ),
)
async def get_surface_plan(
    map_name: str,
    request: Request,
    here: Here,
    parent: Parent = None,
    width: Annotated[
        int, Query(ge=PLAN_WIDTHS[0], le=PLAN_WIDTHS[1], description="Pixels of the longer side.")
    ] = PLAN_WIDTH,
    low: Annotated[
        float | None,
        Query(ge=-FARTHEST_M, le=FARTHEST_M, description="Only above this height, metres."),
    ] = None,
    high: Annotated[
        float | None,
        Query(ge=-FARTHEST_M, le=FARTHEST_M, description="Only below this height, metres."),
    ] = None,
) -> Response:
    """A surface as a picture. `plan` of GET /v1/maps/{map_name}/surface tells where it lies."""
    output = await here.run(lambda: here.surfaces.picture(map_name, parent, width, low, high))
    return await sent(request, here, output, _PNG, "surface.png")


def _numbers(name: str, text: str, count: int) -> list[float]:
    """Return the numbers that a parameter lists; raise InvalidRequest if there are too few, too
    many or invalid ones.
    """
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if len(found) != count or not all(
        math.isfinite(one) and abs(one) <= FARTHEST_M for one in found
    ):
        raise InvalidRequest(
            f"`{name}` is {text!r:.80}. Give {count} numbers with commas between them, in metres.",
            ((name, f"not {count} numbers"),),
        )
    return found
