"""Maps."""

from __future__ import annotations

from typing import Any

from anyio import to_thread
from fastapi import APIRouter, Depends, Request, Response
from pydantic import ValidationError

from sceneprint.errors import InvalidRequest, UnsupportedType
from sceneprint.schemas import Map, NewMap, Page
from sceneprint.schemas.edits import OPERATORS
from service.access import Asking, may_admin, may_read
from service.bodies import media_type, read_json
from service.context import Here
from service.problems import declared, invalid

router = APIRouter(prefix="/maps", tags=["maps"])


BODY: dict[str, Any] = {
    "required": True,
    "content": {"application/json": {"schema": {"$ref": "#/components/schemas/NewMap"}}},
}


@router.post(
    "",
    status_code=201,
    responses={200: {"model": Map}, **declared(400, 409, 413, 415, 422)},
    openapi_extra={"requestBody": BODY},
)
async def create_map(request: Request, here: Here, asking: Asking, response: Response) -> Map:
    """Make a map. One that is there as wanted is answered with 200."""
    # read by hand: FastAPI would read and parse all of it before it asks for a key
    if media_type(request) != "application/json":
        raise UnsupportedType(
            f"The body is {media_type(request) or 'of no type'!r:.80}. Send JSON as "
            "application/json."
        )
    new = _new(await read_json(request))
    asking.require_new(new.name)
    if OPERATORS & new.model_fields_set:
        asking.require_every("admin")
    made, is_new = await to_thread.run_sync(here.engine.create_map, new)
    response.status_code = 201 if is_new else 200
    response.headers["Location"] = f"/v1/maps/{made.name}"
    return made


@router.get("", responses=declared())
def list_maps(here: Here, asking: Asking) -> Page[Map]:
    """All maps by name; those that the key may read."""
    found = here.engine.list_maps().items
    return Page[Map](items=[one for one in found if asking.may("read", one.name)])


@router.get("/{map_name}", responses=declared(404), dependencies=[Depends(may_read)])
def get_map(map_name: str, here: Here, response: Response) -> Map:
    """A map, with how many frames are in each state. Its ETag stands for what PATCH can change."""
    found = here.engine.get_map(map_name)
    response.headers["ETag"] = f'"{found.etag}"'
    return found


@router.delete(
    "/{map_name}", status_code=204, responses=declared(404), dependencies=[Depends(may_admin)]
)
def delete_map(map_name: str, here: Here) -> None:
    """Remove a map with all that is in it, for good."""
    here.engine.delete_map(map_name)


def _new(given: object) -> NewMap:
    if not isinstance(given, dict):
        raise InvalidRequest(
            "The map is not as it should be: it is no JSON object. See /docs for its fields.",
            (("", "not an object"),),
        )
    try:
        return NewMap.model_validate(given)
    except ValidationError as error:
        raise invalid(error, "The map") from error
