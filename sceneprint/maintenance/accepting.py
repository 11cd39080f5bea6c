"""What of an embedded store PostgreSQL would refuse, found before anything is moved.

SQLite keeps what it is given: a text that is longer than its column, a zero byte in it, a number
where a text should be. What comes in through the service today is refused there; files of earlier
versions, or that somebody has edited, may hold such rows all the same.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import islice
from typing import Any

from sqlalchemy import JSON, BigInteger, Boolean, Column, Float, Integer, LargeBinary, String, Text
from sqlalchemy.dialects.postgresql import dialect

from sceneprint.errors import SnapshotError
from sceneprint.maintenance.columns import Form
from sceneprint.store.tables import metadata

#: Rows that are named one by one.
_SHOWN = 6
_SMALL, _LARGE = 1 << 31, 1 << 63
#: What is wrong with a value; None where nothing is.
_Look = Callable[[Any], str | None]


def check_acceptable(file: sqlite3.Connection) -> None:
    """See that PostgreSQL takes every row of a database.

    Parameters
    ----------
    file : of the schema of this version; texts that are no UTF-8 are read all the same here

    Raises
    ------
    SnapshotError : it does not; names rows, and why.
    """
    before, file.text_factory = file.text_factory, _text
    try:
        every = (told for table in metadata.sorted_tables for told in _refused(file, Form(table)))
        refused, others = [*islice(every, _SHOWN)], sum(1 for _ in every)
    finally:
        file.text_factory = before
    if refused:
        more = f"; and {others} more values" if others else ""
        raise SnapshotError(
            f"PostgreSQL cannot hold {'; '.join(refused)}{more}. Nothing was restored: "
            "restore it to a folder, delete or mend these there, and take another snapshot."
        )


def _refused(file: sqlite3.Connection, form: Form) -> Iterator[str]:
    looks = [_look(column) for column in form.table.columns]
    # the bytes of a signature need not be read to see that they are bytes
    told = ", ".join(
        f'typeof("{one.name}")' if isinstance(one.type, LargeBinary) else f'"{one.name}"'
        for one in form.table.columns
    )
    with closing(file.execute(f"SELECT {told} FROM {form.table.name}")) as cursor:
        for row in cursor:
            for column, look, value in zip(form.table.columns, looks, row, strict=True):
                if value is None:
                    wrong = None if column.nullable else "nothing, where something has to be"
                else:
                    wrong = look(value)
                if wrong is not None:
                    yield f"{column.name} of {form.key(row)} ({wrong})"


def _look(column: Column[Any]) -> _Look:
    kind = column.type
    if isinstance(kind, LargeBinary):
        return lambda value: None if value in ("blob", "null") else f"{value} where bytes should be"
    if isinstance(kind, JSON):
        return _look_at_document
    if isinstance(kind, Boolean):
        return lambda value: None if value in (0, 1) else "neither true nor false"
    if isinstance(kind, Float):
        return lambda value: None if isinstance(value, float | int) else "no number"
    if isinstance(kind, Integer):
        there = kind.dialect_impl(dialect())  # type: ignore[no-untyped-call]
        most = _LARGE if isinstance(there, BigInteger) else _SMALL
        return lambda value: (
            None if isinstance(value, int) and -most <= value < most else "no such whole number"
        )
    if isinstance(kind, String | Text):
        longest = kind.length
        return lambda value: _look_at_text(value, longest)
    raise TypeError(f"{column}: nobody has said what PostgreSQL takes of {kind!r}")


def _look_at_text(value: Any, longest: int | None) -> str | None:
    if not isinstance(value, str):
        return "no text"
    if "\0" in value:
        return "a zero byte in a text"
    if longest is not None and len(value) > longest:
        return f"{len(value)} characters, where {longest} have room"
    try:
        value.encode()
    except UnicodeEncodeError:
        return "no UTF-8"
    return None


def _look_at_document(value: Any) -> str | None:
    if isinstance(value, int | float):
        return None if abs(value) < float("inf") else "no JSON"
    wrong = _look_at_text(value, None)
    if wrong is not None:
        return wrong
    try:
        json.loads(value, parse_constant=_refuse)
    except (ValueError, RecursionError):
        return "no JSON"
    return None


def _refuse(constant: str) -> None:
    raise ValueError(constant)  # NaN and the infinities are Python's, not JSON's


def _text(data: bytes) -> str:
    return data.decode("utf-8", "surrogateescape")
