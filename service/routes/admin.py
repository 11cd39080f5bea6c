"""Routes of the operator: health, metrics, keys, the audit log, statistics and models."""

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
from service.auth import (
    Cursor,
    Guest,
    Limit,
    OnlyMap,
    Sender,
    administers,
    may_admin,
    reads_every,
    v1_router,
)
from service.bodies import json_body, read_record
from service.problems import refusals
from service.running_service import Here

router = APIRouter(tags=["operations"])

#: Maximum seconds that `/readyz` waits for compiled kernels.
KERNEL_CHECK_S = 1.0


class Health(BaseModel):
    """State of a running service."""

    status: str
    version: str


class Readiness(Health):
    """State of a service that is ready. If `read_only` is true, the service answers queries but
    refuses changes.
    """

    read_only: bool
    frames: dict[str, int] | None = Field(
        description="Number of frames in each state; null if your key cannot read all maps."
    )
    jobs: dict[str, int] | None = Field(
        description="Number of jobs in each state; null if your key cannot read all maps."
    )


@router.head("/healthz", include_in_schema=False)  # load balancers send HEAD
@router.get("/healthz", responses=refusals())
async def healthz() -> Health:
    """Return 200 while the process is running, even if the store is unavailable."""
    return Health(status="ok", version=__version__)


@router.head("/readyz", include_in_schema=False)
@router.get(
    "/readyz", responses=refusals(), response_model_exclude_defaults=True,
    openapi_extra={"security": [{}]},  # the key is optional
)  # fmt: skip
async def readyz(here: Here, caller: Guest) -> Readiness:
    """Return 200 if the service is ready. Return 503 while the database or the object store does
    not respond, while kernels are being compiled, and permanently after a later version has
    migrated the store. No key is required. The result is at most one second old.
    """
    state = await here.checks.get("readiness", partial(_check_readiness, here.context))
    # Requests without a key get no counts, whose computation takes time.
    if caller is None or not caller.reads_every:
        return state
    frames, jobs = await here.checks.get("counts", here.statistics.state_counts)
    return state.model_copy(update={"frames": frames, "jobs": jobs})


def _check_readiness(context: Context) -> Readiness:
    context.signers.require_kernels(KERNEL_CHECK_S)
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
    "/metrics", response_class=Response, responses=refusals(), dependencies=[Depends(reads_every)]
)
def metrics(here: Here) -> Response:
    """Return Prometheus metrics. If keys are required, the key needs `read` for `*`."""
    figures = here.statistics.figures()
    held, spool = here.requests.by_tenant(), here.spool.by_tenant()
    text = here.metrics.text(figures, here.feed.streams, here.context.query_log.lost, held, spool)
    return Response(text, media_type=CONTENT_TYPE_LATEST)


# Keys and the audit log.

keys_router = v1_router(tag="keys")


@keys_router.post(
    "/keys",
    status_code=201,
    responses=refusals(400, 404, 409, 413, 415, 422),
    openapi_extra=json_body("NewKey"),
    dependencies=[Depends(administers)],
)
async def create_key(request: Request, here: Here, response: Response) -> MadeKey:
    """Create a key. Only this response contains its secret; revoke a key whose secret is lost."""
    new = await read_record(request, NewKey, "The key")
    make = partial(
        operations.create_key, here.context.store, new.name, new.grants, new.expires_at, new.tenant
    )
    key = await here.run(make)
    response.headers["Location"] = f"/v1/keys/{quote(key.name, safe='')}"
    return key


@keys_router.get("/keys", responses=refusals(422), dependencies=[Depends(administers)])
def list_keys(here: Here, cursor: Cursor = None, limit: Limit = 100) -> Page[Key]:
    """List keys, sorted by name, without their secrets."""
    return operations.list_keys(here.context.store, cursor, limit)


@keys_router.get("/keys/me", responses=refusals())
def me(caller: Sender) -> Me:
    """Return the name, the grants and the expiry time of the key of this request."""
    until = caller.expires_at
    return Me(
        name=caller.name or None,
        grants=dict(caller.grants),
        expires_at=None if until is None else datetime.fromtimestamp(until, UTC),
    )


@keys_router.post(
    "/keys/{key_name:path}/rotate",
    responses=refusals(404, 422),
    dependencies=[Depends(administers)],
)
def rotate_key(
    key_name: Annotated[str, Path(description="Name of the key.")],
    here: Here,
    overlap_s: Annotated[
        float,
        Query(
            ge=0,
            le=operations.MOST_OVERLAP_S,
            description="Number of seconds for which the previous secret remains valid; 0 revokes "
            "it immediately.",
        ),
    ] = operations.OVERLAP_S,
) -> MadeKey:
    """Give a key a new secret. Only this response contains the secret.

    A second rotation within the overlap replaces the new secret; the previous secret still expires
    at the time that the first rotation set.
    """
    return operations.rotate_key(here.context.store, key_name, overlap_s)


@keys_router.delete(
    "/keys/{key_name:path}",
    status_code=204,
    responses=refusals(404),
    dependencies=[Depends(administers)],
)
def revoke_key(key_name: Annotated[str, Path(description="Name of the key.")], here: Here) -> None:
    """Revoke a key. Every machine that uses the store refuses the key from the next request on."""
    operations.revoke_key(here.context.store, key_name)


@keys_router.get("/audit", responses=refusals(422), dependencies=[Depends(administers)])
def list_changes(
    here: Here,
    actor: Annotated[
        str | None, Query(max_length=128, description="Only changes by the key with this name.")
    ] = None,
    map_name: OnlyMap = None,
    action: Annotated[
        str | None,
        Query(max_length=32, description="Prefix of the action, such as `key.` or `refused`."),
    ] = None,
    cursor: Cursor = None,
    limit: Limit = 100,
) -> Page[AuditLine]:
    """List changes and refused requests (401, 403) with their keys, newest first.

    The log keeps lines for `SCENEPRINT_AUDIT_LOG_DAYS` days, and at most a million lines per
    tenant.
    """
    return here.audit.page(AuditFilter(actor, map_name, action), cursor, limit)


# Statistics, and the models of maps.

operations_router = v1_router(tag="operations")


@operations_router.get("/stats", responses=refusals(404, 422))
def stats(
    here: Here,
    caller: Sender,
    map_name: Annotated[
        str | None,
        Query(alias="map", description="Only this map; required if the key cannot read all maps."),
    ] = None,
    minutes: Annotated[int, Query(ge=1, le=60, description="Length of the history, minutes.")] = 60,
) -> Stats:
    """Return the current load of all processes, and its history of up to an hour."""
    if map_name is None:
        caller.require_every("read")
    else:
        caller.require(map_name, "read")
    return here.statistics.collect(minutes, map_name)


@operations_router.get("/models", responses=refusals())
def models(here: Here, caller: Sender) -> Page[ModelInfo]:
    """List the models for maps (the presets, and all models that maps have or had)."""
    models = here.catalogue.list_all(lambda name: caller.may("read", name))
    if not caller.reads_every:  # do not reveal models of unreadable maps
        models = [model for model in models if model.preset or model.maps]
    return Page[ModelInfo](items=models)


@operations_router.post(
    "/maps/{map_name}/reencoding",
    status_code=202,
    responses=refusals(400, 404, 409, 413, 415, 422),
    openapi_extra=json_body("NewModel"),
    dependencies=[Depends(may_admin)],
)
async def reencode(map_name: str, request: Request, here: Here, caller: Sender) -> Map:
    """Sign all frames of a map with another model. The map switches when all frames are signed.

    Until then, queries use the current model. The field `reencoding` of the map shows the progress.
    To retry failed frames, repeat the request.
    """
    body = await read_record(request, NewModel, "The model")
    may_read = None if caller.reads_every else partial(caller.may, "read")
    find = here.catalogue.find
    return await here.run(
        lambda: map_lifecycle.begin_reencoding(
            here.context.store, here.context.bell, map_name, find(body.model, may_read)
        )
    )


@operations_router.delete(
    "/maps/{map_name}/reencoding", responses=refusals(404, 409), dependencies=[Depends(may_admin)]
)
def cancel_reencoding(map_name: str, here: Here) -> Map:
    """Cancel the change of a map's model and delete the signatures of the new model."""
    return map_lifecycle.cancel_reencoding(here.context.store, map_name)
