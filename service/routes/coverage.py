"""Coverage of a map: where robots would be found, measured by a job, as numbers and as a plan."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Query, Request, Response

from sceneprint_client.api import Page
from sceneprint_client.api.coverage import (
    CoverageChanges,
    CoverageFrame,
    CoverageOutcome,
    MapCoverage,
    NewMapCoverage,
)
from service.auth import Here, may_read, may_write, v1_router
from service.bodies import json_body, read_record
from service.problems import declared

router = v1_router("/maps/{map_name}/coverage", "coverage", may_read)


@router.post(
    "",
    status_code=202,
    responses=declared(400, 404, 413, 415, 422),
    openapi_extra=json_body("NewMapCoverage", required=False),
    dependencies=[Depends(may_write)],
)
async def begin_coverage(
    map_name: str, request: Request, here: Here, response: Response
) -> MapCoverage:
    """Measure where in the map a robot would be found.

    A job queries each frame, or every n-th, against the rest of the map, and counts by cell of a
    plan how many are found, found in a wrong place, ambiguous and not found. It runs when nothing
    else waits for a worker, and takes about as long as so many queries. Ask under `Location` until
    `state` is `succeeded`. It takes the scope `write`.
    """
    asked = await read_record(request, NewMapCoverage, "The coverage", optional=True)
    begun = await here.run(here.engine.coverage.begin, map_name, asked)
    response.headers["Location"] = f"/v1/maps/{map_name}/coverage/{begun.coverage_id}"
    return begun


@router.get("", responses=declared(404, 422))
def list_coverage(
    map_name: str,
    here: Here,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> Page[MapCoverage]:
    """Coverage jobs of a map, without their plans, the newest first."""
    return here.engine.coverage.list_all(map_name, cursor, limit)


@router.get("/{job_id}", responses=declared(404))
def get_coverage(map_name: str, job_id: str, here: Here) -> MapCoverage:
    """How far a coverage job has come; when it has succeeded, its counts and plans."""
    return here.engine.coverage.get(map_name, job_id)


@router.delete(
    "/{job_id}", status_code=204, responses=declared(404), dependencies=[Depends(may_write)]
)
def delete_coverage(map_name: str, job_id: str, here: Here) -> None:
    """Delete a coverage job with its result; one that is not over is given up."""
    here.engine.coverage.remove(map_name, job_id)


@router.get("/{job_id}/frames", responses=declared(404, 422))
def list_coverage_frames(
    map_name: str,
    job_id: str,
    here: Here,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    outcome: Annotated[
        CoverageOutcome | None, Query(description="Only frames of this outcome.")
    ] = None,
) -> Page[CoverageFrame]:
    """Queried frames with what became of each, also while more are queried.

    Frames that were deleted since are left out.
    """
    return here.engine.coverage.frames(map_name, job_id, cursor, limit, outcome)


@router.get("/{job_id}/changes", responses=declared(404, 409, 422))
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
    return here.engine.coverage.changes(map_name, job_id, since)
