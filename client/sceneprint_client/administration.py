"""A service as its operator sees it: keys, changes, events, figures, models."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
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
from sceneprint_client.errors import InvalidRequest
from sceneprint_client.http import PAGE, follow_stream, given
from sceneprint_client.jobs import JobMethods

_EVENTS = "/v1/events"


class AdminMethods(JobMethods):
    """Keys, events, figures and models of a service."""

    def create_key(
        self, name: str, grants: Mapping[str, Scope], expires_at: datetime | None = None,
        tenant: str | None = None,
    ) -> MadeKey:  # fmt: skip
        """Create a key. Only the returned record contains its secret.

        Parameters
        ----------
        name : unique name of its user
        grants : map name to `read`, `write` or `admin`; `*` for all maps
        expires_at : when it expires, with a time zone; default: never
        tenant : an existing tenant that owns it; default: a new one with the key's name

        Raises
        ------
        InvalidRequest : an invalid name or grant.
        Conflict : a key of that name exists.
        UnknownTenant : no such tenant.
        Forbidden : this client's key does not have `admin` for `*`.
        """
        new = checked(
            NewKey, "The key", name=name, grants=dict(grants), expires_at=expires_at,
            tenant=tenant,
        )  # fmt: skip
        return self._ask(MadeKey, "POST", "/v1/keys", json=new.model_dump(mode="json"))

    def keys(self) -> list[Key]:
        """Return all keys by name, without secrets."""
        return list(self._items(Page[Key], "/v1/keys"))

    def rotate_key(self, name: str, overlap_s: float = 3600.0) -> MadeKey:
        """Give a key a new secret, which only the returned record contains.

        Parameters
        ----------
        name : of the key
        overlap_s : seconds for which the old secret still works, up to 30 days; 0: none.
            A second call within that time keeps its end, and revokes the secret in between

        Raises
        ------
        UnknownKey : it does not exist.
        Forbidden : this client's key does not have `admin` for `*`.
        InvalidRequest : an invalid overlap.
        """
        path = f"/v1/keys/{quote(name, safe='')}/rotate"
        return self._ask(MadeKey, "POST", path, params={"overlap_s": overlap_s})

    def revoke_key(self, name: str) -> None:
        """Revoke a key; UnknownKey if there is none of that name."""
        self._delete(f"/v1/keys/{quote(name, safe='')}")

    def me(self) -> Me:
        """What this client's key may do."""
        return self._ask(Me, "GET", "/v1/keys/me")

    def audit(self, actor: str | None = None, map_name: str | None = None) -> Iterator[AuditLine]:
        """Who changed what, newest first.

        Parameters
        ----------
        actor : name of the key that made the changes; default: any, or none
        map_name : the map that was changed; default: any, or none
        """
        return self._items(Page[AuditLine], "/v1/audit", actor=actor, map=map_name)

    # events and figures

    def events(
        self, map_name: str | None = None, *, kinds: Sequence[str] = (), after: str | None = None,
        follow: bool = True,
    ) -> Iterator[Event]:  # fmt: skip
        """Events in order: those that are kept, then new ones as they happen.

        A broken stream is resumed where it broke, however long that takes: no event is
        lost or repeated. If events are no longer kept, one of the kind
        `events.missed` replaces them.

        Parameters
        ----------
        map_name : only of this map
        kinds : prefixes of the kinds to return, such as `frame.`; default: all
        after : return events after this id; "0": all that are kept. Default: all that are kept,
            or with `follow` only new ones
        follow : wait for new events forever; else end with the last kept one

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : an invalid kind, or an id that is no event's.
        Unreachable : the service did not answer the first request.
        """
        if follow:
            wanted = given(map=map_name, kind=list(kinds))
            return follow_stream(lambda last: self._open_stream(_EVENTS, last, wanted), after)
        return self._kept_events(map_name, kinds, after)

    def event_page(
        self, map_name: str | None = None, *, kinds: Sequence[str] = (), after: str | None = None,
        cursor: str | None = None, limit: int = 100, newest_first: bool = True,
    ) -> EventPage:  # fmt: skip
        """Return a page of kept events, newest first; `cursor` comes from the page before."""
        asked = given(
            map=map_name, kind=list(kinds), after=after, cursor=cursor, limit=limit,
            order="newest" if newest_first else "oldest",
        )  # fmt: skip
        headers = {"Accept": "application/json"}
        return self._ask(EventPage, "GET", _EVENTS, params=asked, headers=headers)

    def _kept_events(
        self, map_name: str | None, kinds: Sequence[str], after: str | None
    ) -> Iterator[Event]:
        cursor = None
        while True:
            page = self.event_page(
                map_name, kinds=kinds, after=after, cursor=cursor, limit=PAGE, newest_first=False
            )
            yield from page.items
            cursor = page.next_cursor
            if cursor is None:
                return

    def stats(self, map_name: str | None = None, *, minutes: int = 60) -> Stats:
        """Statistics of the service or one map, now and for up to 60 minutes.

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : too many minutes, or none.
        """
        if not 1 <= minutes <= 60:
            raise InvalidRequest(
                f"{minutes} minutes of history were asked for. Give 1 to 60.",
                (("minutes", "out of its range"),),
            )
        return self._ask(Stats, "GET", "/v1/stats", params=given(minutes=minutes, map=map_name))

    def models(self) -> list[ModelInfo]:
        """Models for maps: those that ship, and those that maps have or had."""
        return self._ask(Page[ModelInfo], "GET", "/v1/models").items
