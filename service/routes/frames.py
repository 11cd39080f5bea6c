"""Frames of a map."""

from __future__ import annotations

import re
import time
from typing import Annotated, Any

import anyio
from anyio import to_thread
from fastapi import APIRouter, Header, Query, Request, Response

from sceneprint.schemas import Added, Frame, FrameState, Page
from sceneprint.schemas.frames import MOST_PRIORITY
from sceneprint.schemas.novelty import NOVEL, novelty_of
from service.bodies import FORM, priority_of, uploaded
from service.context import Context, Here
from service.problems import declared

router = APIRouter(prefix="/maps/{map_name}/frames", tags=["frames"])

#: Longest time to wait for a worker, seconds.
LONGEST_WAIT_S = 60.0
#: Pause between two looks, seconds: short at first, as most frames are signed at once.
FIRST_PAUSE_S, LONGEST_PAUSE_S, GROWTH = 0.03, 0.5, 1.5

BODY: dict[str, Any] = {
    "required": True,
    "content": {
        FORM: {
            "schema": {
                "type": "object",
                "required": ["frame", "meta"],
                "properties": {
                    "frame": {
                        "type": "string",
                        "format": "binary",
                        "description": "16-bit greyscale PNG in stored units (0 and 65535 where "
                        "missing), or a two-dimensional float NPY in metres.",
                    },
                    "meta": {"$ref": "#/components/schemas/FrameMeta"},
                },
            },
            "encoding": {"meta": {"contentType": "application/json"}},
        }
    },
}


def _with_options() -> dict[str, Any]:
    """What an upload may say beside what a query says."""
    form = BODY["content"][FORM]
    priority = {
        "type": "integer",
        "minimum": -MOST_PRIORITY,
        "maximum": MOST_PRIORITY,
        "default": 0,
        "description": "Frames of a greater one are signed first.",
    }
    share = {"type": "number", "exclusiveMinimum": 0, "maximum": 1}
    if_novel = {
        "anyOf": [share, {"type": "boolean"}],
        "default": False,
        "description": "Keep it only if the map lacks the place: if its nearest frame is farther "
        f"than this share of the distance of unrelated frames; true: {NOVEL:g}. Else it ends "
        "`redundant`, and its upload is removed.",
    }
    properties = {**form["schema"]["properties"], "priority": priority, "if_novel": if_novel}
    return {
        **BODY,
        "content": {FORM: {**form, "schema": {**form["schema"], "properties": properties}}},
    }


@router.post(
    "",
    status_code=202,
    responses={
        200: {"model": Added, "description": "The map has this frame already."},
        201: {"model": Added, "description": "Waited for: indexed, redundant, rejected or failed."},
        **declared(400, 404, 409, 413, 415, 422),
    },
    openapi_extra={"requestBody": _with_options()},
)
async def add_frame(
    map_name: str,
    request: Request,
    here: Here,
    response: Response,
    prefer: Annotated[
        str | None, Header(description="`wait=N`: answer when signed, or after N seconds.")
    ] = None,
) -> Added:
    """Take a frame into a map. When this answers, the frame is safe; a worker signs it next."""
    async with here.uploads.place(), uploaded(request, "priority", "if_novel") as upload:
        priority = priority_of(upload.fields)
        if_novel = novelty_of(upload.fields.get("if_novel"))
        added, is_new = await here.uploads.run(
            lambda: here.engine.add_frame(
                map_name, upload.file.read(), upload.meta, priority, if_novel
            )
        )
    response.headers["Location"] = f"/v1/jobs/{added.job_id}"
    wait_s = _wait(prefer)
    if wait_s > 0:
        response.headers["Preference-Applied"] = f"wait={wait_s:g}"
        added = await _settled(request, here, map_name, added, wait_s)
    is_over = added.state not in (FrameState.RECEIVED, FrameState.SIGNING)
    response.status_code = 200 if not is_new else 201 if is_over else 202
    return added


@router.get("", responses=declared(404, 422))
def list_frames(
    map_name: str,
    here: Here,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    state: FrameState | None = None,
) -> Page[Frame]:
    """Frames in the order they came; deleted ones only with `state=deleted`."""
    return here.engine.list_frames(map_name, cursor, limit, state)


@router.get("/{frame_id}", responses=declared(404))
def get_frame(map_name: str, frame_id: str, here: Here) -> Frame:
    """A frame, and what has become of it."""
    return here.engine.get_frame(map_name, frame_id)


@router.delete("/{frame_id}", status_code=204, responses=declared(404))
def delete_frame(map_name: str, frame_id: str, here: Here) -> None:
    """Take a frame out of its map; from now on no query finds it."""
    here.engine.delete_frame(map_name, frame_id)


def _wait(prefer: str | None) -> float:
    """Seconds that the header `Prefer` asks to wait (RFC 7240); what is not understood is none."""
    found = re.search(r"(?:^|[,;\s])wait\s*=\s*\"?(\d{1,6})", prefer or "", re.IGNORECASE)
    return min(float(found[1]), LONGEST_WAIT_S) if found else 0.0


async def _settled(
    request: Request, here: Context, map_name: str, added: Added, wait_s: float
) -> Added:
    """The frame once nothing more will happen to it, or as it is after the wait.

    Who has hung up is not waited for.
    """
    until, pause = time.monotonic() + wait_s, FIRST_PAUSE_S
    while added.state in (FrameState.RECEIVED, FrameState.SIGNING):
        left = until - time.monotonic()
        if left <= 0 or await request.is_disconnected():
            break
        await anyio.sleep(min(pause, left))  # holds no thread meanwhile
        pause = min(pause * GROWTH, LONGEST_PAUSE_S)
        frame = await to_thread.run_sync(here.engine.get_frame, map_name, added.frame_id)
        added = added.model_copy(update={"state": frame.state, "reason": frame.reason})
    return added
