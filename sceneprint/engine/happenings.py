"""Following events: where a reader begins, and what comes next.

after  --begin-->  place  --read_on-->  events and the next place, again and again

A place counts events of all maps, and stays in the process; what a reader is told of it is
`seen`, the last event up to there that it may be told.
"""

from __future__ import annotations

import time
from typing import NamedTuple

from sceneprint.schemas.events import MISSED
from sceneprint.store import Database
from sceneprint.store.events import EventRow, Wanted, list_events, newest_number, newest_seen
from sceneprint.store.retention import floor_of


class Part(NamedTuple):
    """What comes next to a reader.

    Parameters
    ----------
    found : events
    place : number up to which these are all
    seen : the last number up to there that the reader may know
    """

    found: list[EventRow]
    place: int
    seen: int


def begin(database: Database, wanted: Wanted, kept: int, after: int | None) -> Part:
    """Where a reader goes on from, and what it must be told first.

    Parameters
    ----------
    database : that has the events
    wanted : by the reader
    kept : newest events of each map that are there for sure
    after : number of the last event that the reader has had; None: it wants those from now on
    """
    with database.read() as connection:
        newest = newest_number(connection)
        seen = newest_seen(connection, wanted)
        lost = after is not None and floor_of(connection, wanted, kept, after) > after
    if after is None:
        return Part([], newest, seen)
    if after > newest:  # the database was put back to an earlier state
        return Part([missed(seen)], newest, seen)
    return Part([missed(after)] if lost else [], after, after)


def read_on(database: Database, wanted: Wanted, place: int, most: int) -> Part:
    """The next events."""
    with database.read() as connection:
        newest = newest_number(connection)
        found = list_events(connection, wanted, after=place, limit=most)
        if len(found) == most:
            return Part(found, found[-1].number, found[-1].number)
        return Part(found, max(newest, place), newest_seen(connection, wanted))


def missed(place: int) -> EventRow:
    """Stands before what is still there."""
    return EventRow(place, time.time(), MISSED, None, None, None, {})
