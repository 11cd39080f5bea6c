"""The OpenAPI document: FastAPI's, and the records that only bodies of our own reading use."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic.json_schema import models_json_schema

from sceneprint.schemas import (
    Diversity,
    Filter,
    FrameMeta,
    NamedFrame,
    NewMap,
    Problem,
    ValidationOptions,
)
from sceneprint.schemas.associations import NewAssociation
from sceneprint.schemas.edits import FrameEdit, MapEdit
from sceneprint.schemas.keys import NewKey
from sceneprint.schemas.operations import NewModel
from sceneprint.schemas.reconstructions import NewReconstruction


def openapi_of(app: FastAPI) -> dict[str, Any]:
    """The document of an application, made once."""
    if app.openapi_schema is None:
        document = get_openapi(
            title=app.title, version=app.version, description=app.description, routes=app.routes
        )
        template = "#/components/schemas/{model}"
        _, own = models_json_schema(
            [
                (FrameMeta, "validation"),
                (FrameEdit, "validation"),
                (MapEdit, "validation"),
                (Filter, "validation"),
                (NamedFrame, "validation"),
                (Diversity, "validation"),
                (ValidationOptions, "validation"),
                (NewMap, "validation"),
                (NewKey, "validation"),
                (NewAssociation, "validation"),
                (NewModel, "validation"),
                (NewReconstruction, "validation"),
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
