"""The application: routes around one engine."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from anyio import to_thread
from fastapi import APIRouter, Depends, FastAPI

from sceneprint import __version__
from sceneprint.engine import Engine
from sceneprint.settings import Settings
from service import dashboard, problems
from service.access import caller
from service.context import Context, Gate
from service.cors import origins_of
from service.document import openapi_of
from service.feed import Feed
from service.limits import Limits
from service.metrics import Metrics
from service.middleware import Around
from service.routes import (
    again,
    associations,
    edits,
    events,
    frames,
    health,
    imports,
    jobs,
    kept,
    keys,
    maps,
    operations,
    outputs,
    points,
    queries,
    reconstructions,
    sessions,
    similarity,
    snapshots,
    uploads,
)
from service.sampling import housekeeping

#: In the order in which the document lists them.
ROUTES = (
    maps, frames, uploads, outputs, points, edits, sessions, imports, queries, kept, again,
    similarity, associations, reconstructions, jobs, events, operations, snapshots, keys,
)  # fmt: skip
#: Uploads that are in hand at once, so that one wait for the disk is enough for all of them.
UPLOADS = 12

DESCRIPTION = """\
Where have I seen this before? Upload depth frames or point clouds to a map, and ask where another
was taken: pure geometry, no colour, no pose prior. docs/api.md is a tour with curl.

Lengths are metres. Camera frames are optical (x right, y down, z forward), clouds keep the axes of
their sensor. Refusals are problem documents (RFC 9457) that say what happened, why, and what to do.
"""


def create_app(settings: Settings) -> FastAPI:
    """The service as an ASGI application.

    Parameters
    ----------
    settings : see Settings; callers must show a key where it `asks_for_keys`
    """
    figures = Metrics()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        engine = await to_thread.run_sync(Engine, settings)
        try:
            await to_thread.run_sync(engine.warm)
            gate = Gate(settings.concurrency, settings.waiting, settings.wait_s)
            # they mostly wait for the disk: the engine sees to how many are decoded at once
            uploads = Gate(max(UPLOADS, settings.concurrency), settings.waiting, settings.wait_s)
            feed = Feed(engine.store.database, settings.event_streams, settings.events_kept)
            limits = Limits(settings.requests_per_s, settings.failed_keys_per_minute)
            app.state.context = Context(
                engine, gate, uploads, figures, settings.asks_for_keys, feed=feed, limits=limits
            )
            async with housekeeping(engine, figures.sampler):
                yield
            feed.close()
        finally:
            await to_thread.run_sync(engine.close)

    # a path with a slash too many is not there: a redirection has no problem document, and would
    # lead whoever follows it, with a key, to where Host says, and behind a proxy away from TLS
    app = FastAPI(
        title="sceneprint", version=__version__, description=DESCRIPTION, lifespan=lifespan,
        redirect_slashes=False,
    )  # fmt: skip
    v1 = APIRouter(prefix="/v1", dependencies=[Depends(caller)])
    for part in ROUTES:
        v1.include_router(part.router)
    app.include_router(v1)
    app.include_router(health.router)
    app.include_router(dashboard.routes(dashboard.files_in(dashboard.PAGES)))
    problems.install(app)
    app.add_middleware(Around, settings=settings, origins=origins_of(settings), metrics=figures)
    app.openapi = lambda: openapi_of(app)  # type: ignore[method-assign]
    return app
