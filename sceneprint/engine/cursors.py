"""Cursors of pages: where a page ended, as those who read it are told."""

from __future__ import annotations

from sceneprint.errors import InvalidRequest
from sceneprint.store.seals import START, Kind, Seals


def row_of(cursor: str | None) -> int | None:
    """The place that a cursor stands for in a list that is numbered by itself.

    Raises
    ------
    InvalidRequest : it was not given out.
    """
    if cursor is None:
        return None
    if not (cursor.isascii() and cursor.isdigit() and len(cursor) < 19):
        raise _not_given_out(cursor)
    return int(cursor)


def opened(seals: Seals, kind: Kind, cursor: str | None) -> int | None:
    """The number of the row that a cursor stands for, where rows count over all maps.

    Raises
    ------
    InvalidRequest : it was not given out.
    """
    if cursor is None:
        return None
    number = None if cursor == START else seals.open(kind, cursor)
    if number is None:
        raise _not_given_out(cursor)
    return number


def event_of(seals: Seals, given: str, place: str = "after") -> int:
    """The number of the event that an id stands for; 0 for START, which is before all of them.

    Parameters
    ----------
    seals : of the store
    given : the id
    place : where it was given

    Raises
    ------
    InvalidRequest : it is the id of no event of this store.
    """
    number = seals.open("event", given)
    if number is None:
        raise InvalidRequest(
            f"{given!r:.40} is the id of no event here. Begin anew: with {START} for all events "
            "that are kept, or with none for what happens from now on.",
            ((place, "not the id of an event"),),
        )
    return number


def _not_given_out(cursor: str) -> InvalidRequest:
    return InvalidRequest(
        f"The cursor {cursor!r:.40} was not given out. Take `next_cursor` of a page.",
        (("cursor", "not given out"),),
    )
