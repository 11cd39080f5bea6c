"""Who changed what: the newest lines of it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, String, delete, insert, select

from sceneprint.store.tables import audit

#: Lines that are kept.
KEPT = 100_000


@dataclass(frozen=True)
class Change:
    """A change.

    Parameters
    ----------
    action : the operation
    actor : name of the key that was shown; "" where none was asked for
    address : where the request came from
    map, target : what was changed
    request_id : as in the log
    data : more about it
    at : seconds since 1970; None: now
    number : of the line; 0 before it is one
    """

    action: str
    actor: str
    address: str | None = None
    map: str | None = None
    target: str | None = None
    request_id: str | None = None
    data: dict[str, Any] | None = None
    at: float | None = None
    number: int = 0


#: Columns whose texts may be whatever somebody asked for.
_TEXTS = ("actor", "address", "action", "map", "target", "request_id")


def _cut(name: str, text: str | None) -> str | None:
    """As much of a text as its column takes."""
    kind = audit.c[name].type
    return text if text is None or not isinstance(kind, String) else text[: kind.length]


def note(connection: Connection, change: Change, kept: int = KEPT) -> None:
    """Add a line; the oldest go where there are too many."""
    added = connection.execute(
        insert(audit).values(
            at=time.time() if change.at is None else change.at, data=change.data or {},
            **{name: _cut(name, getattr(change, name)) for name in _TEXTS},
        )
    ).inserted_primary_key  # fmt: skip
    assert added is not None
    connection.execute(delete(audit).where(audit.c.number <= added[0] - kept))


def list_changes(
    connection: Connection, before: int | None, limit: int, actor: str | None, map_name: str | None
) -> list[Change]:
    """Changes, the newest first, from below number `before` on."""
    asked = select(audit).order_by(audit.c.number.desc()).limit(limit)
    if before is not None:
        asked = asked.where(audit.c.number < before)
    if actor is not None:
        asked = asked.where(audit.c.actor == actor)
    if map_name is not None:
        asked = asked.where(audit.c.map == map_name)
    return [Change(**row) for row in connection.execute(asked).mappings()]
