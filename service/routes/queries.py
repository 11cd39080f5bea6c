"""Queries."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

from anyio import to_thread
from fastapi import APIRouter, Depends, Request

from sceneprint.engine.localizing import check_localizes, localization_of
from sceneprint.schemas import Answer, Localization, Query, SeveralQuery
from service.access import Asking, may_read
from service.context import Context, Here
from service.problems import declared
from service.questions import described, question, unnamed

router = APIRouter(tags=["queries"])

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
