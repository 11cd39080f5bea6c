"""One map for a robot's own store: who may read it may copy it."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Path, Query, Response

from sceneprint_client.api.copies import MOST_LISTED, MOST_ROWS, FrameRows, MapListing
from service.auth import Here, may_read, v1_router
from service.problems import declared

router = v1_router("/maps/{map_name}/copy", "maps", may_read)

_BYTES: dict[int | str, dict[str, Any]] = {
    200: {"content": {"application/octet-stream": {"schema": {"type": "string"}}}}
}


@router.get("", responses=declared(404, 422))
def get_map_listing(
    map_name: str,
    here: Here,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the part before.")] = None,
    limit: Annotated[int, Query(ge=1, le=MOST_LISTED)] = 100,
) -> MapListing:
    """The map, and a part of the list of its indexed frames, in the order they came."""
    return here.engine.copies.listing(map_name, cursor, limit)


@router.get("/frames", responses=declared(404, 422))
def get_frame_rows(
    map_name: str,
    here: Here,
    frame_id: Annotated[
        list[Annotated[str, Query(max_length=64)]],
        Query(min_length=1, max_length=MOST_ROWS, description="Once for each frame."),
    ],
) -> FrameRows:
    """All that is known of some indexed frames, with their signatures and without their uploads.

    Those that are not there, or not indexed, are left out.
    """
    return here.engine.copies.rows(map_name, frame_id)


@router.get(
    "/artifacts/{digest}", response_class=Response, responses={**_BYTES, **declared(404, 422)}
)
def get_artifact(
    map_name: str, digest: Annotated[str, Path(pattern="^[0-9a-f]{64}$")], here: Here
) -> Response:
    """The geometry of an indexed frame, as validation compares it."""
    return Response(
        here.engine.copies.artifact(map_name, digest), media_type="application/octet-stream"
    )


@router.get("/model", response_class=Response, responses={**_BYTES, **declared(404)})
def get_map_model(map_name: str, here: Here) -> Response:
    """The file of the map's model."""
    return Response(here.engine.copies.model(map_name), media_type="application/octet-stream")
