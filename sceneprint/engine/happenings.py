"""Following events: where a reader begins, and what comes next.

after  --begin-->  place  --read_on-->  events and the next place, again and again
"""

from __future__ import annotations

import time

from sceneprint.schemas.events import MISSED
from sceneprint.store import Database
from sceneprint.store.events import EventRow, Wanted, list_events, newest_number


def begin(database: Database, kept: int, after: int | None) -> tuple[int, list[EventRow]]:
    """The number from which a reader goes on, and what it must be told first.

    Parameters
    ----------
    database : that has the events
    kept : newest events that are there for sure
    after : number of the last event that the reader has had; None: it wants those from now on
    """
    with database.read() as connection:
        newest = newest_number(connection)
    floor = max(newest - kept, 0)
    if after is None:
        return newest, []
    if floor <= after <= newest:
        return after, []
    # removed long ago; or the database was put back to an earlier state
    place = floor if after < floor else newest
    return place, [EventRow(place, time.time(), MISSED, None, None, None, {"after": after})]


def read_on(
    database: Database, wanted: Wanted, place: int, most: int
) -> tuple[list[EventRow], int]:
    """The next events, and the number up to which these are all."""
    with database.read() as connection:
        newest = newest_number(connection)
        found = list_events(connection, wanted, after=place, limit=most)
    return found, found[-1].number if len(found) == most else max(newest, place)
