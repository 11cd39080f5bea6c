"""The application: routes around one engine."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from anyio import to_thread
from fastapi import APIRouter, Depends, FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic.json_schema import models_json_schema

from sceneprint import __version__
from sceneprint.engine import Engine
from sceneprint.schemas import Filter, FrameMeta, NewMap, Problem
from sceneprint.settings import Settings, is_loopback
from service import problems
from service.context import Context, Gate, key_holder
from service.metrics import Metrics
from service.middleware import Around
from service.routes import frames, health, jobs, maps, queries

DESCRIPTION = """\
Where have I seen this before? Upload depth frames to a map, and ask where another was taken: pure
geometry, no colour, no pose prior. docs/api.md is a tour with curl.

Lengths are metres. Camera frames are optical: x right, y down, z forward. Refusals are problem
documents (RFC 9457) that say what happened, why, and what to do.
"""


def create_app(settings: Settings) -> FastAPI:
    """The service as an ASGI application.

    Parameters
    ----------
    settings : see Settings; callers must show a key unless it listens on a loopback address
    """
    figures, alone = Metrics(), is_loopback(settings.host)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        engine = await to_thread.run_sync(Engine, settings)
        try:
            await to_thread.run_sync(engine.warm)
            gate, uploads = (Gate(settings.concurrency, settings.waiting) for _ in range(2))
            app.state.context = Context(engine, gate, uploads, figures, keys=not alone)
            yield
        finally:
            await to_thread.run_sync(engine.close)

    app = FastAPI(
        title="sceneprint", version=__version__, description=DESCRIPTION, lifespan=lifespan
    )
    v1 = APIRouter(prefix="/v1", dependencies=[Depends(key_holder)])
    for part in (maps, frames, queries, jobs):
        v1.include_router(part.router)
    app.include_router(v1)
    app.include_router(health.router)
    problems.install(app)
    app.add_middleware(Around, limit=settings.upload_bytes, metrics=figures, alone=alone)
    app.openapi = lambda: _openapi(app)  # type: ignore[method-assign]
    return app


def _openapi(app: FastAPI) -> dict[str, Any]:
    """The document, with the records that only bodies of our own reading use."""
    if app.openapi_schema is None:
        document = get_openapi(
            title=app.title, version=app.version, description=app.description, routes=app.routes
        )
        template = "#/components/schemas/{model}"
        _, own = models_json_schema(
            [
                (FrameMeta, "validation"),
                (Filter, "validation"),
                (NewMap, "validation"),
                (Problem, "serialization"),
            ],
            ref_template=template,
        )
        schemas = document.setdefault("components", {}).setdefault("schemas", {})
        for name, schema in own["$defs"].items():
            schemas.setdefault(name, schema)
        for operation in (one for path in document["paths"].values() for one in path.values()):
            if "application/json" in operation["responses"].get("422", {}).get("content", {}):
                del operation["responses"]["422"]  # FastAPI's guess: a name in a path is never so
        for name in ("HTTPValidationError", "ValidationError"):
            schemas.pop(name, None)
        app.openapi_schema = document
    return app.openapi_schema
