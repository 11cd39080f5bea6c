"""Static files as they are sent: packed once, and not again where the browser has them."""

from __future__ import annotations

import gzip
import hashlib
from dataclasses import dataclass
from pathlib import Path

from fastapi import Request, Response

from service.responses import is_known

#: Media types by suffix; files of no other are sent.
KINDS = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}


@dataclass(frozen=True)
class StaticFile:
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


def read_file(path: Path) -> StaticFile:
    """A file of the disk, of a suffix in `KINDS`."""
    return pack_file(path.suffix, path.read_bytes())


def pack_file(suffix: str, plain: bytes) -> StaticFile:
    """Bytes as a file of a suffix in `KINDS`."""
    tag = hashlib.sha256(plain).hexdigest()[:20]
    return StaticFile(KINDS[suffix], plain, gzip.compress(plain, 9, mtime=0), tag)


def answer_file(request: Request, file: StaticFile, policy: str) -> Response:
    """A file with its content security policy; 304 where the browser has it."""
    packs = "gzip" in request.headers.get("accept-encoding", "")
    tag = f"{file.tag}-gzip" if packs else file.tag
    headers = {
        "ETag": f'"{tag}"',
        "Cache-Control": "no-cache",  # asked again each time: another version may serve by now
        "Content-Security-Policy": policy,
        "Vary": "Accept-Encoding",
    }
    if is_known(request, tag):
        return Response(status_code=304, headers=headers)
    if packs:
        headers["Content-Encoding"] = "gzip"
    headers["Content-Type"] = file.kind
    return Response(file.packed if packs else file.plain, headers=headers)
