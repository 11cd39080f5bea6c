"""Which events are kept: so many of each map, whatever happens in the others."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

from sqlalchemy import ColumnElement, Connection, delete, func, or_, select

from sceneprint.store.batching import among, blocks
from sceneprint.store.events import Wanted, newest_number
from sceneprint.store.quotas import last_event
from sceneprint.store.tables import events, maps


def floors(connection: Connection, kept: int) -> dict[str | None, int]:
    """By map, the number of the newest event that is no longer kept, where there is such a one.

    None stands for the events of no map and those of maps that are gone, taken together: nobody
    could bound what is kept of maps that are made and deleted for ever.

    Parameters
    ----------
    connection : of the database
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
    connection : of the database
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
    return max([*own, *_floors_of_gone(connection, wanted.maps - names, found.get(None, 0))])


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
    connection : of the database
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
