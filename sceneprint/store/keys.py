"""Keys of the API: shown once, kept as a hash."""

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
from sqlalchemy.dialects import postgresql, sqlite

from sceneprint.errors import Conflict, IdempotencyConflict, UnknownKey
from sceneprint.store.events import record_event
from sceneprint.store.tables import idempotency, keys
from sceneprint.store.tenants import join_tenant, leave_tenant
from sceneprint_client.api.admin import Scope

if TYPE_CHECKING:
    from sceneprint.store.database import Database

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
    previous_until : until when the secret before the last rotation works; None: none does
    last_used_at : to the hour or so; None: never yet
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
    """Make a key and return its secret, which is stored nowhere; for the rest see KeyRow.

    Without `tenant` it belongs to one of its own name.

    Raises
    ------
    Conflict : there is a key of that name.
    UnknownTenant : there is no such tenant.
    """
    if connection.execute(select(keys.c.id).where(keys.c.name == name)).first() is not None:
        raise Conflict(f"There is a key named {name!r}. Choose another name.")
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
    """The key with that secret, or None; also one that has expired.

    Found by the secret before its rotation, a key expires when that does.
    """
    digest = _digest(secret)
    found = connection.execute(_select_keys().where(keys.c.digest == digest)).mappings().first()
    if found is not None:
        return KeyRow(**found)
    previous = (keys.c.previous_digest == digest) & (keys.c.previous_until > time.time())
    found = connection.execute(_select_keys().where(previous)).mappings().first()
    if found is None:
        return None
    ends = [one for one in (found["expires_at"], found["previous_until"]) if one is not None]
    return replace(KeyRow(**found), expires_at=min(ends))


def rotate_key(connection: Connection, name: str, overlap_s: float) -> str:
    """Give a key a new secret, and return it; what it may do stays.

    The secret before works for so long. Where one before that still does, it keeps its time, and
    the one between ends: an answer with a new secret that was lost costs nobody the key in use.

    Parameters
    ----------
    connection : of a writing transaction
    overlap_s : seconds; 0: all secrets before end now

    Raises
    ------
    UnknownKey : there is none of that name.
    """
    now = time.time()
    found = connection.execute(
        select(keys.c.digest, keys.c.previous_digest, keys.c.previous_until)
        .where(keys.c.name == name)
    ).first()  # fmt: skip
    if found is None:
        raise _unknown_key(name)
    previous: str | None = found.digest
    until: float | None = now + overlap_s
    if overlap_s == 0:
        previous = until = None
    elif found.previous_until is not None and found.previous_until > now:
        previous, until = found.previous_digest, found.previous_until
    secret = _new_secret()
    connection.execute(
        update(keys)
        .where(keys.c.name == name)
        .values(digest=_digest(secret), previous_digest=previous, previous_until=until)
    )
    record_event(connection, "key.rotated", name=name, details={"previous_until": _iso(until)})
    return secret


def find_named_key(connection: Connection, name: str) -> KeyRow:
    """The key of that name; UnknownKey where there is none."""
    found = connection.execute(_select_keys().where(keys.c.name == name)).mappings().first()
    if found is None:
        raise _unknown_key(name)
    return KeyRow(**found)


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
    return select(*(keys.c[one.name] for one in fields(KeyRow)))


def _new_secret() -> str:
    return PREFIX + secrets.token_urlsafe(32)  # 256 random bits: no slow hash is needed


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


#: Seconds for which a use of a key is not noted again: whether it is in use at all is the question.
USED_S = 3600.0


class KeyUses:
    """When keys were used, noted in memory and written now and then; safe to share."""

    def __init__(self) -> None:
        self._due: dict[str, float] = {}
        self._lock = threading.Lock()

    def note(self, key: KeyRow) -> None:
        """Note that a key is used now, unless the database knows about as much."""
        now = time.time()
        if key.last_used_at is None or not 0 <= now - key.last_used_at < USED_S:
            with self._lock:
                self._due[key.id] = now

    def write(self, database: Database) -> None:
        """Write what was noted; what cannot be written is lost, and noted at the next use."""
        with self._lock:
            due, self._due = self._due, {}
        if not due or database.read_only:
            return
        # in one order, as two processes may write the same keys at once
        used = [{"of": key_id, "at": at} for key_id, at in sorted(due.items())]
        asked = update(keys).where(keys.c.id == bindparam("of"))
        with database.write(turn=False) as connection:
            connection.execute(asked.values(last_used_at=bindparam("at")), used)


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

    def columns(self, data: dict[str, Any]) -> dict[str, Any]:
        """Columns of `idempotency`, with what came of it."""
        own = {"actor": self.actor, "key": self.key, "fingerprint": self.fingerprint}
        return {**own, "data": data, "created_at": time.time()}

    def keep(self, connection: Connection, data: dict[str, Any]) -> None:
        """Remember what came of it, in the transaction that stores that.

        One statement, as others wait meanwhile. What was remembered before gives way: it is older
        than a day, or of a map that was deleted since.

        Raises
        ------
        Overtaken : another request with this key was stored since `found`, of another map.
        """
        values, own = self.columns(data), ("actor", "key")
        kind: Any = sqlite if connection.dialect.name == "sqlite" else postgresql
        made = kind.insert(idempotency).values(**values)
        gives_way = or_(
            idempotency.c.fingerprint == self.fingerprint,
            idempotency.c.created_at <= values["created_at"] - KEPT_S,
        )
        known = {name: value for name, value in values.items() if name not in own}
        kept = made.on_conflict_do_update(
            index_elements=own, set_=known, where=gives_way
        ).returning(idempotency.c.key)
        if connection.execute(kept).first() is None:
            raise Overtaken


class Overtaken(Exception):
    """Another transaction stored first what this one relied on being absent: do it again."""


#: Keys that are removed in one transaction: others wait meanwhile.
_REMOVED_AT_ONCE = 5_000


def remove_old_requests(database: Database) -> int:
    """Forget requests of more than a day ago, in short transactions; how many."""
    old = idempotency.c.created_at <= time.time() - KEPT_S
    some = select(idempotency.c.actor, idempotency.c.key).where(old).limit(_REMOVED_AT_ONCE)
    removed = 0
    with database.read() as connection:
        due = connection.execute(some.limit(1)).first() is not None
    while due:
        with database.write() as connection:
            those = tuple_(idempotency.c.actor, idempotency.c.key).in_(some)
            count = connection.execute(delete(idempotency).where(those)).rowcount
        removed, due = removed + count, count == _REMOVED_AT_ONCE
    return removed
