"""The same rows in both databases: how they are asked for, and how they are compared.

    Table  --form_of-->  Form  --of_file | of_server-->  SQL
    rows   --Sum-->  how many, and a digest that is the same for the same rows

Documents (JSON) travel as the text that they are: nothing is parsed and written anew.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from sqlalchemy import JSON, Boolean, Column, Float, LargeBinary, String, Table

#: Values of a row, as a driver gives them.
Row = Sequence[Any]
#: Rows that are held at once; a signature may have 125,000 bytes, a model 700,000.
_BLOCK, _BLOCK_OF_BYTES = 1000, 100


@dataclass(frozen=True)
class Form:
    """How rows of a table are read and written."""

    table: Table

    @cached_property
    def names(self) -> str:
        """All columns, as SQL wants them."""
        return ", ".join(f'"{column.name}"' for column in self.table.columns)

    @property
    def block(self) -> int:
        """Rows to hold at once."""
        return _BLOCK_OF_BYTES if self.places(LargeBinary) else _BLOCK

    @property
    def counts(self) -> bool:
        """Whether the database gives its rows numbers, none of them twice."""
        return bool(self.table.dialect_options["sqlite"]["autoincrement"])

    def places(self, kind: type) -> list[int]:
        """Where the columns of a kind are."""
        return [i for i, one in enumerate(self.table.columns) if isinstance(one.type, kind)]

    def key(self, row: Row) -> str:
        """What a row is called in a message."""
        own = [i for i, one in enumerate(self.table.columns) if one.primary_key]
        return f"row {', '.join(f'{row[i]!r:.80}' for i in own)} of table {self.table.name}"

    def of_file(self) -> str:
        """SQL that reads all rows of a SQLite file, in the order of their keys."""
        return f"SELECT {self.names} FROM {self.table.name} ORDER BY {self._order(server=False)}"

    def of_server(self, *, hashed: bool = False) -> str:
        """The same of PostgreSQL.

        Parameters
        ----------
        hashed : have bytes hashed there, where only a digest of the rows is wanted
        """
        told = ", ".join(_asked(column, hashed) for column in self.table.columns)
        return f"SELECT {told} FROM {self.table.name} ORDER BY {self._order(server=True)}"

    def for_server(self, row: Row) -> list[Any]:
        """A row of a SQLite file as PostgreSQL takes it."""
        values = list(row)
        for i in self._flags:
            values[i] = None if values[i] is None else bool(values[i])
        for i in self._documents:
            if isinstance(values[i], int | float):  # a bare number: SQLite keeps it as one
                values[i] = json.dumps(values[i])
        return values

    def compared(self, row: Row) -> bytes:
        """A row as it enters a digest, whichever database it is of."""
        values = self.for_server(row)
        for i in self._blobs:
            if isinstance(values[i], bytes):
                values[i] = hashlib.sha256(values[i]).hexdigest()
        for i in self._floats:
            if values[i] is not None:  # SQLite knows neither -0.0 nor NaN
                values[i] = values[i] + 0.0 if values[i] == values[i] else None
        for i in self._documents:
            text = values[i]
            if text is not None and text[:1] not in tuple('[{"ntf'):  # 5, or 5.0, or 5e0
                values[i] = repr(float(text))
        return repr(values).encode("utf-8", "surrogateescape")

    @cached_property
    def _flags(self) -> list[int]:
        return self.places(Boolean)

    @cached_property
    def _documents(self) -> list[int]:
        return self.places(JSON)

    @cached_property
    def _blobs(self) -> list[int]:
        return self.places(LargeBinary)

    @cached_property
    def _floats(self) -> list[int]:
        return self.places(Float)

    def _order(self, *, server: bool) -> str:
        # SQLite orders texts by their bytes
        return ", ".join(
            f'"{one.name}"' + (' COLLATE "C"' if server and isinstance(one.type, String) else "")
            for one in self.table.primary_key.columns
        )


def _asked(column: Column[Any], hashed: bool) -> str:
    if isinstance(column.type, JSON):
        return f'"{column.name}"::text'
    if hashed and isinstance(column.type, LargeBinary):
        return f"encode(sha256(\"{column.name}\"), 'hex')"
    return f'"{column.name}"'


class Sum:
    """How many rows went by, and a digest of them.

    Parameters
    ----------
    form : of their table
    """

    def __init__(self, form: Form) -> None:
        self._form, self._hashed, self._count = form, hashlib.sha256(), 0

    def add(self, row: Row) -> None:
        """Take another row; they come in the order of their keys."""
        data = self._form.compared(row)
        self._hashed.update(b"%d " % len(data) + data)
        self._count += 1

    def over(self, rows: Iterable[Row]) -> Iterator[Row]:
        """Rows that go by."""
        for row in rows:
            self.add(row)
            yield row

    @property
    def told(self) -> tuple[int, str]:
        """What two tables of the same rows have in common."""
        return self._count, self._hashed.hexdigest()


def rows_of_file(file: sqlite3.Connection, form: Form) -> Iterator[Row]:
    """All rows of a table, in the order of their keys."""
    with closing(file.cursor()) as cursor:
        cursor.arraysize = form.block
        cursor.execute(form.of_file())
        while block := cursor.fetchmany():
            yield from block
