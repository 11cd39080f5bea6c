"""Maps."""

from __future__ import annotations

from fastapi import APIRouter, Response

from sceneprint.schemas import Map, NewMap, Page
from service.context import Here
from service.problems import declared

router = APIRouter(prefix="/maps", tags=["maps"])


@router.post(
    "", status_code=201, responses={200: {"model": Map}, **declared(400, 409, 413, 415, 422)}
)
def create_map(new: NewMap, here: Here, response: Response) -> Map:
    """Make a map. One that is there as wanted is answered with 200."""
    made, is_new = here.engine.create_map(new)
    response.status_code = 201 if is_new else 200
    response.headers["Location"] = f"/v1/maps/{made.name}"
    return made


@router.get("", responses=declared())
def list_maps(here: Here) -> Page[Map]:
    """All maps by name."""
    return here.engine.list_maps()


@router.get("/{map_name}", responses=declared(404))
def get_map(map_name: str, here: Here) -> Map:
    """A map, with how many frames are in each state."""
    return here.engine.get_map(map_name)


@router.delete("/{map_name}", status_code=204, responses=declared(404))
def delete_map(map_name: str, here: Here) -> None:
    """Remove a map with all that is in it, for good."""
    here.engine.delete_map(map_name)
