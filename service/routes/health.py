"""Whether the service lives, whether it can work, and its figures."""

from __future__ import annotations

from fastapi import APIRouter, Response
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import BaseModel

from sceneprint import __version__
from service.context import Here
from service.problems import declared

router = APIRouter(tags=["operations"])


class Health(BaseModel):
    """The service lives."""

    status: str
    version: str


class Readiness(Health):
    """The service can work; `read_only`: it answers, and takes nothing."""

    read_only: bool
    frames: dict[str, int]
    jobs: dict[str, int]


@router.get("/healthz", responses=declared())
async def healthz() -> Health:
    """Answers while the process lives, whatever else it does."""
    return Health(status="ok", version=__version__)


@router.get("/readyz", responses=declared())
def readyz(here: Here) -> Readiness:
    """Answers while the database does; 503 while it does not."""
    frames, jobs = here.engine.counts()
    read_only = here.engine.store.database.read_only
    return Readiness(
        status="ready", version=__version__, read_only=read_only, frames=frames, jobs=jobs
    )


@router.get("/metrics", response_class=Response, responses=declared())
def metrics(here: Here) -> Response:
    """Figures for Prometheus."""
    return Response(here.metrics.text(*here.engine.counts()), media_type=CONTENT_TYPE_LATEST)
