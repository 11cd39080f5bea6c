"""Keys under which a caller may send a request again: what came of it, kept for a day.

Stored in the transaction of what it guards, so that neither is there without the other.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, delete, insert, select

from sceneprint.errors import IdempotencyConflict
from sceneprint.store.tables import idempotency

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
