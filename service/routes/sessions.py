"""What was taken in one run, and when: sessions of a map, a trajectory, and how the map grew."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response

from sceneprint.engine.browsing import list_sessions, trajectory, trajectory_file
from sceneprint.engine.growth import growth
from sceneprint.schemas import Page
from sceneprint.schemas.browsing import Run, Session, Trajectory
from sceneprint.schemas.growth import Growth, GrowthOf
from service.access import may_read
from service.conditions import chosen
from service.context import Here
from service.problems import declared

router = APIRouter(prefix="/maps/{map_name}", tags=["sessions"], dependencies=[Depends(may_read)])

_TEXT, _JSON = "text/plain", "application/json"
_TRAJECTORY: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "By Accept: TUM lines `t tx ty tz qx qy qz qw`, their frames in comments; "
        "or JSON with the ids of the frames.",
        "model": Trajectory,
        "content": {_TEXT: {"schema": {"type": "string"}}},
    },
    **declared(404, 422),
}


@router.get("/sessions", responses=declared(404, 422))
def get_sessions(
    map_name: str,
    here: Here,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> Page[Session]:
    """Runs of a map by session and robot: how many frames, when, and where their poses lead.

    Frames that name neither are one run, and the first.
    """
    return list_sessions(here.engine.store, map_name, cursor, limit)


@router.get("/trajectory", response_class=Response, responses=_TRAJECTORY)
async def get_trajectory(
    map_name: str,
    request: Request,
    here: Here,
    run: Annotated[Run, Query()],
) -> Response:
    """The poses of a run in the order of time: of the sensors' frames, in metres.

    At most 100,000 frames at once; ask for parts of a longer one by time, or for `most` of them,
    which are evenly taken along it.
    """
    kind = chosen(request, (_TEXT, _JSON))

    def make() -> bytes:
        found = trajectory(here.engine.store, map_name, run)
        return (found.model_dump_json() if kind == _JSON else trajectory_file(found)).encode()

    async with here.gate.place():
        data = await here.gate.run(make)
    return Response(data, 200, {"Vary": "Accept"}, kind)


@router.get("/growth", responses=declared(404, 422))
def get_growth(map_name: str, here: Here, asked: Annotated[GrowthOf, Query()]) -> Growth:
    """How many frames a map has, by the hour or the day (UTC) in which they were indexed."""
    return growth(here.engine.store, map_name, asked.by, asked.last)
