"""The dashboard: static pages that use only the public HTTP API.

The service reads the folder `pages` at startup and serves only these files. Request paths are keys
of a dictionary, and never reach the disk.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from fastapi import APIRouter, Request, Response
from starlette.exceptions import HTTPException

from service.static_files import KINDS, StaticFile, answer_file, read_file

PAGES = Path(__file__).parent / "pages"
#: Page that contains all other pages.
INDEX = "index.html"
#: No external content, no inline scripts, no embedding in frames, no forms.
POLICY = "default-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"


def files_in(folder: Path) -> dict[str, StaticFile]:
    """Read the files in a folder and its subfolders that browsers load, by relative path."""
    return {
        path.relative_to(folder).as_posix(): read_file(path)
        for path in sorted(folder.rglob("*"))
        if path.suffix in KINDS and path.is_file()
    }


def routes(files: Mapping[str, StaticFile]) -> APIRouter:
    """Return the routes of the dashboard for files of `files_in`."""
    router = APIRouter(include_in_schema=False)

    def respond(request: Request, name: str) -> Response:
        file = files.get(name)
        if file is None:
            raise HTTPException(404, "the dashboard does not have this file")
        return answer_file(request, file, POLICY)

    @router.api_route("/", methods=["GET", "HEAD"])
    def front(request: Request) -> Response:
        if "text/html" not in request.headers.get("accept", ""):
            raise HTTPException(404, "Not Found")
        # A relative address preserves the prefix and the TLS of a proxy.
        return Response(status_code=307, headers={"Location": "dashboard", "Vary": "Accept"})

    @router.api_route("/dashboard", methods=["GET", "HEAD"])
    def index(request: Request) -> Response:
        return respond(request, INDEX)

    @router.api_route("/dashboard/", methods=["GET", "HEAD"])
    def slash() -> Response:
        return Response(status_code=307, headers={"Location": "../dashboard"})

    @router.api_route("/dashboard/{path:path}", methods=["GET", "HEAD"])
    def file(request: Request, path: str) -> Response:
        return respond(request, path)

    return router
