"""Keys of the API: shown once, kept as a hash."""

from __future__ import annotations

import hashlib
import secrets
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass

from sqlalchemy import Connection, Select, delete, insert, select

from sceneprint.errors import Conflict, UnknownKey
from sceneprint.schemas.keys import Scope
from sceneprint.store.events import tell
from sceneprint.store.tables import keys

#: So that a key is known for one where it should not be, such as in a public file.
PREFIX = "sp_"


@dataclass(frozen=True)
class KeyRow:
    """A key; times are seconds since 1970.

    Parameters
    ----------
    name : unique
    grants : scope by name of a map, `*` for all
    created_at, expires_at : None: it does not expire
    """

    name: str
    grants: dict[str, Scope]
    created_at: float
    expires_at: float | None


def create_key(
    connection: Connection, name: str, grants: Mapping[str, Scope],
    expires_at: float | None = None,
) -> str:  # fmt: skip
    """Make a key and return its secret, which is stored nowhere; for the rest see KeyRow.

    Raises
    ------
    Conflict : there is a key of that name.
    """
    if connection.execute(select(keys.c.id).where(keys.c.name == name)).first() is not None:
        raise Conflict(f"There is a key named {name!r}. Choose another name.")
    secret = PREFIX + secrets.token_urlsafe(32)  # 256 random bits: no slow hash is needed
    connection.execute(
        insert(keys).values(
            id=uuid.uuid4().hex, name=name, digest=_digest(secret), grants=dict(grants),
            created_at=time.time(), expires_at=expires_at,
        )
    )  # fmt: skip
    tell(connection, "key.created", name=name)
    return secret


def find_key(connection: Connection, secret: str) -> KeyRow | None:
    """The key with that secret, or None; also one that has expired."""
    own = keys.c.digest == _digest(secret)
    found = connection.execute(_asked().where(own)).mappings().first()
    return None if found is None else KeyRow(**found)


def list_keys(
    connection: Connection, after: str | None = None, limit: int | None = None
) -> list[KeyRow]:
    """Keys by name, from behind `after` on; default: all."""
    asked = _asked().order_by(keys.c.name).limit(limit)
    if after is not None:
        asked = asked.where(keys.c.name > after)
    return [KeyRow(**row) for row in connection.execute(asked).mappings()]


def revoke_key(connection: Connection, name: str) -> None:
    """Forget a key.

    Raises
    ------
    UnknownKey : there is none of that name.
    """
    if connection.execute(delete(keys).where(keys.c.name == name)).rowcount != 1:
        raise UnknownKey(
            f"There is no key named {name!r:.80}. List them with `sceneprint keys --list`."
        )
    tell(connection, "key.revoked", name=name)


def _asked() -> Select[tuple[str, dict[str, Scope], float, float | None]]:
    return select(keys.c.name, keys.c.grants, keys.c.created_at, keys.c.expires_at)


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
