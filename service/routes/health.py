"""Whether the service lives, whether it can work, and its figures."""

from __future__ import annotations

from fastapi import APIRouter, Depends, Response
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import BaseModel, Field

from sceneprint import __version__
from sceneprint.schemas.operations import ReplicaSeen
from sceneprint.store.events import newest_number
from service.access import Guest, reads_every
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
    frames: dict[str, int] | None = Field(
        description="How many are in each state; null for who may not read all maps."
    )
    jobs: dict[str, int] | None = Field(description="As `frames`.")
    replica: str | None = Field(
        default=None, description="What queries are answered from, where there is a read replica."
    )


@router.head("/healthz", include_in_schema=False)  # as balancers ask
@router.get("/healthz", responses=declared())
async def healthz() -> Health:
    """Answers while the process lives, whatever else it does."""
    return Health(status="ok", version=__version__)


@router.head("/readyz", include_in_schema=False)
@router.get("/readyz", responses=declared(), response_model_exclude_defaults=True)
def readyz(here: Here, asking: Guest) -> Readiness:
    """Answers while the database and the object store do; 503 while one does not. No key is asked
    for.
    """
    frames = jobs = None
    here.engine.store.blobs.check()
    if asking is not None and asking.reads_every:
        frames, jobs = here.engine.counts()
    else:  # whoever shows no key has nothing counted: that takes the longer the more there is
        with here.engine.store.database.read() as connection:
            newest_number(connection)
    return Readiness(
        status="ready",
        version=__version__,
        read_only=here.engine.store.database.read_only,
        frames=frames,
        jobs=jobs,
        replica=_replica(here.engine.operations.statistics.replica()),
    )


def _replica(seen: ReplicaSeen | None) -> str | None:
    if seen is None:
        return None
    if not seen.used:
        return "the replica is not used: queries are answered from the database itself"
    return f"queries are answered from a replica, which is at most {seen.behind_s:.1f} s behind"


@router.get(
    "/metrics",
    response_class=Response,
    responses=declared(),
    dependencies=[Depends(reads_every)],
)
def metrics(here: Here) -> Response:
    """Figures for Prometheus; a key, where one is asked for, must have `read` for `*`."""
    figures = here.engine.operations.statistics.figures()
    return Response(here.metrics.text(figures, here.feed.streams), media_type=CONTENT_TYPE_LATEST)
