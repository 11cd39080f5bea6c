"""Client methods for operators: keys, audit log, events, statistics and models."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping, Sequence
from datetime import datetime
from urllib.parse import quote

from sceneprint_client.api import Page
from sceneprint_client.api.admin import (
    AuditLine,
    Event,
    EventPage,
    Key,
    MadeKey,
    Me,
    ModelInfo,
    NewKey,
    Scope,
    Stats,
)
from sceneprint_client.api.base import checked
from sceneprint_client.calls import Call, Series
from sceneprint_client.http import PAGE, without_none
from sceneprint_client.jobs import JobMethods

_EVENTS = "/v1/events"


class AdminMethods(JobMethods):
    """Client methods for keys, events, statistics and models."""

    @Call
    async def create_key(
        self, name: str, grants: Mapping[str, Scope], expires_at: datetime | None = None,
        tenant: str | None = None,
    ) -> MadeKey:  # fmt: skip
        """Create a key. Only the returned record contains its secret.

        Parameters
        ----------
        name : unique name of the key
        grants : scope for each map name: `read`, `write` or `admin`; `*` selects all maps
        expires_at : expiry time with a time zone; default: the key does not expire
        tenant : existing tenant that owns the key; default: a new tenant with the key's name

        Raises
        ------
        InvalidRequest : If the name or a grant is invalid.
        Conflict : If a key of that name exists.
        UnknownTenant : If the tenant does not exist.
        Forbidden : If this client's key does not have `admin` for `*`.
        """
        new = checked(
            NewKey, "The key", name=name, grants=dict(grants), expires_at=expires_at,
            tenant=tenant,
        )  # fmt: skip
        return await self._call(MadeKey, "POST", "/v1/keys", json=new.model_dump(mode="json"))

    @Call
    async def keys(self) -> list[Key]:
        """Return all keys, sorted by name, without their secrets."""
        return [key async for key in self._pages(Page[Key], "/v1/keys")]

    @Call
    async def rotate_key(self, name: str, overlap_s: float = 3600.0) -> MadeKey:
        """Replace the secret of a key. Only the returned record contains the new secret.

        Parameters
        ----------
        overlap_s : period for which the old secret stays valid, seconds, up to 30 days. A second
            call within this period does not extend it, and revokes the intermediate secret

        Raises
        ------
        UnknownKey : If the key does not exist.
        Forbidden : If this client's key does not have `admin` for `*`.
        InvalidRequest : If the overlap is out of range.
        """
        path = f"/v1/keys/{quote(name, safe='')}/rotate"
        return await self._call(MadeKey, "POST", path, params={"overlap_s": overlap_s})

    @Call
    async def revoke_key(self, name: str) -> None:
        """Revoke a key; raise UnknownKey if it does not exist."""
        await self._delete(f"/v1/keys/{quote(name, safe='')}")

    @Call
    async def me(self) -> Me:
        """Return the permissions of this client's key."""
        return await self._call(Me, "GET", "/v1/keys/me")

    @Series
    def audit(
        self, actor: str | None = None, map_name: str | None = None
    ) -> AsyncIterator[AuditLine]:
        """Yield the entries of the audit log, newest first.

        Parameters
        ----------
        actor : name of the key that made the changes; None selects all changes
        map_name : name of the changed map; None selects all changes
        """
        return self._pages(Page[AuditLine], "/v1/audit", actor=actor, map=map_name)

    @Series
    def events(
        self, map_name: str | None = None, *, kinds: Sequence[str] = (), after: str | None = None,
        follow: bool = True,
    ) -> AsyncIterator[Event]:  # fmt: skip
        """Yield events in order: stored events after `after`, then new events as they occur.

        After a broken connection, the client reconnects without losing or repeating events. An
        event `events.missed` replaces events that the service no longer stores.

        Parameters
        ----------
        map_name : map of the events; default: all maps
        kinds : prefixes of the kinds of events, such as `frame.`; default: all kinds
        after : id of an event; only later events are returned, "0" selects all stored events.
            Default: "0", or with `follow` only new events
        follow : whether to wait for new events indefinitely

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If a kind is invalid, or no event has this id.
        Unreachable : If the service did not answer the first request.
        """
        if follow:
            return self._follow(_EVENTS, after, without_none(map=map_name, kind=list(kinds)))
        return self._stored_events(map_name, kinds, after)

    @Call
    async def event_page(
        self, map_name: str | None = None, *, kinds: Sequence[str] = (), after: str | None = None,
        cursor: str | None = None, limit: int = 100, newest_first: bool = True,
    ) -> EventPage:  # fmt: skip
        """Return a page of stored events; `cursor` is the `next_cursor` of the previous page."""
        parameters = without_none(
            map=map_name, kind=list(kinds), after=after, cursor=cursor, limit=limit,
            order="newest" if newest_first else "oldest",
        )  # fmt: skip
        headers = {"Accept": "application/json"}
        return await self._call(EventPage, "GET", _EVENTS, params=parameters, headers=headers)

    async def _stored_events(
        self, map_name: str | None, kinds: Sequence[str], after: str | None
    ) -> AsyncIterator[Event]:
        cursor = None
        while True:
            page = await self.event_page(
                map_name, kinds=kinds, after=after, cursor=cursor, limit=PAGE, newest_first=False
            )
            for event in page.items:
                yield event
            cursor = page.next_cursor
            if cursor is None:
                return

    @Call
    async def stats(self, map_name: str | None = None, *, minutes: int = 60) -> Stats:
        """Return statistics of the service or of a map, with a history of 1 to 60 minutes.

        Raise UnknownMap if the map does not exist. Raise InvalidRequest if `minutes` is out of
        range.
        """
        parameters = without_none(minutes=minutes, map=map_name)
        return await self._call(Stats, "GET", "/v1/stats", params=parameters)

    @Call
    async def models(self) -> list[ModelInfo]:
        """Return the models that the service includes, or that its maps use or have used."""
        return (await self._call(Page[ModelInfo], "GET", "/v1/models")).items
