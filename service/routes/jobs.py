"""Jobs."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response

from sceneprint.schemas import Job, JobState, Page
from service.context import Here
from service.problems import declared

router = APIRouter(prefix="/jobs", tags=["jobs"])


@router.get("", responses=declared(422))
def list_jobs(
    here: Here,
    state: JobState | None = None,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> Page[Job]:
    """Jobs of all maps, the newest first; `state=dead` lists what broke down again and again."""
    return here.engine.list_jobs(state, cursor, limit)


@router.get("/{job_id}", responses=declared(404))
def get_job(job_id: str, here: Here) -> Job:
    """What has become of a job."""
    return here.engine.get_job(job_id)


@router.post("/{job_id}/cancel", responses=declared(404, 409))
def cancel_job(job_id: str, here: Here) -> Job:
    """Give up a job that is not over; its frame is `failed` then. Asked twice, it stays so."""
    return here.engine.cancel_job(job_id)


@router.post(
    "/{job_id}/retry",
    status_code=202,
    responses={
        200: {"model": Job, "description": "Its frame is being tried again already, by this job."},
        **declared(404, 409),
    },
)
def retry_job(job_id: str, here: Here, response: Response) -> Job:
    """Try again what was given up (dead, cancelled or failed), in a new job."""
    job, is_new = here.engine.retry_job(job_id)
    response.headers["Location"] = f"/v1/jobs/{job.job_id}"
    response.status_code = 202 if is_new else 200
    return job
