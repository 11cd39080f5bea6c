"""Archives of sequences into a map."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.concurrency import contextmanager_in_threadpool
from pydantic_core import from_json

from sceneprint.engine.imports import Receiver
from sceneprint.errors import InvalidRequest, MalformedBody, UnsupportedType
from sceneprint.schemas import Job, Page
from sceneprint.schemas.ingest import ImportItem, ImportOptions
from sceneprint.schemas.novelty import novelty_of
from sceneprint.store.parts import JobFile
from service import raw
from service.access import Asking, may_read, may_write
from service.bodies import media_type
from service.context import Context, Here
from service.once import IdempotencyKey, guarded, tell_replayed
from service.problems import declared
from service.questions import checked
from service.routes.uploads import OPTIONS

router = APIRouter(prefix="/maps/{map_name}/imports", tags=["imports"])

#: Types of a body that is an archive; its first bytes decide what it is.
TYPES = (
    "application/zip", "application/x-tar", "application/gzip", "application/x-bzip2",
    "application/x-xz", "application/octet-stream",
)  # fmt: skip
#: Bytes that are written at once.
_CHUNK = 1 << 20
_TEXTS = ("name", "robot", "session", "parent_frame", "every", "with_poses")
_PARAMETERS = (*_TEXTS, "tags", "base", "base_frame", "priority", "if_novel")


def _described() -> dict[str, Any]:
    own = ImportOptions.model_json_schema(ref_template="#/components/schemas/{model}")["properties"]
    base = {one["name"]: one for one in raw.parameters() if one["name"].startswith("base")}
    text = "ImportOptions as JSON, in place of what follows."
    parameters: list[dict[str, Any]] = [
        {
            "name": "options",
            "in": "query",
            "required": False,
            "schema": {"type": "string"},
            "description": text,
        }
    ]
    for name in _PARAMETERS:
        told = own.get(name, {})
        schema = OPTIONS.get(name) or {"type": "string"}
        if name in ("every", "with_poses", "name"):
            schema = {key: told[key] for key in ("type", "default", "minimum") if key in told}
        said = told.get("description") or base.get(name, {}).get("description", "")
        if name == "tags":
            said = "Of all frames, with commas between."
        parameters.append(
            {"name": name, "in": "query", "required": False, "schema": schema, "description": said}
        )
    return {
        "parameters": parameters,
        "requestBody": {"required": True, "content": raw.content(TYPES)},
    }


@router.post(
    "", status_code=202, responses=declared(400, 404, 413, 415, 422), openapi_extra=_described(),
    dependencies=[Depends(may_write)],
)  # fmt: skip
async def add_import(
    map_name: str, request: Request, here: Here, asking: Asking, response: Response,
    key: IdempotencyKey = None,
) -> Job:  # fmt: skip
    """Take an archive of sequences into a map; the body is the archive itself.

    A zip, or a tar (plain, .gz, .bz2 or .xz), of a 7-Scenes scene or sequence, a TUM RGB-D folder,
    or depth images with their intrinsics.json. When this answers, the archive is safe; a worker
    takes its frames one by one, and what is wrong with one costs no other.
    """
    if media_type(request) not in TYPES:
        raise UnsupportedType(
            f"The body is {media_type(request) or 'of no type'!r:.80}, and an archive comes as "
            f"one of {', '.join(TYPES)}."
        )
    options = _options(request)
    async with here.uploads.place():
        archive = await _received(map_name, request, here)
        once = guarded(asking, key, "import", map_name, archive.blob, options)
        job, replayed = await here.uploads.run(
            lambda: here.engine.imports.begin(map_name, archive, options, once), patient=True
        )
    tell_replayed(response, replayed=replayed)
    response.headers["Location"] = f"/v1/maps/{map_name}/imports/{job.job_id}"
    return job


@router.get("/{job_id}", responses=declared(404), dependencies=[Depends(may_read)])
def get_import(map_name: str, job_id: str, here: Here) -> Job:
    """How far an import has come."""
    return here.engine.imports.get(map_name, job_id)


@router.get("/{job_id}/items", responses=declared(404, 422), dependencies=[Depends(may_read)])
def list_import_items(
    map_name: str,
    job_id: str,
    here: Here,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> Page[ImportItem]:
    """What came of each frame of the archive so far, and of members that are none."""
    return here.engine.imports.items(map_name, job_id, cursor, limit)


async def _received(map_name: str, request: Request, here: Context) -> JobFile:
    """The archive as it came, durable."""
    async with contextmanager_in_threadpool(here.engine.imports.receive(map_name)) as receiver:
        waiting = bytearray()
        async for chunk in request.stream():
            waiting += chunk
            if len(waiting) >= _CHUNK:
                await _written(here, receiver, bytes(waiting))
                waiting.clear()

        def end() -> JobFile:
            receiver.write(bytes(waiting))
            return receiver.end()

        return await here.uploads.run(end, patient=True)


async def _written(here: Context, receiver: Receiver, data: bytes) -> None:
    await here.uploads.run(lambda: receiver.write(data), patient=True)


def _options(request: Request) -> ImportOptions:
    given = raw.once_each(request, ("options", *_PARAMETERS))
    text = given.pop("options", None)
    if text is not None:
        if given:
            raise InvalidRequest(
                f"The query string has `options` and {', '.join(sorted(given))}. Say all in "
                "`options`, or leave it out.",
                tuple((name, "beside options") for name in sorted(given)),
            )
        try:
            return checked(ImportOptions, from_json(text), "What is said of the archive")
        except ValueError as error:
            raise MalformedBody("The parameter `options` is not JSON. Send an object.") from error
    fields: dict[str, Any] = {name: given[name] for name in _TEXTS if name in given}
    if given.get("tags"):
        fields["tags"] = given["tags"].split(",")
    raw.add_transform(fields, given, "base", "T_base_sensor", "base_frame")
    if "priority" in given:
        fields["priority"] = given["priority"]
    fields["if_novel"] = novelty_of(given.get("if_novel"))
    return checked(ImportOptions, fields, "What is said of the archive")
