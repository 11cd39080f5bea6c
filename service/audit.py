"""Which requests are noted in the audit log, and what is noted of them: the one place that does."""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from collections.abc import Callable
from typing import Any
from urllib.parse import unquote

from starlette.types import Scope as AsgiScope

from sceneprint.errors import SceneprintError
from sceneprint.store.audit_chain import KeyChange
from service.context import Context
from service.limits import TokenBucket, network_of

log = logging.getLogger(__name__)

_READING = frozenset(("GET", "HEAD", "OPTIONS"))
#: What is asked much and changes no map, and uploads, which are many: frames and events tell of
#: them.
UNNOTED = frozenset(
    ("add_frame", "put_frame", "add_batch", "ask", "ask_several", "ask_again", "localize",
     "localize_sequence", "compare")
)  # fmt: skip


#: Statuses of what was refused for who asked.
REFUSED = (401, 403)
#: Refusals of one caller from one address that are noted at once, and how long one more takes.
AT_ONCE, AGAIN_S = 10, 600.0
#: Refusals of all callers together that are noted at once, and each second: each is a commit.
ALL_AT_ONCE, ALL_PER_S = 20, 1.0


class RefusalFilter:
    """Which refusals are noted: however many there are, they do not fill the log or the disk.

    Parameters
    ----------
    clock : seconds, never going back
    most : callers and addresses that are remembered
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, most: int = 10_000) -> None:
        self._each = TokenBucket("refusals", 1 / AGAIN_S, AT_ONCE, most, clock)
        self._all = TokenBucket("refusals", ALL_PER_S, ALL_AT_ONCE, most, clock)
        self._passed_over: OrderedDict[str, int] = OrderedDict()
        self._most = most

    def count(self, caller: str, address: str) -> int | None:
        """How many refusals alike were passed over before this one; None: it is passed over."""
        whose = f"{network_of(address)} {caller}"
        for bucket, of in ((self._each, whose), (self._all, "")):
            state = bucket.take(of)
            if state is not None and not state.allowed:
                self._passed_over[whose] = self._passed_over.pop(whose, 0) + 1
                if len(self._passed_over) > self._most:
                    self._passed_over.popitem(last=False)
                return None
        return self._passed_over.pop(whose, 0)


async def note(scope: AsgiScope, status: int, headers: list[tuple[bytes, bytes]]) -> None:
    """Note an answer that tells of a change or a refusal, before it is sent: who has it finds the
    line.

    An answer is not held back by a log that cannot be written.
    """
    if status in REFUSED:
        change = _refusal(scope, status)
    elif scope["method"] not in _READING and 200 <= status < 300:
        change = _change(scope, status, headers)
    else:
        return
    if change is None:
        return
    context: Context = scope["app"].state.context
    try:
        # however long its turn takes: who asks much must not get rid of what is noted
        await context.run(context.engine.audit.note, change, patient=True)
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
        tenant=state.get("tenant"),
    )


def _refusal(scope: AsgiScope, status: int) -> KeyChange | None:
    """What is noted of a refusal; None where there were too many."""
    state: dict[str, Any] = scope["state"]
    client, caller = scope.get("client"), state.get("caller", "")
    address = None if client is None else client[0]
    before = scope["app"].state.refusals.count(caller, address or "")
    if before is None:
        return None
    given: dict[str, str] = scope.get("path_params", {})
    target = [value for name, value in given.items() if name != "map_name"]
    return KeyChange(
        getattr(scope.get("route"), "name", None) or "request",
        caller,
        address,
        given.get("map_name"),
        target[-1] if target else None,
        state["request_id"],
        {"status": status} | ({"not_noted_before": before} if before else {}),
        tenant=state.get("tenant"),
        refused=True,
    )


def _location(headers: list[tuple[bytes, bytes]]) -> str:
    return next((value.decode() for name, value in headers if name == b"location"), "")
