"""What operators and dashboards ask of a store: events, figures, models; and its housekeeping."""

from __future__ import annotations

import base64
import binascii
import logging
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from sqlalchemy import Connection

from sceneprint.engine.admin.statistics import Statistics, anchors
from sceneprint.engine.maps.map_lifecycle import Catalogue
from sceneprint.engine.serializers import when
from sceneprint.errors import InvalidRequest, SceneprintError
from sceneprint.process import COMMAND, Actor
from sceneprint.settings import Settings
from sceneprint.store import Database, Store, audit_log, tenants
from sceneprint.store import keys as stored
from sceneprint.store.audit_log import AuditFilter, AuditRow
from sceneprint.store.deletion import DAY_S, remove_in_blocks
from sceneprint.store.events import (
    EventRow,
    Wanted,
    floor_of,
    list_events,
    newest_number,
    newest_seen,
    number_events,
    remove_events,
    spent_numbers,
)
from sceneprint.store.maps import find_map
from sceneprint.store.opaque_ids import OpaqueIds, invalid_cursor
from sceneprint.store.queue import read_clock
from sceneprint.store.wakeup import Wakeup
from sceneprint_client.api import Page
from sceneprint_client.api.admin import (
    EVERY,
    MISSED,
    AuditLine,
    Event,
    EventPage,
    Key,
    MadeKey,
    Scope,
)
from sceneprint_client.api.base import MAP_OR_EVERY

# Following events: where a reader begins, and what comes next.
#
# after  --begin-->  place  --next_events-->  events and the next place, again and again
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
    number_events(database)
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
    number_events(database)
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

#: Seconds between two looks for events that are no longer kept, and how many are removed after one.
TIDY_S = 60.0
AT_MOST = 20_000
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
        number_events(self._store.database)
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
        """Remove events that are no longer kept, if it is time; returns how many. Requests whose
        keys are not remembered any more go with them.

        Where that cannot be written, nothing is lost: it is tried again the next time.
        """
        if time.monotonic() - self._tidied < TIDY_S:
            return 0
        self._tidied = time.monotonic()
        try:
            stored.remove_old_requests(self._store.database)
            return self.remove_spent()
        except SceneprintError as error:
            log.warning("event removal failed", extra={"error": str(error)})
            return 0

    def remove_spent(self) -> int:
        """Remove events that are no longer kept, a few at a time; returns how many."""
        kept, indexes = self._settings.events_kept, Path(self._settings.indexes)

        def spent(connection: Connection, limit: int) -> list[int]:
            if not spent_numbers(connection, kept, (), 1):
                return []  # most often: no index is looked at
            return spent_numbers(connection, kept, anchors(indexes), limit)

        return remove_in_blocks(self._store.database, spent, remove_events, AT_MOST)


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


# Who changed what.

#: Seconds between two looks for lines that are no longer kept.
PRUNE_S = 3600.0
#: Lines that are read at once.
_BLOCK = 1000


class Audit:
    """The audit log of one store.

    Parameters
    ----------
    kept_days : after which a line is removed
    """

    def __init__(self, store: Store, kept_days: float) -> None:
        self._store, self._kept_s = store, DAY_S * kept_days
        self._pruned = time.monotonic() - PRUNE_S

    def record_refusal(
        self, actor: Actor, tenant: str, map_name: str | None, target: str | None, request_id: str,
        **data: Any,
    ) -> None:  # fmt: skip
        """Write a line for a request that was refused; see `audit_log.record_refusal`."""
        with self._store.database.write(turn=False) as connection:
            audit_log.record_refusal(
                connection, actor, tenant, map_name, target, request_id, **data
            )

    def record(
        self, action: str, map_name: str | None = None, target: str | None = None, **data: Any
    ) -> None:
        """Write a line for a change outside of the database, or in many transactions."""
        with self._store.database.write(turn=False) as connection:
            audit_log.record_change(connection, action, map_name, target, **data)

    def tidy(self, now: float | None = None) -> int:
        """Remove expired lines if the last removal was long enough ago; return their number.

        Errors are logged, and the next call tries again.

        Parameters
        ----------
        now : seconds since 1970; default: by the clock of the database
        """
        if time.monotonic() - self._pruned < PRUNE_S or self._store.database.read_only:
            return 0
        self._pruned = time.monotonic()

        def spent(connection: Connection, limit: int) -> list[int]:
            before = (read_clock(connection) if now is None else now) - self._kept_s
            return audit_log.spent_lines(connection, before, limit)

        try:
            return remove_in_blocks(self._store.database, spent, audit_log.remove_lines, AT_MOST)
        except SceneprintError as error:
            log.warning("audit entries not removed", extra={"error": str(error)})
            return 0

    def lines(self, wanted: AuditFilter) -> Iterator[AuditLine]:
        """Yield all lines, the oldest first."""
        after = 0
        while True:  # whoever takes them may be slow, and no transaction waits for that
            with self._store.database.read() as connection:
                block = audit_log.list_lines(connection, wanted, _BLOCK, after=after)
            if not block:
                return
            yield from map(_audit_line, block)
            after = block[-1].number

    def page(
        self, wanted: AuditFilter, cursor: str | None = None, limit: int = 100
    ) -> Page[AuditLine]:
        """Return a page of lines, the newest first.

        Raises
        ------
        InvalidRequest : a cursor that was not given out.
        """
        seals = self._store.seals
        before = seals.row("audit", cursor)
        with self._store.database.read() as connection:
            found = audit_log.list_lines(connection, wanted, limit + 1, before=before)
        more = seals.next_cursor("audit", [one.number for one in found], limit)
        return Page[AuditLine](items=[_audit_line(one) for one in found[:limit]], next_cursor=more)


def _audit_line(row: AuditRow) -> AuditLine:
    values = vars(row) | {"at": when(row.at), "actor": row.actor or None}
    return AuditLine.model_validate(values)


def create_key(
    store: Store, name: str, grants: Mapping[str, Scope] | None = None,
    expires_at: datetime | None = None, tenant: str | None = None,
) -> MadeKey:  # fmt: skip
    """Make a key; its secret is shown this once.

    Parameters
    ----------
    grants : scope by name of a map, `*` for all; default: admin of all
    expires_at : when it opens nothing any more, with a zone; default: never
    tenant : whom it belongs to; default: one of the key's name

    Raises
    ------
    InvalidRequest : the name is empty, too long, not printable or taken by us; or a name of a map
        that none can have; or `expires_at` is beyond what a date can say.
    Conflict : there is a key of that name.
    UnknownTenant : there is no such tenant.
    """
    _check_name(name, "key")
    granted: dict[str, Scope] = dict(grants or {EVERY: "admin"})
    for one in granted:
        if not re.fullmatch(MAP_OR_EVERY, one):
            raise InvalidRequest(
                f"{one!r:.80} is not a valid map name. Give map names, or * for all maps.",
                (("grants", "not a map name"),),
            )
    until = None if expires_at is None else _until(expires_at)
    with store.database.write() as connection:
        secret = stored.create_key(connection, name, granted, until, tenant)
        row = stored.find_key(connection, secret)
    assert row is not None
    return MadeKey(secret=secret, **_key_record(row).model_dump())


def create_tenant(store: Store, name: str) -> None:
    """Create a tenant without keys.

    Raises
    ------
    InvalidRequest : the name is empty, too long, not printable or taken by us.
    Conflict : there is a tenant of that name.
    """
    _check_name(name, "tenant")
    with store.database.write() as connection:
        tenants.create_tenant(connection, name)
        audit_log.record_change(connection, "tenant.created", target=name)


def delete_tenant(store: Store, name: str) -> None:
    """Delete a tenant that has no key; UnknownTenant, Conflict."""
    with store.database.write() as connection:
        tenants.delete_tenant(connection, name)
        audit_log.record_change(connection, "tenant.deleted", target=name)


def _check_name(name: str, of: str) -> None:
    if not (0 < len(name) <= 128 and name.isprintable()) or name == COMMAND:
        raise InvalidRequest(
            f"{name!r:.80} is not a valid {of} name. Use up to 128 printable characters, but not "
            f"{COMMAND!r}.",
            (("name", "not printable, empty, too long or reserved"),),
        )


#: Seconds for which a secret works after its rotation, unless told otherwise, and at most.
OVERLAP_S, MOST_OVERLAP_S = 3600.0, 30 * 86_400.0


def rotate_key(store: Store, name: str, overlap_s: float = OVERLAP_S) -> MadeKey:
    """Give a key a new secret, shown this once; the one before works for a while longer.

    Parameters
    ----------
    overlap_s : seconds; 0: the one before ends now

    Raises
    ------
    InvalidRequest : `overlap_s` is negative, or more than 30 days.
    UnknownKey : there is none of that name.
    """
    if not 0 <= overlap_s <= MOST_OVERLAP_S:
        raise InvalidRequest(
            f"An overlap of {overlap_s:g} s is not within 0 s and 30 days. Choose a shorter one.",
            (("overlap_s", "not within 0 and 2592000"),),
        )
    with store.database.write() as connection:
        secret = stored.rotate_key(connection, name, overlap_s)
        row = stored.find_named_key(connection, name)
    return MadeKey(secret=secret, **_key_record(row).model_dump())


def list_keys(store: Store, cursor: str | None = None, limit: int = 100) -> Page[Key]:
    """Keys by name.

    Raises
    ------
    InvalidRequest : a cursor that was not given out.
    """
    after = None if cursor is None else _name_of(cursor)
    with store.database.read() as connection:
        found = stored.list_keys(connection, after, limit + 1)
    last = found[limit - 1].name.encode() if len(found) > limit else None
    more = None if last is None else base64.urlsafe_b64encode(last).decode()
    items = [_key_record(row) for row in found[:limit]]
    return Page[Key](items=items, next_cursor=more)


def _until(expires_at: datetime) -> float:
    """Seconds since 1970, that are a date again when the key is told of."""
    seconds = expires_at.timestamp()
    try:
        datetime.fromtimestamp(seconds, UTC)
    except (ValueError, OverflowError) as error:  # of another zone, or rounded up
        raise InvalidRequest(
            f"{expires_at.isoformat()} is not within the years 1 to 9999 of UTC. Leave expires_at "
            "out for a key that does not expire.",
            (("expires_at", "not within the years 1 to 9999 of UTC"),),
        ) from error
    return seconds


def _key_record(row: stored.KeyRow) -> Key:
    now = time.time()
    return Key(
        name=row.name,
        grants=row.grants,
        created_at=when(row.created_at),
        expires_at=when(row.expires_at),
        tenant=row.tenant,
        # when it has passed, it is of no more interest
        previous_until=when(row.previous_until) if (row.previous_until or 0) > now else None,
        last_used_at=when(row.last_used_at),
    )


def _name_of(cursor: str) -> str:
    try:
        return base64.urlsafe_b64decode(cursor.encode()).decode()
    except (binascii.Error, UnicodeError) as error:
        raise invalid_cursor(cursor) from error
