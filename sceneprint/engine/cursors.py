"""Cursors of pages: the number of the row at which a page ended."""

from __future__ import annotations

from sceneprint.errors import InvalidRequest


def row_of(cursor: str | None) -> int | None:
    """The row that a cursor stands for.

    Raises
    ------
    InvalidRequest : it was not given out.
    """
    if cursor is None:
        return None
    if not (cursor.isascii() and cursor.isdigit() and len(cursor) < 19):
        raise InvalidRequest(
            f"The cursor {cursor!r:.40} was not given out. Take `next_cursor` of a page.",
            (("cursor", "not given out"),),
        )
    return int(cursor)
