"""Static files, compressed once: the page `/docs` and the OpenAPI document.

`/docs` is Swagger UI for the OpenAPI document of the service. All its files come from the package
fastapi-offline, so the page needs no network.
"""

from __future__ import annotations

import asyncio
import gzip
import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from anyio import to_thread
from fastapi import APIRouter, Request, Response
from starlette.exceptions import HTTPException

from service.responses import is_known

#: Media types by suffix. Files with other suffixes are not served.
KINDS = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".json": "application/json",
}


@dataclass(frozen=True)
class StaticFile:
    """A file in memory, with its compressed form.

    Parameters
    ----------
    kind : media type of the file
    plain, packed : content of the file, uncompressed and compressed with gzip
    tag : entity tag of the content
    """

    kind: str
    plain: bytes
    packed: bytes
    tag: str


def read_file(path: Path) -> StaticFile:
    """Read a file whose suffix is in `KINDS`."""
    return pack_file(path.suffix, path.read_bytes())


def pack_file(suffix: str, plain: bytes) -> StaticFile:
    """Return bytes as a static file, compressed; `suffix` is in `KINDS`."""
    tag = hashlib.sha256(plain).hexdigest()[:20]
    return StaticFile(KINDS[suffix], plain, gzip.compress(plain, 9, mtime=0), tag)


def answer_file(request: Request, file: StaticFile, policy: str | None = None) -> Response:
    """Return a response with a file, or 304 if the client has the file.

    Parameters
    ----------
    policy : content security policy; the default allows nothing
    """
    packs = "gzip" in request.headers.get("accept-encoding", "")
    tag = f"{file.tag}-gzip" if packs else file.tag
    headers = {
        "ETag": f'"{tag}"',
        "Cache-Control": "no-cache",  # clients revalidate, because an update may change the file
        "Vary": "Accept-Encoding",
    }
    if policy is not None:
        headers["Content-Security-Policy"] = policy
    if is_known(request, tag):
        return Response(status_code=304, headers=headers)
    if packs:
        headers["Content-Encoding"] = "gzip"
    headers["Content-Type"] = file.kind
    return Response(file.packed if packs else file.plain, headers=headers)


#: Allow only scripts and documents of the service; Swagger UI adds inline styles and data images.
POLICY = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
# Addresses are relative, because a proxy may serve the pages below a prefix.
_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>sceneprint: HTTP API</title>
<link rel="stylesheet" href="docs/swagger-ui.css">
<link rel="icon" href="dashboard/icon.svg">
</head>
<body>
<div id="swagger-ui"></div>
<script src="docs/swagger-ui-bundle.js"></script>
<script src="docs/start.js"></script>
</body>
</html>
"""
_START = """SwaggerUIBundle({
  url: "openapi.json",
  dom_id: "#swagger-ui",
  deepLinking: true,
  showCommonExtensions: true,
  presets: [SwaggerUIBundle.presets.apis, SwaggerUIBundle.SwaggerUIStandalonePreset],
});
"""
_LIBRARY = ("swagger-ui.css", "swagger-ui-bundle.js")


def routes(document: Callable[[], dict[str, Any]]) -> APIRouter:
    """Return the routes of the page `/docs`, its files and the OpenAPI document. The first request
    calls `document`.
    """
    router = APIRouter(include_in_schema=False)
    rendered: list[StaticFile] = []
    rendering = asyncio.Lock()

    def render() -> StaticFile:
        return pack_file(".json", json.dumps(document(), separators=(",", ":")).encode())

    @router.api_route("/openapi.json", methods=["GET", "HEAD"])
    async def openapi(request: Request) -> Response:
        async with rendering:
            if not rendered:
                rendered.append(await to_thread.run_sync(render))
        return answer_file(request, rendered[0])

    @router.api_route("/docs", methods=["GET", "HEAD"])
    def page(request: Request) -> Response:
        return answer_file(request, _file("index.html"), POLICY)

    @router.api_route("/docs/{name}", methods=["GET", "HEAD"])
    def file(request: Request, name: str) -> Response:
        if name != "start.js" and name not in _LIBRARY:
            raise HTTPException(404, "the documentation of the API does not have this file")
        return answer_file(request, _file(name), POLICY)

    return router


@cache
def _file(name: str) -> StaticFile:
    """Return a file of Swagger UI by name; it is compressed on first use."""
    if name == "index.html":
        return pack_file(".html", _PAGE.encode())
    if name == "start.js":
        return pack_file(".js", _START.encode())
    spec = find_spec("fastapi_offline")
    if spec is None or spec.origin is None:
        raise HTTPException(404, "the package fastapi-offline with Swagger UI is missing")
    return read_file(Path(spec.origin).parent / "static" / name)
