"""Routes that copy a map to a robot's own store. They require the scope `read` of the map."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Path, Request, Response

from sceneprint.engine.maps import map_copy
from sceneprint_client.api.copies import CopyRequest
from service.auth import may_read, v1_router
from service.bodies import json_body, read_record
from service.responses import file_responses
from service.running_service import Here

router = v1_router("/maps/{map_name}/copy", "maps", may_read)

_BYTES = "application/octet-stream"


def _responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    return file_responses(_BYTES, description="The bytes.", statuses=statuses, tagged=False)


@router.post(
    "", response_class=Response, responses=_responses(400, 404, 413, 415, 422),
    openapi_extra=json_body("CopyRequest"),
)  # fmt: skip
async def copy_map(map_name: str, request: Request, here: Here) -> Response:
    """Return a consistent copy of a map and its indexed frames. The first line is a `MapCopy` as
    JSON. It is followed by the bytes of the parts that are not in `have`, at most approximately 32
    MB. To receive the remaining parts, repeat the request.
    """
    body = await read_record(request, CopyRequest, "The request")
    data = await here.run(map_copy.read_copy, here.context.store, map_name, frozenset(body.have))
    return Response(data, media_type=_BYTES)


@router.get("/artifacts/{digest}", response_class=Response, responses=_responses(404, 422))
def get_artifact(
    map_name: str, digest: Annotated[str, Path(pattern="^[0-9a-f]{64}$")], here: Here
) -> Response:
    """Return the geometry that validation compares for an indexed frame."""
    return Response(map_copy.read_artifact(here.context.store, map_name, digest), media_type=_BYTES)


@router.get("/model", response_class=Response, responses=_responses(404))
def get_map_model(map_name: str, here: Here) -> Response:
    """Return the model file of a map."""
    return Response(map_copy.read_copied_model(here.context.store, map_name), media_type=_BYTES)
