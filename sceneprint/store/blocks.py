"""Numbers in lists that one statement can hold: PostgreSQL takes 65,535 values, SQLite 32,766."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice

#: Numbers in one list.
MOST = 10_000


def blocks(numbers: Iterable[int]) -> Iterator[list[int]]:
    """The numbers, at most `MOST` at a time; no list where there are none."""
    left = iter(numbers)
    while block := list(islice(left, MOST)):
        yield block
