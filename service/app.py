"""The ASGI application: its routes, OpenAPI document and background tasks."""

from __future__ import annotations

import asyncio
import gc
import logging
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, nullcontext, suppress
from typing import Any

from anyio import to_thread
from fastapi import FastAPI
from fastapi.concurrency import contextmanager_in_threadpool
from fastapi.openapi.utils import get_openapi
from fastapi.routing import APIRoute
from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from sceneprint import __version__
from sceneprint.engine.compilation import compile_kernels
from sceneprint.engine.context import Context, open_context
from sceneprint.engine.upkeep.purge import MemoryPurging
from sceneprint.errors import SceneprintError
from sceneprint.settings import Settings
from sceneprint.store.database_errors import PATIENCE_S
from sceneprint_client.api import (
    Diversity,
    Filter,
    FrameMeta,
    NamedFrame,
    NewMap,
    Prior,
    Problem,
    ValidationOptions,
)
from sceneprint_client.api.admin import NewKey, NewModel
from sceneprint_client.api.copies import CopyRequest
from sceneprint_client.api.coverage import NewMapCoverage
from sceneprint_client.api.listing import (
    FrameEdit,
    FramesEdit,
    FrameSelection,
    MapEdit,
    SessionEdit,
)
from sceneprint_client.api.results import KeepOptions
from sceneprint_client.api.sessions import NewAssociation, NewDifference
from sceneprint_client.api.surface import NewReconstruction
from service import dashboard, problems, static_files
from service.auth import RefusalFilter
from service.browser_security import origins_of
from service.metrics import EVERY_S as SAMPLED_S
from service.metrics import Metrics
from service.middleware import RequestMiddleware
from service.routes import (
    admin,
    copies,
    frame_data,
    frames,
    jobs,
    maps,
    products,
    queries,
    reconstructions,
    results,
    selections,
    sessions,
    surface,
)
from service.running_service import Service

# The OpenAPI document of FastAPI, supplemented by the records that routes parse themselves.

PARSED: tuple[type[BaseModel], ...] = (
    FrameMeta, FrameEdit, SessionEdit, FrameSelection, FramesEdit, KeepOptions, MapEdit, Filter,
    NamedFrame, Diversity, ValidationOptions, Prior, NewMap, NewKey, NewAssociation, CopyRequest,
    NewMapCoverage, NewDifference, NewModel, NewReconstruction,
)  # fmt: skip


def openapi_of(app: FastAPI) -> dict[str, Any]:
    """Return the OpenAPI document of an application; it is built in the first call."""
    if app.openapi_schema is None:
        for route in app.routes:
            if isinstance(route, APIRoute):
                route.operation_id = route.name  # name of the function in generated clients
        document = get_openapi(
            title=app.title, version=app.version, description=app.description, routes=app.routes
        )
        _, own = models_json_schema(
            [*((kind, "validation") for kind in PARSED), (Problem, "serialization")],
            ref_template="#/components/schemas/{model}",
        )
        schemas = document.setdefault("components", {}).setdefault("schemas", {})
        for name, schema in own["$defs"].items():
            schemas.setdefault(name, schema)
        for operation in (each for path in document["paths"].values() for each in path.values()):
            if "application/json" in operation["responses"].get("422", {}).get("content", {}):
                del operation["responses"]["422"]  # FastAPI adds it for every path parameter
        for name in ("HTTPValidationError", "ValidationError"):
            schemas.pop(name, None)
        app.openapi_schema = document
    return app.openapi_schema


log = logging.getLogger(__name__)

#: Routers in the order of the OpenAPI document.
ROUTERS = (
    maps.router, frames.router, selections.router, frame_data.router, frame_data.points_router,
    maps.edits_router, copies.router, sessions.router, frames.imports_router, queries.router,
    results.history_router, results.router, queries.similarity_router, products.associations_router,
    products.coverage_router, products.differences_router, surface.router, reconstructions.router,
    jobs.router, jobs.events_router, admin.operations_router, admin.keys_router,
)  # fmt: skip

DESCRIPTION = """\
Where have I seen this before? Upload depth frames or point clouds to a map, and query where another
frame was taken. Queries use only geometry, and need neither colour nor a pose prior. docs/api.md is
a tour with curl.

Lengths are in metres. Camera frames are optical (x right, y down, z forward); clouds keep the axes
of their sensor. Errors are problem documents (RFC 9457) that say what happened, why, and what to
do.
"""


@asynccontextmanager
async def warm_up(context: Context) -> AsyncIterator[None]:
    """Compile or load kernels and tables in the background, while the service responds."""
    stop = threading.Event()
    context.signers.hold()
    task = asyncio.create_task(to_thread.run_sync(_warm, context, stop))
    try:
        yield
    finally:
        stop.set()
        await task  # finish before the store closes


def _warm(context: Context, stop: threading.Event) -> None:
    try:
        compile_kernels(context.settings.cache_dir, say=log.info, stop=stop)
    finally:
        context.signers.release()
    if stop.is_set():
        return
    context.store.decoders.start()
    try:
        context.signers.warm()
    except SceneprintError as error:  # later requests retry
        log.info("store unreachable", extra={"error": str(error)})
    gc.collect()
    gc.freeze()  # otherwise, full collections would stop all threads for 50 ms to traverse code


@asynccontextmanager
async def housekeeping(service: Service) -> AsyncIterator[None]:
    """Write metrics and the last use of keys at intervals; drop cached data of deleted frames."""
    database, sampler = service.context.store.database, service.metrics.sampler
    purging = MemoryPurging(service.context)

    async def repeat() -> None:
        while True:
            await asyncio.sleep(SAMPLED_S)
            await to_thread.run_sync(sampler.flush, database)
            try:
                await to_thread.run_sync(purging.run)
                await to_thread.run_sync(service.key_uses.write, database)
            except SceneprintError as error:
                log.info("store unreachable", extra={"error": str(error)})

    task = asyncio.create_task(repeat())
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
        await to_thread.run_sync(sampler.flush, database)
        with suppress(SceneprintError):  # the store may be unreachable
            await to_thread.run_sync(service.key_uses.write, database)


def create_app(settings: Settings, *, warm: bool = True) -> FastAPI:
    """Return the service as an ASGI application; with `warm`, it loads models and kernels at its
    start.
    """
    figures = Metrics()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        # Wait for the database server, which may have stopped since the process started.
        opened = open_context(settings, PATIENCE_S)
        async with contextmanager_in_threadpool(opened) as context:
            service = Service(context, figures)
            # More threads than one tenant may use, so that some are free for other tenants.
            to_thread.current_default_thread_limiter().total_tokens += service.places
            app.state.service, app.state.refusals = service, RefusalFilter()
            loading = warm_up(context) if warm else nullcontext()
            async with housekeeping(service), loading:
                yield
            service.feed.close()

    # A path with an extra slash returns 404: a redirect would send the client, with its key, to the
    # address in Host, and behind a proxy to an address without TLS.
    app = FastAPI(
        title="sceneprint", version=__version__, description=DESCRIPTION, lifespan=lifespan,
        redirect_slashes=False, docs_url=None, redoc_url=None, openapi_url=None,
    )  # fmt: skip
    for router in (*ROUTERS, admin.router):  # `include_router` would build all routes again
        app.router.routes.extend(router.routes)
    app.include_router(static_files.routes(lambda: openapi_of(app)))
    app.include_router(dashboard.routes(dashboard.files_in(dashboard.PAGES)))
    problems.install(app)
    app.add_middleware(
        RequestMiddleware, settings=settings, origins=origins_of(settings), metrics=figures
    )
    app.openapi = lambda: openapi_of(app)  # type: ignore[method-assign]
    return app
