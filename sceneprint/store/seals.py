"""Numbers of rows as the outside sees them.

Rows are numbered over all maps, so that the numbers themselves, and the gaps between them, would
tell who may see one map how much happens in the others. A seal is 128 bits that only the store
can read: the same for the same number, and like chance beside any other.

    tag = HMAC(secret, kind, number)      seal = tag, number xor HMAC(secret, tag)

Encryption whose nonce is made of what is encrypted, which the tag then proves: SIV (Rogaway and
Shrimpton, Deterministic Authenticated-Encryption, 2006), of one block.
"""

from __future__ import annotations

import hmac
import re
from functools import cached_property
from typing import Literal

from sqlalchemy import select

from sceneprint.errors import UnusableStore
from sceneprint.store.database import Database
from sceneprint.store.tables import secrets

#: What a number counts: a seal of one kind is none of another.
Kind = Literal["audit", "event", "frame", "job"]
#: Before everything: what no row has as its number, and so needs no seal.
START = "0"
_HALF = 8


class Seals:
    """The seals of one store.

    Parameters
    ----------
    database : that has the secret
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    def seal(self, kind: Kind, number: int) -> str:
        """32 digits that stand for a number; START for 0."""
        if number == 0:
            return START
        plain = number.to_bytes(_HALF, "big")
        tag = self._tag(kind, plain)
        return (tag + _xor(plain, self._pad(tag))).hex()

    def open(self, kind: Kind, seal: str) -> int | None:
        """The number that a seal stands for; None where this store gave out no such seal."""
        if seal == START:
            return 0
        if not re.fullmatch(r"[0-9a-f]{32}", seal):
            return None
        tag, body = bytes.fromhex(seal[: 2 * _HALF]), bytes.fromhex(seal[2 * _HALF :])
        plain = _xor(body, self._pad(tag))
        return int.from_bytes(plain, "big") if hmac.compare_digest(tag, self._tag(kind, plain)) \
            else None  # fmt: skip

    @property
    def owner(self) -> str:
        """32 digits that stand for the store itself, and tell nothing of its secret."""
        return hmac.digest(self._secret, b"store", "sha256")[: 2 * _HALF].hex()

    def _tag(self, kind: Kind, plain: bytes) -> bytes:
        return hmac.digest(self._secret, b"tag " + kind.encode() + plain, "sha256")[:_HALF]

    def _pad(self, tag: bytes) -> bytes:
        return hmac.digest(self._secret, b"pad " + tag, "sha256")[:_HALF]

    @cached_property
    def _secret(self) -> bytes:
        with self._database.read() as connection:
            asked = select(secrets.c.value).where(secrets.c.name == "seals")
            found = connection.execute(asked).scalar()
        if found is None:
            raise UnusableStore(
                "The database lacks the secret that ids of events are made with. Restore the data "
                "folder from a copy."
            )
        return bytes(found)


def _xor(a: bytes, b: bytes) -> bytes:
    return bytes(x ^ y for x, y in zip(a, b, strict=True))
