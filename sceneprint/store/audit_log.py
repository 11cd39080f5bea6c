"""The audit log: who changed what. Each line is written in the transaction of its change.

    record_event (see `events`)  -->  a line for the change that the event tells of
    record_change                -->  a line for a change that has no event
    record_refusal               -->  a line for a request that was refused

Lines are only ever appended, and removed when they are old or a tenant has too many.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, delete, func, insert, select

from sceneprint.process import NOBODY, Actor
from sceneprint.store.tables import among, audit, audit_values, tenants

#: Newest lines of each tenant that are kept, some 200 bytes each.
KEPT_LINES = 1_000_000
#: Action of a line for a request that was refused.
REFUSED = "refused"


@dataclass(frozen=True)
class AuditRow:
    """A line of the audit log; fields as in the table."""

    number: int
    at: float
    actor: str
    address: str | None
    tenant: str
    action: str
    map: str | None
    target: str | None
    request_id: str | None
    data: dict[str, Any]


@dataclass(frozen=True)
class AuditFilter:
    """Which lines are wanted; None: any.

    Parameters
    ----------
    actor : name of the key
    map : name of the map that was changed
    action : beginning of the action, such as `key.`
    since : seconds since 1970
    """

    actor: str | None = None
    map: str | None = None
    action: str | None = None
    since: float | None = None


def record_change(
    connection: Connection, action: str, map_name: str | None = None, target: str | None = None,
    **data: Any,
) -> None:  # fmt: skip
    """Write a line for a change by the current actor; nothing where there is none.

    Parameters
    ----------
    connection : of the transaction of the change
    action : as a kind of event, such as `job.cancelled`
    map_name, target : that were changed
    data : more, by action
    """
    append_lines(connection, [audit_values(action, map_name, target, data)])


def append_lines(connection: Connection, lines: Iterable[dict[str, Any] | None]) -> None:
    """Insert lines, see `audit_values`; those that are None are left out."""
    if found := [one for one in lines if one is not None]:
        connection.execute(insert(audit), found)


def record_refusal(
    connection: Connection, actor: Actor, tenant: str, map_name: str | None, target: str | None,
    request_id: str, **data: Any,
) -> None:  # fmt: skip
    """Write a line for a request that was refused. Its texts may be anything, and are cut."""
    texts = {"map": map_name, "target": target}
    for name, text in texts.items():
        if text is not None:
            text = text.replace("\0", "\ufffd").encode(errors="replace").decode()
            texts[name] = text[: getattr(audit.c[name].type, "length", None)]
    connection.execute(
        insert(audit).values(
            at=time.time(), actor=actor.name, address=actor.address, tenant=tenant, action=REFUSED,
            request_id=request_id, data=data, **texts,
        )
    )  # fmt: skip


def list_lines(
    connection: Connection, wanted: AuditFilter, limit: int, *, before: int | None = None,
    after: int | None = None,
) -> list[AuditRow]:  # fmt: skip
    """Return lines, the newest first; with `after`, those above that number, the oldest first."""
    order = audit.c.number.desc() if after is None else audit.c.number
    statement = select(audit).order_by(order).limit(limit)
    if after is not None:
        statement = statement.where(audit.c.number > after)
    if before is not None:
        statement = statement.where(audit.c.number < before)
    if wanted.actor is not None:
        statement = statement.where(audit.c.actor == wanted.actor)
    if wanted.map is not None:
        statement = statement.where(audit.c.map == wanted.map)
    if wanted.action is not None:
        statement = statement.where(audit.c.action.startswith(wanted.action, autoescape=True))
    if wanted.since is not None:
        statement = statement.where(audit.c.at >= wanted.since)
    return [AuditRow(**row) for row in connection.execute(statement).mappings()]


def spent_lines(
    connection: Connection, before: float, limit: int, kept: int = KEPT_LINES
) -> list[int]:
    """Return numbers of lines that may be removed: the oldest, and those of a tenant beyond `kept`.

    Parameters
    ----------
    before : seconds since 1970; older lines may go. Where a clock was set back, an older line
        behind a younger one stays until that is old too
    limit : most numbers
    kept : newest lines of each tenant that stay
    """
    oldest = connection.execute(
        select(audit.c.number, audit.c.at).order_by(audit.c.number).limit(limit)
    ).all()
    found = []
    for number, at in oldest:
        if at >= before:
            break
        found.append(int(number))
    newest = connection.execute(select(func.max(audit.c.number))).scalar()
    if found or not oldest or newest is None or newest - oldest[0].number < kept:
        return found
    for name in (NOBODY, *connection.execute(select(tenants.c.name)).scalars()):
        own = select(audit.c.number).where(audit.c.tenant == name)
        newest_first = own.order_by(audit.c.number.desc())
        floor = connection.execute(newest_first.offset(kept).limit(1)).scalar()
        if floor is not None:
            spent = own.where(audit.c.number <= floor).order_by(audit.c.number)
            found += connection.execute(spent.limit(limit - len(found))).scalars()
    return found


def remove_lines(connection: Connection, numbers: Sequence[int]) -> None:
    """Remove lines; see `spent_lines`."""
    connection.execute(delete(audit).where(among(connection, audit.c.number, numbers)))
