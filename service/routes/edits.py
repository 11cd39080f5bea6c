"""Metadata of frames and maps, edited."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Depends, Query, Request, Response

from sceneprint.engine.edits import edit_frame, edit_map
from sceneprint.engine.maps import LIMITS
from sceneprint.errors import InvalidRequest, UnsupportedType
from sceneprint.schemas import Frame, Map
from sceneprint.schemas.edits import OPERATORS
from service.access import Asking, may_admin, may_write
from service.bodies import media_type, read_json
from service.conditions import expected
from service.context import Here
from service.problems import declared

router = APIRouter(prefix="/maps/{map_name}")

MERGE_PATCH = "application/merge-patch+json"
_KINDS = (MERGE_PATCH, "application/json")


DryRun = Annotated[
    bool,
    Query(
        description="Change nothing; the map is told as it would be: `overdue` is how many frames "
        "`retention_days` would delete at once."
    ),
]


def _document(record: str) -> dict[str, Any]:
    """The parts of an operation that FastAPI does not see."""
    schema = {"schema": {"$ref": f"#/components/schemas/{record}"}}
    if_match = {
        "name": "If-Match",
        "in": "header",
        "required": False,
        "schema": {"type": "string"},
        "description": "The ETag of what was read: 412 where it has been edited since. Without "
        "it the last edit wins.",
    }
    body = {"required": True, "content": dict.fromkeys(_KINDS, schema)}
    return {"requestBody": body, "parameters": [if_match]}


@router.patch(
    "/frames/{frame_id}",
    tags=["frames"],
    responses=declared(400, 404, 412, 413, 415, 422),
    openapi_extra=_document("FrameEdit"),
    dependencies=[Depends(may_write)],
)
async def patch_frame(
    map_name: str, frame_id: str, request: Request, here: Here, response: Response
) -> Frame:
    """Change the metadata of a frame (JSON merge patch, RFC 7396); filters see it at once."""
    patch, tags = await _patch(request), expected(request)
    frame = await to_thread.run_sync(edit_frame, here.engine.store, map_name, frame_id, patch, tags)
    response.headers["ETag"] = f'"{frame.etag}"'
    return frame


@router.patch(
    "",
    tags=["maps"],
    responses=declared(400, 404, 412, 413, 415, 422),
    openapi_extra=_document("MapEdit"),
    dependencies=[Depends(may_admin)],
)
async def patch_map(
    map_name: str, request: Request, here: Here, asking: Asking, response: Response,
    dry_run: DryRun = False,
) -> Map:  # fmt: skip
    """Change title, quotas and retention of a map (JSON merge patch, RFC 7396).

    Quotas are the operator's: `quota_frames` and `quota_bytes` ask for `admin` for `*`.
    """
    patch, tags = await _patch(request), expected(request)
    if OPERATORS & patch.keys():
        asking.require_every("admin")
    edit = partial(edit_map, here.engine.store, map_name, patch, tags, dry_run=dry_run)
    edited = await to_thread.run_sync(edit)
    told = {name: getattr(edited, name) for name in sorted(LIMITS & patch.keys())}
    request.state.audited = {"dry_run": True} if dry_run else told
    response.headers["ETag"] = f'"{edited.etag}"'
    return edited


async def _patch(request: Request) -> Mapping[str, Any]:
    if media_type(request) not in _KINDS:
        raise UnsupportedType(
            f"The body is {media_type(request) or 'of no type'!r:.80}. Send JSON as "
            f"{MERGE_PATCH} or application/json."
        )
    given = await read_json(request)
    if not isinstance(given, dict):
        raise InvalidRequest(
            "The change is not as it should be: it is no JSON object. See /docs for its fields.",
            (("", "not an object"),),
        )
    return given
