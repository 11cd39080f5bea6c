"""What happened, in order: written in the transaction in which it happens.

writer of all  --record_event-->  events  <--number_events--  pending_events  <--  writer of a map

Numbers are in the order of the commits, so that who has read up to one never misses a smaller one.
Writers that have the turn to themselves give them. Writers of single maps commit at the same time,
and cannot: what they tell is pending until somebody numbers what is committed, one at a time. Of a
map, what is pending is in the order of its commits, as its writers take turns.
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
    """Write an event, and its line of the audit log where an actor made the change.

    Parameters
    ----------
    connection : of the transaction of the change
    kind : one of `KINDS` of the API
    map_name, frame_id, job_id : that it is about
    details : for the audit log alone
    data : more, by kind
    """
    record_events(connection, [event_values(kind, map_name, frame_id, job_id, data)], details)


def record_events(
    connection: Connection, found: Sequence[dict[str, Any]],
    details: Mapping[str, Any] | None = None,
) -> None:  # fmt: skip
    """Write events and their lines of the audit log, as `record_event`.

    Parameters
    ----------
    connection : of the transaction of the changes
    found : columns of each, see `event_values`
    details : for the audit log alone, of each
    """
    connection.execute(insert(events_table(connection)), found)
    append_lines(
        connection,
        [
            audit_values(
                one["kind"], one["map"],
                one["frame_id"] or one["data"].get("name") or one["job_id"],
                {**one["data"], **(details or {})},
            )
            for one in found
            if one["kind"] not in _DISCOVERIES
        ],
    )  # fmt: skip


#: Kinds of events that are no change by whoever happens to read the frame.
_DISCOVERIES = frozenset(("frame.damaged",))


def events_table(connection: Connection) -> Table:
    """Where a writer's events are inserted."""
    of_maps = connection.get_execution_options().get(MAPS_OPTION)
    return pending_events if of_maps else events


#: Seconds that who numbers events waits for another who does: a long transaction may be one.
NUMBERING_S = 1.0


def number_events(database: Database) -> None:
    """Give numbers to the events that are committed, before they are read.

    Where that cannot be done now, such as in a database that may only be read, those that are
    pending come later.
    """
    if not database.read_only:
        with suppress(UnusableStore):
            _number_pending(database)


def _number_pending(database: Database) -> None:
    """As `number_events`; UnusableStore where that cannot be done now."""
    if database.is_sqlite:
        return
    with database.read() as connection:
        if connection.execute(_PENDING).first() is None:
            return
    with database.write(turn=False) as connection:
        wait_ms = str(int(1000 * NUMBERING_S))
        connection.execute(select(func.set_config("lock_timeout", wait_ms, True)))
        connection.execute(select(func.number_pending_events()))


_PENDING = select(pending_events.c.number).limit(1)


def anchor_of_now(database: Database, map_name: str) -> str:
    """The last event of a map, as a mark of the state that it has now.

    It is later than all that was committed before this is called: what is pending has no number.

    Raises
    ------
    UnusableStore : the events that are pending cannot be numbered now.
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
    since : when whoever asks was first let in, seconds since 1970: of a map that was deleted before
        nothing is told, though another has its name; None: of those too
    """

    maps: frozenset[str] | None = None
    kinds: tuple[str, ...] = ()
    of_maps: bool = False
    since: float | None = None

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
        beginnings = _beginnings(connection, wanted)
        newest = select(func.max(events.c.number))
        of = [
            connection.execute(
                newest.where(events.c.map == one, events.c.number > beginnings.get(one, 0))
            )
            for one in wanted.maps
        ]
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

    `number_events` first finds those of writers of single maps.
    """
    order = events.c.number.desc() if newest_first else events.c.number
    asked = select(events).where(events.c.number > after).order_by(order).limit(limit)
    if before is not None:
        asked = asked.where(events.c.number < before)
    if wanted.maps is not None:
        asked = asked.where(_of_maps(wanted.maps, _beginnings(connection, wanted)))
    elif wanted.of_maps:
        asked = asked.where(events.c.map.is_not(None))
    if wanted.kinds:
        fits = [events.c.kind.startswith(one, autoescape=True) for one in wanted.kinds]
        asked = asked.where(or_(*fits))
    return [EventRow(**row) for row in connection.execute(asked).mappings()]


#: Maps with a beginning of their own that one statement asks about: SQLite bounds its depth.
_MOST_BEGINNINGS = 500
#: As the index of those says it; see `_LIVING` of `deletion`.
_DELETED: ColumnElement[bool] = events.c.kind == literal_column("'map.deleted'")


def _beginnings(connection: Connection, wanted: Wanted) -> dict[str, int]:
    """By map, the number after which its events begin for whoever asks, where a map of the name was
    deleted before it was let in.
    """
    if wanted.since is None or wanted.maps is None:
        return {}
    asked = (
        select(events.c.map, func.max(events.c.number))
        .where(_DELETED, events.c.map.in_(sorted(wanted.maps)), events.c.at < wanted.since)
        .group_by(events.c.map)
    )
    return {row[0]: int(row[1]) for row in connection.execute(asked)}


def _of_maps(names: Collection[str], beginnings: Mapping[str, int]) -> ColumnElement[bool]:
    """That an event is of one of some maps, and not of before its beginning."""
    whole = events.c.map.in_(sorted(set(names) - beginnings.keys()))
    if len(beginnings) > _MOST_BEGINNINGS:
        last = max(beginnings.values())
        return or_(whole, and_(events.c.map.in_(sorted(beginnings)), events.c.number > last))
    of = [
        and_(events.c.map == name, events.c.number > last)
        for name, last in sorted(beginnings.items())
    ]
    return or_(whole, *of)


def anchor_number(anchor: str) -> int | None:
    """Number of the event that an anchor marks; None where it is none."""
    number = anchor.partition(" ")[0]
    return int(number) if number.isascii() and number.isdigit() and len(number) < 19 else None


# Which events are kept: so many of each map, whatever happens in the others.


def floors(connection: Connection, kept: int) -> dict[str | None, int]:
    """By map, the number of the newest event that is no longer kept, where there is such a one.

    None stands for the events of no map and those of maps that are gone, taken together: nobody
    could bound what is kept of maps that are made and deleted for ever.

    Parameters
    ----------
    kept : newest events that stay of each map
    """
    oldest = connection.execute(select(func.min(events.c.number))).scalar()
    if oldest is None or newest_number(connection) - oldest < kept:
        return {}  # there are no more of all of them
    found: dict[str | None, int] = {}
    for name in (*_names(connection), None):
        of = _of(name)
        least, most = (
            connection.execute(select(end(events.c.number)).where(of)).scalar()
            for end in (func.min, func.max)
        )
        if least is None or most is None or most - least < kept:
            continue
        beyond = select(events.c.number).where(of).order_by(events.c.number.desc())
        number = connection.execute(beyond.offset(kept).limit(1)).scalar()
        if number is not None:
            found[name] = number
    return found


def floor_of(connection: Connection, wanted: Wanted, kept: int, after: int) -> int:
    """Number up to which events of those that are wanted may be gone; 0: all are there.

    Parameters
    ----------
    wanted : whose maps are looked at, and not its kinds
    kept : see `floors`
    after : only whether the answer is greater is asked for: most often that is known at once
    """
    if newest_number(connection) - kept <= after:
        return 0  # a map has no more events than there are numbers
    found = floors(connection, kept)
    if wanted.maps is None:
        return max(found.values(), default=0)
    names = set(_names(connection))
    own = [found.get(one, 0) for one in wanted.maps & names]
    beginnings = _beginnings(connection, wanted)
    gone = {
        name for name in wanted.maps - names
        if last_event(connection, name) > beginnings.get(name, 0)
    }  # fmt: skip
    return max([*own, *_floors_of_gone(connection, gone, found.get(None, 0))])


def _floors_of_gone(connection: Connection, names: Collection[str], floor: int) -> Iterator[int]:
    """As `floor_of`, of each of some maps that are gone: 0 first, so that there is one.

    Their events go together, and yet nothing is missed after the last of one's own.
    """
    yield 0
    for name in names:
        last = last_event(connection, name)
        left = select(events.c.number).where(events.c.map == name).limit(1)
        # the last of all that go together may be gone too: then no floor tells of them
        yield last if connection.execute(left).first() is None else min(floor, last)


def spent_numbers(
    connection: Connection, kept: int, anchors: Collection[int], limit: int
) -> list[int]:
    """Numbers of events that may be removed, map by map, the oldest of each first.

    An index is believed while the event is there that was the last of its map when it was made:
    its anchor. So of each map the last one stays of those that are old enough to go: an index
    that is being published has no other. And so do the anchors of indexes that are there.

    Parameters
    ----------
    kept : newest events of each map that stay
    anchors : numbers that stay too
    limit : at most so many
    """
    found: list[int] = []
    for name, floor in floors(connection, kept).items():
        old = select(events.c.number).where(_of(name), events.c.number <= floor)
        stay = {number for number in anchors if number <= floor}
        if name is not None:
            stay.add(floor)
        most = limit - len(found) + len(stay)
        oldest = connection.execute(old.order_by(events.c.number).limit(most)).scalars()
        found += [number for number in oldest if number not in stay]
        if len(found) >= limit:
            break
    return found[:limit]


def remove_events(connection: Connection, numbers: Sequence[int]) -> None:
    """Remove events; see `spent_numbers`."""
    for some in blocks(numbers):
        connection.execute(delete(events).where(among(connection, events.c.number, some)))


def _names(connection: Connection) -> list[str]:
    return list(connection.execute(select(maps.c.name)).scalars())


def _of(name: str | None) -> ColumnElement[bool]:
    """That an event is of a map; None: of none that is there."""
    if name is not None:
        return events.c.map == name
    gone = select(maps.c.name)
    return or_(events.c.map.is_(None), events.c.map.not_in(gone))


# What is remembered of maps that are gone, by their names.
#
# The number of its last event: who read on after that has missed nothing of it, whatever was
# removed of other maps since. And its quota, which the next map of the name inherits.

#: Names that are remembered, beside those with a quota: of older ones it is not known any more
#: when they went.
MOST_FORMER = 10_000


def remember(connection: Connection, row: MapRow) -> None:
    """Note a map that was just removed; its last event is told already."""
    last = select(func.max(events.c.number)).where(events.c.map == row.name)
    connection.execute(delete(former_maps).where(former_maps.c.name == row.name))
    connection.execute(
        insert(former_maps).values(
            name=row.name, number=connection.execute(last).scalar_one(),
            quota_frames=row.quota_frames, quota_bytes=row.quota_bytes,
        )
    )  # fmt: skip
    beyond = (
        select(former_maps.c.number)
        .where(_spent())
        .order_by(former_maps.c.number.desc())
        .offset(MOST_FORMER)
        .limit(1)
    )
    oldest = connection.execute(beyond).scalar()
    if oldest is not None:
        connection.execute(delete(former_maps).where(_spent(), former_maps.c.number <= oldest))


def inherited(connection: Connection, name: str) -> dict[str, float | None]:
    """The quota of the map that had a name before; from now on the new one has it."""
    asked = select(former_maps.c.quota_frames, former_maps.c.quota_bytes)
    found = connection.execute(asked.where(former_maps.c.name == name)).mappings().first()
    connection.execute(delete(former_maps).where(former_maps.c.name == name))
    return {} if found is None else dict(found)


def last_event(connection: Connection, name: str) -> int:
    """Number of the last event of a deleted map, or from which on it has none."""
    asked = select(former_maps.c.number).where(former_maps.c.name == name)
    found = connection.execute(asked).scalar()
    if found is not None:
        return int(found)
    count, least = connection.execute(
        select(func.count(), func.min(former_maps.c.number)).where(_spent())
    ).one()
    return int(least) if count >= MOST_FORMER else 0


def _spent() -> ColumnElement[bool]:
    return former_maps.c.quota_frames.is_(None) & former_maps.c.quota_bytes.is_(None)
