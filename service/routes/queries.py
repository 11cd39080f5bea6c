"""Routes for queries: localisation, similar frames, and the comparison of two frames.

A query names a stored frame in JSON, or sends a frame with its options.

    SentQuery, function that answers it  --run_query-->  Answer
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
from service.auth import Caller, Sender, may_read, require_readable, v1_router
from service.problems import refusals
from service.running_service import Here, Service

QueryType = TypeVar("QueryType", bound=Query)

TEMPLATE = "#/components/schemas/{model}"
_QUERY = "The query"


@dataclass(frozen=True, eq=False)
class QueryBody(Generic[QueryType]):
    """The content of a query request.

    Parameters
    ----------
    query : options of the query
    upload : uploaded frame; None if the request names a stored frame
    named : JSON fields beside the query, by name
    robot : name of the robot that sends the query; None if unknown
    """

    query: QueryType
    upload: bodies.FormUpload | None
    named: Mapping[str, Any]
    robot: str | None = None

    @property
    def session(self) -> str | None:
        """Name of the session of the uploaded frame."""
        return None if self.upload is None else self.upload.meta.session


class _Sender(Given):
    """The JSON field that names the sender."""

    robot: Label | None = None


@asynccontextmanager
async def read_query(
    request: Request, kind: type[QueryType], named: str
) -> AsyncIterator[QueryBody[QueryType]]:
    """Read a query from JSON or from an upload.

    Parameters
    ----------
    request : request with JSON, or with a frame for `read_upload`
    kind : class of the query
    named : name of the JSON field that names a stored frame; forms do not have it

    Raises
    ------
    UnsupportedType, MalformedBody, InvalidRequest, StoreFull, UnusableStore : See `read_upload`.
    """
    if bodies.media_type(request) == bodies.JSON:
        fields = await read_object(request)
        sender = record_of(_Sender, {"robot": fields.pop("robot", None)}, _QUERY)
        own = {} if named in kind.model_fields else {named: fields.pop(named, None)}
        yield QueryBody(record_of(kind, fields, _QUERY), None, own, sender.robot)
        return
    options = [name for name in kind.model_fields if name != named]
    async with bodies.read_upload(request, *options) as upload:
        yield QueryBody(record_of(kind, upload.fields, _QUERY), upload, {}, upload.meta.robot)


async def read_object(request: Request) -> dict[str, Any]:
    """Return the body as a JSON object; raise MalformedBody if it is not a JSON object."""
    body = await bodies.read_json(request)
    if not isinstance(body, dict):
        raise MalformedBody("The body is not a JSON object. Send an object.")
    return body


def missing_frame_error(name: str) -> InvalidRequest:
    """Return the error for a query without a frame."""
    return InvalidRequest(
        f"The query has no frame. Specify `{name}`, or send a frame in a form.",
        ((name, "missing"),),
    )


def query_operation(kind: type[BaseModel], named: Mapping[str, Any], required: list[str]) -> Any:
    """Return `requestBody` and `parameters` of a query, for the OpenAPI document.

    Parameters
    ----------
    kind : class of the query
    named : schemas of the JSON fields beside the query, by name
    required : names of the fields that JSON must have
    """
    own = kind.model_json_schema(ref_template=TEMPLATE)["properties"]
    texts = {n: bodies.as_text(schema) for n, schema in own.items() if n not in bodies.FRAME_PARTS}
    # Generated clients send the default, as text if the field may be a text or a list.
    own["stages"]["default"] = texts["stages"]["default"]
    needed = sorted({*bodies.FRAME_PARTS, *(name for name in required if name in texts)})
    body = bodies.form_body(bodies.FRAME_PARTS | texts, needed, "meta")
    sent = {"type": "object", "required": required, "properties": {**named, **own}}
    body["content"] |= {bodies.JSON: {"schema": sent}, **bodies.content()}
    options = [bodies.option_parameter(name, text) for name, text in texts.items()]
    return {"requestBody": body, "parameters": bodies.parameters() + options}


def sequence_body(kind: type[BaseModel], most: int) -> dict[str, Any]:
    """Return the form of a query with a sequence of frames, for the OpenAPI document."""
    own = kind.model_json_schema(ref_template=TEMPLATE)["properties"]
    properties = {
        "frame": {
            "type": "array", "minItems": 2, "maxItems": most, "items": bodies.FILE,
            "description": "One `frame` part for each frame, in chronological order.",
        },
        "metas": {
            "type": "array", "items": bodies.META,
            "description": "One object for each frame, with its odometry `pose`.",
        },
        **{name: bodies.as_text(schema) for name, schema in own.items()},
    }  # fmt: skip
    return {"requestBody": bodies.form_body(properties, ["frame", "metas"], "metas")}


# The comparison of two frames, which are named, or sent in parts of a form.

_SIDES = ("a", "b")


@dataclass(frozen=True, eq=False)
class Sent:
    """A frame of a form, with its content in a spooled file."""

    file: BinaryIO
    meta: FrameMeta

    def read(self) -> tuple[bytes, FrameMeta]:
        """Return the bytes and the metadata of the frame."""
        return self.file.read(), self.meta


@dataclass(frozen=True, eq=False)
class PairBody:
    """Two frames and the options of their comparison."""

    a: NamedFrame | Sent
    b: NamedFrame | Sent
    how: Comparison


@asynccontextmanager
async def read_pair(request: Request) -> AsyncIterator[PairBody]:
    """Read two frames from JSON, or from a form with parts `a` and `b`. Raise UnsupportedType or
    MalformedBody if the body is neither, InvalidRequest for a missing or repeated frame or an
    invalid field, and StoreFull or UnusableStore if a file cannot be spooled.
    """
    if bodies.media_type(request) == bodies.JSON:
        how = record_of(Comparison, await read_object(request), "The comparison")
        a, b = (_pair_frame(name, how, {}, {}) for name in _SIDES)
        yield PairBody(a, b, how)
        return
    async with bodies.read_form(request, most_files=2) as form:
        files, texts = _parts(form)
        own = {name: value for name, value in texts.items() if not name.startswith("meta_")}
        how = record_of(Comparison, own, "The comparison")
        a, b = (_pair_frame(name, how, files, texts) for name in _SIDES)
        yield PairBody(a, b, how)


def _parts(form: FormData) -> tuple[dict[str, BinaryIO], dict[str, str]]:
    """Return the files and the texts of a form by name."""
    files: dict[str, BinaryIO] = {}
    texts: dict[str, str] = {}
    for name, value in form.multi_items():
        if name in files or name in texts:
            raise _wrong(name, "specified more than once")
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
    """Return frame `name` (a or b) of a comparison."""
    named: NamedFrame | None = getattr(how, f"frame_{name}")
    if (named is None) == (name not in files):
        raise _wrong(
            f"frame_{name}",
            f"missing, and so is a file part `{name}`" if named is None
            else f"specified together with a file part `{name}`",
        )  # fmt: skip
    if named is not None:
        return named
    field = f"meta_{name}"
    if field not in texts:
        raise _wrong(field, "missing")
    return Sent(files[name], bodies.read_meta(texts[field], f"The field `{field}`"))


def _wrong(name: str, how: str) -> InvalidRequest:
    return InvalidRequest(
        f"The frames to compare are not valid: {name[:80]!r} is {how}. Specify each frame once: as "
        "a file part `a` or `b` with `meta_a` or `meta_b`, or by name in `frame_a` or `frame_b`.",
        ((name[:80], how),),
    )


async def run_query(
    here: Service, sent: SentQuery, since: float, do: Callable[[], Answer]
) -> Answer:
    """Answer a query at the gate, count it, and log it if it fails.

    Parameters
    ----------
    here : service; the query must hold a place at its gate
    sent : the query and its sender
    since : time of the request, by `time.perf_counter`
    do : function that answers and logs the query, in a thread

    Raises
    ------
    Busy : If the wait is too long; see `Gate.run`. Errors of `do` are passed on.
    """
    try:
        answer = await here.gate.run(do)
    except NotFound:  # not logged, since no query was started
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
        "description": "Name of the robot that sends the query, for the log. For an upload, "
        "specify it in `meta`.",
    }
}  # fmt: skip
_FRAME_ID: dict[str, Any] = {
    "frame_id": {
        "type": "string",
        "description": "Id of a frame of the map to query instead of an upload.",
    }
}
_BODY = query_operation(Query, _FRAME_ID | _ROBOT, ["frame_id"])
_SEVERAL = query_operation(SeveralQuery, _ROBOT, ["maps"])
_STATUSES = refusals(400, 404, 413, 415, 422)


@router.post(
    "/maps/{map_name}/queries", responses=_STATUSES, openapi_extra=_BODY,
    dependencies=[Depends(may_read)],
)  # fmt: skip
async def ask(map_name: str, request: Request, here: Here, caller: Sender) -> Answer:
    """Find where a frame was taken. Send a frame, or name a frame of the map.

    A sent frame is not added to the map. A frame of the map is not compared with itself.
    """
    return await _answer(map_name, request, here, caller, localizes=False)


@router.post(
    "/maps/{map_name}/localize", responses=_STATUSES, openapi_extra=_BODY,
    dependencies=[Depends(may_read)],
)  # fmt: skip
async def localize(map_name: str, request: Request, here: Here, caller: Sender) -> Localization:
    """Find the pose of a robot in a map. The options are those of a query.

    The full answer with all candidates is stored under `query_id` unless `keep` is false.
    """
    return localization_of(await _answer(map_name, request, here, caller, localizes=True))


_SEQUENCE: dict[str, Any] = sequence_body(Query, MOST_OF_SEQUENCE)


@router.post(
    "/maps/{map_name}/localize/sequence", responses=_STATUSES, openapi_extra=_SEQUENCE,
    dependencies=[Depends(may_read)],
)  # fmt: skip
async def localize_sequence(
    map_name: str, request: Request, here: Here, caller: Sender
) -> Localization:
    """Find the pose of a robot in a map from the robot's most recent frames. The pose is that of
    the last frame.

    Send 2 to 10 frames in chronological order, each with its odometry as `pose`, in the same parent
    frame. Each frame is queried, and all frames vote for the pose of the last one.
    """
    since, at = time.perf_counter(), time.time()
    options = tuple(Query.model_fields)
    async with (
        here.gate.place(),
        bodies.read_frames(request, *options, most=MOST_OF_SEQUENCE) as sent,
    ):
        query = record_of(Query, sent.texts, _QUERY)
        wrong = next((meta for meta in sent.metas if not isinstance(meta, FrameMeta)), None)
        if wrong is not None:
            raise wrong
        *_, last = (meta for meta in sent.metas if isinstance(meta, FrameMeta))
        log = SentQuery([map_name], query, last.robot, last.session, caller.key_id, at=at)
        answer = await run_query(
            here, log, since,
            lambda: here.queries.sequence(
                map_name, [(part.data, part.meta) for part in sent.read()], query, since, log
            ),
        )  # fmt: skip
    return localization_of(answer)


@router.post("/queries", responses=_STATUSES | refusals(409), openapi_extra=_SEVERAL)
async def ask_several(request: Request, here: Here, caller: Sender) -> Answer:
    """Search several maps for the place where a frame was taken, with one ranking over all maps.

    The maps must have the same model. Poses are averaged only within one parent frame of one map;
    `location.map` is the name of this map.
    """
    since, at, queries = time.perf_counter(), time.time(), here.queries
    async with here.gate.place(), read_query(request, SeveralQuery, "frame") as body:
        query, upload, frame = body.query, body.upload, body.query.frame
        if query.query_id is not None and (upload is not None or frame is not None):
            raise InvalidRequest(
                "The query has two frames. Specify either a frame or `query_id`.",
                (("query_id", "specified together with a frame"),),
            )
        maps = await here.run(queries.maps_of, query, partial(caller.may, "read"))
        named = None if frame is None else FrameName(map=frame.map, frame_id=frame.frame_id)
        sent = SentQuery(maps, query, body.robot, body.session, caller.key_id, named, at)
        if upload is not None:
            return await run_query(
                here, sent, since,
                lambda: queries.upload(maps, upload.file.read(), upload.meta, query, since, sent),
            )  # fmt: skip
        if query.query_id is not None:
            return await _repeat(query.query_id, here, caller, sent, since)
        if named is None:
            raise missing_frame_error("frame")
        caller.require(named.map, "read")
        return await run_query(
            here, sent, since, lambda: queries.stored(maps, named, query, since, sent)
        )


async def _repeat(
    query_id: str, here: Service, caller: Caller, sent: SentQuery, since: float
) -> Answer:
    """Repeat an earlier query with other options."""
    log = here.context.query_log
    await here.run(require_readable, query_id, here, caller)
    stored = await here.run(log.find, query_id)
    sent = replace(sent, frame=stored.answer.frame)
    return await run_query(
        here, sent, since,
        lambda: here.queries.again(list(sent.maps), stored, sent.query, since, sent),
    )  # fmt: skip


async def _answer(
    map_name: str, request: Request, here: Service, caller: Caller, *, localizes: bool
) -> Answer:
    since, at = time.perf_counter(), time.time()
    async with here.gate.place(), read_query(request, Query, "frame_id") as body:
        query, upload = body.query, body.upload
        sent = SentQuery([map_name], query, body.robot, body.session, caller.key_id, at=at)
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
            raise missing_frame_error("frame_id")
        frame = FrameName(map=map_name, frame_id=frame_id)
        sent = replace(sent, frame=frame)
        return await run_query(
            here, sent, since, lambda: here.queries.stored([map_name], frame, query, since, sent)
        )


# The comparison of two frames.

similarity_router = v1_router(tag="queries")


def _body() -> dict[str, Any]:
    """Return the body of a comparison, for the OpenAPI document."""
    own = Comparison.model_json_schema(ref_template=TEMPLATE)["properties"]
    file = {**bodies.FILE, "description": "A depth image as PNG or NPY."}
    meta = {"type": "string", "contentMediaType": bodies.JSON, "contentSchema": bodies.META}
    parts = {"a": file, "meta_a": meta, "b": file, "meta_b": meta}
    body = bodies.form_body(parts | {n: bodies.as_text(s) for n, s in own.items()}, [])
    body["content"][bodies.JSON] = {
        "schema": {
            "type": "object", "required": ["frame_a", "frame_b"], "properties": own,
            "additionalProperties": False,
        }
    }  # fmt: skip
    return body


@similarity_router.post(
    "/similarity",
    responses=refusals(400, 404, 413, 415, 422),
    openapi_extra={"requestBody": _body()},
)
async def compare(request: Request, here: Here, caller: Sender) -> Similarity:
    """Return how similar two frames are and whether they show the same place. Neither frame is
    stored.

    Name each frame in `frame_a` or `frame_b`, or send it in the file part `a` with `meta_a` or `b`
    with `meta_b`. Stored frames must have the same model; sent frames are signed with this model.
    The transform maps b to a.
    """
    async with here.gate.place(), read_pair(request) as body:
        a, b = body.a, body.b
        for side in (a, b):
            if isinstance(side, NamedFrame):
                caller.require(side.map, "read")
        return await here.gate.run(
            lambda: here.queries.compare(
                a.read() if isinstance(a, Sent) else a,
                b.read() if isinstance(b, Sent) else b,
                body.how,
            )
        )
