"""The dashboard: static pages that use the public HTTP API, as any other page would.

What is in the folder `pages` when the service starts is all that is served: a path of a request
is looked up among those names, and never reaches the disk.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from fastapi import APIRouter, Request, Response
from starlette.exceptions import HTTPException

from service.static_files import KINDS, StaticFile, answer_file, read_file

PAGES = Path(__file__).parent / "pages"
#: The page that all others are shown in.
INDEX = "index.html"
#: Nothing from elsewhere, nothing written into the page, no frame around it, no form sent away.
POLICY = "default-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"


def files_in(folder: Path) -> dict[str, StaticFile]:
    """Files of a folder and those within it that a browser is sent, by their path from there."""
    return {
        path.relative_to(folder).as_posix(): read_file(path)
        for path in sorted(folder.rglob("*"))
        if path.suffix in KINDS and path.is_file()
    }


def routes(files: Mapping[str, StaticFile]) -> APIRouter:
    """Return the routes of the dashboard for files of `files_in`."""
    router = APIRouter(include_in_schema=False)

    def sent(request: Request, name: str) -> Response:
        found = files.get(name)
        if found is None:
            raise HTTPException(404, "the dashboard does not have this file")
        return answer_file(request, found, POLICY)

    @router.api_route("/", methods=["GET", "HEAD"])
    def front(request: Request) -> Response:
        if "text/html" not in request.headers.get("accept", ""):
            raise HTTPException(404, "Not Found")
        # from where it was asked for, so that a proxy's prefix and its TLS stay
        return Response(status_code=307, headers={"Location": "dashboard", "Vary": "Accept"})

    @router.api_route("/dashboard", methods=["GET", "HEAD"])
    def index(request: Request) -> Response:
        return sent(request, INDEX)

    @router.api_route("/dashboard/", methods=["GET", "HEAD"])
    def slash() -> Response:
        return Response(status_code=307, headers={"Location": "../dashboard"})

    @router.api_route("/dashboard/{path:path}", methods=["GET", "HEAD"])
    def file(request: Request, path: str) -> Response:
        return sent(request, path)

    return router
