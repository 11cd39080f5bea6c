"""What is made of frames and answers, as answers to requests: who has it is told so with 304."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from anyio import to_thread
from fastapi import Request, Response

from sceneprint.engine.made import Output
from service.conditions import is_known
from service.context import Context
from service.problems import declared

T = TypeVar("T")


def made_files(
    *kinds: str, model: Any = None, description: str, statuses: tuple[int, ...] = (404, 409)
) -> dict[int | str, dict[str, Any]]:
    """Responses of a route that sends files, for the OpenAPI document."""
    headers = {
        "ETag": {
            "description": "Stands for these bytes: sent in If-None-Match, it saves them.",
            "schema": {"type": "string"},
        }
    }
    schema = {"schema": {"type": "string", "format": "binary"}}
    content = dict.fromkeys(kinds, schema)
    done: dict[str, Any] = {"description": description, "headers": headers, "content": content}
    if model is not None:
        done["model"] = model
    known = {"description": "As the caller has it: its If-None-Match names this ETag."}
    return {200: done, 304: known, **declared(*statuses)}


async def look(find: Callable[[], Output[T]]) -> Output[T]:
    """Look for it in a thread."""
    return await to_thread.run_sync(find)


def tagged(output: Output[Any]) -> dict[str, str]:
    """Its headers."""
    return {"ETag": f'"{output.tag}"', "Cache-Control": "private, no-cache"}


async def sent(
    request: Request, here: Context, output: Output[bytes], kind: str,
    name: str | None = None, **headers: str,
) -> Response:  # fmt: skip
    """An output; made only where the caller does not have it yet, and when it is its turn."""
    headers |= tagged(output)
    if is_known(request, output.tag):
        return Response(None, 304, headers)
    async with here.gate.place():
        data = await here.gate.run(output.make)
    if name is not None:
        headers["Content-Disposition"] = f'inline; filename="{safe(name)}"'
    return Response(data, 200, headers, kind)


def safe(name: str) -> str:
    """An id as a header may hold it."""
    return "".join(one if one.isascii() and one.isprintable() and one not in '"\\/' else "_"
                   for one in name)  # fmt: skip
