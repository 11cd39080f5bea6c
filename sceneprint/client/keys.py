"""Keys, and who changed what.

A topic of the client: what it needs of a backend, both backends, and the calls of `Client`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import datetime
from typing import TYPE_CHECKING, Protocol
from urllib.parse import quote

from sceneprint.client.sending import PAGE, Sender, given
from sceneprint.schemas import Page
from sceneprint.schemas.keys import EVERY, Audited, Key, MadeKey, Me, NewKey, Scope

if TYPE_CHECKING:
    from sceneprint.engine import Engine


class KeysBackend(Protocol):
    """What this topic needs of whoever does the work."""

    def create_key(self, new: NewKey) -> MadeKey:
        """Make a key."""

    def list_keys(self, cursor: str | None) -> Page[Key]:
        """A page of the keys by name."""

    def revoke_key(self, name: str) -> None:
        """Let a key open nothing any more."""

    def me(self) -> Me:
        """Who asks."""

    def list_changes(
        self, cursor: str | None, actor: str | None, map_name: str | None
    ) -> Page[Audited]:
        """A page of the changes, the newest first."""


class RemoteKeys(Sender):
    """Over HTTP."""

    def create_key(self, new: NewKey) -> MadeKey:
        """Make a key; where an answer was lost, trying again finds a key without its secret."""
        return self._ask(MadeKey, "POST", "/v1/keys", json=new.model_dump(mode="json"))

    def list_keys(self, cursor: str | None) -> Page[Key]:
        """A page of the keys by name."""
        return self._ask(Page[Key], "GET", "/v1/keys", params=given(cursor=cursor, limit=PAGE))

    def revoke_key(self, name: str) -> None:
        """Let a key open nothing any more."""
        self._delete(f"/v1/keys/{quote(name, safe='')}")

    def me(self) -> Me:
        """Who asks."""
        return self._ask(Me, "GET", "/v1/keys/me")

    def list_changes(
        self, cursor: str | None, actor: str | None, map_name: str | None
    ) -> Page[Audited]:
        """A page of the changes, the newest first."""
        asked = given(cursor=cursor, limit=PAGE, actor=actor, map=map_name)
        return self._ask(Page[Audited], "GET", "/v1/audit", params=asked)


class EmbeddedKeys:
    """In this process."""

    _engine: Engine

    def create_key(self, new: NewKey) -> MadeKey:
        """Make a key."""
        return self._engine.create_key(new.name, new.grants, new.expires_at)

    def list_keys(self, cursor: str | None) -> Page[Key]:
        """A page of the keys by name."""
        return self._engine.list_keys(cursor, PAGE)

    def revoke_key(self, name: str) -> None:
        """Let a key open nothing any more."""
        self._engine.revoke_key(name)

    def me(self) -> Me:
        """Who has the folder has all of it."""
        return Me(name=None, grants={EVERY: "admin"})

    def list_changes(
        self, cursor: str | None, actor: str | None, map_name: str | None
    ) -> Page[Audited]:
        """A page of the changes, the newest first."""
        return self._engine.audit.page(cursor, PAGE, actor, map_name)


class Keys:
    """The calls."""

    _backend: KeysBackend

    def create_key(
        self, name: str, grants: Mapping[str, Scope], expires_at: datetime | None = None
    ) -> MadeKey:
        """Make a key; only what is returned has its secret.

        Parameters
        ----------
        name : who it is for; unique
        grants : `read`, `write` or `admin` by name of a map, `*` for all
        expires_at : when it opens nothing any more, with a zone; default: never

        Raises
        ------
        InvalidRequest : a name or grant that is none.
        Conflict : there is a key of that name.
        Forbidden : the key of this client is not for `admin` of all.
        """
        from sceneprint.client.frames import checked

        return self._backend.create_key(
            checked(NewKey, "The key", name=name, grants=dict(grants), expires_at=expires_at)
        )

    def keys(self) -> list[Key]:
        """All keys by name, without their secrets."""
        page = self._backend.list_keys(None)
        found = page.items
        while page.next_cursor is not None:
            page = self._backend.list_keys(page.next_cursor)
            found = found + page.items
        return found

    def revoke_key(self, name: str) -> None:
        """Let a key open nothing any more; UnknownKey where there is none of that name."""
        self._backend.revoke_key(name)

    def me(self) -> Me:
        """What the key of this client may do."""
        return self._backend.me()

    def audit(self, actor: str | None = None, map_name: str | None = None) -> Iterator[Audited]:
        """Who changed what, the newest first.

        Parameters
        ----------
        actor : name of the key that made the changes; default: of all, and of none
        map_name : that was changed; default: any, and none
        """
        cursor = None
        while True:
            page = self._backend.list_changes(cursor, actor, map_name)
            yield from page.items
            cursor = page.next_cursor
            if cursor is None:
                return
