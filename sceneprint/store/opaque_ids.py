"""Encryption of row numbers that clients receive, as event ids and as cursors of pages.

Rows are numbered across all maps, so plain numbers would reveal the activity in other maps. A seal
is a number encrypted with AES-SIV (RFC 5297) and the secret of the store. Seals are deterministic;
seals of different numbers are unrelated.
"""

from __future__ import annotations

import hmac
import re
import struct
from collections.abc import Sequence
from functools import cached_property
from typing import Literal

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESSIV
from sqlalchemy import select

from sceneprint.errors import InvalidRequest, UnusableStore
from sceneprint.store.database import Database
from sceneprint.store.tables import secrets

#: Kinds of rows. A seal is valid for only one kind.
Kind = Literal["audit", "deletion", "event", "frame", "job", "query"]
#: Position before all rows, in place of a seal of the number 0.
START = "0"
#: Position in a list that is sorted by time: seconds since 1970, and the number of a row.
_MOMENT = struct.Struct(">dQ")


class OpaqueIds:
    """Cipher of the row numbers of a store."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def seal(self, kind: Kind, number: int) -> str:
        """Encrypt a number as 48 hexadecimal digits; return START for 0."""
        if number == 0:
            return START
        return self._cipher.encrypt(number.to_bytes(8, "big"), [kind.encode()]).hex()

    def open(self, kind: Kind, seal: str) -> int | None:
        """Decrypt a seal; return None if this store did not issue it."""
        if seal == START:
            return 0
        if not re.fullmatch(r"[0-9a-f]{48}", seal):
            return None
        try:
            plain = self._cipher.decrypt(bytes.fromhex(seal), [kind.encode()])
        except InvalidTag:
            return None
        return int.from_bytes(plain, "big")

    def event(self, event_id: str, place: str = "after") -> int:
        """Return the number of an event by its id; 0 for START.

        Raises
        ------
        InvalidRequest : If this store did not issue the id.
        """
        number = self.open("event", event_id)
        if number is None:
            raise InvalidRequest(
                f"{event_id!r:.40} is not the id of an event of this service. Start again with "
                f"{START} for all stored events, or without an id for only new events.",
                ((place, "not the id of an event"),),
            )
        return number

    def row(self, kind: Kind, cursor: str | None) -> int | None:
        """Return the number of the last row of the previous page; None without a cursor.

        Raises
        ------
        InvalidRequest : If this store did not issue the cursor.
        """
        if cursor is None:
            return None
        number = None if cursor == START else self.open(kind, cursor)
        if number is None:
            raise invalid_cursor(cursor)
        return number

    def next_cursor(self, kind: Kind, numbers: Sequence[int], limit: int) -> str | None:
        """Return the cursor of the page after the first `limit` rows; None without further rows."""
        return self.seal(kind, numbers[limit - 1]) if len(numbers) > limit else None

    def next_moment(
        self, kind: Kind, moments: Sequence[tuple[float, int]], limit: int
    ) -> str | None:
        """Return the next cursor of a list sorted by time and number; see `next_cursor`."""
        if len(moments) <= limit:
            return None
        return self._cipher.encrypt(_MOMENT.pack(*moments[limit - 1]), [kind.encode()]).hex()

    def moment(self, kind: Kind, cursor: str | None) -> tuple[float, int] | None:
        """Return time and number of the last row of the previous page; None for the first page.

        Raises
        ------
        InvalidRequest : If this store did not issue the cursor.
        """
        if cursor is None:
            return None
        try:
            if not re.fullmatch(r"[0-9a-f]{64}", cursor):
                raise invalid_cursor(cursor)
            at, number = _MOMENT.unpack(
                self._cipher.decrypt(bytes.fromhex(cursor), [kind.encode()])
            )
        except InvalidTag:
            raise invalid_cursor(cursor) from None
        return at, number

    @property
    def owner(self) -> str:
        """Return the public name of the store: 32 digits that do not reveal its secret."""
        return owner_of(self._secret)

    @cached_property
    def _cipher(self) -> AESSIV:
        return AESSIV(self._secret)

    @cached_property
    def _secret(self) -> bytes:
        with self._database.read() as connection:
            statement = select(secrets.c.value).where(secrets.c.name == "seals")
            value = connection.execute(statement).scalar()
        if value is None:
            raise UnusableStore(
                "The secret that encrypts the ids of events is missing from the database. Restore "
                "the data folder from a copy."
            )
        return bytes(value)


def row_of(cursor: str | None) -> int | None:
    """Return the row number of an unencrypted cursor; None for the first page.

    Raises
    ------
    InvalidRequest : If the service did not issue the cursor.
    """
    if cursor is None:
        return None
    if not (cursor.isascii() and cursor.isdigit() and len(cursor) < 19):
        raise invalid_cursor(cursor)
    return int(cursor)


def invalid_cursor(cursor: str) -> InvalidRequest:
    """Return the error for a cursor that the service did not issue."""
    return InvalidRequest(
        f"The cursor {cursor!r:.40} is not valid. Use the `next_cursor` of a page.",
        (("cursor", "not a cursor of this service"),),
    )


def owner_of(secret: bytes) -> str:
    """Return the public name of a store, derived from its secret."""
    return hmac.digest(secret, b"store", "sha256")[:16].hex()
