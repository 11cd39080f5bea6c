"""Events, audit log, keys and tenants of a store, and removal of expired rows."""

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

from sceneprint.engine.admin.statistics import anchors
from sceneprint.engine.serializers import copy_fields, when
from sceneprint.errors import InvalidRequest, SceneprintError
from sceneprint.process import COMMAND, Actor
from sceneprint.settings import Settings
from sceneprint.store import Database, Store, audit_log, tenants
from sceneprint.store import keys as stored
from sceneprint.store.audit_log import AuditFilter, AuditRow
from sceneprint.store.deletion import DAY_S, remove_in_blocks
from sceneprint.store.events import (
    EventFilter,
    EventRow,
    list_events,
    newest_number,
    newest_selected,
    number_events,
    removal_floor,
    remove_events,
    surplus_events,
)
from sceneprint.store.maps import find_map
from sceneprint.store.opaque_ids import OpaqueIds, invalid_cursor
from sceneprint.store.queue import read_clock
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

# Event streams.
#
# after  --begin-->  place  --next_events-->  events and the next place, repeatedly
# A place is an event number, counted across all maps. Readers do not receive it; they receive
# `seen`, the number of the last event that they may read.


class EventSlice(NamedTuple):
    """A slice of the event stream of a reader.

    Parameters
    ----------
    place : number of the last event read, from any map
    seen : number of the last event up to `place` that the reader may read
    """

    events: list[EventRow]
    place: int
    seen: int


def begin(
    database: Database, event_filter: EventFilter, minimum: int, after: int | None
) -> EventSlice:
    """Start an event stream at `after`, or with new events if `after` is None.

    The result has no events, except a `missed` event if the reader missed events that were removed,
    or that a restore of the database lost.

    Parameters
    ----------
    minimum : number of newest events per map that are never removed
    after : number of the last event that the reader has received
    """
    number_events(database)
    with database.read() as connection:
        newest = newest_number(connection)
        seen = newest_selected(connection, event_filter)
        lost = after is not None and removal_floor(connection, event_filter, minimum, after) > after
    if after is None:
        return EventSlice([], newest, seen)
    if after > newest:  # the database was restored to an earlier state
        return EventSlice([missed(seen)], newest, seen)
    return EventSlice([missed(after)] if lost else [], after, after)


def next_events(database: Database, event_filter: EventFilter, place: int, most: int) -> EventSlice:
    """Assign numbers to pending events; return up to `most` events after `place`, oldest first."""
    number_events(database)
    with database.read() as connection:
        newest = newest_number(connection)
        rows = list_events(connection, event_filter, after=place, limit=most)
        if len(rows) == most:
            return EventSlice(rows, rows[-1].number, rows[-1].number)
        return EventSlice(rows, max(newest, place), newest_selected(connection, event_filter))


def missed(place: int) -> EventRow:
    """Return a `missed` event, which states that events after `place` were removed unread."""
    return EventRow(place, time.time(), MISSED, None, None, None, {})


log = logging.getLogger(__name__)

#: Seconds between removals of old events, and maximum number of events per removal.
TIDY_S = 60.0
AT_MOST = 20_000
#: Maximum number of event kind prefixes in a request.
MOST_KINDS = 20


class Events:
    """The events of a store: pages of them, and removal of old ones."""

    def __init__(self, store: Store, settings: Settings) -> None:
        self._store, self._settings = store, settings
        self._tidied = time.monotonic()

    def wanted(self, map_name: str | None = None, kinds: Sequence[str] = ()) -> EventFilter:
        """Check the map and the kinds of a request, and return them as an event filter.

        Parameters
        ----------
        map_name : map of the events; None selects all maps
        kinds : prefixes of event kinds, such as `frame.`; an empty sequence selects all kinds

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If there are more than MOST_KINDS kinds, or a kind is malformed.
        """
        if len(kinds) > MOST_KINDS or not all(re.fullmatch(r"[a-z_.]{1,32}", k) for k in kinds):
            raise InvalidRequest(
                f"The kinds {', '.join(kinds)!r:.80} are not valid. Pass up to {MOST_KINDS} "
                "prefixes of event kinds, such as frame. or frame.indexed.",
                (("kind", "not an event kind"),),
            )
        if map_name is None:
            return EventFilter(None, tuple(kinds))
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
        return EventFilter(frozenset((row.name,)), tuple(kinds))

    def page(
        self, event_filter: EventFilter, *, after: str | None = None, cursor: str | None = None,
        limit: int = 100, newest_first: bool = False,
    ) -> EventPage:  # fmt: skip
        """Return a page of events.

        Parameters
        ----------
        after : id of an event; the page contains only later events
        cursor : `next_cursor` of the previous page
        limit : maximum number of events
        newest_first : whether to sort the events from new to old

        Raises
        ------
        InvalidRequest : If the service did not issue the cursor or the event id.
        """
        seals, before = self._store.seals, None
        least = 0 if after is None else seals.event(after)
        place = seals.row("event", cursor)
        if place is not None:
            least, before = (least, place) if newest_first else (max(least, place), None)
        number_events(self._store.database)
        with self._store.database.read() as connection:
            newest = newest_selected(connection, event_filter)
            rows = list_events(
                connection, event_filter, after=least, before=before, limit=limit + 1,
                newest_first=newest_first,
            )  # fmt: skip
        items = [event_record(seals, row) for row in rows[:limit]]
        more = items[-1].id if len(rows) > limit else None
        return EventPage(items=items, next_cursor=more, newest=seals.seal("event", newest))

    def tidy(self) -> int:
        """Remove old events and idempotency keys, at most every TIDY_S seconds; return the number
        of removed events.

        Errors are logged; a later call retries.
        """
        if time.monotonic() - self._tidied < TIDY_S:
            return 0
        self._tidied = time.monotonic()
        try:
            stored.remove_old_requests(self._store.database)
            return self.remove_surplus()
        except SceneprintError as error:
            log.warning("event removal failed", extra={"error": str(error)})
            return 0

    def remove_surplus(self) -> int:
        """Remove events beyond each map's limit, except anchors of indexes; return their number."""
        most_events, indexes = self._settings.events_per_map, Path(self._settings.indexes)

        def spent(connection: Connection, limit: int) -> list[int]:
            if not surplus_events(connection, most_events, (), 1):
                return []  # in the usual case, avoid reading the indexes
            return surplus_events(connection, most_events, anchors(indexes), limit)

        return remove_in_blocks(self._store.database, spent, remove_events, AT_MOST)


def event_record(seals: OpaqueIds, row: EventRow) -> Event:
    """Return the API record of an event."""
    return copy_fields(Event, row, id=seals.seal("event", row.number), at=when(row.at))


#: Seconds between removals of expired lines of the audit log.
PRUNE_S = 3600.0
#: Number of audit lines read in one transaction.
_BLOCK = 1000


class Audit:
    """The audit log of a store.

    Parameters
    ----------
    days : age in days at which lines are removed
    """

    def __init__(self, store: Store, days: float) -> None:
        self._store, self._lifetime_s = store, DAY_S * days
        self._pruned = time.monotonic() - PRUNE_S

    def record_refusal(
        self, actor: Actor, tenant: str, map_name: str | None, target: str | None, request_id: str,
        **data: Any,
    ) -> None:  # fmt: skip
        """Write a line for a refused request; see `audit_log.record_refusal`."""
        with self._store.database.write(turn=False) as connection:
            audit_log.record_refusal(
                connection, actor, tenant, map_name, target, request_id, **data
            )

    def record(
        self, action: str, map_name: str | None = None, target: str | None = None, **data: Any
    ) -> None:
        """Write a line for a change that is not made by a single database transaction."""
        with self._store.database.write(turn=False) as connection:
            audit_log.record_change(connection, action, map_name, target, **data)

    def tidy(self, now: float | None = None) -> int:
        """Remove expired lines, at most every PRUNE_S seconds, unless the store is read-only;
        return the number of removed lines.

        Errors are logged; a later call retries.

        Parameters
        ----------
        now : current time, seconds since 1970; None reads the clock of the database
        """
        if time.monotonic() - self._pruned < PRUNE_S or self._store.database.read_only:
            return 0
        self._pruned = time.monotonic()

        def spent(connection: Connection, limit: int) -> list[int]:
            before = (read_clock(connection) if now is None else now) - self._lifetime_s
            return audit_log.surplus_lines(connection, before, limit)

        try:
            return remove_in_blocks(self._store.database, spent, audit_log.remove_lines, AT_MOST)
        except SceneprintError as error:
            log.warning("audit entries not removed", extra={"error": str(error)})
            return 0

    def lines(self, audit_filter: AuditFilter) -> Iterator[AuditLine]:
        """Yield the lines that pass a filter, oldest first."""
        after = 0
        while True:  # one transaction per block, since the consumer may be slow
            with self._store.database.read() as connection:
                block = audit_log.list_lines(connection, audit_filter, _BLOCK, after=after)
            if not block:
                return
            yield from map(_audit_line, block)
            after = block[-1].number

    def page(
        self, audit_filter: AuditFilter, cursor: str | None = None, limit: int = 100
    ) -> Page[AuditLine]:
        """Return a page of the lines that pass a filter, newest first.

        Raise InvalidRequest if the service did not issue the cursor.
        """
        seals = self._store.seals
        before = seals.row("audit", cursor)
        with self._store.database.read() as connection:
            rows = audit_log.list_lines(connection, audit_filter, limit + 1, before=before)
        more = seals.next_cursor("audit", [row.number for row in rows], limit)
        return Page[AuditLine](items=[_audit_line(row) for row in rows[:limit]], next_cursor=more)


def _audit_line(row: AuditRow) -> AuditLine:
    return copy_fields(AuditLine, row, at=when(row.at), actor=row.actor or None)


def create_key(
    store: Store, name: str, grants: Mapping[str, Scope] | None = None,
    expires_at: datetime | None = None, tenant: str | None = None,
) -> MadeKey:  # fmt: skip
    """Create a key, and return it with its secret, of which only a hash is stored.

    Parameters
    ----------
    grants : scope by map name, where `*` stands for all maps; None grants `admin` on all maps
    expires_at : time, with a time zone, at which the key expires; None for no expiry
    tenant : name of the owner; None selects the tenant with the name of the key, which is created
        if it does not exist

    Raises
    ------
    InvalidRequest : If the name is empty, too long, not printable or reserved, a map name is
        malformed, or `expires_at` is out of range.
    Conflict : If the name is in use.
    UnknownTenant : If `tenant` does not exist.
    """
    _check_name(name, "key")
    granted: dict[str, Scope] = dict(grants or {EVERY: "admin"})
    for pattern in granted:
        if not re.fullmatch(MAP_OR_EVERY, pattern):
            raise InvalidRequest(
                f"{pattern!r:.80} is not a valid map name. Use names of maps, or * for all maps.",
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
    InvalidRequest : If the name is empty, too long, not printable or reserved.
    Conflict : If the name is in use.
    """
    _check_name(name, "tenant")
    with store.database.write() as connection:
        tenants.create_tenant(connection, name)
        audit_log.record_change(connection, "tenant.created", target=name)


def delete_tenant(store: Store, name: str) -> None:
    """Delete a tenant without keys.

    Raises
    ------
    UnknownTenant, Conflict : See `tenants.delete_tenant`.
    """
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


#: Default and maximum validity of the old secret after a rotation, seconds.
OVERLAP_S, MOST_OVERLAP_S = 3600.0, 30 * 86_400.0


def revoke_key(store: Store, name: str) -> None:
    """Revoke a key; raise UnknownKey if it does not exist."""
    with store.database.write() as connection:
        stored.revoke_key(connection, name)


def rotate_key(store: Store, name: str, overlap_s: float = OVERLAP_S) -> MadeKey:
    """Replace the secret of a key; return the key with its new secret.

    Parameters
    ----------
    overlap_s : seconds for which the old secret remains valid

    Raises
    ------
    InvalidRequest : If `overlap_s` is negative or longer than 30 days.
    UnknownKey : If the key does not exist.
    """
    if not 0 <= overlap_s <= MOST_OVERLAP_S:
        raise InvalidRequest(
            f"An overlap of {overlap_s:g} s is not between 0 s and 30 days. Choose a shorter "
            "overlap.",
            (("overlap_s", "not between 0 and 2592000"),),
        )
    with store.database.write() as connection:
        secret = stored.rotate_key(connection, name, overlap_s)
        row = stored.find_named_key(connection, name)
    return MadeKey(secret=secret, **_key_record(row).model_dump())


def list_keys(store: Store, cursor: str | None = None, limit: int = 100) -> Page[Key]:
    """Return a page of keys, sorted by name.

    Raise InvalidRequest if the service did not issue the cursor.
    """
    after = None if cursor is None else _name_of(cursor)
    with store.database.read() as connection:
        rows = stored.list_keys(connection, after, limit + 1)
    last = rows[limit - 1].name.encode() if len(rows) > limit else None
    more = None if last is None else base64.urlsafe_b64encode(last).decode()
    items = [_key_record(row) for row in rows[:limit]]
    return Page[Key](items=items, next_cursor=more)


def _until(expires_at: datetime) -> float:
    """Convert a time to seconds since 1970; raise InvalidRequest outside the years 1 to 9999."""
    seconds = expires_at.timestamp()
    try:
        datetime.fromtimestamp(seconds, UTC)
    except (ValueError, OverflowError) as error:  # out of range after conversion or rounding
        raise InvalidRequest(
            f"{expires_at.isoformat()} is not within the years 1 to 9999 of UTC. Omit expires_at "
            "to create a key that does not expire.",
            (("expires_at", "not within the years 1 to 9999 of UTC"),),
        ) from error
    return seconds


def _key_record(row: stored.KeyRow) -> Key:
    previous = row.previous_until if (row.previous_until or 0) > time.time() else None
    return copy_fields(
        Key, row, created_at=when(row.created_at), expires_at=when(row.expires_at),
        previous_until=when(previous), last_used_at=when(row.last_used_at),
    )  # fmt: skip


def _name_of(cursor: str) -> str:
    try:
        return base64.urlsafe_b64decode(cursor.encode()).decode()
    except (binascii.Error, UnicodeError) as error:
        raise invalid_cursor(cursor) from error
