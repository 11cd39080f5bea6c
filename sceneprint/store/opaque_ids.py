"""Numbers of rows as the outside sees them: ids of events, and cursors of pages.

Rows are numbered over all maps, so that the numbers themselves, and the gaps between them, would
tell who may see one map how much happens in the others. A seal is a number under AES-SIV (RFC
5297), which only the store can read: the same for the same number, and like chance beside any
other.
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

#: What a number counts: a seal of one kind is none of another.
Kind = Literal["audit", "deletion", "event", "frame", "job", "query"]
#: Before everything: what no row has as its number, and so needs no seal.
START = "0"
#: A place in a list that is ordered by time: seconds since 1970, and the number of a row.
_MOMENT = struct.Struct(">dQ")


class OpaqueIds:
    """The seals of one store."""

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

    def event(self, given: str, place: str = "after") -> int:
        """The number of the event that an id stands for; 0 for START, which is before all of them.

        Raises
        ------
        InvalidRequest : it is the id of no event of this store.
        """
        number = self.open("event", given)
        if number is None:
            raise InvalidRequest(
                f"{given!r:.40} is not the id of an event here. Start again: with {START} for all "
                "stored events, or without an id for new events only.",
                ((place, "not the id of an event"),),
            )
        return number

    def row(self, kind: Kind, cursor: str | None) -> int | None:
        """The number of the row that a page before ended with, by its cursor; None for the first.

        Raises
        ------
        InvalidRequest : it was not given out.
        """
        if cursor is None:
            return None
        number = None if cursor == START else self.open(kind, cursor)
        if number is None:
            raise invalid_cursor(cursor)
        return number

    def next_cursor(self, kind: Kind, numbers: Sequence[int], limit: int) -> str | None:
        """The cursor of the page after one of `limit` rows; None: no more were found than these."""
        return self.seal(kind, numbers[limit - 1]) if len(numbers) > limit else None

    # of lists that are ordered by time: rows of one time are told apart by their numbers

    def next_moment(
        self, kind: Kind, moments: Sequence[tuple[float, int]], limit: int
    ) -> str | None:
        """The cursor of the page after one of `limit` rows; None: no more were found than these."""
        if len(moments) <= limit:
            return None
        return self._cipher.encrypt(_MOMENT.pack(*moments[limit - 1]), [kind.encode()]).hex()

    def moment(self, kind: Kind, cursor: str | None) -> tuple[float, int] | None:
        """Time and number of the row that a page before ended with; None for the first page.

        Raises
        ------
        InvalidRequest : it was not given out.
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
        """32 digits that stand for the store itself, and tell nothing of its secret."""
        return owner_of(self._secret)

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


def row_of(cursor: str | None) -> int | None:
    """The place that a cursor stands for in a list that is numbered by itself.

    Raises
    ------
    InvalidRequest : it was not given out.
    """
    if cursor is None:
        return None
    if not (cursor.isascii() and cursor.isdigit() and len(cursor) < 19):
        raise invalid_cursor(cursor)
    return int(cursor)


def invalid_cursor(cursor: str) -> InvalidRequest:
    """What is said of a cursor that was not given out."""
    return InvalidRequest(
        f"The cursor {cursor!r:.40} is not valid. Use the `next_cursor` of a page.",
        (("cursor", "not a cursor of this service"),),
    )


def owner_of(secret: bytes) -> str:
    """Return the name of the store that has a secret; see `OpaqueIds.owner`."""
    return hmac.digest(secret, b"store", "sha256")[:16].hex()
