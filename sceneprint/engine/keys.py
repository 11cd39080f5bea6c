"""Keys: made, told of, and forgotten."""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Mapping
from datetime import UTC, datetime

from sceneprint.engine.audit import COMMAND
from sceneprint.errors import InvalidRequest
from sceneprint.schemas import Page
from sceneprint.schemas.keys import EVERY, GRANTED, Key, MadeKey, Scope
from sceneprint.store import Store
from sceneprint.store import keys as stored


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
            f"{name!r:.80} is no name for a key. Take up to 128 printable characters, and not "
            f"{COMMAND!r}.",
            (("name", "not printable, empty, too long or taken"),),
        )
    granted: dict[str, Scope] = dict(grants or {EVERY: "admin"})
    for one in granted:
        if not re.fullmatch(GRANTED, one):
            raise InvalidRequest(
                f"{one!r:.80} is no name of a map, so no key can be for it. Give names of maps, "
                "or * for all.",
                (("grants", "no name of a map"),),
            )
    until = None if expires_at is None else _until(expires_at)
    with store.database.write() as connection:
        secret = stored.create_key(connection, name, granted, until)
        row = stored.find_key(connection, secret)
    assert row is not None
    return MadeKey(secret=secret, **_told(row).model_dump())


def list_keys(store: Store, cursor: str | None = None, limit: int = 100) -> Page[Key]:
    """Keys by name.

    Raises
    ------
    InvalidRequest : a cursor that was not given out.
    """
    after = None if cursor is None else _name_of(cursor)
    with store.database.read() as connection:
        found = stored.list_keys(connection, after, limit + 1)
    more = _cursor_of(found[limit - 1].name) if len(found) > limit else None
    return Page[Key](items=[_told(row) for row in found[:limit]], next_cursor=more)


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


def _told(row: stored.KeyRow) -> Key:
    return Key(
        name=row.name,
        grants=row.grants,
        created_at=datetime.fromtimestamp(row.created_at, UTC),
        expires_at=None if row.expires_at is None else datetime.fromtimestamp(row.expires_at, UTC),
    )


def _cursor_of(name: str) -> str:
    return base64.urlsafe_b64encode(name.encode()).decode()


def _name_of(cursor: str) -> str:
    try:
        return base64.urlsafe_b64decode(cursor.encode()).decode()
    except (binascii.Error, UnicodeError) as error:
        raise InvalidRequest(
            f"The cursor {cursor!r:.40} was not given out. Take `next_cursor` of a page.",
            (("cursor", "not given out"),),
        ) from error
