"""Numbers of rows as the outside sees them.

Rows are numbered over all maps, so that the numbers themselves, and the gaps between them, would
tell who may see one map how much happens in the others. A seal is a number under AES-SIV (RFC
5297), which only the store can read: the same for the same number, and like chance beside any
other.
"""

from __future__ import annotations

import hmac
import re
from functools import cached_property
from typing import Literal

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESSIV
from sqlalchemy import select

from sceneprint.errors import UnusableStore
from sceneprint.store.database import Database
from sceneprint.store.tables import secrets

#: What a number counts: a seal of one kind is none of another.
Kind = Literal["audit", "event", "frame", "job"]
#: Before everything: what no row has as its number, and so needs no seal.
START = "0"


class OpaqueIds:
    """The seals of one store.

    Parameters
    ----------
    database : that has the secret
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    def seal(self, kind: Kind, number: int) -> str:
        """48 digits that stand for a number; START for 0."""
        if number == 0:
            return START
        return self._cipher.encrypt(number.to_bytes(8, "big"), [kind.encode()]).hex()

    def open(self, kind: Kind, seal: str) -> int | None:
        """The number that a seal stands for; None where this store gave out no such seal."""
        if seal == START:
            return 0
        if not re.fullmatch(r"[0-9a-f]{48}", seal):
            return None
        try:
            plain = self._cipher.decrypt(bytes.fromhex(seal), [kind.encode()])
        except InvalidTag:
            return None
        return int.from_bytes(plain, "big")

    @property
    def owner(self) -> str:
        """32 digits that stand for the store itself, and tell nothing of its secret."""
        return hmac.digest(self._secret, b"store", "sha256")[:16].hex()

    @cached_property
    def _cipher(self) -> AESSIV:
        return AESSIV(self._secret)

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
