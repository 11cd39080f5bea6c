"""Frames of a map."""

from __future__ import annotations

import re
import time
from typing import Annotated, Any

import anyio
from fastapi import Depends, Header, Query, Request, Response
from fastapi.concurrency import contextmanager_in_threadpool
from pydantic_core import from_json

from sceneprint.engine.ingest.archive_import import Receiver
from sceneprint.engine.ingest.uploads import Upload
from sceneprint.engine.maps import map_frames
from sceneprint.errors import MalformedBody, UnsupportedType
from sceneprint.store.queue import JobFile
from sceneprint_client.api import Added, Frame, FrameState, Job, Page
from sceneprint_client.api.base import NOVEL, novelty_of, record_of
from sceneprint_client.api.frames import (
    MOST_OF_BATCH,
    MOST_PRIORITY,
    Batch,
    ImportItem,
    ImportOptions,
    camera_fields,
    check_frame_id,
    offset_fields,
)
from sceneprint_client.api.listing import FramePage
from sceneprint_client.formats import media_types_of
from service import bodies
from service.auth import Asking, Caller, may_read, may_write, v1_router
from service.bodies import (
    FORM,
    FRAME_BODY,
    IdempotencyKey,
    frames_of,
    guarded,
    mark_replayed,
    media_type,
    priority_of,
    upload_responses,
    uploaded,
)
from service.problems import declared
from service.running_service import Here, Service

router = v1_router("/maps/{map_name}/frames", "frames")


@router.get("", responses=declared(404, 422), dependencies=[Depends(may_read)])
def list_frames(map_name: str, here: Here, wanted: Annotated[FramePage, Query()]) -> Page[Frame]:
    """Frames in the order they came; deleted ones only with `state=deleted`."""
    return map_frames.list_frames(here.context.store, map_name, wanted, wanted.cursor, wanted.limit)


@router.get("/{frame_id}", responses=declared(404), dependencies=[Depends(may_read)])
def get_frame(map_name: str, frame_id: str, here: Here, response: Response) -> Frame:
    """A frame, and what has become of it. Its ETag stands for what PATCH can change of it."""
    frame = map_frames.get_frame(here.context.store, map_name, frame_id)
    response.headers["ETag"] = f'"{frame.etag}"'
    return frame


@router.delete(
    "/{frame_id}", status_code=204, responses=declared(404), dependencies=[Depends(may_write)]
)
def delete_frame(map_name: str, frame_id: str, here: Here) -> None:
    """Take a frame out of its map; from now on no query finds it.

    Ten minutes by default, POST /v1/maps/{map_name}/frames/{frame_id}/restore undoes it.
    """
    here.tombstones.delete_frame(map_name, frame_id)


# Frames on their way into a map: one, one under an id of the caller's, or many.


#: Longest time to wait for a worker, seconds.
LONGEST_WAIT_S = 200.0
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
    text = "Where the frame is the body: as in the form."
    return [bodies.query_parameter(name, schema, text) for name, schema in options.items()]


def _described_upload() -> dict[str, Any]:
    """What an upload may be, and say beside what a query says."""
    form = FRAME_BODY["content"][FORM]
    properties = {**form["schema"]["properties"], **OPTIONS}
    schema = {**form["schema"], "properties": properties}
    return {
        "parameters": [*bodies.parameters(), *in_query(OPTIONS)],
        "requestBody": {
            **FRAME_BODY, "content": {FORM: {**form, "schema": schema}, **bodies.content()},
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
    "", status_code=202, responses=_SAID, openapi_extra=_described_upload(),
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
    "/{frame_id}", status_code=202, responses=_SAID, openapi_extra=_described_upload(),
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
    async with here.upload_gate.place(), frames_of(request, "priority", "if_novel") as batch:

        def take() -> tuple[Batch, bool]:
            uploads = batch.read()
            said = [(one.data, one.meta) for one in uploads]
            parts = ("batch", map_name, said, batch.priority, batch.if_novel, batch.faults())
            once = guarded(asking, key, *parts)
            outcomes, replayed = here.uploads.add_all(map_name, uploads, once)
            return upload_responses(batch, outcomes), replayed

        answer, replayed = await here.upload_gate.run(take)
    mark_replayed(response, replayed=replayed)
    return answer


async def _taken(
    map_name: str, frame_id: str | None, request: Request, here: Service, asking: Caller,
    response: Response, prefer: str | None, key: str | None,
) -> Added:  # fmt: skip
    options = ("priority", "if_novel")
    async with here.upload_gate.place(), uploaded(request, *options) as form:
        priority = priority_of(form.fields)
        if_novel = novelty_of(form.fields.get("if_novel"))

        def take() -> tuple[Added, bool, bool]:
            upload = Upload(form.file.read(), form.meta, priority, if_novel, frame_id)
            parts = ("frame", map_name, upload.data, form.meta, priority, if_novel)
            once = guarded(asking, key, *parts)
            outcome, replayed = here.uploads.add(map_name, upload, once)
            return outcome.taken, outcome.new, replayed

        added, is_new, replayed = await here.upload_gate.run(take)
    mark_replayed(response, replayed=replayed)
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
    request: Request, here: Service, map_name: str, added: Added, wait_s: float
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
        frame = await here.run(map_frames.get_frame, here.context.store, map_name, added.frame_id)
        added = added.model_copy(update={"state": frame.state, "reason": frame.reason})
    return added


# Archives of sequences, and maps that come as one file, into a map.

imports_router = v1_router("/maps/{map_name}/imports", "imports")

#: Types of a body that is an archive; its first bytes decide what it is.
TYPES = media_types_of("archive")
#: Bytes that are written at once.
_CHUNK = 1 << 20
_TEXTS = (
    "as", "name", "robot", "session", "parent_frame", "every", "with_poses", "trust_depth",
    "units_per_metre",
)  # fmt: skip
_PARAMETERS = (
    *_TEXTS, "tags", "base", "base_frame", "up", "heights", "offset", "camera", "priority",
    "if_novel",
)  # fmt: skip
#: How those of several values are written in a query string.
_WRITTEN = {
    "tags": "With commas between.",
    "heights": "With commas between.",
    "offset": "Written as x,y,z.",
    "camera": "Written as fx,fy,cx,cy,width,height.",
}


def _described_import() -> dict[str, Any]:
    schema_of = ImportOptions.model_json_schema(ref_template="#/components/schemas/{model}")
    own = schema_of["properties"]
    base = {one["name"]: one for one in bodies.parameters() if one["name"].startswith("base")}
    text = "ImportOptions as JSON, in place of what follows."
    parameters = [bodies.query_parameter("options", {"type": "string"}, text)]
    for name in _PARAMETERS:
        told = own.get(name, {})
        schema = OPTIONS.get(name) or {"type": "string"}
        if name in ("as", "every", "with_poses", "trust_depth", "name"):
            known = ("type", "enum", "default", "minimum")
            schema = {key: told[key] for key in known if key in told}
        if name == "units_per_metre":
            schema = {"type": "number", "exclusiveMinimum": 0}
        said = told.get("description") or base.get(name, {}).get("description", "")
        said = " ".join(filter(None, (said, _WRITTEN.get(name))))
        parameters.append(bodies.query_parameter(name, schema, said))
    return {
        "parameters": parameters,
        "requestBody": {"required": True, "content": bodies.content(TYPES)},
    }


@imports_router.post(
    "", status_code=202, responses=declared(400, 404, 409, 413, 415, 422),
    openapi_extra=_described_import(),
    dependencies=[Depends(may_write)],
)  # fmt: skip
async def add_import(
    map_name: str, request: Request, here: Here, asking: Asking, response: Response,
    key: IdempotencyKey = None,
) -> Job:  # fmt: skip
    """Take an archive of sequences into a map, or a map that comes as one file; the body is the
    file itself.

    An archive is a zip, or a tar (plain, .gz, .bz2 or .xz), of a 7-Scenes scene or sequence, a TUM
    RGB-D folder, or depth images with their intrinsics.json. When this answers, the archive is
    safe; a worker takes its frames one by one, and what is wrong with one costs no other.

    With `as=map` the body is one cloud or mesh of a whole place (PCD, PLY, LAS, LAZ, OBJ, STL, glTF
    or E57), and `name` the name of its file. A worker renders views of it, adds them as frames with
    poses, and looks other views up in the map: `result` of the job says how many it found
    (MapImportResult).
    """
    if media_type(request) not in TYPES:
        raise UnsupportedType(
            f"The body is {media_type(request) or 'of no type'!r:.80}. Send an archive as one of "
            f"{', '.join(TYPES)}."
        )
    options = _options(request)
    receiving = contextmanager_in_threadpool(here.imports.receive(map_name, options))
    async with here.upload_gate.place(), receiving as receiver:
        archive = await _received(receiver, request, here)
        once = guarded(asking, key, "import", map_name, archive.blob, options)
        job, replayed = await here.upload_gate.run(
            lambda: here.imports.begin(map_name, archive, options, once), patient=True
        )
    mark_replayed(response, replayed=replayed)
    response.headers["Location"] = f"/v1/jobs/{job.job_id}"
    return job


@imports_router.get(
    "/{job_id}/items", responses=declared(404, 422), dependencies=[Depends(may_read)]
)
def list_import_items(
    map_name: str,
    job_id: str,
    here: Here,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> Page[ImportItem]:
    """What came of each frame of the archive so far, and of members that are none; or of each view
    of a map.
    """
    return here.imports.items(map_name, job_id, cursor, limit)


async def _received(receiver: Receiver, request: Request, here: Service) -> JobFile:
    """Store the archive durably as it comes."""
    waiting = bytearray()
    async for chunk in request.stream():
        waiting += chunk
        if len(waiting) >= _CHUNK:
            await _written(here, receiver, bytes(waiting))
            waiting.clear()

    def end() -> JobFile:
        receiver.write(bytes(waiting))
        return receiver.end()

    return await here.upload_gate.run(end, patient=True)


async def _written(here: Service, receiver: Receiver, data: bytes) -> None:
    await here.upload_gate.run(lambda: receiver.write(data), patient=True)


def _options(request: Request) -> ImportOptions:
    given = bodies.query_parameters(request, ("options", *_PARAMETERS))
    text = bodies.take_alone(given, "options")
    if text is not None:
        try:
            return record_of(ImportOptions, from_json(text), "The import options")
        except ValueError as error:
            raise MalformedBody("The parameter `options` is not JSON. Send an object.") from error
    fields: dict[str, Any] = {name: given[name] for name in _TEXTS if name in given}
    for name in ("tags", "heights"):
        if given.get(name):
            fields[name] = given[name].split(",")
    if "camera" in given:
        fields["camera"] = camera_fields(given["camera"])
    if "offset" in given:
        fields["offset"] = offset_fields(given["offset"])
    bodies.add_transform(fields, given, "base", "T_base_sensor", "base_frame")
    if fields.get("as") == "map" and "up" in given:
        fields["up"] = given["up"]
    else:
        bodies.add_up(fields, given)
    if "priority" in given:
        fields["priority"] = given["priority"]
    fields["if_novel"] = novelty_of(given.get("if_novel"))
    return record_of(ImportOptions, fields, "The import options")
