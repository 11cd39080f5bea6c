"""What operators and dashboards ask of a store: events, figures, models; and its housekeeping."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from sceneprint.engine.admin.statistics import Statistics, anchors
from sceneprint.engine.maps.maps import Catalogue
from sceneprint.engine.serializers import when
from sceneprint.errors import InvalidRequest, SceneprintError
from sceneprint.settings import Settings
from sceneprint.store import Database, Store
from sceneprint.store.events import (
    EventRow,
    Wanted,
    floor_of,
    list_events,
    newest_number,
    newest_seen,
    remove_events,
    spent_numbers,
)
from sceneprint.store.maps import find_map
from sceneprint.store.opaque_ids import OpaqueIds
from sceneprint.store.wakeup import Wakeup
from sceneprint_client.api.admin import MISSED, Event, EventPage

# Following events: where a reader begins, and what comes next.
#
# after  --begin-->  place  --read_on-->  events and the next place, again and again
#
# A place counts events of all maps, and stays in the process; what a reader is told of it is
# `seen`, the last event up to there that it may be told.


class EventSlice(NamedTuple):
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


def begin(database: Database, wanted: Wanted, kept: int, after: int | None) -> EventSlice:
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
        return EventSlice([], newest, seen)
    if after > newest:  # the database was put back to an earlier state
        return EventSlice([missed(seen)], newest, seen)
    return EventSlice([missed(after)] if lost else [], after, after)


def next_events(database: Database, wanted: Wanted, place: int, most: int) -> EventSlice:
    """The next events."""
    with database.read() as connection:
        newest = newest_number(connection)
        found = list_events(connection, wanted, after=place, limit=most)
        if len(found) == most:
            return EventSlice(found, found[-1].number, found[-1].number)
        return EventSlice(found, max(newest, place), newest_seen(connection, wanted))


def missed(place: int) -> EventRow:
    """Stands before what is still there."""
    return EventRow(place, time.time(), MISSED, None, None, None, {})


log = logging.getLogger(__name__)

#: Seconds between two looks for events that are no longer kept, and how many are removed in one
#: commit, and after one look.
TIDY_S = 60.0
AT_ONCE, AT_MOST = 2_000, 20_000
#: Most beginnings of kinds that may be asked for.
MOST_KINDS = 20


class OperatorTasks:
    """Events, figures and models of one store."""

    def __init__(self, store: Store, settings: Settings, bell: Wakeup) -> None:
        self._store, self._settings = store, settings
        self.statistics = Statistics(store, settings, bell)
        self.catalogue = Catalogue(store.database)
        self._tidied = time.monotonic()

    def wanted(self, map_name: str | None = None, kinds: Sequence[str] = ()) -> Wanted:
        """Which events are meant.

        Parameters
        ----------
        map_name : only of this map
        kinds : beginnings of the kinds; none: all

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : too many kinds, or one that cannot be one.
        """
        if len(kinds) > MOST_KINDS or not all(re.fullmatch(r"[a-z_.]{1,32}", k) for k in kinds):
            raise InvalidRequest(
                f"The kinds {', '.join(kinds)!r:.80} are not valid. Give up to {MOST_KINDS} "
                "prefixes of event kinds, such as frame. or frame.indexed.",
                (("kind", "not an event kind"),),
            )
        if map_name is None:
            return Wanted(None, tuple(kinds))
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
        return Wanted(frozenset((row.name,)), tuple(kinds))

    def events(
        self, wanted: Wanted, *, after: str | None = None, cursor: str | None = None,
        limit: int = 100, newest_first: bool = False,
    ) -> EventPage:  # fmt: skip
        """A page of events.

        Parameters
        ----------
        wanted : which
        after : only those that followed the event of this id
        cursor : `next_cursor` of the page before
        limit : at most so many
        newest_first : else the oldest first

        Raises
        ------
        InvalidRequest : a cursor that was not given out, or no id of an event.
        """
        seals, before = self._store.seals, None
        least = 0 if after is None else seals.event(after)
        place = seals.row("event", cursor)
        if place is not None:
            least, before = (least, place) if newest_first else (max(least, place), None)
        with self._store.database.read() as connection:
            newest = newest_seen(connection, wanted)
            found = list_events(
                connection, wanted, after=least, before=before, limit=limit + 1,
                newest_first=newest_first,
            )  # fmt: skip
        items = [event_record(seals, one) for one in found[:limit]]
        more = items[-1].id if len(found) > limit else None
        return EventPage(items=items, next_cursor=more, newest=seals.seal("event", newest))

    def tidy(self) -> int:
        """Remove events that are no longer kept, if it is time; returns how many.

        Where that cannot be written, nothing is lost: it is tried again the next time.
        """
        if time.monotonic() - self._tidied < TIDY_S:
            return 0
        self._tidied = time.monotonic()
        try:
            return self.remove_spent()
        except SceneprintError as error:
            log.warning("event removal failed", extra={"error": str(error)})
            return 0

    def remove_spent(self) -> int:
        """Remove events that are no longer kept, a few at a time; returns how many."""
        removed, indexes = 0, Path(self._settings.indexes)
        while removed < AT_MOST:
            with self._store.database.read() as connection:  # most often there is none: no lock
                if not spent_numbers(connection, self._settings.events_kept, (), 1):
                    break
                numbers = spent_numbers(
                    connection, self._settings.events_kept, anchors(indexes), AT_ONCE
                )
            if numbers:
                with self._store.database.write() as connection:
                    remove_events(connection, numbers)
            removed += len(numbers)
            if len(numbers) < AT_ONCE:
                break
        return removed


def event_record(seals: OpaqueIds, row: EventRow) -> Event:
    """An event as JSON tells it."""
    return Event(
        id=seals.seal("event", row.number),
        at=when(row.at),
        kind=row.kind,
        map=row.map,
        frame_id=row.frame_id,
        job_id=row.job_id,
        data=row.data,
    )
