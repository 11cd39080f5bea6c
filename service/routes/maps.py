"""Routes that create, list, edit and delete maps, and edit a frame."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from fastapi import Depends, Query, Request, Response

from sceneprint.engine.maps import map_lifecycle
from sceneprint.engine.maps.map_lifecycle import edit_frame, edit_map
from sceneprint_client.api import Frame, Map, NewMap, Page
from sceneprint_client.api.listing import OPERATORS
from service.auth import Sender, may_admin, may_read, may_write, v1_router
from service.bodies import json_body, query_parameter, read_json_object, read_record
from service.problems import refusals
from service.responses import expected_tags
from service.running_service import Here

router = v1_router("/maps", "maps")


@router.post(
    "",
    status_code=201,
    responses={200: {"model": Map}, **refusals(400, 409, 413, 415, 422)},
    openapi_extra=json_body("NewMap"),
)
async def create_map(request: Request, here: Here, caller: Sender, response: Response) -> Map:
    """Create a map. If it already exists with the same settings, the response is 200."""
    new = await read_record(request, NewMap, "The map")
    caller.require_new(new.name)
    if OPERATORS & new.model_fields_set:
        caller.require_every("admin")
    record, is_new = await here.run(map_lifecycle.create_map, here.context.store, new)
    response.status_code = 201 if is_new else 200
    response.headers["Location"] = f"/v1/maps/{record.name}"
    return record


@router.get("", responses=refusals())
def list_maps(here: Here, caller: Sender) -> Page[Map]:
    """List the maps that the key may read, sorted by name."""
    records = map_lifecycle.get_maps(here.context.store)
    return Page[Map](items=[record for record in records if caller.may("read", record.name)])


@router.get("/{map_name}", responses=refusals(404), dependencies=[Depends(may_read)])
def get_map(map_name: str, here: Here, response: Response) -> Map:
    """Return a map with its number of frames in each state. The ETag changes with each PATCH."""
    record = map_lifecycle.get_map(here.context.store, map_name)
    response.headers["ETag"] = f'"{record.etag}"'
    return record


@router.delete(
    "/{map_name}", status_code=204, responses=refusals(404), dependencies=[Depends(may_admin)]
)
def delete_map(map_name: str, here: Here) -> None:
    """Delete a map with everything in it. This cannot be undone."""
    map_lifecycle.delete_map(here.context, map_name)


# Edits of metadata of frames and maps.

edits_router = v1_router("/maps/{map_name}")

MERGE_PATCH = "application/merge-patch+json"
_KINDS = (MERGE_PATCH, "application/json")

DryRun = Annotated[
    bool,
    Query(
        description="Return the map as it would be after the edit, but change nothing. `overdue` "
        "is the number of frames that would be deleted immediately because of `retention_days`."
    ),
]


def _document(record: str) -> dict[str, Any]:
    """Return the request body and the header `If-Match`, for the OpenAPI document."""
    schema = {"schema": {"$ref": f"#/components/schemas/{record}"}}
    text = (
        "The ETag of a previous response. If the object has been edited since, the response is "
        "412. Without the header, the last edit wins."
    )
    if_match = query_parameter("If-Match", {"type": "string"}, text) | {"in": "header"}
    body = {"required": True, "content": dict.fromkeys(_KINDS, schema)}
    return {"requestBody": body, "parameters": [if_match]}


@edits_router.patch(
    "/frames/{frame_id}",
    tags=["frames"],
    responses=refusals(400, 404, 412, 413, 415, 422),
    openapi_extra=_document("FrameEdit"),
    dependencies=[Depends(may_write)],
)
async def patch_frame(
    map_name: str, frame_id: str, request: Request, here: Here, response: Response
) -> Frame:
    """Edit the metadata of a frame (JSON merge patch, RFC 7396). Filters use the new metadata
    immediately.
    """
    patch, tags = await read_json_object(request, "The edit", _KINDS), expected_tags(request)
    frame = await here.run(edit_frame, here.context.store, map_name, frame_id, patch, tags)
    response.headers["ETag"] = f'"{frame.etag}"'
    return frame


@edits_router.patch(
    "",
    tags=["maps"],
    responses=refusals(400, 404, 412, 413, 415, 422),
    openapi_extra=_document("MapEdit"),
    dependencies=[Depends(may_admin)],
)
async def patch_map(
    map_name: str, request: Request, here: Here, caller: Sender, response: Response,
    dry_run: DryRun = False,
) -> Map:  # fmt: skip
    """Edit the title, quotas, retention and up vector of a map (JSON merge patch, RFC 7396).

    `quota_frames` and `quota_bytes` require the scope `admin` for `*`.
    """
    patch, tags = await read_json_object(request, "The edit", _KINDS), expected_tags(request)
    if OPERATORS & patch.keys():
        caller.require_every("admin")
    edit = partial(edit_map, here.context.store, map_name, patch, tags, dry_run=dry_run)
    edited = await here.run(edit)
    response.headers["ETag"] = f'"{edited.etag}"'
    return edited
