"""Products of maps: coverage, associations and differences of sessions share their routes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response

from sceneprint.engine.products.pose_graph import MEDIA_TYPES
from sceneprint.engine.products.product import Products
from sceneprint.engine.products.session_differences import POINTS
from sceneprint.formats.export import MEDIA_TYPE
from sceneprint_client.api import Page
from sceneprint_client.api.admin import Product
from sceneprint_client.api.coverage import (
    CoverageChanges,
    CoverageFrame,
    CoverageOutcome,
    MapCoverage,
)
from sceneprint_client.api.sessions import Association, Difference, Edge, Graph, GraphFormat
from service.auth import may_read, may_write, v1_router
from service.bodies import json_body, read_record
from service.problems import declared
from service.responses import file_responses, preferred_media_type, send_product_file
from service.running_service import Here, Service

Cursor = Annotated[str | None, Query(description="`next_cursor` of the page before.")]
Limit = Annotated[int, Query(ge=1, le=1000)]


def product_router(
    products_of: Callable[[Service], Products[Any, Any]], record: type[Product], about: str, *,
    optional: bool = False,
) -> APIRouter:  # fmt: skip
    """Return the routes that all products have: begin, list, get and delete.

    Parameters
    ----------
    products_of : returns the products of a service
    record : of the API
    about : what the job does, for the OpenAPI document
    optional : whether a request may come without a body
    """
    noun, path, request_type = record.noun, record.collection, record.request_type
    router = v1_router(f"/maps/{{map_name}}/{path}", path, may_read)

    async def begin(map_name: str, request: Request, here: Here, response: Response) -> Any:
        wanted = await read_record(request, request_type, f"The {noun}", optional=optional)
        begun = await here.run(products_of(here).begin, map_name, wanted)
        response.headers["Location"] = f"/v1/maps/{map_name}/{path}/{begun.job_id}"
        return begun

    def list_all(map_name: str, here: Here, cursor: Cursor = None, limit: Limit = 100) -> Any:
        return products_of(here).list_all(map_name, cursor, limit)

    def get(map_name: str, job_id: str, here: Here) -> Any:
        return products_of(here).get(map_name, job_id)

    def delete(map_name: str, job_id: str, here: Here) -> None:
        products_of(here).remove(map_name, job_id)

    add, writes = router.add_api_route, [Depends(may_write)]
    add(
        "", begin, methods=["POST"], name=f"begin_{noun}", status_code=202, response_model=record,
        responses=declared(400, 404, 413, 415, 422), dependencies=writes,
        openapi_extra=json_body(request_type.__name__, required=not optional),
        description=f"{about} GET the path in `Location` until `state` is `succeeded`. Needs the "
        "scope `write`.",
    )  # fmt: skip
    add(
        "", list_all, methods=["GET"], name=f"list_{path}", responses=declared(404, 422),
        response_model=Page[record],  # type: ignore[valid-type]
        description=f"The {noun} jobs of a map, newest first.",
    )  # fmt: skip
    add(
        "/{job_id}", get, methods=["GET"], name=f"get_{noun}", responses=declared(404),
        response_model=record,
        description=f"The state of the {noun} job, and its result once it has succeeded.",
    )  # fmt: skip
    add(
        "/{job_id}", delete, methods=["DELETE"], name=f"delete_{noun}", status_code=204,
        responses=declared(404, 409), dependencies=writes,
        description=f"Delete the {noun} job and its results, also while a worker runs it. 409: the "
        "map depends on it.",
    )  # fmt: skip
    return router


# Coverage.

coverage_router = product_router(
    lambda service: service.coverage, MapCoverage,
    "Measure where in the map a robot would be found. A job queries each frame, or every n-th, "
    "against the rest of the map, and counts by cell of a plan how many are found, found in a "
    "wrong place, ambiguous and not found. It runs when nothing else waits for a worker, and takes "
    "about as long as so many queries.",
    optional=True,
)  # fmt: skip


@coverage_router.get("/{job_id}/frames", responses=declared(404, 422))
def list_coverage_frames(
    map_name: str,
    job_id: str,
    here: Here,
    cursor: Cursor = None,
    limit: Limit = 100,
    outcome: Annotated[
        CoverageOutcome | None, Query(description="Only frames of this outcome.")
    ] = None,
) -> Page[CoverageFrame]:
    """Queried frames with what became of each, also while more are queried.

    Frames that were deleted since are left out.
    """
    return here.coverage.frames(map_name, job_id, cursor, limit, outcome)


@coverage_router.get("/{job_id}/changes", responses=declared(404, 409, 422))
def get_coverage_changes(
    map_name: str,
    job_id: str,
    here: Here,
    since: Annotated[
        str,
        Query(max_length=64, description="Id of an earlier result of the map, with equal options."),
    ],
) -> CoverageChanges:
    """Which cells became better or worse since an earlier result; 409 until both succeeded."""
    return here.coverage.changes(map_name, job_id, since)


# Differences of sessions.

differences_router = product_router(
    lambda service: service.differences, Difference,
    "Compare two sessions whose frames have poses in one parent frame. A job fuses at most 500 "
    "frames of each session to cells, and asks the frames of the other session about each cell. It "
    "runs when nothing else waits for a worker.",
)  # fmt: skip


@differences_router.get(
    "/{job_id}/points",
    response_class=Response,
    responses=file_responses(
        MEDIA_TYPE,
        description="Cells of both sessions in the format of `frames/{frame_id}/points`. The patch "
        "index says what each is: 0 same, 1 gone, 2 new, 3 only in `before` and unseen in `after`, "
        "4 the reverse. Points are in this order.",
        statuses=(404, 409),
    ),
)
def get_difference_points(map_name: str, job_id: str, request: Request, here: Here) -> Response:
    """The cells of both sessions; 409 until the job has succeeded."""
    find = partial(here.differences.file, map_name, job_id, POINTS)
    return send_product_file(request, here, find, f"{job_id[:12]}-points")


# Associations: sessions joined, loops closed.

associations_router = product_router(
    lambda service: service.associations, Association,
    "Find where sessions see the same places: two of them, which joins their maps, or one, which "
    "closes its loops. Every frame of the first session is looked up among those of the second; "
    "what validation accepts is an edge. Edges near each other must agree with how the robots "
    "moved between their frames, and those that are left vote on how the sessions' parent frames "
    "lie to each other. The job takes some 0.1 s a frame and worker.",
)  # fmt: skip

_TEXT_SCHEMA = {"schema": {"type": "string"}}
_GRAPH: dict[int | str, dict[str, Any]] = {
    200: {
        "model": Graph,
        "description": "The graph as one of its files.",
        "content": {MEDIA_TYPES["g2o"]: _TEXT_SCHEMA, MEDIA_TYPES["tum"]: _TEXT_SCHEMA},
    }
}
_Overlap = Annotated[float, Query(ge=0.0, le=1.0, description="Least overlap of an edge.")]


@associations_router.delete(
    "/{job_id}/join", responses=declared(404, 409), dependencies=[Depends(may_write)]
)
def undo_join(map_name: str, job_id: str, here: Here) -> Association:
    """Undo the join of an association: poses are again as they were sent, or in the parent frame
    that other joins lead to. Without a join that stands nothing changes. The parent frames are not
    joined again unless somebody asks for an association.
    """
    return here.associations.undo_join(map_name, job_id)


@associations_router.get("/{job_id}/edges", responses=declared(404, 422))
def list_edges(
    map_name: str,
    job_id: str,
    here: Here,
    cursor: Cursor = None,
    limit: Limit = 100,
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
    return here.associations.edges(
        map_name, job_id, cursor, limit, min_overlap, consistent=consistent
    )


@associations_router.get(
    "/{job_id}/graph", response_class=Response, responses={**_GRAPH, **declared(404, 409, 422)}
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
    text = await here.gate.enter(
        lambda: here.associations.graph(
            map_name, job_id, wanted, min_overlap, odometry=odometry, consistent=consistent
        )
    )
    name = f'attachment; filename="{job_id}.{wanted}"'
    return Response(text, media_type=MEDIA_TYPES[wanted], headers={"Content-Disposition": name})
