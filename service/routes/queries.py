"""Queries."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import Any

from fastapi import Depends, Request

from sceneprint.engine.results.query_history import AskedQuery
from sceneprint.engine.search.query import check_localizes, localization_of
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
from sceneprint_client.api.query import MOST_OF_SEQUENCE
from service.auth import Asking, Caller, may_read, v1_router
from service.bodies import FORM, frames_of
from service.context import Context, Here
from service.problems import declared
from service.query_bodies import (
    JSON,
    TEMPLATE,
    Sent,
    as_text,
    checked,
    described,
    pair,
    question,
    run_query,
    sequence_body,
    unnamed,
)

router = v1_router(tag="queries")

_ROBOT: dict[str, Any] = {
    "robot": {
        "type": "string", "maxLength": 128,
        "description": "Who asks, for the record; of an upload `meta` says so.",
    }
}  # fmt: skip
_FRAME_ID: dict[str, Any] = {
    "frame_id": {"type": "string", "description": "A frame of the map, in place of an upload."}
}
_BODY = described(Query, _FRAME_ID | _ROBOT, ["frame_id"])
_SEVERAL = described(SeveralQuery, _ROBOT, ["maps", "frame"])
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

    The whole answer, with all candidates, is kept under `query_id` unless `keep` is false.
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
    since, at, engine = time.perf_counter(), time.time(), here.engine
    options = tuple(Query.model_fields)
    async with (
        here.gate.place(),
        frames_of(request, *options, most=MOST_OF_SEQUENCE) as sent,
    ):
        query = checked(Query, sent.texts)
        wrong = next((one for one in sent.metas if not isinstance(one, FrameMeta)), None)
        if wrong is not None:
            raise wrong
        *_, last = (one for one in sent.metas if isinstance(one, FrameMeta))
        asked = AskedQuery([map_name], query, last.robot, last.session, asking.key_id, at=at)
        answer = await run_query(
            here, asked, since,
            lambda: engine.queries.sequence(
                map_name, [(one.data, one.meta) for one in sent.read()], query, since
            ),
        )  # fmt: skip
    return localization_of(answer)


@router.post("/queries", responses=_STATUSES, openapi_extra=_SEVERAL)
async def ask_several(request: Request, here: Here, asking: Asking) -> Answer:
    """In which of these maps was this frame taken? One ranking over all of them.

    The maps must be of one model. A pose is averaged within one parent frame of one map, which
    `location.map` names.
    """
    since, at, queries = time.perf_counter(), time.time(), here.engine.queries
    async with here.gate.place(), question(request, SeveralQuery, "frame") as body:
        query, upload, frame = body.query, body.upload, body.query.frame
        maps = await here.run(queries.maps_of, query, partial(asking.may, "read"))
        named = None if frame is None else FrameName(map=frame.map, frame_id=frame.frame_id)
        asked = AskedQuery(maps, query, body.robot, body.session, asking.key_id, named, at)
        if upload is not None:
            return await run_query(
                here, asked, since,
                lambda: queries.upload(maps, upload.file.read(), upload.meta, query, since),
            )  # fmt: skip
        if frame is None:
            raise unnamed("frame")
        asking.require(frame.map, "read")
        return await run_query(
            here, asked, since, lambda: queries.stored(maps, frame, query, since)
        )


async def _asked(
    map_name: str, request: Request, here: Context, asking: Caller, *, localizes: bool
) -> Answer:
    since, at, engine = time.perf_counter(), time.time(), here.engine
    async with here.gate.place(), question(request, Query, "frame_id") as body:
        query, upload = body.query, body.upload
        asked = AskedQuery([map_name], query, body.robot, body.session, asking.key_id, at=at)
        if localizes:
            check_localizes(query)
        if upload is not None:
            return await run_query(
                here, asked, since,
                lambda: engine.query_upload(
                    map_name, upload.file.read(), upload.meta, query, since
                ),
            )  # fmt: skip
        frame_id = body.named["frame_id"]
        if not isinstance(frame_id, str):
            raise unnamed("frame_id")
        asked = replace(asked, frame=FrameName(map=map_name, frame_id=frame_id))
        return await run_query(
            here, asked, since, lambda: engine.query_frame(map_name, frame_id, query, since)
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
            lambda: here.engine.queries.compare(
                a.read() if isinstance(a, Sent) else a,
                b.read() if isinstance(b, Sent) else b,
                asked.how,
            )
        )
