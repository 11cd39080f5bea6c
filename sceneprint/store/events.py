"""What happened, in order: written in the transaction in which it happens."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, func, insert, or_, select

from sceneprint.store.tables import events


def record_event(
    connection: Connection,
    kind: str,
    map_name: str | None = None,
    frame_id: str | None = None,
    job_id: str | None = None,
    **data: Any,
) -> None:
    """Note an event; `kind` is one of `KINDS` of the API."""
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
    return _fingerprint(*last)


def holds_anchor(connection: Connection, anchor: str) -> bool:
    """Whether the state that was marked is this one, or an earlier one of the same history.

    A database that was put back to an earlier state gives the same numbers out again, but not at
    the same time to the same frames.
    """
    number = anchor_number(anchor)
    if number is None:
        return False
    found = connection.execute(
        select(events.c.number, events.c.at, events.c.frame_id).where(events.c.number == number)
    ).first()
    return found is not None and _fingerprint(*found) == anchor


def _fingerprint(number: int, at: float, frame_id: str | None) -> str:
    return f"{number} {at!r} {frame_id}"


@dataclass(frozen=True)
class EventRow:
    """An event; fields as in the table."""

    number: int
    at: float
    kind: str
    map: str | None
    frame_id: str | None
    job_id: str | None
    data: dict[str, Any]


@dataclass(frozen=True)
class Wanted:
    """Which events somebody asks for, and may see.

    Parameters
    ----------
    maps : only of these; None: of all, and those of no map
    kinds : beginnings of kinds, one of which must fit; none: all
    of_maps : whether those of no map are left out
    """

    maps: frozenset[str] | None = None
    kinds: tuple[str, ...] = ()
    of_maps: bool = False

    def __call__(self, event: EventRow) -> bool:
        """Whether an event is one of them."""
        return self.sees(event) and (not self.kinds or event.kind.startswith(self.kinds))

    def sees(self, event: EventRow) -> bool:
        """Whether an event is one that may be told, of whatever kind."""
        if self.maps is None:
            return event.map is not None or not self.of_maps
        return event.map in self.maps


def newest_number(connection: Connection) -> int:
    """Number of the newest event, 0 where there is none."""
    return int(connection.execute(select(func.max(events.c.number))).scalar() or 0)


def newest_seen(connection: Connection, wanted: Wanted) -> int:
    """Number of the newest event that may be told, of whatever kind; 0 where there is none.

    What is told of how far somebody has read is this, and never the number of an event that is
    hidden: when it changes, the caller was told what happened.
    """
    if wanted.maps is not None:
        newest = select(func.max(events.c.number))
        of = [connection.execute(newest.where(events.c.map == one)) for one in wanted.maps]
        return max((int(one.scalar() or 0) for one in of), default=0)
    if not wanted.of_maps:
        return newest_number(connection)
    last = select(events.c.number).where(events.c.map.is_not(None))
    return int(connection.execute(last.order_by(events.c.number.desc()).limit(1)).scalar() or 0)


def list_events(
    connection: Connection, wanted: Wanted, *, after: int = 0, before: int | None = None,
    limit: int = 1000, newest_first: bool = False,
) -> list[EventRow]:  # fmt: skip
    """Events between two numbers, neither of them included.

    Numbers are in the order of the commits: writers are one at a time (see `Database.write`), and a
    number is given within the writer's turn. So who has read up to one number never misses a
    smaller one.
    """
    order = events.c.number.desc() if newest_first else events.c.number
    asked = select(events).where(events.c.number > after).order_by(order).limit(limit)
    if before is not None:
        asked = asked.where(events.c.number < before)
    if wanted.maps is not None:
        asked = asked.where(events.c.map.in_(sorted(wanted.maps)))
    elif wanted.of_maps:
        asked = asked.where(events.c.map.is_not(None))
    if wanted.kinds:
        fits = [events.c.kind.startswith(one, autoescape=True) for one in wanted.kinds]
        asked = asked.where(or_(*fits))
    return [EventRow(**row) for row in connection.execute(asked).mappings()]


def anchor_number(anchor: str) -> int | None:
    """Number of the event that an anchor marks; None where it is none."""
    number = anchor.partition(" ")[0]
    return int(number) if number.isascii() and number.isdigit() and len(number) < 19 else None
