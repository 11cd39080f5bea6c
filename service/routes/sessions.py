"""What was taken in one run, and when: sessions of a map, a trajectory, and how the map grew."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from fastapi import Depends, Query, Request, Response

from sceneprint.engine.maps.map_frames import list_sessions, trajectory, trajectory_file
from sceneprint.engine.maps.selections import delete_session, edit_session
from sceneprint.engine.sessions.associations import MEDIA_TYPES
from sceneprint_client.api import Page
from sceneprint_client.api.base import Label
from sceneprint_client.api.listing import Run, Session, SessionChange, SessionEdit, Trajectory
from sceneprint_client.api.sessions import Association, Edge, Graph, GraphFormat, NewAssociation
from service.auth import Here, may_read, may_write, v1_router
from service.bodies import json_body, read_record
from service.problems import declared
from service.responses import preferred_media_type

router = v1_router("/maps/{map_name}", "sessions", may_read)

_PLAIN, _JSON = "text/plain", "application/json"
_TRAJECTORY: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "By Accept: TUM lines `t tx ty tz qx qy qz qw`, their frames in comments; "
        "or JSON with the ids of the frames.",
        "model": Trajectory,
        "content": {_PLAIN: {"schema": {"type": "string"}}},
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


# Names of sessions may hold anything, such as slashes, and so are no parts of a path.
_SessionName = Annotated[Label, Query(description="Name of the session.")]
_Robot = Annotated[Label | None, Query(description="Only frames of this robot; default: of all.")]


@router.delete("/sessions", responses=declared(404, 422), dependencies=[Depends(may_write)])
async def delete_session_frames(
    map_name: str, session: _SessionName, here: Here, robot: _Robot = None
) -> SessionChange:
    """Delete all frames of a session.

    A call ends after ten seconds: repeat it while `remaining` is not 0. Ten minutes by default,
    POST /v1/maps/{map_name}/deletions/{deletion_id}/restore undoes it.
    """
    async with here.uploads.place():
        return await here.uploads.run(
            partial(
                delete_session,
                here.engine.store,
                map_name,
                session,
                here.engine.tombstones,
                robot,
            )
        )


@router.patch(
    "/sessions",
    responses=declared(400, 404, 413, 415, 422),
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
        str | None, Query(description="`last_frame_id` of the call before, to go on from there.")
    ] = None,
) -> SessionChange:
    """Rename a session or its robot, and add or remove tags, on all its frames.

    A call ends after ten seconds: repeat it with `after` while `remaining` is not 0.
    """
    edit = await read_record(request, SessionEdit, "The edit of the session")
    async with here.uploads.place():
        return await here.uploads.run(
            partial(edit_session, here.engine.store, map_name, session, edit, robot, after)
        )


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
    kind = preferred_media_type(request, (_PLAIN, _JSON))

    def make() -> bytes:
        found = trajectory(here.engine.store, map_name, run)
        return (found.model_dump_json() if kind == _JSON else trajectory_file(found)).encode()

    async with here.gate.place():
        data = await here.gate.run(make)
    return Response(data, 200, {"Vary": "Accept"}, kind)


# Associations: sessions joined, loops closed.

associations_router = v1_router("/maps/{map_name}/associations", "associations", may_read)

_TEXT_SCHEMA = {"schema": {"type": "string"}}
_GRAPH: dict[int | str, dict[str, Any]] = {
    200: {
        "model": Graph,
        "description": "The graph as one of its files.",
        "content": {MEDIA_TYPES["g2o"]: _TEXT_SCHEMA, MEDIA_TYPES["tum"]: _TEXT_SCHEMA},
    }
}
_Overlap = Annotated[float, Query(ge=0.0, le=1.0, description="Least overlap of an edge.")]


@associations_router.post(
    "",
    status_code=202,
    responses=declared(400, 404, 413, 415, 422),
    openapi_extra=json_body("NewAssociation"),
    dependencies=[Depends(may_write)],
)
async def begin_association(
    map_name: str, request: Request, here: Here, response: Response
) -> Association:
    """Find where sessions see the same places: two of them, which joins their maps, or one, which
    closes its loops. A job does it: some 0.1 s a frame and worker.

    Every frame of the first session is looked up among those of the second; what validation
    accepts is an edge. Edges near each other must agree with how the robots moved between their
    frames, and those that are left vote on how the sessions' parent frames lie to each other.
    """
    asked = await read_record(request, NewAssociation, "The association")
    begun = await here.run(here.engine.associations.begin, map_name, asked)
    response.headers["Location"] = f"/v1/maps/{map_name}/associations/{begun.association_id}"
    return begun


@associations_router.get("", responses=declared(404, 422))
def list_associations(
    map_name: str,
    here: Here,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> Page[Association]:
    """Associations of a map, the newest first."""
    return here.engine.associations.list_all(map_name, cursor, limit)


@associations_router.get("/{job_id}", responses=declared(404))
def get_association(map_name: str, job_id: str, here: Here) -> Association:
    """How far an association has come, and what it came to: whether the sessions are joined, by
    which transform, and how many edges agree on it.
    """
    return here.engine.associations.get(map_name, job_id)


@associations_router.delete(
    "/{job_id}", status_code=204, responses=declared(404, 409), dependencies=[Depends(may_write)]
)
def delete_association(map_name: str, job_id: str, here: Here) -> None:
    """Forget an association with its edges; one that is not over is given up. One whose join moved
    poses has to stay until that is undone.
    """
    here.engine.associations.remove(map_name, job_id)


@associations_router.delete(
    "/{job_id}/join", responses=declared(404, 409), dependencies=[Depends(may_write)]
)
def undo_join(map_name: str, job_id: str, here: Here) -> Association:
    """Undo the join of an association: poses are again as they were sent, or in the parent frame
    that other joins lead to. Without a join that stands nothing changes. The parent frames are not
    joined again unless somebody asks for an association.
    """
    return here.engine.associations.undo_join(map_name, job_id)


@associations_router.get("/{job_id}/edges", responses=declared(404, 422))
def list_edges(
    map_name: str,
    job_id: str,
    here: Here,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    min_overlap: _Overlap = 0.0,
    consistent: Annotated[
        bool | None,
        Query(
            description="`true`: those that a second edge or a join supports. `false`: those that "
            "were outvoted."
        ),
    ] = None,
) -> Page[Edge]:
    """Edges in the order in which they were found, also while more are."""
    return here.engine.associations.edges(
        map_name, job_id, cursor, limit, min_overlap, consistent=consistent
    )


@associations_router.get(
    "/{job_id}/graph",
    response_class=Response,
    responses={**_GRAPH, **declared(404, 409, 422)},
)
async def get_graph(
    map_name: str,
    job_id: str,
    request: Request,
    here: Here,
    kind: Annotated[
        GraphFormat | None,
        Query(
            alias="format",
            description="`g2o` (VERTEX_SE3:QUAT, EDGE_SE3:QUAT), `tum` (the vertices as a "
            "trajectory), or `json`; default: by Accept, else g2o.",
        ),
    ] = None,
    min_overlap: _Overlap = 0.0,
    odometry: Annotated[
        bool,
        Query(description="With an edge between each two consecutive frames, from their poses."),
    ] = False,
    consistent: Annotated[
        bool,
        Query(
            description="Only edges that a second edge of another viewpoint or a join supports. "
            "`false`: also those that nothing checks, such as all edges of frames without poses."
        ),
    ] = True,
) -> Response:
    """The pose graph of an association that has succeeded, for an optimiser.

    Vertices are all frames of the sessions, run after run in the order of time, numbered from 0;
    their poses are in one frame where the sessions are joined. One pair of frames that look alike
    is no evidence of one place, so edges that no other supports are left out. `format=json` tells
    which vertex is which frame.
    """
    kinds = {media: name for name, media in MEDIA_TYPES.items()}
    wanted: Any = kind or kinds[preferred_media_type(request, list(kinds))]
    async with here.gate.place():
        text = await here.gate.run(
            lambda: here.engine.associations.graph(
                map_name, job_id, wanted, min_overlap, odometry=odometry, consistent=consistent
            )
        )
    name = f'attachment; filename="{job_id}.{wanted}"'
    return Response(text, media_type=MEDIA_TYPES[wanted], headers={"Content-Disposition": name})
