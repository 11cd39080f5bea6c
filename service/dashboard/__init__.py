"""The dashboard: static pages that use the public HTTP API, as any other page would.

What is in the folder `pages` when the service starts is all that is served: a path of a request
is looked up among those names, and never reaches the disk.
"""

from __future__ import annotations

import gzip
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fastapi import APIRouter, Request, Response
from starlette.exceptions import HTTPException

from service.responses import is_known

PAGES = Path(__file__).parent / "pages"
#: The page that all others are shown in.
INDEX = "index.html"
#: Nothing from elsewhere, nothing written into the page, no frame around it, no form sent away.
POLICY = "default-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
_KINDS = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}


@dataclass(frozen=True)
class File:
    """A file as it is sent.

    Parameters
    ----------
    kind : its media type
    plain, packed : its bytes, as they are and through gzip
    tag : stands for them
    """

    kind: str
    plain: bytes
    packed: bytes
    tag: str


def files_in(folder: Path) -> dict[str, File]:
    """Files of a folder and those within it that a browser is sent, by their path from there."""
    return {
        path.relative_to(folder).as_posix(): _read(path)
        for path in sorted(folder.rglob("*"))
        if path.suffix in _KINDS and path.is_file()
    }


def routes(files: Mapping[str, File]) -> APIRouter:
    """Routes of the dashboard.

    Parameters
    ----------
    files : as `files_in` found them
    """
    router = APIRouter(include_in_schema=False)

    def sent(request: Request, name: str) -> Response:
        found = files.get(name)
        if found is None:
            raise HTTPException(404, "the dashboard does not have this file")
        return _answer(request, found)

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


def _read(path: Path) -> File:
    plain = path.read_bytes()
    tag = hashlib.sha256(plain).hexdigest()[:20]
    return File(_KINDS[path.suffix], plain, gzip.compress(plain, 9, mtime=0), tag)


def _answer(request: Request, file: File) -> Response:
    packs = "gzip" in request.headers.get("accept-encoding", "")
    tag = f"{file.tag}-gzip" if packs else file.tag
    headers = {
        "ETag": f'"{tag}"',
        "Cache-Control": "no-cache",  # asked again each time: another version may serve by now
        "Content-Security-Policy": POLICY,
        "Vary": "Accept-Encoding",
    }
    if is_known(request, tag):
        return Response(status_code=304, headers=headers)
    if packs:
        headers["Content-Encoding"] = "gzip"
    headers["Content-Type"] = file.kind
    return Response(file.packed if packs else file.plain, headers=headers)
