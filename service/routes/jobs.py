"""Jobs."""

from __future__ import annotations

from fastapi import APIRouter

from sceneprint.schemas import Job
from service.context import Here
from service.problems import declared

router = APIRouter(prefix="/jobs", tags=["jobs"])


@router.get("/{job_id}", responses=declared(404))
def get_job(job_id: str, here: Here) -> Job:
    """What has become of a job."""
    return here.engine.get_job(job_id)
