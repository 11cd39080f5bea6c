"""API keys, stored as hashes, and results of requests with an `Idempotency-Key`."""

from __future__ import annotations

import hashlib
import secrets
import threading
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from sqlalchemy import (
    Connection,
    Select,
    bindparam,
    delete,
    insert,
    or_,
    select,
    tuple_,
    update,
)

from sceneprint.errors import Conflict, IdempotencyConflict, UnknownKey
from sceneprint.store.events import record_event
from sceneprint.store.tables import dialect_insert, idempotency, keys
from sceneprint.store.tenants import join_tenant, leave_tenant
from sceneprint_client.api.admin import Scope

if TYPE_CHECKING:
    from sceneprint.store.database import Database

#: Prefix of secrets, so that scanners recognise leaked keys.
PREFIX = "sp_"


@dataclass(frozen=True)
class KeyRow:
    """An API key; times are seconds since 1970.

    Parameters
    ----------
    id : identifier, which is never reused, unlike the name
    name : unique name
    grants : scope by map name; `*` stands for all maps
    created_at, expires_at : times of creation and expiry; None for no expiry
    tenant : owner of the key
    previous_until : time until which the previous secret is valid; None if it is invalid
    last_used_at : time of the last use, accurate to an hour; None if the key was never used
    """

    id: str
    name: str
    grants: dict[str, Scope]
    created_at: float
    expires_at: float | None
    tenant: str
    previous_until: float | None
    last_used_at: float | None


def create_key(
    connection: Connection, name: str, grants: Mapping[str, Scope],
    expires_at: float | None = None, tenant: str | None = None,
) -> str:  # fmt: skip
    """Create a key, and return its secret; see KeyRow for the parameters.

    Without `tenant`, the key belongs to the tenant with the name of the key, created if missing.

    Raises
    ------
    Conflict : If the name is in use.
    UnknownTenant : If the tenant does not exist.
    """
    if connection.execute(select(keys.c.id).where(keys.c.name == name)).first() is not None:
        raise Conflict(f"A key named {name!r} already exists. Choose another name.")
    secret = _new_secret()
    connection.execute(
        insert(keys).values(
            id=uuid.uuid4().hex, name=name, digest=_digest(secret), grants=dict(grants),
            created_at=time.time(), expires_at=expires_at,
            tenant=join_tenant(connection, name, tenant),
        )
    )  # fmt: skip
    record_event(
        connection, "key.created", name=name,
        details={"grants": dict(grants), "tenant": tenant or name, "expires_at": _iso(expires_at)},
    )  # fmt: skip
    return secret


def find_key(connection: Connection, secret: str) -> KeyRow | None:
    """Return the key of a secret, even if the key has expired; None for an unknown secret.

    For the previous secret of a key, `expires_at` is the expiry of that secret.
    """
    digest = _digest(secret)
    row = connection.execute(_select_keys().where(keys.c.digest == digest)).mappings().first()
    if row is not None:
        return KeyRow(**row)
    previous = (keys.c.previous_digest == digest) & (keys.c.previous_until > time.time())
    row = connection.execute(_select_keys().where(previous)).mappings().first()
    if row is None:
        return None
    ends = [end for end in (row["expires_at"], row["previous_until"]) if end is not None]
    return replace(KeyRow(**row), expires_at=min(ends))


def rotate_key(connection: Connection, name: str, overlap_s: float) -> str:
    """Replace the secret of a key, and return the new secret.

    The current secret remains valid for the overlap. If an earlier secret is still valid, it
    remains valid instead, and the current secret expires: the response with the current secret may
    have been lost.

    Parameters
    ----------
    connection : writing transaction
    overlap_s : duration of the overlap, seconds; 0 invalidates all old secrets

    Raises
    ------
    UnknownKey : If the key does not exist.
    """
    now = time.time()
    row = connection.execute(
        select(keys.c.digest, keys.c.previous_digest, keys.c.previous_until)
        .where(keys.c.name == name)
    ).first()  # fmt: skip
    if row is None:
        raise _unknown_key(name)
    previous: str | None = row.digest
    until: float | None = now + overlap_s
    if overlap_s == 0:
        previous = until = None
    elif row.previous_until is not None and row.previous_until > now:
        previous, until = row.previous_digest, row.previous_until
    secret = _new_secret()
    connection.execute(
        update(keys)
        .where(keys.c.name == name)
        .values(digest=_digest(secret), previous_digest=previous, previous_until=until)
    )
    record_event(connection, "key.rotated", name=name, details={"previous_until": _iso(until)})
    return secret


def find_named_key(connection: Connection, name: str) -> KeyRow:
    """Return the key with a name. Raise UnknownKey if it does not exist."""
    row = connection.execute(_select_keys().where(keys.c.name == name)).mappings().first()
    if row is None:
        raise _unknown_key(name)
    return KeyRow(**row)


def list_keys(
    connection: Connection, after: str | None = None, limit: int | None = None
) -> list[KeyRow]:
    """Return up to `limit` keys after the name `after`, sorted by name; default: all keys."""
    statement = _select_keys().order_by(keys.c.name).limit(limit)
    if after is not None:
        statement = statement.where(keys.c.name > after)
    return [KeyRow(**row) for row in connection.execute(statement).mappings()]


def revoke_key(connection: Connection, name: str) -> None:
    """Delete a key, and a tenant created only for it. Raise UnknownKey if it does not exist."""
    removal = delete(keys).where(keys.c.name == name).returning(keys.c.tenant)
    tenant = connection.execute(removal).scalar()
    if tenant is None:
        raise _unknown_key(name)
    leave_tenant(connection, name, tenant)
    record_event(connection, "key.revoked", name=name)


def _iso(seconds: float | None) -> str | None:
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC).isoformat()


def _unknown_key(name: str) -> UnknownKey:
    return UnknownKey(
        f"There is no key named {name!r:.80}. List them with `sceneprint keys --list`."
    )


def _select_keys() -> Select[Any]:
    return select(*(keys.c[member.name] for member in fields(KeyRow)))


def _new_secret() -> str:
    return PREFIX + secrets.token_urlsafe(32)  # 256 random bits do not need a slow hash


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


#: Minimum seconds between recorded uses of a key.
USED_S = 3600.0


class KeyUses:
    """Uses of keys, collected in memory and written in batches; safe to share between threads."""

    def __init__(self) -> None:
        self._due: dict[str, float] = {}
        self._lock = threading.Lock()

    def note(self, key: KeyRow) -> None:
        """Record a use of a key, unless the last recorded use is less than USED_S ago."""
        now = time.time()
        if key.last_used_at is None or not 0 <= now - key.last_used_at < USED_S:
            with self._lock:
                self._due[key.id] = now

    def write(self, database: Database) -> None:
        """Write the recorded uses; after an error, they are lost."""
        with self._lock:
            due, self._due = self._due, {}
        if not due or database.read_only:
            return
        # sort, to prevent deadlocks between processes that write the same keys
        rows = [{"key_id": key_id, "at": at} for key_id, at in sorted(due.items())]
        statement = update(keys).where(keys.c.id == bindparam("key_id"))
        with database.write(turn=False) as connection:
            connection.execute(statement.values(last_used_at=bindparam("at")), rows)


# Requests with an `Idempotency-Key`: results are stored in the transaction of the effect.

#: Seconds for which the result of a request remains stored.
RESULT_S = 86_400.0


@dataclass(frozen=True)
class IdempotentRequest:
    """A request that must take effect only once.

    Parameters
    ----------
    actor : name of the API key of the caller; "" without a key
    fingerprint : hash (64 digits) of route and content
    """

    actor: str
    key: str
    fingerprint: str

    def stored_result(self, connection: Connection) -> dict[str, Any] | None:
        """Return the result of an earlier identical request within `RESULT_S`; None without one.

        Raises
        ------
        IdempotencyConflict : If the actor used the key for a different request within that time.
        """
        row = connection.execute(
            select(idempotency.c.fingerprint, idempotency.c.data).where(
                idempotency.c.actor == self.actor,
                idempotency.c.key == self.key,
                idempotency.c.created_at > time.time() - RESULT_S,
            )
        ).first()
        if row is None:
            return None
        if row.fingerprint != self.fingerprint:
            raise IdempotencyConflict(
                f"The Idempotency-Key {self.key!r:.80} was used for another request within a day. "
                "Create a new key for each request, and reuse it only for the same content."
            )
        data: dict[str, Any] = row.data
        return data

    def columns(self, data: dict[str, Any]) -> dict[str, Any]:
        """Return the columns of the table `idempotency` for a result."""
        own = {"actor": self.actor, "key": self.key, "fingerprint": self.fingerprint}
        return {**own, "data": data, "created_at": time.time()}

    def store(self, connection: Connection, data: dict[str, Any]) -> None:
        """Store the result, in the transaction of the effect.

        This replaces a result that is older than RESULT_S, or has the same fingerprint because its
        map was deleted.

        Raises
        ------
        Overtaken : If a transaction on another map has stored a result for the key meanwhile.
        """
        values, own = self.columns(data), ("actor", "key")
        replaceable = or_(
            idempotency.c.fingerprint == self.fingerprint,
            idempotency.c.created_at <= values["created_at"] - RESULT_S,
        )
        others = {name: value for name, value in values.items() if name not in own}
        statement = (
            dialect_insert(connection, idempotency)
            .values(**values)
            .on_conflict_do_update(index_elements=own, set_=others, where=replaceable)
            .returning(idempotency.c.key)
        )
        if connection.execute(statement).first() is None:
            raise Overtaken


class Overtaken(Exception):
    """Another transaction stored the same row first; the caller must repeat its transaction."""


#: Number of results to remove in one transaction.
_REMOVED_AT_ONCE = 5_000


def remove_old_requests(database: Database) -> int:
    """Remove results older than RESULT_S, in short transactions; return their number."""
    old = idempotency.c.created_at <= time.time() - RESULT_S
    some = select(idempotency.c.actor, idempotency.c.key).where(old).limit(_REMOVED_AT_ONCE)
    removed = 0
    with database.read() as connection:
        due = connection.execute(some.limit(1)).first() is not None
    while due:
        with database.write() as connection:
            old_keys = tuple_(idempotency.c.actor, idempotency.c.key).in_(some)
            count = connection.execute(delete(idempotency).where(old_keys)).rowcount
        removed, due = removed + count, count == _REMOVED_AT_ONCE
    return removed
