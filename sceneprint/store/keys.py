"""Keys of the API: shown once, kept as a hash."""

from __future__ import annotations

import hashlib
import secrets
import time
import uuid

from sqlalchemy import Connection, delete, insert, select
from sqlalchemy.exc import IntegrityError

from sceneprint.errors import Conflict, UnknownKey
from sceneprint.store.events import tell
from sceneprint.store.tables import keys

#: So that a key is known for one where it should not be, such as in a public file.
PREFIX = "sp_"


def create_key(connection: Connection, name: str) -> str:
    """Make a key and return its secret, which is stored nowhere.

    Raises
    ------
    Conflict : there is a key of that name.
    """
    secret = PREFIX + secrets.token_urlsafe(32)  # 256 random bits: no slow hash is needed
    try:
        connection.execute(
            insert(keys).values(
                id=uuid.uuid4().hex, name=name, digest=_digest(secret), scopes=["admin"],
                created_at=time.time(),
            )
        )  # fmt: skip
    except IntegrityError as error:
        raise Conflict(f"There is a key named {name!r}. Choose another name.") from error
    tell(connection, "key.created", name=name)
    return secret


def key_name(connection: Connection, secret: str) -> str | None:
    """Name of the key with that secret, or None."""
    found: str | None = connection.execute(
        select(keys.c.name).where(keys.c.digest == _digest(secret))
    ).scalar()
    return found


def list_keys(connection: Connection) -> list[tuple[str, float]]:
    """Name of every key and when it was made, by name."""
    rows = connection.execute(select(keys.c.name, keys.c.created_at).order_by(keys.c.name))
    return [(row.name, row.created_at) for row in rows]


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


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
