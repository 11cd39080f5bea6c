"""What happened, in order: written in the transaction in which it happens."""

from __future__ import annotations

import time
from typing import Any

from sqlalchemy import Connection, insert, select

from sceneprint.store.tables import events


def tell(
    connection: Connection,
    kind: str,
    map_name: str | None = None,
    frame_id: str | None = None,
    job_id: str | None = None,
    **data: Any,
) -> None:
    """Note an event; `kind` is such as frame.indexed."""
    connection.execute(
        insert(events).values(
            at=time.time(), kind=kind, map=map_name, frame_id=frame_id, job_id=job_id, data=data
        )
    )


def anchor_of(connection: Connection, map_name: str) -> str:
    """The last event of a map, as a mark of the state that this transaction sees."""
    last = connection.execute(
        select(events.c.number, events.c.at, events.c.frame_id)
        .where(events.c.map == map_name)
        .order_by(events.c.number.desc())
        .limit(1)
    ).one()
    return _mark(*last)


def holds_anchor(connection: Connection, anchor: str) -> bool:
    """Whether the state that was marked is this one, or an earlier one of the same history.

    A database that was put back to an earlier state gives the same numbers out again, but not at
    the same time to the same frames.
    """
    number = anchor.partition(" ")[0]
    if not (number.isascii() and number.isdigit() and len(number) < 19):
        return False
    found = connection.execute(
        select(events.c.number, events.c.at, events.c.frame_id).where(
            events.c.number == int(number)
        )
    ).first()
    return found is not None and _mark(*found) == anchor


def _mark(number: int, at: float, frame_id: str | None) -> str:
    return f"{number} {at!r} {frame_id}"
