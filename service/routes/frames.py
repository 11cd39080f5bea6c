"""Routes for the frames of a map: uploads, batches, reads, deletions and imports of archives."""

from __future__ import annotations

import re
import time
from functools import partial
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
    RECORDING_OPTIONS,
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
from service.auth import Caller, Cursor, Limit, Sender, may_read, may_write, v1_router
from service.problems import refusals
from service.running_service import Here, Service

router = v1_router("/maps/{map_name}/frames", "frames")


@router.get("", responses=refusals(404, 422), dependencies=[Depends(may_read)])
def list_frames(map_name: str, here: Here, page: Annotated[FramePage, Query()]) -> Page[Frame]:
    """List frames in the order of their upload; deleted frames are listed only with
    `state=deleted`.
    """
    return map_frames.list_frames(here.context.store, map_name, page, page.cursor, page.limit)


@router.get("/{frame_id}", responses=refusals(404), dependencies=[Depends(may_read)])
def get_frame(map_name: str, frame_id: str, here: Here, response: Response) -> Frame:
    """Return a frame and its state. The ETag changes with each PATCH."""
    frame = map_frames.get_frame(here.context.store, map_name, frame_id)
    response.headers["ETag"] = f'"{frame.etag}"'
    return frame


@router.delete(
    "/{frame_id}", status_code=204, responses=refusals(404), dependencies=[Depends(may_write)]
)
def delete_frame(map_name: str, frame_id: str, here: Here) -> None:
    """Delete a frame. Queries stop finding it immediately.

    POST /v1/maps/{map_name}/frames/{frame_id}/restore undoes the deletion, by default within ten
    minutes.
    """
    here.tombstones.delete_frame(map_name, frame_id)


# Uploads: one frame, one frame under an id of the caller, or a batch.

#: Maximum seconds to wait for a worker.
LONGEST_WAIT_S = 200.0
#: First and maximum pause between reads of the state, seconds, and its growth factor.
FIRST_PAUSE_S, LONGEST_PAUSE_S, GROWTH = 0.03, 0.5, 1.5

_PRIORITY = {
    "type": "integer", "minimum": -MOST_PRIORITY, "maximum": MOST_PRIORITY, "default": 0,
    "description": "Workers sign frames of higher priority first.",
}  # fmt: skip
_IF_NOVEL = {
    "anyOf": [{"type": "number", "exclusiveMinimum": 0, "maximum": 1}, {"type": "boolean"}],
    "default": False,
    "description": "Keep the frame only if the map does not cover its place yet, that is, if the "
    "distance to the nearest frame exceeds this share of the distance between unrelated frames; "
    f"`true` means {NOVEL:g}. Otherwise, the state becomes `redundant` and the upload is deleted.",
}
OPTIONS = {"priority": _PRIORITY, "if_novel": _IF_NOVEL}
_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"model": Added, "description": "The map already contains this frame."},
    201: {"model": Added, "description": "With `Prefer: wait`: the frame has its final state."},
    **refusals(400, 404, 409, 413, 415, 422),
}
Prefer = Annotated[
    str | None,
    Header(
        description="`wait=N`: respond when the frame is signed, but after N seconds at the latest."
    ),
]


_PARAMETERS_OF_OPTIONS = [
    bodies.query_parameter(name, schema, f"The same as the field of the form. {bodies.BARE}")
    for name, schema in OPTIONS.items()
]
_UPLOAD = bodies.form_body(bodies.FRAME_PARTS | OPTIONS, ["frame", "meta"], "meta")
_UPLOAD["content"] |= bodies.content()
_DESCRIBED = {
    "parameters": [*bodies.parameters(), *_PARAMETERS_OF_OPTIONS], "requestBody": _UPLOAD,
}  # fmt: skip
_METAS = {
    "anyOf": [bodies.META, {"type": "array", "items": bodies.META}],
    "description": "One object for all frames, or a list with one object for each frame, in the "
    "same order.",
}
_BATCH_PARTS = {
    "frame": {
        "type": "array", "minItems": 1, "maxItems": MOST_OF_BATCH, "items": bodies.FILE,
        "description": "One `frame` part for each frame.",
    },
    "metas": _METAS,
}  # fmt: skip
_BATCH = {"requestBody": bodies.form_body(_BATCH_PARTS | OPTIONS, ["frame", "metas"], "metas")}


@router.post(
    "", status_code=202, responses=_RESPONSES, openapi_extra=_DESCRIBED,
    dependencies=[Depends(may_write)],
)  # fmt: skip
async def add_frame(
    map_name: str, request: Request, here: Here, caller: Sender, response: Response,
    prefer: Prefer = None, key: bodies.IdempotencyKey = None,
) -> Added:  # fmt: skip
    """Add a frame to a map. The frame is stored durably before the response; a worker then signs
    it.

    Send a form, or send the image as the body, with all options in the query string.
    """
    return await _add_frame(map_name, None, request, here, caller, response, prefer, key)


@router.put(
    "/{frame_id}", status_code=202, responses=_RESPONSES, openapi_extra=_DESCRIBED,
    dependencies=[Depends(may_write)],
)  # fmt: skip
async def put_frame(
    map_name: str, frame_id: str, request: Request, here: Here, caller: Sender,
    response: Response, prefer: Prefer = None,
) -> Added:  # fmt: skip
    """Add a frame to a map under your own id. Repeating the request returns the existing frame.

    The id has up to 64 letters, digits, dots, hyphens and underscores. Different content or
    metadata under the same id is refused; the same content under another id is a separate frame.
    """
    check_frame_id(frame_id)
    return await _add_frame(map_name, frame_id, request, here, caller, response, prefer, None)


@router.post(
    "/batch", responses=refusals(400, 404, 413, 415, 422), openapi_extra=_BATCH,
    dependencies=[Depends(may_write)],
)  # fmt: skip
async def add_batch(
    map_name: str, request: Request, here: Here, caller: Sender, response: Response,
    key: bodies.IdempotencyKey = None,
) -> Batch:  # fmt: skip
    """Add up to 64 frames to a map at once. An invalid frame does not affect the others.

    All valid frames are added in one transaction. If the request fails, no frame is added.
    """
    async with (
        here.upload_gate.place(),
        bodies.read_frames(request, "priority", "if_novel") as batch,
    ):

        def add() -> tuple[Batch, bool]:
            uploads = batch.read()
            contents = [(upload.data, upload.meta) for upload in uploads]
            parts = ("batch", map_name, contents, batch.priority, batch.if_novel, batch.faults())
            once = bodies.idempotent_request(caller, key, *parts)
            outcomes, replayed = here.uploads.add_all(map_name, uploads, once)
            return bodies.upload_responses(batch, outcomes), replayed

        answer, replayed = await here.upload_gate.run(add)
    bodies.mark_replayed(response, replayed=replayed)
    return answer


async def _add_frame(
    map_name: str, frame_id: str | None, request: Request, here: Service, caller: Caller,
    response: Response, prefer: str | None, key: str | None,
) -> Added:  # fmt: skip
    options = ("priority", "if_novel")
    async with here.upload_gate.place(), bodies.read_upload(request, *options) as form:
        priority = bodies.priority_of(form.fields)
        if_novel = novelty_of(form.fields.get("if_novel"))

        def add() -> tuple[Added, bool, bool]:
            upload = Upload(form.file.read(), form.meta, priority, if_novel, frame_id)
            parts = ("frame", map_name, upload.data, form.meta, priority, if_novel)
            once = bodies.idempotent_request(caller, key, *parts)
            outcome, replayed = here.uploads.add(map_name, upload, once)
            return outcome.accepted, outcome.new, replayed

        added, is_new, replayed = await here.upload_gate.run(add)
    bodies.mark_replayed(response, replayed=replayed)
    response.headers["Location"] = f"/v1/jobs/{added.job_id}"
    wait_s = _wait(prefer)
    if wait_s > 0:
        response.headers["Preference-Applied"] = f"wait={wait_s:g}"
        added = await _wait_for_frame(request, here, map_name, added, wait_s)
    is_over = added.state not in (FrameState.RECEIVED, FrameState.SIGNING)
    response.status_code = 200 if not is_new else 201 if is_over else 202
    return added


def _wait(prefer: str | None) -> float:
    """Return the seconds to wait, from the header `Prefer` (RFC 7240); 0 if it is not valid."""
    match = re.search(r"(?:^|[,;\s])wait\s*=\s*\"?(\d{1,6})", prefer or "", re.IGNORECASE)
    return min(float(match[1]), LONGEST_WAIT_S) if match else 0.0


async def _wait_for_frame(
    request: Request, here: Service, map_name: str, added: Added, wait_s: float
) -> Added:
    """Wait until a frame has its final state, for at most `wait_s` seconds or until the client
    disconnects; return the frame.
    """
    until, pause = time.monotonic() + wait_s, FIRST_PAUSE_S
    while added.state in (FrameState.RECEIVED, FrameState.SIGNING):
        remaining_s = until - time.monotonic()
        if remaining_s <= 0 or await request.is_disconnected():
            break
        await anyio.sleep(min(pause, remaining_s))
        pause = min(pause * GROWTH, LONGEST_PAUSE_S)
        frame = await here.run(map_frames.get_frame, here.context.store, map_name, added.frame_id)
        added = added.model_copy(update={"state": frame.state, "reason": frame.reason})
    return added


# Imports of archives of sequences and of maps in one file.

imports_router = v1_router("/maps/{map_name}/imports", "imports")

#: Media types of archives. The magic bytes of the body determine the format.
TYPES = media_types_of("archive")
#: Number of bytes per write.
_CHUNK = 1 << 20
_TEXTS = (
    "as", "name", "robot", "session", "parent_frame", "every", "with_poses", "trust_depth",
    "units_per_metre", *RECORDING_OPTIONS,
)  # fmt: skip
_PARAMETERS = (
    *_TEXTS, "tags", "base", "base_frame", "up", "heights", "offset", "camera", "priority",
    "if_novel",
)  # fmt: skip
#: Descriptions of options with several values in the query string.
_VALUE_FORMATS = {
    "tags": "Separated by commas.",
    "heights": "Separated by commas.",
    "offset": "Format: x,y,z.",
    "camera": "Format: fx,fy,cx,cy,width,height.",
}


def _described_import() -> dict[str, Any]:
    schema_of = ImportOptions.model_json_schema(ref_template="#/components/schemas/{model}")
    own = schema_of["properties"]
    base = {p["name"]: p for p in bodies.parameters() if p["name"].startswith("base")}
    text = "ImportOptions as JSON, instead of the parameters below."
    parameters = [bodies.query_parameter("options", {"type": "string"}, text)]
    for name in _PARAMETERS:
        own_schema = own.get(name, {})
        schema = OPTIONS.get(name) or {"type": "string"}
        if "type" in own_schema and name in _TEXTS:
            keys = ("type", "enum", "default", "minimum")
            schema = {key: own_schema[key] for key in keys if key in own_schema}
        if name in ("units_per_metre", "depth_scale"):
            schema = {"type": "number", "exclusiveMinimum": 0}
        text = own_schema.get("description") or base.get(name, {}).get("description", "")
        text = " ".join(filter(None, (text, _VALUE_FORMATS.get(name))))
        parameters.append(bodies.query_parameter(name, schema, text))
    return {
        "parameters": parameters,
        "requestBody": {"required": True, "content": bodies.content(TYPES)},
    }


@imports_router.post(
    "", status_code=202, responses=refusals(400, 404, 409, 413, 415, 422),
    openapi_extra=_described_import(),
    dependencies=[Depends(may_write)],
)  # fmt: skip
async def add_import(
    map_name: str, request: Request, here: Here, caller: Sender, response: Response,
    key: bodies.IdempotencyKey = None,
) -> Job:  # fmt: skip
    """Import an archive of sequences, a map in one file, or a recording. The body is the file.

    An archive is a zip or tar file (plain, .gz, .bz2 or .xz) of a 7-Scenes scene or sequence, a TUM
    RGB-D folder, or depth images with their intrinsics.json. The archive is stored durably before
    the response. A worker then adds its frames one by one; an invalid frame does not affect the
    others.

    With `as=map` the body is one cloud or mesh of a whole place (PCD, PLY, LAS, LAZ, OBJ, STL, glTF
    or E57), and `name` is the name of its file. A worker renders views of it and adds them as
    frames with poses. It then queries the map with other views; the `result` of the job
    (MapImportResult) contains the number of views that were found.

    With `as=recording` the body is an MCAP file or a ROS 1 bag, and `name` is the name of its file.
    A worker selects keyframes and adds them, as `sceneprint upload` does. `progress.recording` of
    the job (RecordingOutline) lists the topics and findings as soon as the file is read, even if no
    frame can be used.
    """
    if (kind := bodies.media_type(request)) not in TYPES:
        raise UnsupportedType(
            f"The body is {kind or 'of no type'!r:.80}. Send an archive with one of the types "
            f"{', '.join(TYPES)}."
        )
    options = _options(request)
    receiving = contextmanager_in_threadpool(here.imports.receive(map_name, options))
    async with here.upload_gate.place(), receiving as receiver:
        archive = await _store_archive(receiver, request, here)
        once = bodies.idempotent_request(caller, key, "import", map_name, archive.blob, options)
        job, replayed = await here.upload_gate.run(
            lambda: here.imports.begin(map_name, archive, options, once), patient=True
        )
    bodies.mark_replayed(response, replayed=replayed)
    response.headers["Location"] = f"/v1/jobs/{job.job_id}"
    return job


@imports_router.get(
    "/{job_id}/items", responses=refusals(404, 422), dependencies=[Depends(may_read)]
)
def list_import_items(
    map_name: str, job_id: str, here: Here, cursor: Cursor = None, limit: Limit = 100
) -> Page[ImportItem]:
    """List the results of an import so far, with one item for each frame and each skipped file of
    an archive, or for each view of a map.
    """
    return here.imports.items(map_name, job_id, cursor, limit)


async def _store_archive(receiver: Receiver, request: Request, here: Service) -> JobFile:
    """Store an archive durably while it is received."""
    waiting = bytearray()
    async for chunk in request.stream():
        waiting += chunk
        if len(waiting) >= _CHUNK:
            data = bytes(waiting)
            await here.upload_gate.run(partial(receiver.write, data), patient=True)
            waiting.clear()

    def end() -> JobFile:
        receiver.write(bytes(waiting))
        return receiver.end()

    return await here.upload_gate.run(end, patient=True)


def _options(request: Request) -> ImportOptions:
    parameters = bodies.query_parameters(request, ("options", *_PARAMETERS))
    text = bodies.take_alone(parameters, "options")
    if text is not None:
        try:
            return record_of(ImportOptions, from_json(text), "The import options")
        except ValueError as error:
            raise MalformedBody("The parameter `options` is not JSON. Send an object.") from error
    fields: dict[str, Any] = {name: parameters[name] for name in _TEXTS if name in parameters}
    for name in ("tags", "heights"):
        if parameters.get(name):
            fields[name] = parameters[name].split(",")
    if "camera" in parameters:
        fields["camera"] = camera_fields(parameters["camera"])
    if "offset" in parameters:
        fields["offset"] = offset_fields(parameters["offset"])
    bodies.add_transform(fields, parameters, "base", "T_base_sensor", "base_frame")
    if fields.get("as") == "map" and "up" in parameters:
        fields["up"] = parameters["up"]
    else:
        bodies.add_up(fields, parameters)
    if "priority" in parameters:
        fields["priority"] = parameters["priority"]
    fields["if_novel"] = novelty_of(parameters.get("if_novel"))
    return record_of(ImportOptions, fields, "The import options")
