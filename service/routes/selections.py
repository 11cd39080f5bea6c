"""Routes that delete, edit and restore several frames of a map at once."""

from __future__ import annotations

from functools import partial

from fastapi import Depends, Request

from sceneprint.engine.maps.map_frames import get_frame
from sceneprint.engine.maps.selections import delete_selection, edit_selection
from sceneprint_client.api import Frame, Page
from sceneprint_client.api.listing import (
    FrameDeletion,
    FramesDeleted,
    FramesEdit,
    FramesEdited,
    FrameSelection,
    FramesRestored,
)
from service.auth import Cursor, Limit, may_read, may_write, v1_router
from service.bodies import json_body, read_record
from service.problems import refusals
from service.running_service import Here

router = v1_router("/maps/{map_name}", "frames")

_STATUSES = refusals(400, 404, 413, 415, 422)


@router.post(
    "/frames/delete", responses=_STATUSES, openapi_extra=json_body("FrameSelection"),
    dependencies=[Depends(may_write)],
)  # fmt: skip
async def delete_frames(map_name: str, request: Request, here: Here) -> FramesDeleted:
    """Delete frames by their ids, or all frames that match a filter.

    Queries stop finding them immediately. A call ends after ten seconds; repeat it while
    `remaining` is not 0. POST /v1/maps/{map_name}/deletions/{deletion_id}/restore undoes the
    deletion, by default within ten minutes.
    """
    selection = await read_record(request, FrameSelection, "The selection")
    return await here.upload_gate.enter(
        partial(delete_selection, here.context.store, map_name, selection, here.tombstones)
    )


@router.post(
    "/frames/edit", responses=_STATUSES, openapi_extra=json_body("FramesEdit"),
    dependencies=[Depends(may_write)],
)  # fmt: skip
async def edit_frames(map_name: str, request: Request, here: Here) -> FramesEdited:
    """Move frames to a session, change their robot, and add or remove tags. Select the frames by
    their ids or by a filter.

    A call edits at most 1000 frames; repeat it with `after` while `remaining` is not 0. `inverse`
    contains the requests that undo the edit.
    """
    edit = await read_record(request, FramesEdit, "The edit of the frames")
    return await here.upload_gate.enter(partial(edit_selection, here.context.store, map_name, edit))


@router.post(
    "/frames/{frame_id}/restore", responses=refusals(404, 409), dependencies=[Depends(may_write)]
)
def restore_frame(map_name: str, frame_id: str, here: Here) -> Frame:
    """Restore a deleted frame. Queries find it again immediately.

    The response is 404 if the frame has been purged or another frame has its id, and 409 if its
    content was uploaded again.
    """
    here.tombstones.restore_one(map_name, frame_id)
    return get_frame(here.context.store, map_name, frame_id)


@router.get("/deletions", responses=refusals(404, 422), dependencies=[Depends(may_read)])
def list_deletions(
    map_name: str, here: Here, cursor: Cursor = None, limit: Limit = 100
) -> Page[FrameDeletion]:
    """List deletions of frames that can still be undone, newest first."""
    return here.tombstones.list_all(map_name, cursor, limit)


@router.post(
    "/deletions/{deletion_id}/restore", responses=refusals(404), dependencies=[Depends(may_write)]
)
async def restore_deletion(map_name: str, deletion_id: str, here: Here) -> FramesRestored:
    """Restore the frames of a deletion with all their data. Queries find them again immediately.

    A call ends after ten seconds; repeat it while `remaining` is not 0. The response is 403 if the
    frames exceed the quota of the map.
    """
    return await here.upload_gate.enter(partial(here.tombstones.restore, map_name, deletion_id))
