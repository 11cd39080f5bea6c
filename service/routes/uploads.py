"""Frames on their way into a map: one, one under an id of the caller's, or many."""

from __future__ import annotations

import re
import time
from typing import Annotated, Any

import anyio
from anyio import to_thread
from fastapi import APIRouter, Depends, Header, Request, Response

from sceneprint.engine.uploads import Upload
from sceneprint.schemas import Added, FrameState
from sceneprint.schemas.frames import MOST_PRIORITY
from sceneprint.schemas.ingest import MOST_OF_BATCH, Batch, check_frame_id
from sceneprint.schemas.novelty import NOVEL, novelty_of
from service import raw
from service.access import Asking, Caller, may_write
from service.batches import frames_of, told
from service.bodies import FORM, priority_of, uploaded
from service.context import Context, Here
from service.once import IdempotencyKey, guarded, tell_replayed
from service.problems import declared
from service.routes.frames import BODY

router = APIRouter(prefix="/maps/{map_name}/frames", tags=["frames"])

#: Longest time to wait for a worker, seconds.
LONGEST_WAIT_S = 60.0
#: Pause between two looks, seconds: short at first, as most frames are signed at once.
FIRST_PAUSE_S, LONGEST_PAUSE_S, GROWTH = 0.03, 0.5, 1.5

_PRIORITY = {
    "type": "integer",
    "minimum": -MOST_PRIORITY,
    "maximum": MOST_PRIORITY,
    "default": 0,
    "description": "Frames of a greater one are signed first.",
}
_IF_NOVEL = {
    "anyOf": [{"type": "number", "exclusiveMinimum": 0, "maximum": 1}, {"type": "boolean"}],
    "default": False,
    "description": "Keep it only if the map lacks the place: if its nearest frame is farther "
    f"than this share of the distance of unrelated frames; true: {NOVEL:g}. Else it ends "
    "`redundant`, and its upload is removed.",
}
OPTIONS = {"priority": _PRIORITY, "if_novel": _IF_NOVEL}
_SAID: dict[int | str, dict[str, Any]] = {
    200: {"model": Added, "description": "The map has this frame already."},
    201: {"model": Added, "description": "Waited for: indexed, redundant, rejected or failed."},
    **declared(400, 404, 409, 413, 415, 422),
}
Prefer = Annotated[
    str | None, Header(description="`wait=N`: answer when signed, or after N seconds.")
]


def in_query(options: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """Options as the query string has them, for the OpenAPI document."""
    return [
        {"name": name, "in": "query", "required": False, "schema": schema,
         "description": "Where the frame is the body: as in the form."}
        for name, schema in options.items()
    ]  # fmt: skip


def _described() -> dict[str, Any]:
    """What an upload may be, and say beside what a query says."""
    form = BODY["content"][FORM]
    properties = {**form["schema"]["properties"], **OPTIONS}
    schema = {**form["schema"], "properties": properties}
    return {
        "parameters": [*raw.parameters(), *in_query(OPTIONS)],
        "requestBody": {
            **BODY, "content": {FORM: {**form, "schema": schema}, **raw.content()},
        },
    }  # fmt: skip


_BATCH = {
    "requestBody": {
        "required": True,
        "content": {
            FORM: {
                "schema": {
                    "type": "object",
                    "required": ["frame", "metas"],
                    "properties": {
                        "frame": {
                            "type": "array",
                            "minItems": 1,
                            "maxItems": MOST_OF_BATCH,
                            "items": {"type": "string", "format": "binary"},
                            "description": "A part `frame` for each.",
                        },
                        "metas": {
                            "anyOf": [
                                {"$ref": "#/components/schemas/FrameMeta"},
                                {
                                    "type": "array",
                                    "items": {"$ref": "#/components/schemas/FrameMeta"},
                                },
                            ],
                            "description": "One for all, or one for each in their order.",
                        },
                        **OPTIONS,
                    },
                },
                "encoding": {"metas": {"contentType": "application/json"}},
            }
        },
    }
}


@router.post(
    "", status_code=202, responses=_SAID, openapi_extra=_described(),
    dependencies=[Depends(may_write)],
)  # fmt: skip
async def add_frame(
    map_name: str, request: Request, here: Here, asking: Asking, response: Response,
    prefer: Prefer = None, key: IdempotencyKey = None,
) -> Added:  # fmt: skip
    """Take a frame into a map. When this answers, the frame is safe; a worker signs it next.

    Send a form, or the image as the body with all else in the query string.
    """
    return await _taken(map_name, None, request, here, asking, response, prefer, key)


@router.put(
    "/{frame_id}", status_code=202, responses=_SAID, openapi_extra=_described(),
    dependencies=[Depends(may_write)],
)  # fmt: skip
async def put_frame(
    map_name: str, frame_id: str, request: Request, here: Here, asking: Asking,
    response: Response, prefer: Prefer = None,
) -> Added:  # fmt: skip
    """Take a frame into a map under an id of your own; sent again, it is the frame that is there.

    The id has up to 64 letters, digits, dots, hyphens and underscores. Other content or metadata
    under the same id is refused; the same content under another id is a frame of its own.
    """
    check_frame_id(frame_id)
    return await _taken(map_name, frame_id, request, here, asking, response, prefer, None)


@router.post(
    "/batch", responses=declared(400, 404, 413, 415, 422), openapi_extra=_BATCH,
    dependencies=[Depends(may_write)],
)  # fmt: skip
async def add_batch(
    map_name: str, request: Request, here: Here, asking: Asking, response: Response,
    key: IdempotencyKey = None,
) -> Batch:  # fmt: skip
    """Take up to 64 frames into a map at once. What is wrong with one costs no other.

    All that are taken are taken in one commit: where the whole is refused, none was.
    """
    async with here.uploads.place(), frames_of(request) as batch:

        def take() -> tuple[Batch, bool]:
            uploads = batch.read()
            said = [(one.data, one.meta) for one in uploads]
            parts = ("batch", map_name, said, batch.priority, batch.if_novel, batch.faults())
            once = guarded(asking, key, *parts)
            outcomes, replayed = here.engine.uploads.add_all(map_name, uploads, once)
            return told(batch, outcomes), replayed

        answer, replayed = await here.uploads.run(take)
    tell_replayed(response, replayed=replayed)
    return answer


async def _taken(
    map_name: str, frame_id: str | None, request: Request, here: Context, asking: Caller,
    response: Response, prefer: str | None, key: str | None,
) -> Added:  # fmt: skip
    async with here.uploads.place(), uploaded(request, "priority", "if_novel") as form:
        priority = priority_of(form.fields)
        if_novel = novelty_of(form.fields.get("if_novel"))

        def take() -> tuple[Added, bool, bool]:
            upload = Upload(form.file.read(), form.meta, priority, if_novel, frame_id)
            parts = ("frame", map_name, upload.data, form.meta, priority, if_novel)
            once = guarded(asking, key, *parts)
            outcome, replayed = here.engine.uploads.add(map_name, upload, once)
            return outcome.taken, outcome.new, replayed

        added, is_new, replayed = await here.uploads.run(take)
    tell_replayed(response, replayed=replayed)
    response.headers["Location"] = f"/v1/jobs/{added.job_id}"
    wait_s = _wait(prefer)
    if wait_s > 0:
        response.headers["Preference-Applied"] = f"wait={wait_s:g}"
        added = await _settled(request, here, map_name, added, wait_s)
    is_over = added.state not in (FrameState.RECEIVED, FrameState.SIGNING)
    response.status_code = 200 if not is_new else 201 if is_over else 202
    return added


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
