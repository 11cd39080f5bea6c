"""Keys of the API: shown once, kept as a hash."""

from __future__ import annotations

import hashlib
import secrets
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Select, delete, insert, select

from sceneprint.errors import Conflict, IdempotencyConflict, UnknownKey
from sceneprint.store.events import record_event
from sceneprint.store.tables import idempotency, keys
from sceneprint.store.tenants import join_tenant, leave_tenant
from sceneprint_client.api.admin import Scope

#: So that a key is known for one where it should not be, such as in a public file.
PREFIX = "sp_"


@dataclass(frozen=True)
class KeyRow:
    """A key; times are seconds since 1970.

    Parameters
    ----------
    id : never given to another, unlike its name
    name : unique
    grants : scope by name of a map, `*` for all
    created_at, expires_at : None: it does not expire
    tenant : whom it belongs to
    """

    id: str
    name: str
    grants: dict[str, Scope]
    created_at: float
    expires_at: float | None
    tenant: str


def create_key(
    connection: Connection, name: str, grants: Mapping[str, Scope],
    expires_at: float | None = None, tenant: str | None = None,
) -> str:  # fmt: skip
    """Make a key and return its secret, which is stored nowhere; for the rest see KeyRow.

    Without `tenant` it belongs to one of its own name.

    Raises
    ------
    Conflict : there is a key of that name.
    UnknownTenant : there is no such tenant.
    """
    if connection.execute(select(keys.c.id).where(keys.c.name == name)).first() is not None:
        raise Conflict(f"There is a key named {name!r}. Choose another name.")
    secret = PREFIX + secrets.token_urlsafe(32)  # 256 random bits: no slow hash is needed
    connection.execute(
        insert(keys).values(
            id=uuid.uuid4().hex, name=name, digest=_digest(secret), grants=dict(grants),
            created_at=time.time(), expires_at=expires_at,
            tenant=join_tenant(connection, name, tenant),
        )
    )  # fmt: skip
    record_event(connection, "key.created", name=name)
    return secret


def find_key(connection: Connection, secret: str) -> KeyRow | None:
    """The key with that secret, or None; also one that has expired."""
    own = keys.c.digest == _digest(secret)
    found = connection.execute(_select_keys().where(own)).mappings().first()
    return None if found is None else KeyRow(**found)


def list_keys(
    connection: Connection, after: str | None = None, limit: int | None = None
) -> list[KeyRow]:
    """Keys by name, from behind `after` on; default: all."""
    asked = _select_keys().order_by(keys.c.name).limit(limit)
    if after is not None:
        asked = asked.where(keys.c.name > after)
    return [KeyRow(**row) for row in connection.execute(asked).mappings()]


def revoke_key(connection: Connection, name: str) -> None:
    """Forget a key.

    Raises
    ------
    UnknownKey : there is none of that name.
    """
    gone = delete(keys).where(keys.c.name == name).returning(keys.c.tenant)
    tenant = connection.execute(gone).scalar()
    if tenant is None:
        raise UnknownKey(
            f"There is no key named {name!r:.80}. List them with `sceneprint keys --list`."
        )
    leave_tenant(connection, name, tenant)
    record_event(connection, "key.revoked", name=name)


def _select_keys() -> Select[tuple[str, str, dict[str, Scope], float, float | None, str]]:
    own = keys.c
    return select(own.id, own.name, own.grants, own.created_at, own.expires_at, own.tenant)


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


# Keys under which a caller may send a request again: what came of it, kept for a day.
#
# Stored in the transaction of what it guards, so that neither is there without the other.

#: Seconds for which a key is remembered.
KEPT_S = 86_400.0


@dataclass(frozen=True)
class IdempotentRequest:
    """A request that is to take effect once.

    Parameters
    ----------
    actor : name of the caller's key, or ""
    key : that the caller made up
    fingerprint : 64 digits, of what is asked for
    """

    actor: str
    key: str
    fingerprint: str

    def found(self, connection: Connection) -> dict[str, Any] | None:
        """What `keep` was given when the same was asked before; None where it was not.

        Raises
        ------
        IdempotencyConflict : something else was asked with this key.
        """
        row = connection.execute(
            select(idempotency.c.fingerprint, idempotency.c.data).where(
                idempotency.c.actor == self.actor,
                idempotency.c.key == self.key,
                idempotency.c.created_at > time.time() - KEPT_S,
            )
        ).first()
        if row is None:
            return None
        if row.fingerprint != self.fingerprint:
            raise IdempotencyConflict(
                f"The Idempotency-Key {self.key!r:.80} was sent with another request within a day. "
                "Make up one for each request, and send it again only with the same content."
            )
        data: dict[str, Any] = row.data
        return data

    def keep(self, connection: Connection, data: dict[str, Any]) -> None:
        """Remember what came of it, in the transaction that stores that; old ones go."""
        mine = (idempotency.c.actor == self.actor) & (idempotency.c.key == self.key)
        old = idempotency.c.created_at <= time.time() - KEPT_S
        connection.execute(delete(idempotency).where(old | mine))
        connection.execute(
            insert(idempotency).values(
                actor=self.actor, key=self.key, fingerprint=self.fingerprint, data=data,
                created_at=time.time(),
            )
        )  # fmt: skip
