"""Numbers in lists that one statement can hold, and asking for rows of such numbers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice

from sqlalchemy import ARRAY, BigInteger, Column, ColumnElement, Connection, any_, literal

#: Numbers in one list: SQLite takes 32,766 values.
MOST = 10_000


def blocks(numbers: Iterable[int]) -> Iterator[list[int]]:
    """The numbers, at most `MOST` at a time; no list where there are none."""
    left = iter(numbers)
    while block := list(islice(left, MOST)):
        yield block


def among(
    connection: Connection, column: Column[int], numbers: Sequence[int]
) -> ColumnElement[bool]:
    """That a number is one of a block; for PostgreSQL they are one value, however many they are.

    As 10,000 values of a statement they would take ten times as long to be read.
    """
    if connection.dialect.name == "postgresql":
        return column == any_(literal(list(numbers), ARRAY(BigInteger)))
    return column.in_(numbers)
