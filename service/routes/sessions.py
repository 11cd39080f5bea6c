"""Routes for the sessions of a map and their trajectories."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from fastapi import Depends, Query, Request, Response

from sceneprint.engine.maps.map_frames import list_sessions, trajectory, trajectory_file
from sceneprint.engine.maps.selections import delete_session, edit_session
from sceneprint_client.api import Page
from sceneprint_client.api.base import Label
from sceneprint_client.api.listing import Run, Session, SessionChange, SessionEdit, Trajectory
from service.auth import Cursor, Limit, may_read, may_write, v1_router
from service.bodies import json_body, read_record
from service.problems import refusals
from service.responses import file_responses, preferred_media_type
from service.running_service import Here

router = v1_router("/maps/{map_name}", "sessions", may_read)

_PLAIN, _JSON = "text/plain", "application/json"
_TRAJECTORY = file_responses(
    _PLAIN, model=Trajectory, statuses=(404, 422), tagged=False,
    description="Depending on Accept: TUM lines `t tx ty tz qx qy qz qw` with the coordinate "
    "frames in comments, or JSON with the ids of the frames.",
)  # fmt: skip


@router.get("/sessions", responses=refusals(404, 422))
def get_sessions(
    map_name: str, here: Here, cursor: Cursor = None, limit: Limit = 100
) -> Page[Session]:
    """List the runs of a map by session and robot, with the number of frames and the times of each.

    Frames without a session and a robot form one run, which is listed first.
    """
    return list_sessions(here.context.store, map_name, cursor, limit)


# Session names are not part of the path, since they may contain slashes.
_SessionName = Annotated[Label, Query(description="Name of the session.")]
_Robot = Annotated[
    Label | None, Query(description="Only frames of this robot; default: all robots.")
]


@router.delete("/sessions", responses=refusals(404, 422), dependencies=[Depends(may_write)])
async def delete_session_frames(
    map_name: str, session: _SessionName, here: Here, robot: _Robot = None
) -> SessionChange:
    """Delete all frames of a session.

    A call ends after ten seconds; repeat it while `remaining` is not 0. POST
    /v1/maps/{map_name}/deletions/{deletion_id}/restore undoes the deletion, by default within ten
    minutes.
    """
    return await here.upload_gate.enter(
        partial(delete_session, here.context.store, map_name, session, here.tombstones, robot)
    )


@router.patch(
    "/sessions",
    responses=refusals(400, 404, 413, 415, 422),
    openapi_extra=json_body("SessionEdit"),
    dependencies=[Depends(may_write)],
)
async def patch_session(
    map_name: str,
    session: _SessionName,
    request: Request,
    here: Here,
    robot: _Robot = None,
    after: Annotated[
        str | None, Query(description="`last_frame_id` of the previous call, to continue after it.")
    ] = None,
) -> SessionChange:
    """Change the name, the robot or the tags of a session, in all its frames.

    A call ends after ten seconds; repeat it with `after` while `remaining` is not 0.
    """
    edit = await read_record(request, SessionEdit, "The edit of the session")
    return await here.upload_gate.enter(
        partial(edit_session, here.context.store, map_name, session, edit, robot, after)
    )


@router.get("/trajectory", response_class=Response, responses=_TRAJECTORY)
async def get_trajectory(
    map_name: str, request: Request, here: Here, run: Annotated[Run, Query()]
) -> Response:
    """Return the sensor poses of a run in chronological order, in metres.

    A response has at most 100,000 frames. For a longer run, request intervals of time, or limit the
    number of frames with `most`, which selects frames evenly spaced along the run.
    """
    kind = preferred_media_type(request, (_PLAIN, _JSON))

    def make() -> bytes:
        track = trajectory(here.context.store, map_name, run)
        return (track.model_dump_json() if kind == _JSON else trajectory_file(track)).encode()

    data = await here.gate.enter(make)
    return Response(data, 200, {"Vary": "Accept"}, kind)
