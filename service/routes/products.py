"""Routes for coverage, associations and differences of sessions."""

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
from service.auth import Cursor, Limit, may_read, may_write, v1_router
from service.bodies import json_body, read_record
from service.problems import refusals
from service.responses import file_responses, preferred_media_type, send_product_file
from service.running_service import Here, Service


def product_router(
    products_of: Callable[[Service], Products[Any, Any]], record: type[Product], about: str, *,
    optional: bool = False,
) -> APIRouter:  # fmt: skip
    """Return the routes that all products have: to begin, list, get and delete them.

    Parameters
    ----------
    products_of : function that returns the products of a service
    record : class of the product in the API
    about : description of the job, for the OpenAPI document
    optional : whether the body of a request is optional
    """
    noun, path, request_type = record.noun, record.collection, record.request_type
    router = v1_router(f"/maps/{{map_name}}/{path}", path, may_read)

    async def begin(map_name: str, request: Request, here: Here, response: Response) -> Any:
        body = await read_record(request, request_type, f"The {noun}", optional=optional)
        begun = await here.run(products_of(here).begin, map_name, body)
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
        responses=refusals(400, 404, 413, 415, 422), dependencies=writes,
        openapi_extra=json_body(request_type.__name__, required=not optional),
        description=f"{about} GET the path in `Location` until `state` is `succeeded`. Requires "
        "the scope `write`.",
    )  # fmt: skip
    add(
        "", list_all, methods=["GET"], name=f"list_{path}", responses=refusals(404, 422),
        response_model=Page[record],  # type: ignore[valid-type]
        description=f"List the {noun} jobs of a map, newest first.",
    )  # fmt: skip
    add(
        "/{job_id}", get, methods=["GET"], name=f"get_{noun}", responses=refusals(404),
        response_model=record,
        description=f"Return the state of the {noun} job, and its result once it has succeeded.",
    )  # fmt: skip
    add(
        "/{job_id}", delete, methods=["DELETE"], name=f"delete_{noun}", status_code=204,
        responses=refusals(404, 409), dependencies=writes,
        description=f"Delete the {noun} job and its results, even while a worker runs it. The "
        "response is 409 if the map depends on the job.",
    )  # fmt: skip
    return router


# Coverage.

coverage_router = product_router(
    lambda service: service.coverage, MapCoverage,
    "Measure where in the map localisation works. A job queries each frame, or every n-th, against "
    "the rest of the map. For each cell of a plan, it counts frames that are found, found in the "
    "wrong place, ambiguous or not found. The job runs when no other job is waiting for a worker, "
    "and takes as long as the same number of queries.",
    optional=True,
)  # fmt: skip


@coverage_router.get("/{job_id}/frames", responses=refusals(404, 422))
def list_coverage_frames(
    map_name: str,
    job_id: str,
    here: Here,
    cursor: Cursor = None,
    limit: Limit = 100,
    outcome: Annotated[
        CoverageOutcome | None, Query(description="Only frames with this outcome.")
    ] = None,
) -> Page[CoverageFrame]:
    """List the queried frames with their outcomes, even while the job runs.

    Frames that have been deleted since are omitted.
    """
    return here.coverage.frames(map_name, job_id, cursor, limit, outcome)


@coverage_router.get("/{job_id}/changes", responses=refusals(404, 409, 422))
def get_coverage_changes(
    map_name: str,
    job_id: str,
    here: Here,
    since: Annotated[
        str,
        Query(max_length=64, description="Id of an earlier job of the map with the same options."),
    ],
) -> CoverageChanges:
    """Return the cells that became better or worse since an earlier job. The response is 409 until
    both jobs have succeeded.
    """
    return here.coverage.changes(map_name, job_id, since)


# Differences of sessions.

differences_router = product_router(
    lambda service: service.differences, Difference,
    "Compare two sessions whose frames have poses in the same parent frame. A job fuses at most "
    "500 frames of each session into cells, and compares each cell with the frames of the other "
    "session. The job runs when no other job is waiting for a worker.",
)  # fmt: skip


@differences_router.get(
    "/{job_id}/points",
    response_class=Response,
    responses=file_responses(
        MEDIA_TYPE,
        description="Cells of both sessions in the format of `frames/{frame_id}/points`. The patch "
        "index is the class of the cell: 0 same, 1 gone, 2 new, 3 in `before` but unseen in "
        "`after`, 4 in `after` but unseen in `before`. Points are sorted by class.",
        statuses=(404, 409),
    ),
)
def get_difference_points(map_name: str, job_id: str, request: Request, here: Here) -> Response:
    """Return the cells of both sessions. The response is 409 until the job has succeeded."""
    find = partial(here.differences.file, map_name, job_id, POINTS)
    return send_product_file(request, here, find, f"{job_id[:12]}-points")


# Associations: joins of sessions and loop closures.

associations_router = product_router(
    lambda service: service.associations, Association,
    "Find the places that two sessions share, to join their maps, or the places that one session "
    "revisits, to close its loops. A job queries each frame of the first session against the "
    "second. Each match that passes validation is an edge. Edges of neighbouring frames must agree "
    "with the motion of the robots; the remaining edges vote for the transform between the parent "
    "frames of the sessions. Each frame takes one worker approximately 0.1 s.",
)  # fmt: skip

_Overlap = Annotated[float, Query(ge=0.0, le=1.0, description="Minimum overlap of an edge.")]


@associations_router.delete(
    "/{job_id}/join", responses=refusals(404, 409), dependencies=[Depends(may_write)]
)
def undo_join(map_name: str, job_id: str, here: Here) -> Association:
    """Undo the join of an association. Poses return to their uploaded values, or to the parent
    frame of the remaining joins. If there is no active join, nothing changes. Workers join the
    parent frames again only if you request an association.
    """
    return here.associations.undo_join(map_name, job_id)


@associations_router.get("/{job_id}/edges", responses=refusals(404, 422))
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
            description="`true`: only edges that a second edge or a join supports. `false`: only "
            "edges that were outvoted."
        ),
    ] = None,
) -> Page[Edge]:
    """List the edges in order of discovery, even while the job runs."""
    return here.associations.edges(
        map_name, job_id, cursor, limit, min_overlap, consistent=consistent
    )


@associations_router.get(
    "/{job_id}/graph",
    response_class=Response,
    responses=file_responses(
        MEDIA_TYPES["g2o"],
        MEDIA_TYPES["tum"],
        model=Graph,
        tagged=False,
        description="The graph in the requested format.",
        statuses=(404, 409, 422),
    ),
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
            "trajectory), or `json`; default: the type in Accept, otherwise g2o.",
        ),
    ] = None,
    min_overlap: _Overlap = 0.0,
    odometry: Annotated[
        bool,
        Query(description="Add an edge between consecutive frames, computed from their poses."),
    ] = False,
    consistent: Annotated[
        bool,
        Query(
            description="`true`: only edges that a second edge from another viewpoint or a join "
            "supports. `false`: also unsupported edges, such as all edges of frames without poses."
        ),
    ] = True,
) -> Response:
    """Return the pose graph of an association that has succeeded, for an optimiser.

    The vertices are all frames of the sessions, run by run in chronological order, numbered from 0.
    Their poses are in one coordinate frame if the sessions are joined. By default, edges that no
    other edge supports are omitted, because two frames of different places may look alike. With
    `format=json`, each vertex has the id of its frame.
    """
    kinds = {media: name for name, media in MEDIA_TYPES.items()}
    suffix: Any = kind or kinds[preferred_media_type(request, list(kinds))]
    text = await here.gate.enter(
        lambda: here.associations.graph(
            map_name, job_id, suffix, min_overlap, odometry=odometry, consistent=consistent
        )
    )
    name = f'attachment; filename="{job_id}.{suffix}"'
    return Response(text, media_type=MEDIA_TYPES[suffix], headers={"Content-Disposition": name})
