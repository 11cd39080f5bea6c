"""Events: reports of changes, in order, each written in the transaction of the change.

    writer of all maps  --record_event-->  events  <--number_events--  pending_events  <--  writer
    of a map

Numbers are in commit order, so that a reader never misses an event with a smaller number. Writers
of all maps run one at a time and assign numbers themselves. Writers of single maps commit
concurrently, so their events are pending until a process numbers them. The pending events of a map
are in commit order, since its writers take turns.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    Table,
    and_,
    delete,
    func,
    insert,
    literal_column,
    or_,
    select,
)

from sceneprint.errors import UnusableStore
from sceneprint.store.audit_log import append_lines
from sceneprint.store.database import MAPS_OPTION, Database
from sceneprint.store.tables import (
    MapRow,
    among,
    audit_values,
    blocks,
    event_values,
    events,
    former_maps,
    maps,
    pending_events,
)


def record_event(
    connection: Connection,
    kind: str,
    map_name: str | None = None,
    frame_id: str | None = None,
    job_id: str | None = None,
    *,
    details: Mapping[str, Any] | None = None,
    **data: Any,
) -> None:
    """Write an event, and an audit line if the change was made by an actor.

    Parameters
    ----------
    connection : transaction of the change
    kind : event kind, from `KINDS` of the API
    map_name, frame_id, job_id : changed objects
    details : data only for the audit line
    """
    record_events(connection, [event_values(kind, map_name, frame_id, job_id, data)], details)


def record_events(
    connection: Connection, rows: Sequence[dict[str, Any]],
    details: Mapping[str, Any] | None = None,
) -> None:  # fmt: skip
    """Write events and audit lines; see `record_event`.

    Parameters
    ----------
    connection : transaction of the changes
    rows : columns of each event, see `event_values`
    details : data only for the audit lines
    """
    connection.execute(insert(events_table(connection)), rows)
    append_lines(
        connection,
        [
            audit_values(
                row["kind"], row["map"],
                row["frame_id"] or row["data"].get("name") or row["job_id"],
                {**row["data"], **(details or {})},
            )
            for row in rows
            if row["kind"] not in _DISCOVERIES
        ],
    )  # fmt: skip


#: Kinds of events without an audit line: they are not caused by the actor, who only reads.
_DISCOVERIES = frozenset(("frame.damaged",))


def events_table(connection: Connection) -> Table:
    """Return the event table for the transaction of a connection: pending or numbered events."""
    of_maps = connection.get_execution_options().get(MAPS_OPTION)
    return pending_events if of_maps else events


#: Maximum seconds to wait while another process numbers events.
NUMBERING_S = 1.0


def number_events(database: Database) -> None:
    """Assign numbers to pending events; call this before reading events.

    If this is not possible, for example in a read-only database, they remain pending.
    """
    if not database.read_only:
        with suppress(UnusableStore):
            _number_pending(database)


def _number_pending(database: Database) -> None:
    """Assign numbers to pending events. Raise UnusableStore if this is not possible now."""
    if database.is_sqlite:
        return
    with database.read() as connection:
        if connection.execute(select(pending_events.c.number).limit(1)).first() is None:
            return
    with database.write(turn=False) as connection:
        wait_ms = str(int(1000 * NUMBERING_S))
        connection.execute(select(func.set_config("lock_timeout", wait_ms, True)))
        connection.execute(select(func.number_pending_events()))


def anchor_of_now(database: Database, map_name: str) -> str:
    """Return an anchor of the current state of a map, derived from its last event.

    The anchor covers all changes that were committed before this call.

    Raises
    ------
    UnusableStore : If pending events cannot be numbered now.
    """
    _number_pending(database)
    with database.read() as connection:
        last = connection.execute(
            select(events.c.number, events.c.at, events.c.frame_id)
            .where(events.c.map == map_name)
            .order_by(events.c.number.desc())
            .limit(1)
        ).one()
    return _fingerprint(*last)


def holds_anchor(connection: Connection, anchor: str) -> bool:
    """Return whether the event of an anchor is in the history of the database.

    After a restore to an earlier state, the same number may belong to an event of another time or
    frame.
    """
    number = anchor_number(anchor)
    if number is None:
        return False
    row = connection.execute(
        select(events.c.number, events.c.at, events.c.frame_id).where(events.c.number == number)
    ).first()
    return row is not None and _fingerprint(*row) == anchor


def _fingerprint(number: int, at: float, frame_id: str | None) -> str:
    return f"{number} {at!r} {frame_id}"


@dataclass(frozen=True)
class EventRow:
    """A row of the table `events`."""

    number: int
    at: float
    kind: str
    map: str | None
    frame_id: str | None
    job_id: str | None
    data: dict[str, Any]


@dataclass(frozen=True)
class EventFilter:
    """Conditions on events, including the permissions of the caller.

    Parameters
    ----------
    maps : names of the selected maps; None selects all maps, and events without a map
    kinds : prefixes of kinds, one of which must match; empty selects all kinds
    of_maps : whether to exclude events without a map
    since : time of the first access by the caller, seconds since 1970. Events of maps deleted
        earlier are hidden, even if another map has the same name. None hides no events
    """

    maps: frozenset[str] | None = None
    kinds: tuple[str, ...] = ()
    of_maps: bool = False
    since: float | None = None

    def __call__(self, event: EventRow) -> bool:
        """Return whether the caller has requested an event and may read it."""
        return self.sees(event) and (not self.kinds or event.kind.startswith(self.kinds))

    def sees(self, event: EventRow) -> bool:
        """Return whether the caller may read an event, regardless of its kind."""
        if self.maps is None:
            return event.map is not None or not self.of_maps
        return event.map in self.maps


def newest_number(connection: Connection) -> int:
    """Return the number of the newest event; 0 without events."""
    return int(connection.execute(select(func.max(events.c.number))).scalar() or 0)


def newest_selected(connection: Connection, criteria: EventFilter) -> int:
    """Return the number of the newest event, of any kind, of the selected maps; 0 without events.

    It serves as a position in the list, because it does not reveal hidden events.
    """
    if criteria.maps is not None:
        beginnings = _beginnings(connection, criteria)
        newest = select(func.max(events.c.number))
        rows = [
            connection.execute(
                newest.where(events.c.map == name, events.c.number > beginnings.get(name, 0))
            )
            for name in criteria.maps
        ]
        return max((int(row.scalar() or 0) for row in rows), default=0)
    if not criteria.of_maps:
        return newest_number(connection)
    last = select(events.c.number).where(events.c.map.is_not(None))
    return int(connection.execute(last.order_by(events.c.number.desc()).limit(1)).scalar() or 0)


def list_events(
    connection: Connection, criteria: EventFilter, *, after: int = 0, before: int | None = None,
    limit: int = 1000, newest_first: bool = False,
) -> list[EventRow]:  # fmt: skip
    """Return up to `limit` matching events, numbered between `after` and `before`, exclusive.

    Call `number_events` first to include pending events.
    """
    order = events.c.number.desc() if newest_first else events.c.number
    statement = select(events).where(events.c.number > after).order_by(order).limit(limit)
    if before is not None:
        statement = statement.where(events.c.number < before)
    if criteria.maps is not None:
        statement = statement.where(_of_maps(criteria.maps, _beginnings(connection, criteria)))
    elif criteria.of_maps:
        statement = statement.where(events.c.map.is_not(None))
    if criteria.kinds:
        matches = [events.c.kind.startswith(kind, autoescape=True) for kind in criteria.kinds]
        statement = statement.where(or_(*matches))
    return [EventRow(**row) for row in connection.execute(statement).mappings()]


#: Maximum number of `_beginnings` in a statement, since SQLite limits the depth of expressions.
_MOST_BEGINNINGS = 500
#: Condition with a literal value for the partial index; see `_LIVING` of `deletion`.
_DELETED: ColumnElement[bool] = events.c.kind == literal_column("'map.deleted'")


def _beginnings(connection: Connection, criteria: EventFilter) -> dict[str, int]:
    """Return the number of the last hidden event of each reused map name; see `EventFilter`."""
    if criteria.since is None or criteria.maps is None:
        return {}
    statement = (
        select(events.c.map, func.max(events.c.number))
        .where(_DELETED, events.c.map.in_(sorted(criteria.maps)), events.c.at < criteria.since)
        .group_by(events.c.map)
    )
    return {row[0]: int(row[1]) for row in connection.execute(statement)}


def _of_maps(names: Collection[str], beginnings: Mapping[str, int]) -> ColumnElement[bool]:
    """Return the SQL condition for events of some maps, after their `_beginnings`."""
    whole = events.c.map.in_(sorted(set(names) - beginnings.keys()))
    if len(beginnings) > _MOST_BEGINNINGS:
        last = max(beginnings.values())
        return or_(whole, and_(events.c.map.in_(sorted(beginnings)), events.c.number > last))
    parts = (
        and_(events.c.map == name, events.c.number > last)
        for name, last in sorted(beginnings.items())
    )
    return or_(whole, *parts)


def anchor_number(anchor: str) -> int | None:
    """Return the number of the event in an anchor; None if the anchor is malformed."""
    number = anchor.partition(" ")[0]
    return int(number) if number.isascii() and number.isdigit() and len(number) < 19 else None


def removal_floors(connection: Connection, most_events: int) -> dict[str | None, int]:
    """Return the number of the newest surplus event of each map that has too many events.

    The key None stands for events without a map or of deleted maps; their total is limited.

    Parameters
    ----------
    most_events : maximum number of events per map
    """
    oldest = connection.execute(select(func.min(events.c.number))).scalar()
    if oldest is None or newest_number(connection) - oldest < most_events:
        return {}
    numbers: dict[str | None, int] = {}
    for name in (*_names(connection), None):
        condition = _events_of(name)
        least, most = (
            connection.execute(select(end(events.c.number)).where(condition)).scalar()
            for end in (func.min, func.max)
        )
        if least is None or most is None or most - least < most_events:
            continue
        beyond = select(events.c.number).where(condition).order_by(events.c.number.desc())
        number = connection.execute(beyond.offset(most_events).limit(1)).scalar()
        if number is not None:
            numbers[name] = number
    return numbers


def removal_floor(
    connection: Connection, criteria: EventFilter, most_events: int, after: int
) -> int:
    """Return the number up to which events that match a filter may have been removed, or 0.

    Parameters
    ----------
    criteria : filter; its kinds are ignored
    most_events : maximum number of events per map
    after : position of the reader; results up to it may be returned as 0
    """
    if newest_number(connection) - most_events <= after:
        return 0  # too few events after that position
    numbers = removal_floors(connection, most_events)
    if criteria.maps is None:
        return max(numbers.values(), default=0)
    names = set(_names(connection))
    own = [numbers.get(name, 0) for name in criteria.maps & names]
    beginnings = _beginnings(connection, criteria)
    deleted = {
        name for name in criteria.maps - names
        if last_event(connection, name) > beginnings.get(name, 0)
    }  # fmt: skip
    return max([*own, *_former_floors(connection, deleted, numbers.get(None, 0))])


def _former_floors(connection: Connection, names: Collection[str], floor: int) -> Iterator[int]:
    """Yield 0, and the number up to which the events of each deleted map may have been removed.

    The events of all deleted maps are removed up to the same number, `floor`; the result for a map
    does not exceed its last event.
    """
    yield 0
    for name in names:
        last = last_event(connection, name)
        remaining = select(events.c.number).where(events.c.map == name).limit(1)
        # the common floor does not apply to a map whose last event was removed
        yield last if connection.execute(remaining).first() is None else min(floor, last)


def surplus_events(
    connection: Connection, most_events: int, anchors: Collection[int], limit: int
) -> list[int]:
    """Return the numbers of events to remove, map by map, oldest first.

    The anchor of an index is the last event of its map at the time of the build; without it, the
    index is invalid. Therefore, anchors of existing indexes remain, and so does the newest surplus
    event of each map, which may become the anchor of an index under construction.

    Parameters
    ----------
    most_events : maximum number of events per map
    anchors : numbers of events that must not be removed
    """
    numbers: list[int] = []
    for name, floor in removal_floors(connection, most_events).items():
        old = select(events.c.number).where(_events_of(name), events.c.number <= floor)
        stay = {number for number in anchors if number <= floor}
        if name is not None:
            stay.add(floor)
        most = limit - len(numbers) + len(stay)
        oldest = connection.execute(old.order_by(events.c.number).limit(most)).scalars()
        numbers += [number for number in oldest if number not in stay]
        if len(numbers) >= limit:
            break
    return numbers[:limit]


def remove_events(connection: Connection, numbers: Sequence[int]) -> None:
    """Remove the events with these numbers; see `surplus_events`."""
    for block in blocks(numbers):
        connection.execute(delete(events).where(among(connection, events.c.number, block)))


def _names(connection: Connection) -> list[str]:
    return list(connection.execute(select(maps.c.name)).scalars())


def _events_of(name: str | None) -> ColumnElement[bool]:
    """Return the SQL condition for events of a map; None selects events without an existing map."""
    if name is not None:
        return events.c.map == name
    return or_(events.c.map.is_(None), events.c.map.not_in(select(maps.c.name)))


# Former maps by name, with the number of their last event, and their quotas, which the next map of
# the same name inherits.

#: Maximum number of former maps without a quota.
MOST_FORMER = 10_000


def record_former_map(connection: Connection, row: MapRow) -> None:
    """Record the quotas and the last event of a removed map; call this after that event.

    The record replaces an earlier record of the same name. Of the records without quotas, only the
    newest `MOST_FORMER` remain.
    """
    last = select(func.max(events.c.number)).where(events.c.map == row.name)
    connection.execute(delete(former_maps).where(former_maps.c.name == row.name))
    connection.execute(
        insert(former_maps).values(
            name=row.name, number=connection.execute(last).scalar_one(),
            quota_frames=row.quota_frames, quota_bytes=row.quota_bytes,
        )
    )  # fmt: skip
    surplus = (
        select(former_maps.c.number)
        .where(_without_quota())
        .order_by(former_maps.c.number.desc())
        .offset(MOST_FORMER)
        .limit(1)
    )
    oldest = connection.execute(surplus).scalar()
    if oldest is not None:
        connection.execute(
            delete(former_maps).where(_without_quota(), former_maps.c.number <= oldest)
        )


def inherit_quota(connection: Connection, name: str) -> dict[str, float | None]:
    """Return the quotas of the former map of a name, and remove its record; {} without one."""
    statement = select(former_maps.c.quota_frames, former_maps.c.quota_bytes)
    row = connection.execute(statement.where(former_maps.c.name == name)).mappings().first()
    connection.execute(delete(former_maps).where(former_maps.c.name == name))
    return {} if row is None else dict(row)


def last_event(connection: Connection, name: str) -> int:
    """Return the number of the last event of a deleted map, or a lower bound if unknown."""
    number = connection.execute(
        select(former_maps.c.number).where(former_maps.c.name == name)
    ).scalar()
    if number is not None:
        return int(number)
    count, least = connection.execute(
        select(func.count(), func.min(former_maps.c.number)).where(_without_quota())
    ).one()
    return int(least) if count >= MOST_FORMER else 0


def _without_quota() -> ColumnElement[bool]:
    return former_maps.c.quota_frames.is_(None) & former_maps.c.quota_bytes.is_(None)
