"""Queries."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

from anyio import to_thread
from fastapi import Depends, Request

from sceneprint.engine.search.query import check_localizes, localization_of
from sceneprint_client.api import (
    Answer,
    Comparison,
    FrameMeta,
    Localization,
    NamedFrame,
    Query,
    SeveralQuery,
    Similarity,
)
from sceneprint_client.api.query import MOST_OF_SEQUENCE
from service.auth import Asking, may_read, v1_router
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
    sequence_body,
    unnamed,
)

router = v1_router(tag="queries")

_FRAME_ID: dict[str, Any] = {
    "frame_id": {"type": "string", "description": "A frame of the map, in place of an upload."}
}
_BODY = described(Query, _FRAME_ID, ["frame_id"])
_SEVERAL = described(SeveralQuery, {}, ["maps", "frame"])
_STATUSES = declared(400, 404, 413, 415, 422)


@router.post(
    "/maps/{map_name}/queries", responses=_STATUSES, openapi_extra=_BODY,
    dependencies=[Depends(may_read)],
)  # fmt: skip
async def ask(map_name: str, request: Request, here: Here) -> Answer:
    """Where was this frame taken? Ask with a frame of your own, or with one of the map.

    An uploaded frame is not added to the map. A frame of the map does not find itself.
    """
    return await _asked(map_name, request, here, localizes=False)


@router.post(
    "/maps/{map_name}/localize", responses=_STATUSES, openapi_extra=_BODY,
    dependencies=[Depends(may_read)],
)  # fmt: skip
async def localize(map_name: str, request: Request, here: Here) -> Localization:
    """Where am I in this map? One status and one pose; ask as for a query.

    The whole answer, with all candidates, is kept under `query_id` unless `keep` is false.
    """
    return localization_of(await _asked(map_name, request, here, localizes=True))


_SEQUENCE: dict[str, Any] = sequence_body(Query, MOST_OF_SEQUENCE)


@router.post(
    "/maps/{map_name}/localize/sequence", responses=_STATUSES, openapi_extra=_SEQUENCE,
    dependencies=[Depends(may_read)],
)  # fmt: skip
async def localize_sequence(map_name: str, request: Request, here: Here) -> Localization:
    """Where am I in this map, by my last few frames? One status and the pose of the last.

    Send 2 to 10 frames in the order they were taken, each with a `pose` in one parent frame of any
    name: the odometry. Each is looked up; all of them vote for the pose of the last.
    """
    since, engine = time.perf_counter(), here.engine
    options = tuple(Query.model_fields)
    async with (
        here.gate.place(),
        frames_of(request, *options, most=MOST_OF_SEQUENCE) as sent,
    ):
        query = checked(Query, sent.texts)
        wrong = next((one for one in sent.metas if not isinstance(one, FrameMeta)), None)
        if wrong is not None:
            raise wrong
        answer = await here.gate.run(
            lambda: engine.queries.sequence(
                map_name, [(one.data, one.meta) for one in sent.read()], query, since
            )
        )
    here.metrics.answer(answer)
    return localization_of(answer)


@router.post("/queries", responses=_STATUSES, openapi_extra=_SEVERAL)
async def ask_several(request: Request, here: Here, asking: Asking) -> Answer:
    """In which of these maps was this frame taken? One ranking over all of them.

    The maps must be of one model. A pose is averaged within one parent frame of one map, which
    `location.map` names.
    """
    since, queries = time.perf_counter(), here.engine.queries
    async with here.gate.place(), question(request, SeveralQuery, "frame") as asked:
        query, upload, frame = asked.query, asked.upload, asked.query.frame
        maps = await to_thread.run_sync(queries.maps_of, query, partial(asking.may, "read"))
        if upload is not None:
            answer = await here.gate.run(
                lambda: queries.upload(maps, upload.file.read(), upload.meta, query, since)
            )
        elif frame is not None:
            asking.require(frame.map, "read")
            answer = await here.gate.run(lambda: queries.stored(maps, frame, query, since))
        else:
            raise unnamed("frame")
    here.metrics.answer(answer)
    return answer


async def _asked(map_name: str, request: Request, here: Context, *, localizes: bool) -> Answer:
    since, engine = time.perf_counter(), here.engine
    async with here.gate.place(), question(request, Query, "frame_id") as asked:
        query, upload = asked.query, asked.upload
        if localizes:
            check_localizes(query)
        if upload is None:
            frame_id = asked.named["frame_id"]
            if not isinstance(frame_id, str):
                raise unnamed("frame_id")
            answer = await here.gate.run(
                lambda: engine.query_frame(map_name, frame_id, query, since)
            )
        else:
            answer = await here.gate.run(
                lambda: engine.query_upload(map_name, upload.file.read(), upload.meta, query, since)
            )
    here.metrics.answer(answer)
    return answer


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
