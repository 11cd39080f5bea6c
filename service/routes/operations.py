"""How the service does, what maps can be signed with, and changing that."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Depends, Query, Request
from pydantic import ValidationError

from sceneprint.errors import InvalidRequest, UnsupportedType
from sceneprint.schemas import Map, Page
from sceneprint.schemas.operations import ModelInfo, NewModel, Stats
from service.access import Asking, may_admin
from service.bodies import media_type, read_json
from service.context import Here
from service.problems import declared, invalid

router = APIRouter(tags=["operations"])

BODY: dict[str, Any] = {
    "required": True,
    "content": {"application/json": {"schema": {"$ref": "#/components/schemas/NewModel"}}},
}


@router.get("/stats", responses=declared(404, 422))
def stats(
    here: Here,
    asking: Asking,
    map_name: Annotated[
        str | None,
        Query(alias="map", description="Of this map alone, for who may read that but not all."),
    ] = None,
    minutes: Annotated[int, Query(ge=1, le=60, description="Of history.")] = 60,
) -> Stats:
    """How the service does now, and did in the last hour, whichever of its processes did it."""
    if map_name is None:
        asking.require_every("read")
    else:
        asking.require(map_name, "read")
    return here.engine.operations.statistics.tell(minutes, map_name)


@router.get("/models", responses=declared())
def models(here: Here, asking: Asking) -> Page[ModelInfo]:
    """Models that a map can be signed with: those that ship, and those that maps have or had."""
    found = here.engine.operations.models(lambda name: asking.may("read", name))
    if not asking.reads_every:  # one that only other maps have tells of them
        found = [one for one in found if one.preset or one.maps]
    return Page[ModelInfo](items=found)


@router.post(
    "/maps/{map_name}/reencoding",
    status_code=202,
    responses=declared(400, 404, 409, 413, 415, 422),
    openapi_extra={"requestBody": BODY},
    dependencies=[Depends(may_admin)],
)
async def reencode(map_name: str, request: Request, here: Here, asking: Asking) -> Map:
    """Have every frame of a map signed with another model; the map switches when all are.

    Queries go on with the model that the map has until then. `reencoding` of the map tells how
    far it is. Asked again, it tries again what broke down.
    """
    if media_type(request) != "application/json":
        raise UnsupportedType(
            f"The body is {media_type(request) or 'of no type'!r:.80}. Send JSON as "
            "application/json."
        )
    wanted = _wanted(await read_json(request))
    may_read = None if asking.reads_every else partial(asking.may, "read")
    find = here.engine.operations.catalogue.find
    return await to_thread.run_sync(
        lambda: here.engine.reencode(map_name, find(wanted.model, may_read))
    )


@router.delete(
    "/maps/{map_name}/reencoding",
    responses=declared(404, 409),
    dependencies=[Depends(may_admin)],
)
def cancel_reencoding(map_name: str, here: Here) -> Map:
    """Let a map keep the model that it has; what was made for the other is removed."""
    return here.engine.cancel_reencode(map_name)


def _wanted(given: object) -> NewModel:
    if not isinstance(given, dict):
        raise InvalidRequest(
            "The body is no JSON object. Send one with the field `model`.",
            (("", "not an object"),),
        )
    try:
        return NewModel.model_validate(given)
    except ValidationError as error:
        raise invalid(error, "The model") from error
