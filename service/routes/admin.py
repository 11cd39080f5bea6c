"""Whether the service lives, whether it can work, and its figures."""

from __future__ import annotations

from datetime import UTC, datetime
from functools import partial
from typing import Annotated
from urllib.parse import quote

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import BaseModel, Field

from sceneprint import __version__
from sceneprint.engine.admin import operations
from sceneprint.engine.context import Context
from sceneprint.engine.maps import map_lifecycle
from sceneprint.store.audit_log import AuditFilter
from sceneprint.store.events import newest_number
from sceneprint_client.api import Map, Page
from sceneprint_client.api.admin import (
    AuditLine,
    Key,
    MadeKey,
    Me,
    ModelInfo,
    NewKey,
    NewModel,
    Stats,
)
from service.auth import Asking, Guest, administers, may_admin, reads_every, v1_router
from service.bodies import json_body, read_record
from service.problems import declared
from service.running_service import Here

router = APIRouter(tags=["operations"])

#: Seconds that `/readyz` waits to learn whether kernels have to be compiled.
LOOK_S = 1.0


class Health(BaseModel):
    """The service is running."""

    status: str
    version: str


class Readiness(Health):
    """The service is ready; `read_only`: it answers queries, and accepts no changes."""

    read_only: bool
    frames: dict[str, int] | None = Field(
        description="Number of frames in each state; null if you may not read all maps."
    )
    jobs: dict[str, int] | None = Field(
        description="Number of jobs in each state; null like `frames`."
    )


@router.head("/healthz", include_in_schema=False)  # as balancers ask
@router.get("/healthz", responses=declared())
async def healthz() -> Health:
    """Answers while the process lives, whatever else it does."""
    return Health(status="ok", version=__version__)


@router.head("/readyz", include_in_schema=False)
@router.get(
    "/readyz", responses=declared(), response_model_exclude_defaults=True,
    openapi_extra={"security": [{}]},  # besides a key: none
)  # fmt: skip
async def readyz(here: Here, asking: Guest) -> Readiness:
    """Answers while the database and the object store do; 503 while one does not, while kernels are
    being compiled, and for good once a later version has migrated the store. Requires no key. The
    answer is at most a second old.
    """
    found = await here.looks.get("readiness", partial(_look, here.context))
    # who shows no key has nothing counted: that takes the longer the more there is
    if asking is None or not asking.reads_every:
        return found
    frames, jobs = await here.looks.get("counts", here.statistics.state_counts)
    return found.model_copy(update={"frames": frames, "jobs": jobs})


def _look(context: Context) -> Readiness:
    """Check that the service can work; raises what it cannot do without."""
    context.signers.require_kernels(LOOK_S)
    context.store.blobs.check()
    context.store.database.require_schema()
    with context.store.database.read() as connection:
        newest_number(connection)
    return Readiness(
        status="ready",
        version=__version__,
        read_only=context.store.read_only,
        frames=None,
        jobs=None,
    )


@router.get(
    "/metrics", response_class=Response, responses=declared(), dependencies=[Depends(reads_every)]
)
def metrics(here: Here) -> Response:
    """Figures for Prometheus; a key, where one is asked for, must have `read` for `*`."""
    figures = here.statistics.figures()
    held, spool = here.requests.by_tenant(), here.spool.by_tenant()
    text = here.metrics.text(figures, here.feed.streams, here.context.query_log.lost, held, spool)
    return Response(text, media_type=CONTENT_TYPE_LATEST)


# Keys, and who changed what.

keys_router = v1_router(tag="keys")

Cursor = Annotated[str | None, Query(description="`next_cursor` of the page before.")]
Limit = Annotated[int, Query(ge=1, le=1000)]


@keys_router.post(
    "/keys",
    status_code=201,
    responses=declared(400, 404, 409, 413, 415, 422),
    openapi_extra=json_body("NewKey"),
    dependencies=[Depends(administers)],
)
async def create_key(request: Request, here: Here, response: Response) -> MadeKey:
    """Make a key. Its secret is in this answer and nowhere else; a lost one is revoked."""
    new = await read_record(request, NewKey, "The key")
    make = partial(
        operations.create_key, here.context.store, new.name, new.grants, new.expires_at, new.tenant
    )
    made = await here.run(make)
    response.headers["Location"] = f"/v1/keys/{quote(made.name, safe='')}"
    return made


@keys_router.get("/keys", responses=declared(422), dependencies=[Depends(administers)])
def list_keys(here: Here, cursor: Cursor = None, limit: Limit = 100) -> Page[Key]:
    """Keys by name, without their secrets."""
    return operations.list_keys(here.context.store, cursor, limit)


@keys_router.get("/keys/me", responses=declared())
def me(asking: Asking) -> Me:
    """What the key may do that is shown."""
    until = asking.expires_at
    return Me(
        name=asking.name or None,
        grants=dict(asking.grants),
        expires_at=None if until is None else datetime.fromtimestamp(until, UTC),
    )


@keys_router.post(
    "/keys/{key_name:path}/rotate",
    responses=declared(404, 422),
    dependencies=[Depends(administers)],
)
def rotate_key(
    key_name: Annotated[str, Path(description="Of the key.")],
    here: Here,
    overlap_s: Annotated[
        float,
        Query(
            ge=0,
            le=operations.MOST_OVERLAP_S,
            description="Seconds for which the secret before still works; 0: it ends now.",
        ),
    ] = operations.OVERLAP_S,
) -> MadeKey:
    """Give a key a new secret, which is in this answer and nowhere else.

    Rotated again within the overlap, the secret in use keeps its end, and the new one is replaced.
    """
    return operations.rotate_key(here.context.store, key_name, overlap_s)


@keys_router.delete(
    "/keys/{key_name:path}",
    status_code=204,
    responses=declared(404),
    dependencies=[Depends(administers)],
)
def revoke_key(key_name: Annotated[str, Path(description="Of the key.")], here: Here) -> None:
    """Let a key open nothing any more, from the next request on, on every machine of the store."""
    operations.revoke_key(here.context.store, key_name)


@keys_router.get("/audit", responses=declared(422), dependencies=[Depends(administers)])
def list_changes(
    here: Here,
    actor: Annotated[
        str | None, Query(max_length=128, description="Name of the key that made them.")
    ] = None,
    map_name: Annotated[
        str | None, Query(alias="map", max_length=63, description="That was changed.")
    ] = None,
    action: Annotated[
        str | None,
        Query(max_length=32, description="Beginning of the action, such as `key.` or `refused`."),
    ] = None,
    cursor: Cursor = None,
    limit: Limit = 100,
) -> Page[AuditLine]:
    """List who changed what, and which requests were refused (401, 403), the newest first.

    Lines are kept for `SCENEPRINT_AUDIT_LOG_DAYS`, and at most a million of each tenant.
    """
    return here.audit.page(AuditFilter(actor, map_name, action), cursor, limit)


# How the service does, what maps can be signed with, and changing that.

operations_router = v1_router(tag="operations")


@operations_router.get("/stats", responses=declared(404, 422))
def stats(
    here: Here,
    asking: Asking,
    map_name: Annotated[
        str | None,
        Query(alias="map", description="Of this map alone, for who may read that but not all."),
    ] = None,
    minutes: Annotated[int, Query(ge=1, le=60, description="Of history.")] = 60,
) -> Stats:
    """How the service does now, and did in the last hour, whichever of its processes did it."""
    if map_name is None:
        asking.require_every("read")
    else:
        asking.require(map_name, "read")
    return here.statistics.tell(minutes, map_name)


@operations_router.get("/models", responses=declared())
def models(here: Here, asking: Asking) -> Page[ModelInfo]:
    """Models that a map can be signed with: those that ship, and those that maps have or had."""
    found = here.catalogue.tell(lambda name: asking.may("read", name))
    if not asking.reads_every:  # one that only other maps have tells of them
        found = [one for one in found if one.preset or one.maps]
    return Page[ModelInfo](items=found)


@operations_router.post(
    "/maps/{map_name}/reencoding",
    status_code=202,
    responses=declared(400, 404, 409, 413, 415, 422),
    openapi_extra=json_body("NewModel"),
    dependencies=[Depends(may_admin)],
)
async def reencode(map_name: str, request: Request, here: Here, asking: Asking) -> Map:
    """Have every frame of a map signed with another model; the map switches when all are.

    Queries go on with the model that the map has until then. `reencoding` of the map tells how
    far it is. Asked again, it tries again what broke down.
    """
    wanted = await read_record(request, NewModel, "The model")
    may_read = None if asking.reads_every else partial(asking.may, "read")
    find = here.catalogue.find
    return await here.run(
        lambda: map_lifecycle.begin_reencoding(
            here.context.store, here.context.bell, map_name, find(wanted.model, may_read)
        )
    )


@operations_router.delete(
    "/maps/{map_name}/reencoding", responses=declared(404, 409), dependencies=[Depends(may_admin)]
)
def cancel_reencoding(map_name: str, here: Here) -> Map:
    """Let a map keep the model that it has; what was made for the other is removed."""
    return map_lifecycle.cancel_reencoding(here.context.store, map_name)
