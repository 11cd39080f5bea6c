"""Jobs."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response

from sceneprint.schemas import Job, JobState, Page
from service.access import Asking
from service.context import Here
from service.problems import declared

router = APIRouter(prefix="/jobs", tags=["jobs"])


@router.get("", responses=declared(404, 422))
def list_jobs(
    here: Here,
    asking: Asking,
    state: JobState | None = None,
    kind: Annotated[str | None, Query(max_length=16, description="Such as `associate`.")] = None,
    map_name: Annotated[str | None, Query(alias="map", description="Of this map alone.")] = None,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> Page[Job]:
    """Jobs of all maps, the newest first; `state=dead` lists what broke down again and again.

    With a key, those of the maps that it may read.
    """
    names = asking.named
    if map_name is not None:
        asking.require(map_name, "read")
        here.engine.get_map(map_name)
        names = (map_name,)
    elif names is None and not asking.may("admin"):
        names = tuple(one.name for one in here.engine.list_maps().items)
    return here.engine.list_jobs(state, cursor, limit, kind, names)


@router.get("/{job_id}", responses=declared(404))
def get_job(job_id: str, here: Here, asking: Asking) -> Job:
    """What has become of a job."""
    return asking.require_job(here.engine.get_job(job_id))


@router.post("/{job_id}/cancel", responses=declared(404, 409))
def cancel_job(job_id: str, here: Here, asking: Asking) -> Job:
    """Give up a job that is not over; its frame is `failed` then. Asked twice, it stays so."""
    asking.require_job(here.engine.get_job(job_id), "write")
    return here.engine.cancel_job(job_id)


@router.post(
    "/{job_id}/retry",
    status_code=202,
    responses={
        200: {"model": Job, "description": "Its frame is being tried again already, by this job."},
        **declared(404, 409),
    },
)
def retry_job(job_id: str, here: Here, asking: Asking, response: Response) -> Job:
    """Try again what was given up (dead, cancelled or failed): a frame in a new job, a long job
    as itself, from where it stood.
    """
    asking.require_job(here.engine.get_job(job_id), "write")
    job, is_new = here.engine.retry_job(job_id)
    response.headers["Location"] = f"/v1/jobs/{job.job_id}"
    response.status_code = 202 if is_new else 200
    return job
