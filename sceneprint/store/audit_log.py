"""Audit log: changes and their actors. Each line is written in the transaction of its change.

    record_event (see `events`)  -->  a line for the change that the event reports
    record_change                -->  a line for a change without an event
    record_refusal               -->  a line for a refused request

Lines are never edited. Expired lines are removed, and so are the oldest lines of a tenant that has
too many.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, delete, func, insert, select

from sceneprint.process import NOBODY, Actor
from sceneprint.store.tables import among, audit, audit_values, tenants

#: Maximum number of lines per tenant, approximately 200 bytes each.
MAXIMUM_LINES = 1_000_000
#: Action of the line of a refused request.
REFUSED = "refused"


@dataclass(frozen=True)
class AuditRow:
    """Line of the audit log; see the table for the fields."""

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
    """Conditions on audit lines; None matches all lines.

    Parameters
    ----------
    actor : name of the key
    map : name of the changed map
    action : prefix of the action, such as `key.`
    since : earliest time, seconds since 1970
    """

    actor: str | None = None
    map: str | None = None
    action: str | None = None
    since: float | None = None


def record_change(
    connection: Connection, action: str, map_name: str | None = None, target: str | None = None,
    **data: Any,
) -> None:  # fmt: skip
    """Write a line for a change by the current actor; without an actor, write nothing.

    Parameters
    ----------
    connection : transaction of the change
    action : name in the style of event kinds, such as `job.cancelled`
    map_name, target : changed map and object
    data : details of the action
    """
    append_lines(connection, [audit_values(action, map_name, target, data)])


def append_lines(connection: Connection, lines: Iterable[dict[str, Any] | None]) -> None:
    """Insert lines (see `audit_values`) that are not None."""
    if rows := [line for line in lines if line is not None]:
        connection.execute(insert(audit), rows)


def record_refusal(
    connection: Connection, actor: Actor, tenant: str, map_name: str | None, target: str | None,
    request_id: str, **data: Any,
) -> None:  # fmt: skip
    """Write a line for a refused request; clean and truncate its unvalidated map and target."""
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
    connection: Connection, criteria: AuditFilter, limit: int, *, before: int | None = None,
    after: int | None = None,
) -> list[AuditRow]:  # fmt: skip
    """Return up to `limit` matching lines, newest first; with `after`, oldest first.

    Parameters
    ----------
    before, after : return only lines with smaller, or with larger, numbers
    """
    order = audit.c.number.desc() if after is None else audit.c.number
    statement = select(audit).order_by(order).limit(limit)
    if after is not None:
        statement = statement.where(audit.c.number > after)
    if before is not None:
        statement = statement.where(audit.c.number < before)
    if criteria.actor is not None:
        statement = statement.where(audit.c.actor == criteria.actor)
    if criteria.map is not None:
        statement = statement.where(audit.c.map == criteria.map)
    if criteria.action is not None:
        statement = statement.where(audit.c.action.startswith(criteria.action, autoescape=True))
    if criteria.since is not None:
        statement = statement.where(audit.c.at >= criteria.since)
    return [AuditRow(**row) for row in connection.execute(statement).mappings()]


def surplus_lines(
    connection: Connection, before: float, limit: int, most_lines: int = MAXIMUM_LINES
) -> list[int]:
    """Return the row numbers of lines to remove: the expired lines or, failing that, surplus lines.

    Parameters
    ----------
    before : lines before this time are expired, seconds since 1970. The search stops at the first
        later line, in case a clock was set back
    limit : maximum number of lines to return
    most_lines : maximum number of lines per tenant
    """
    oldest = connection.execute(
        select(audit.c.number, audit.c.at).order_by(audit.c.number).limit(limit)
    ).all()
    numbers = []
    for number, at in oldest:
        if at >= before:
            break
        numbers.append(int(number))
    newest = connection.execute(select(func.max(audit.c.number))).scalar()
    if numbers or not oldest or newest is None or newest - oldest[0].number < most_lines:
        return numbers
    for name in (NOBODY, *connection.execute(select(tenants.c.name)).scalars()):
        own = select(audit.c.number).where(audit.c.tenant == name)
        newest_first = own.order_by(audit.c.number.desc())
        floor = connection.execute(newest_first.offset(most_lines).limit(1)).scalar()
        if floor is not None:
            surplus = own.where(audit.c.number <= floor).order_by(audit.c.number)
            numbers += connection.execute(surplus.limit(limit - len(numbers))).scalars()
    return numbers


def remove_lines(connection: Connection, numbers: Sequence[int]) -> None:
    """Remove the audit lines with these row numbers; see `surplus_lines`."""
    connection.execute(delete(audit).where(among(connection, audit.c.number, numbers)))
