"""Which requests are noted as changes, and what is noted of them: the one place that does."""

from __future__ import annotations

import logging
from typing import Any
from urllib.parse import unquote

from anyio import to_thread
from starlette.types import Scope as AsgiScope

from sceneprint.errors import SceneprintError
from sceneprint.store.keys import KeyChange

log = logging.getLogger(__name__)

_READING = frozenset(("GET", "HEAD", "OPTIONS"))
#: What is asked much and changes no map, and uploads, which are many: frames and events tell of
#: them.
UNNOTED = frozenset(
    ("add_frame", "put_frame", "add_batch", "ask", "ask_several", "ask_again", "localize",
     "localize_sequence", "compare")
)  # fmt: skip


async def note(scope: AsgiScope, status: int, headers: list[tuple[bytes, bytes]]) -> None:
    """Note an answer where it tells of a change, before it is sent: who has it finds the line.

    An answer is not held back by a log that cannot be written.
    """
    if scope["method"] in _READING or not 200 <= status < 300:
        return
    change = _change(scope, status, headers)
    if change is None:
        return
    try:
        await to_thread.run_sync(scope["app"].state.context.engine.audit.note, change)
    except SceneprintError as error:
        log.error("audit entry not written", extra={"action": change.action, "error": str(error)})


def _change(scope: AsgiScope, status: int, headers: list[tuple[bytes, bytes]]) -> KeyChange | None:
    action = getattr(scope.get("route"), "name", None)
    if action is None or action in UNNOTED:
        return None
    state: dict[str, Any] = scope["state"]
    given: dict[str, str] = scope.get("path_params", {})
    map_name, target = given.get("map_name"), None
    for name, value in given.items():
        target = value if name != "map_name" else target
    made = [unquote(one) for one in _location(headers).split("/")[2:]]
    if len(made) >= 2 and made[0] == "maps" and map_name is None:
        map_name = made[1]
    elif len(made) >= 2 and target is None:
        target = made[-1]
    changed = state.get("changed", ())
    if map_name is None and len(changed) == 1:
        (map_name,) = changed
    client = scope.get("client")
    return KeyChange(
        action,
        state.get("caller", ""),
        None if client is None else client[0],
        map_name,
        target,
        state["request_id"],
        {"status": status, **state.get("audited", {})},
    )


def _location(headers: list[tuple[bytes, bytes]]) -> str:
    return next((value.decode() for name, value in headers if name == b"location"), "")
