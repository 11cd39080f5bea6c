"""Keys of the API: shown once, kept as a hash."""

from __future__ import annotations

import hashlib
import secrets
import time
import uuid

from sqlalchemy import Connection, insert, select
from sqlalchemy.exc import IntegrityError

from sceneprint.errors import Conflict
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


def any_key(connection: Connection) -> bool:
    """Whether there is a key."""
    return connection.execute(select(keys.c.id).limit(1)).first() is not None


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
