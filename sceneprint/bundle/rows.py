"""Rows of tables as parts of a bundle, the same from SQLite and from PostgreSQL.

    rows of a table  --cut_rows-->  rows of each part, and their digest
    --write_part-->  JSON lines, compressed  --read_rows-->  the same rows

A part ends after a row whose key has a hash of a certain kind. So a row that comes, changes or goes
changes the part that it is in, and no other: what did not change is in the bundle before already.
The digest tells so before the part is written, which costs several times as much as to read it.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import marshal
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from functools import cache
from itertools import islice
from operator import itemgetter
from typing import Any

from sqlalchemy import (
    JSON,
    Boolean,
    Column,
    Connection,
    Float,
    LargeBinary,
    String,
    Table,
)
from sqlalchemy.exc import IntegrityError

from sceneprint.errors import BundleError, DamagedBundle, UnusableStore
from sceneprint.store.tables import events, metadata, pending_events

#: Rows of a part on average, and bytes after which one ends in any case.
_ROWS, _BYTES = 1024, 8 << 20
#: Most bytes of a part when it is read: one row may be as large as a request.
_MOST_BYTES = 1 << 28
#: Rows that are read or written at once; a signature may have 125,000 bytes.
_BLOCK = 200
#: Rows whose bytes are counted at once while a part grows.
_TOGETHER = 32

_encode = json.JSONEncoder(separators=(",", ":")).encode

#: Values of a row, in the order of the columns of its table.
Row = Sequence[Any]


def tables() -> list[Table]:
    """Return the tables of a bundle, each after those that it refers to.

    Pending events are none of them: they are numbered as they are read.
    """
    return [one for one in metadata.sorted_tables if one is not pending_events]


def numbered(table: Table) -> bool:
    """Return whether the database numbers the rows of a table, and uses no number twice."""
    return bool(table.dialect_options["sqlite"]["autoincrement"])


def column_names(table: Table) -> str:
    """Return all columns of a table, as SQL wants them."""
    return ", ".join(f'"{one.name}"' for one in table.columns)


def read_table(connection: Connection, table: Table) -> Iterator[Row]:
    """Yield all rows of a table in the order of their keys, as the driver has them.

    Documents (JSON) are text, and on PostgreSQL truth values are numbers, as they are on SQLite.

    Parameters
    ----------
    connection : of a transaction that sees one state
    """
    server = connection.dialect.name == "postgresql"
    columns = ", ".join(f'"{one.name}"' + (_cast(one) if server else "") for one in table.columns)
    order = ", ".join(  # SQLite orders texts by their bytes
        f'"{one.name}"' + (' COLLATE "C"' if server and isinstance(one.type, String) else "")
        for one in table.primary_key.columns
    )
    yield from fetch_rows(connection, f"SELECT {columns} FROM {table.name} ORDER BY {order}")
    if server and table is events:
        yield from _pending(connection)


def fetch_rows(connection: Connection, statement: str) -> Iterator[Row]:
    """Yield the rows of a statement as tuples, a block at a time."""
    options = {"stream_results": True}
    with closing(connection.exec_driver_sql(statement, execution_options=options)) as found:
        while block := found.fetchmany(_BLOCK):
            yield from map(tuple, block)


def _cast(column: Column[Any]) -> str:
    if isinstance(column.type, JSON):
        return "::text"
    return "::integer" if isinstance(column.type, Boolean) else ""


def _pending(connection: Connection) -> Iterator[Row]:
    """Yield the events that PostgreSQL has not numbered yet, with the numbers that come next."""
    last = _last_of_server(connection, events.name)
    for number, row in enumerate(read_table(connection, pending_events), last + 1):
        yield (number, *row[1:])


def _last_of_server(connection: Connection, name: str) -> int:
    sequence = connection.exec_driver_sql(
        f"SELECT pg_get_serial_sequence('{name}', 'number')"
    ).scalar_one()
    statement = f"SELECT CASE WHEN is_called THEN last_value ELSE 0 END FROM {sequence}"
    return int(connection.exec_driver_sql(statement).scalar_one())


def last_numbers(connection: Connection) -> dict[str, int]:
    """Return the last number that each table has given out, 0 where it has given none."""
    found = {one.name: 0 for one in tables() if numbered(one)}
    if connection.dialect.name == "sqlite":
        given_out = connection.exec_driver_sql(
            "SELECT name, seq FROM sqlite_sequence WHERE typeof(seq) = 'integer'"
        )
        return found | {name: seq for name, seq in given_out if name in found}
    found = {name: _last_of_server(connection, name) for name in found}
    pending = f"SELECT count(*) FROM {pending_events.name}"
    found[events.name] += int(connection.exec_driver_sql(pending).scalar_one())
    return found


def cut_rows(rows: Iterable[Row], keys: Sequence[int]) -> Iterator[tuple[list[Row], str]]:
    """Yield the rows of one part after the other, and a digest that no other rows have.

    Parameters
    ----------
    rows : of texts, bytes and numbers
    keys : places of the values in a row by which the rows are in order
    """
    key = itemgetter(*keys)
    part, size, hashed = list[Row](), 0, hashlib.sha256()
    for row in rows:
        part.append(row)
        ends = zlib.crc32(repr(key(row)).encode()) % _ROWS == 0
        if ends or len(part) % _TOGETHER == 0:
            size += _add(hashed, part)
        if ends or size >= _BYTES:
            yield part, hashed.hexdigest()
            part, size, hashed = [], 0, hashlib.sha256()
    if part:
        _add(hashed, part)
        yield part, hashed.hexdigest()


def _add(hashed: hashlib._Hash, part: list[Row]) -> int:
    """Add the last rows of a part to its digest; return their bytes."""
    first = (len(part) - 1) // _TOGETHER * _TOGETHER
    packed = marshal.dumps(part[first:], 2)  # the last version without references between values
    hashed.update(packed)
    return len(packed)


def write_part(columns: Sequence[str], rows: Iterable[Row]) -> bytes:
    """Return the bytes of a part: the names of the columns and each row, as lines of JSON."""
    from isal import isal_zlib

    lines = "\n".join([json.dumps(list(columns)), *map(_encode, rows)])
    return bytes(isal_zlib.compress(lines.encode(), 1))


def table_part(table: Table, rows: Iterable[Row]) -> bytes:
    """Return the bytes of a part of a table; see `write_part`.

    Raises
    ------
    UnusableStore : a value is not of its column's type, as after somebody has edited the database.
    """
    try:
        return write_part([one.name for one in table.columns], encoded_rows(table.columns, rows))
    except (TypeError, ValueError) as error:
        raise UnusableStore(
            f"A row of table {table.name} cannot be read ({error}). Run `sceneprint fsck`."
        ) from error


def encoded_rows(columns: Iterable[Column[Any]], rows: Iterable[Row]) -> Iterator[Row]:
    """Yield rows of a database as JSON has them: bytes as base64, documents as text."""
    encoders = [_encoder(one) for one in columns]
    for row in rows:
        yield [x if f is None or x is None else f(x) for f, x in zip(encoders, row, strict=True)]


def _encoder(column: Column[Any]) -> Callable[[Any], Any] | None:
    """Return what turns a value of the driver into one of JSON; None where it is one."""
    if isinstance(column.type, LargeBinary):
        return lambda value: base64.b64encode(value).decode()
    if isinstance(column.type, Boolean):
        return bool
    if isinstance(column.type, JSON):  # SQLite keeps a bare number as one
        return lambda value: value if isinstance(value, str) else json.dumps(value, sort_keys=True)
    return None


def read_rows(data: bytes, columns: Sequence[str]) -> Iterator[Row]:
    """Yield the rows of a part.

    Parameters
    ----------
    data : of `write_part`
    columns : that it must have

    Raises
    ------
    DamagedBundle : it is no such part.
    """
    try:
        unpacker = zlib.decompressobj()
        text = unpacker.decompress(data, _MOST_BYTES)
        if not unpacker.eof or unpacker.unused_data:
            raise ValueError("it is longer than any that is written")
        head, *lines = text.split(b"\n")
        if json.loads(head) != list(columns):
            raise ValueError("it has other columns")
        for line in lines:
            row = json.loads(line)
            if not isinstance(row, list) or len(row) != len(columns):
                raise ValueError("a row has another number of columns")
            yield row
    except (zlib.error, ValueError, RecursionError) as error:
        raise DamagedBundle(
            f"A part of the bundle holds no rows ({error}), and nothing was restored."
        ) from error


def decoded_rows(columns: Sequence[Column[Any]], rows: Iterable[Row]) -> Iterator[Row]:
    """Yield rows of `encoded_rows` as the database takes them, each value of its column's type.

    Raises
    ------
    DamagedBundle : a value is of another type.
    """
    decoders = [_decoder(one) for one in columns]
    for row in rows:
        try:
            yield [None if x is None else f(x) for f, x in zip(decoders, row, strict=True)]
        except (TypeError, ValueError, binascii.Error) as error:
            raise DamagedBundle(
                f"A row of table {columns[0].table.name} of the bundle is not one of this schema "
                f"({error}), and nothing was restored."
            ) from error


@cache
def _decoder(column: Column[Any]) -> Callable[[Any], Any]:
    if isinstance(column.type, LargeBinary):
        return lambda value: base64.b64decode(value, validate=True)
    kinds: tuple[type, ...] = (int,)
    if isinstance(column.type, Boolean):
        kinds = (bool,)
    elif isinstance(column.type, JSON | String):
        kinds = (str,)
    elif isinstance(column.type, Float):
        kinds = (int, float)

    def check(value: Any) -> Any:
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            raise TypeError(f"column {column.name} holds a {type(value).__name__}")
        return value

    return check


def write_rows(connection: Connection, table: Table, rows: Iterator[Row]) -> None:
    """Insert rows as `decoded_rows` yields them.

    Raises
    ------
    DamagedBundle : they break a constraint of the table.
    BundleError : the database cannot hold one of them.
    """
    if connection.dialect.name == "sqlite":
        marks = ", ".join("?" * len(table.columns))
        statement = f"INSERT INTO {table.name} ({column_names(table)}) VALUES ({marks})"
        try:
            while block := [tuple(row) for row in islice(rows, _BLOCK)]:
                connection.exec_driver_sql(statement, block)
        except IntegrityError as error:
            raise _contradiction(table, error.orig) from error
        return
    import psycopg

    driver: Any = connection.connection.cursor()
    statement = f"COPY {table.name} ({column_names(table)}) FROM STDIN"
    try:
        with driver as cursor, cursor.copy(statement) as copy:
            for row in rows:
                copy.write_row(row)
    except psycopg.IntegrityError as error:
        raise _contradiction(table, error) from error
    except psycopg.DataError as error:
        # SQLite keeps what it is given: a file that somebody has edited may hold anything
        raise BundleError(
            f"PostgreSQL cannot hold a row of table {table.name} "
            f"({str(error).partition(chr(10))[0]}), and nothing was restored. Restore the bundle "
            "to a folder, mend the row there, and take a snapshot of that."
        ) from error


def _contradiction(table: Table, error: object) -> DamagedBundle:
    return DamagedBundle(
        f"The rows of table {table.name} of the bundle contradict each other or those before "
        f"({str(error).partition(chr(10))[0]}), and nothing was restored. Restore another bundle."
    )


def count_on(connection: Connection, numbers: dict[str, int]) -> None:
    """Let every table go on after the last number that it has given out."""
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql("DELETE FROM sqlite_sequence")
    for table in tables():
        if not numbered(table):
            continue
        name, last = table.name, numbers.get(table.name, 0)
        highest = f"SELECT coalesce(max(number), 0) FROM {name}"
        last = max(last, int(connection.exec_driver_sql(highest).scalar_one()))
        if connection.dialect.name == "sqlite":
            if last:
                values = (name, last)
                connection.exec_driver_sql("INSERT INTO sqlite_sequence VALUES (?, ?)", values)
            continue
        connection.exec_driver_sql(
            f"SELECT setval(pg_get_serial_sequence('{name}', 'number'), {max(last, 1)}, "
            f"{'true' if last else 'false'})"
        )
