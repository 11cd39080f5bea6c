"""Keys: made, told of, and forgotten."""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from sceneprint.errors import InvalidRequest
from sceneprint.store import Store
from sceneprint.store import keys as stored
from sceneprint.store.keys import KeyChange
from sceneprint.store.opaque_ids import invalid_cursor
from sceneprint_client.api import Page
from sceneprint_client.api.admin import EVERY, GRANTED, Audited, Key, MadeKey, Scope

# Who changed what.

#: The actor of what a command does to the data folder; no key may be named so.
COMMAND = "command"


class Audit:
    """The audit log of one store."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def note(self, change: KeyChange) -> None:
        """Add a line."""
        with self._store.database.write() as connection:
            stored.note(connection, change)

    def command(
        self, action: str, *, map_name: str | None = None, target: str | None = None, **data: Any
    ) -> None:
        """Add a line for a command on the data folder."""
        self.note(KeyChange(action, COMMAND, map=map_name, target=target, data=data))

    def page(
        self, cursor: str | None = None, limit: int = 100, actor: str | None = None,
        map_name: str | None = None,
    ) -> Page[Audited]:  # fmt: skip
        """Changes, the newest first.

        Parameters
        ----------
        cursor, limit : of the page
        actor : name of the key that made them; default: of all, and of none
        map_name : that was changed; default: any, and none

        Raises
        ------
        InvalidRequest : a cursor that was not given out.
        """
        seals = self._store.seals
        before = seals.row("audit", cursor)
        with self._store.database.read() as connection:
            found = stored.list_changes(connection, before, limit + 1, actor, map_name)
        more = seals.next_cursor("audit", [one.number for one in found], limit)
        return Page[Audited](items=[_audit_record(one) for one in found[:limit]], next_cursor=more)


def _audit_record(change: KeyChange) -> Audited:
    assert change.at is not None
    return Audited(
        at=datetime.fromtimestamp(change.at, UTC),
        actor=change.actor or None,
        address=change.address,
        action=change.action,
        map=change.map,
        target=change.target,
        request_id=change.request_id,
        data=change.data or {},
    )


def create_key(
    store: Store, name: str, grants: Mapping[str, Scope] | None = None,
    expires_at: datetime | None = None,
) -> MadeKey:  # fmt: skip
    """Make a key; its secret is shown this once.

    Parameters
    ----------
    store : see Store
    name : of the key
    grants : scope by name of a map, `*` for all; default: admin of all
    expires_at : when it opens nothing any more, with a zone; default: never

    Raises
    ------
    InvalidRequest : the name is empty, too long, not printable or taken by us; or a name of a map
        that none can have; or `expires_at` is beyond what a date can say.
    Conflict : there is a key of that name.
    """
    if not (0 < len(name) <= 128 and name.isprintable()) or name == COMMAND:
        raise InvalidRequest(
            f"{name!r:.80} is not a valid key name. Use up to 128 printable characters, but not "
            f"{COMMAND!r}.",
            (("name", "not printable, empty, too long or reserved"),),
        )
    granted: dict[str, Scope] = dict(grants or {EVERY: "admin"})
    for one in granted:
        if not re.fullmatch(GRANTED, one):
            raise InvalidRequest(
                f"{one!r:.80} is not a valid map name. Give map names, or * for all maps.",
                (("grants", "not a map name"),),
            )
    until = None if expires_at is None else _until(expires_at)
    with store.database.write() as connection:
        secret = stored.create_key(connection, name, granted, until)
        row = stored.find_key(connection, secret)
    assert row is not None
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
    return Page[Key](items=[_key_record(row) for row in found[:limit]], next_cursor=more)


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
    return Key(
        name=row.name,
        grants=row.grants,
        created_at=datetime.fromtimestamp(row.created_at, UTC),
        expires_at=None if row.expires_at is None else datetime.fromtimestamp(row.expires_at, UTC),
    )


def _name_of(cursor: str) -> str:
    try:
        return base64.urlsafe_b64decode(cursor.encode()).decode()
    except (binascii.Error, UnicodeError) as error:
        raise invalid_cursor(cursor) from error
