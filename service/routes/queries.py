"""Queries as they come, and each answered in its turn, with its count and its record.

A query names a stored frame in JSON, or comes as a frame with its options.

    SentQuery, what answers it  --run_query-->  Answer
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, BinaryIO, Generic, TypeVar

from fastapi import Depends, Request
from pydantic import BaseModel
from starlette.datastructures import FormData, UploadFile

from sceneprint.engine.results.query_entry import SentQuery, query_row
from sceneprint.engine.search.query import check_localizes, localization_of
from sceneprint.errors import InvalidRequest, MalformedBody, NotFound
from sceneprint_client.api import (
    Answer,
    Comparison,
    FrameMeta,
    FrameName,
    Localization,
    NamedFrame,
    Query,
    SeveralQuery,
    Similarity,
)
from sceneprint_client.api.base import Given, Label, record_of
from sceneprint_client.api.query import MOST_OF_SEQUENCE
from service import bodies
from service.auth import Asking, Caller, may_read, require_readable, v1_router
from service.bodies import (
    FORM,
    FRAME_BODY,
    FormUpload,
    form_of,
    frames_of,
    media_type,
    query_parameter,
    read_json,
    read_meta,
    uploaded,
)
from service.problems import declared
from service.running_service import Here, Service

Asked = TypeVar("Asked", bound=Query)

JSON = "application/json"
TEMPLATE = "#/components/schemas/{model}"
_QUERY = "The query"


@dataclass(frozen=True, eq=False)
class QueryBody(Generic[Asked]):
    """A query as it came.

    Parameters
    ----------
    query : how to ask
    upload : the frame that was sent; None where a stored one is named
    named : what JSON had beside the query, by name
    robot : who asks, as far as it is told
    """

    query: Asked
    upload: FormUpload | None
    named: Mapping[str, Any]
    robot: str | None = None

    @property
    def session(self) -> str | None:
        """In which run an upload was taken."""
        return None if self.upload is None else self.upload.meta.session


class _Asker(Given):
    """What JSON says of who asks."""

    robot: Label | None = None


@asynccontextmanager
async def question(
    request: Request, kind: type[Asked], named: str
) -> AsyncIterator[QueryBody[Asked]]:
    """Read a query, however it came.

    Parameters
    ----------
    request : with JSON, or with a frame as `uploaded` reads it
    kind : of the query
    named : field of JSON that names a stored frame; others have none

    Raises
    ------
    UnsupportedType, MalformedBody, InvalidRequest, StoreFull, UnusableStore : see `uploaded`.
    """
    if media_type(request) == JSON:
        given = await read_object(request)
        asker = record_of(_Asker, {"robot": given.pop("robot", None)}, _QUERY)
        own = {} if named in kind.model_fields else {named: given.pop(named, None)}
        yield QueryBody(record_of(kind, given, _QUERY), None, own, asker.robot)
        return
    options = [name for name in kind.model_fields if name != named]
    async with uploaded(request, *options) as upload:
        yield QueryBody(record_of(kind, upload.fields, _QUERY), upload, {}, upload.meta.robot)


async def read_object(request: Request) -> dict[str, Any]:
    """The body as a JSON object; MalformedBody where it is none."""
    given = await read_json(request)
    if not isinstance(given, dict):
        raise MalformedBody("The body is not a JSON object. Send an object.")
    return given


def unnamed(name: str) -> InvalidRequest:
    """That a query has no frame: neither a file nor the name of a stored one."""
    return InvalidRequest(
        f"The query has no frame. Give `{name}`, or send a frame as a form.", ((name, "missing"),)
    )


def described(kind: type[BaseModel], named: Mapping[str, Any], required: list[str]) -> Any:
    """The ways to ask, for the OpenAPI document: `requestBody` and `parameters`.

    Parameters
    ----------
    kind : of the query
    named : schemas of what JSON has beside it, by name
    required : fields that JSON must have
    """
    form = FRAME_BODY["content"][FORM]["schema"]
    own = kind.model_json_schema(ref_template=TEMPLATE)["properties"]
    texts = {n: as_text(one) for n, one in own.items() if n not in form["properties"]}
    needed = sorted({*form["required"], *(name for name in required if name in texts)})
    parts = {**form["properties"], **texts}
    body = {"type": "object", "required": required, "properties": {**named, **own}}
    return {
        "requestBody": {
            "required": True,
            "content": {
                FORM: {"schema": {**form, "required": needed, "properties": parts}},
                JSON: {"schema": body},
                **bodies.content(),
            },
        },
        "parameters": bodies.parameters() + [_parameter(name, one) for name, one in texts.items()],
    }


def sequence_body(kind: type[BaseModel], most: int) -> dict[str, Any]:
    """A form with the frames of a sequence and how to ask, for the OpenAPI document."""
    own = kind.model_json_schema(ref_template=TEMPLATE)["properties"]
    meta = {"type": "array", "items": {"$ref": "#/components/schemas/FrameMeta"}}
    file = {"type": "string", "format": "binary"}
    properties = {
        "frame": {
            "type": "array", "minItems": 2, "maxItems": most, "items": file,
            "description": "A part `frame` for each, in the order they were taken.",
        },
        "metas": {**meta, "description": "One for each, with `pose`: the odometry."},
        **{name: as_text(one) for name, one in own.items()},
    }  # fmt: skip
    schema = {"type": "object", "required": ["frame", "metas"], "properties": properties}
    encoding = {"metas": {"contentType": JSON}}
    return {
        "requestBody": {
            "required": True, "content": {FORM: {"schema": schema, "encoding": encoding}}
        }
    }  # fmt: skip


def _parameter(name: str, option: Mapping[str, Any]) -> dict[str, Any]:
    """An option as the query string has it, where the frame is the body."""
    schema = {key: one for key, one in option.items() if key not in ("description", "title")}
    told = f"Where the frame is the body: {option.get('description', 'as in JSON')}"
    return query_parameter(name, schema, told)


def as_text(option: Mapping[str, Any]) -> dict[str, Any]:
    """An option as a form has it: an object as JSON text, a list with commas between."""
    kinds = option.get("anyOf", [])
    reference = next((one for one in kinds if "$ref" in one), None)
    told = {name: option[name] for name in ("description", "title") if name in option}
    if reference is not None:
        content = {"contentMediaType": JSON, "contentSchema": reference}
        return {"type": "string", **content, **told}
    if any(one.get("type") == "array" for one in kinds):
        given = option.get("default")
        default = {} if given is None else {"default": ",".join(given)}
        return {"type": "string", **default, **told}
    one = next((one for one in kinds if one.get("type") != "null"), None)
    return dict(option) if one is None else {**one, **told}


# Two frames to compare: each named, or sent as a part of a form.

_SIDES = ("a", "b")


@dataclass(frozen=True, eq=False)
class Sent:
    """A frame that came in a form; its bytes are on disk until they are read."""

    file: BinaryIO
    meta: FrameMeta

    def read(self) -> tuple[bytes, FrameMeta]:
        """Its bytes, and what is known of it."""
        return self.file.read(), self.meta


@dataclass(frozen=True, eq=False)
class PairBody:
    """Two frames, and how to compare them."""

    a: NamedFrame | Sent
    b: NamedFrame | Sent
    how: Comparison


@asynccontextmanager
async def pair(request: Request) -> AsyncIterator[PairBody]:
    """Read two frames from JSON, or from a form with parts `a` and `b`. Raise UnsupportedType or
    MalformedBody if the body is neither, InvalidRequest for a missing or repeated frame or an
    invalid field, and StoreFull or UnusableStore if a file cannot be spooled.
    """
    if media_type(request) == JSON:
        how = record_of(Comparison, await read_object(request), "The comparison")
        a, b = (_pair_frame(name, how, {}, {}) for name in _SIDES)
        yield PairBody(a, b, how)
        return
    async with form_of(request, most_files=2) as form:
        files, texts = _parts(form)
        own = {name: value for name, value in texts.items() if not name.startswith("meta_")}
        how = record_of(Comparison, own, "The comparison")
        a, b = (_pair_frame(name, how, files, texts) for name in _SIDES)
        yield PairBody(a, b, how)


def _parts(form: FormData) -> tuple[dict[str, BinaryIO], dict[str, str]]:
    """Files and texts of a form by their names."""
    files: dict[str, BinaryIO] = {}
    texts: dict[str, str] = {}
    for name, value in form.multi_items():
        if name in files or name in texts:
            raise _wrong(name, "given more than once")
        if isinstance(value, UploadFile) != (name in _SIDES):
            raise _wrong(name, "a file instead of text, or text instead of a file")
        if isinstance(value, UploadFile):
            files[name] = value.file
        else:
            texts[name] = value
    for name in texts:
        if name.startswith("meta_") and name.removeprefix("meta_") not in files:
            raise _wrong(name, "without a file")
    return files, texts


def _pair_frame(
    name: str, how: Comparison, files: Mapping[str, BinaryIO], texts: Mapping[str, str]
) -> NamedFrame | Sent:
    """One of the two, as it came."""
    named: NamedFrame | None = getattr(how, f"frame_{name}")
    if (named is None) == (name not in files):
        raise _wrong(
            f"frame_{name}",
            f"missing, and so is a file part `{name}`" if named is None
            else f"given together with a file part `{name}`",
        )  # fmt: skip
    if named is not None:
        return named
    field = f"meta_{name}"
    if field not in texts:
        raise _wrong(field, "missing")
    return Sent(files[name], read_meta(texts[field], f"The field `{field}`"))


def _wrong(name: str, how: str) -> InvalidRequest:
    return InvalidRequest(
        f"The frames to compare are not valid: {name[:80]!r} is {how}. Give each frame once: as "
        "a file part `a` or `b` with `meta_a` or `meta_b`, or named in `frame_a` or `frame_b`.",
        ((name[:80], how),),
    )


async def run_query(
    here: Service, sent: SentQuery, since: float, do: Callable[[], Answer]
) -> Answer:
    """Answer a query when it is its turn, count it, and log it if it fails.

    Parameters
    ----------
    here : of the service; the query has a place at its gate
    sent : the query, and who sends it
    since : when the request came, by `time.perf_counter`
    do : answers and logs it, in a thread

    Raises
    ------
    Busy : see `Gate.run`; and what `do` raises.
    """
    try:
        answer = await here.gate.run(do)
    except NotFound:  # what was asked for is not there: no query was begun
        raise
    except Exception as error:
        here.context.query_log.note(query_row(sent, error, time.perf_counter() - since))
        raise
    if sent.query.record:
        here.metrics.answer(answer)
    return answer


# The routes.

router = v1_router(tag="queries")

_ROBOT: dict[str, Any] = {
    "robot": {
        "type": "string", "maxLength": 128,
        "description": "Who sends it, for the log; of an upload `meta` says so.",
    }
}  # fmt: skip
_FRAME_ID: dict[str, Any] = {
    "frame_id": {"type": "string", "description": "A frame of the map, in place of an upload."}
}
_BODY = described(Query, _FRAME_ID | _ROBOT, ["frame_id"])
_SEVERAL = described(SeveralQuery, _ROBOT, ["maps"])
_STATUSES = declared(400, 404, 413, 415, 422)


@router.post(
    "/maps/{map_name}/queries", responses=_STATUSES, openapi_extra=_BODY,
    dependencies=[Depends(may_read)],
)  # fmt: skip
async def ask(map_name: str, request: Request, here: Here, asking: Asking) -> Answer:
    """Where was this frame taken? Ask with a frame of your own, or with one of the map.

    An uploaded frame is not added to the map. A frame of the map does not find itself.
    """
    return await _asked(map_name, request, here, asking, localizes=False)


@router.post(
    "/maps/{map_name}/localize", responses=_STATUSES, openapi_extra=_BODY,
    dependencies=[Depends(may_read)],
)  # fmt: skip
async def localize(map_name: str, request: Request, here: Here, asking: Asking) -> Localization:
    """Where am I in this map? One status and one pose; ask as for a query.

    The whole answer, with all candidates, is stored under `query_id` unless `keep` is false.
    """
    return localization_of(await _asked(map_name, request, here, asking, localizes=True))


_SEQUENCE: dict[str, Any] = sequence_body(Query, MOST_OF_SEQUENCE)


@router.post(
    "/maps/{map_name}/localize/sequence", responses=_STATUSES, openapi_extra=_SEQUENCE,
    dependencies=[Depends(may_read)],
)  # fmt: skip
async def localize_sequence(
    map_name: str, request: Request, here: Here, asking: Asking
) -> Localization:
    """Where am I in this map, by my last few frames? One status and the pose of the last.

    Send 2 to 10 frames in the order they were taken, each with a `pose` in one parent frame of any
    name: the odometry. Each is looked up; all of them vote for the pose of the last.
    """
    since, at = time.perf_counter(), time.time()
    options = tuple(Query.model_fields)
    async with here.gate.place(), frames_of(request, *options, most=MOST_OF_SEQUENCE) as sent:
        query = record_of(Query, sent.texts, _QUERY)
        wrong = next((one for one in sent.metas if not isinstance(one, FrameMeta)), None)
        if wrong is not None:
            raise wrong
        *_, last = (one for one in sent.metas if isinstance(one, FrameMeta))
        log = SentQuery([map_name], query, last.robot, last.session, asking.key_id, at=at)
        answer = await run_query(
            here, log, since,
            lambda: here.queries.sequence(
                map_name, [(one.data, one.meta) for one in sent.read()], query, since, log
            ),
        )  # fmt: skip
    return localization_of(answer)


@router.post("/queries", responses=_STATUSES | declared(409), openapi_extra=_SEVERAL)
async def ask_several(request: Request, here: Here, asking: Asking) -> Answer:
    """In which of these maps was this frame taken? One ranking over all of them.

    The maps must be of one model. A pose is averaged within one parent frame of one map, which
    `location.map` names.
    """
    since, at, queries = time.perf_counter(), time.time(), here.queries
    async with here.gate.place(), question(request, SeveralQuery, "frame") as body:
        query, upload, frame = body.query, body.upload, body.query.frame
        if query.query_id is not None and (upload is not None or frame is not None):
            raise InvalidRequest(
                "The query has two frames. Give a frame or `query_id`.",
                (("query_id", "given together with a frame"),),
            )
        maps = await here.run(queries.maps_of, query, partial(asking.may, "read"))
        named = None if frame is None else FrameName(map=frame.map, frame_id=frame.frame_id)
        sent = SentQuery(maps, query, body.robot, body.session, asking.key_id, named, at)
        if upload is not None:
            return await run_query(
                here, sent, since,
                lambda: queries.upload(maps, upload.file.read(), upload.meta, query, since, sent),
            )  # fmt: skip
        if query.query_id is not None:
            return await _repeated(query.query_id, here, asking, sent, since)
        if named is None:
            raise unnamed("frame")
        asking.require(named.map, "read")
        return await run_query(
            here, sent, since, lambda: queries.stored(maps, named, query, since, sent)
        )


async def _repeated(
    query_id: str, here: Service, asking: Caller, sent: SentQuery, since: float
) -> Answer:
    """Repeat an earlier query with other options."""
    log = here.context.query_log
    await here.run(require_readable, query_id, here, asking)
    stored = await here.run(log.find, query_id)
    sent = replace(sent, frame=stored.answer.frame)
    return await run_query(
        here, sent, since,
        lambda: here.queries.again(list(sent.maps), stored, sent.query, since, sent),
    )  # fmt: skip


async def _asked(
    map_name: str, request: Request, here: Service, asking: Caller, *, localizes: bool
) -> Answer:
    since, at = time.perf_counter(), time.time()
    async with here.gate.place(), question(request, Query, "frame_id") as body:
        query, upload = body.query, body.upload
        sent = SentQuery([map_name], query, body.robot, body.session, asking.key_id, at=at)
        if localizes:
            check_localizes(query)
        if upload is not None:
            return await run_query(
                here, sent, since,
                lambda: here.queries.upload(
                    [map_name], upload.file.read(), upload.meta, query, since, sent
                ),
            )  # fmt: skip
        frame_id = body.named["frame_id"]
        if not isinstance(frame_id, str):
            raise unnamed("frame_id")
        frame = FrameName(map=map_name, frame_id=frame_id)
        sent = replace(sent, frame=frame)
        return await run_query(
            here, sent, since, lambda: here.queries.stored([map_name], frame, query, since, sent)
        )


# Two frames compared.

similarity_router = v1_router(tag="queries")


def _body() -> dict[str, Any]:
    """The ways to name two frames, for the OpenAPI document."""
    own = Comparison.model_json_schema(ref_template=TEMPLATE)["properties"]
    file = {"type": "string", "format": "binary", "description": "A depth image: PNG or NPY."}
    meta = {
        "type": "string",
        "contentMediaType": JSON,
        "contentSchema": {"$ref": "#/components/schemas/FrameMeta"},
    }
    parts = {"a": file, "meta_a": meta, "b": file, "meta_b": meta}
    texts = {name: as_text(one) for name, one in own.items()}
    return {
        "required": True,
        "content": {
            JSON: {
                "schema": {
                    "type": "object", "required": ["frame_a", "frame_b"], "properties": own,
                    "additionalProperties": False,
                }
            },
            FORM: {"schema": {"type": "object", "properties": {**parts, **texts}}},
        },
    }  # fmt: skip


@similarity_router.post(
    "/similarity",
    responses=declared(400, 404, 413, 415, 422),
    openapi_extra={"requestBody": _body()},
)
async def compare(request: Request, here: Here, asking: Asking) -> Similarity:
    """How alike are two frames, and do they see one place? Neither is kept.

    Each is stored, or sent: file part `a` with `meta_a`, `b` with `meta_b`. Stored frames must be
    of one model; what is sent is signed with theirs. The transform maps b to a.
    """
    async with here.gate.place(), pair(request) as asked:
        a, b = asked.a, asked.b
        for side in (a, b):
            if isinstance(side, NamedFrame):
                asking.require(side.map, "read")
        return await here.gate.run(
            lambda: here.queries.compare(
                a.read() if isinstance(a, Sent) else a,
                b.read() if isinstance(b, Sent) else b,
                asked.how,
            )
        )
