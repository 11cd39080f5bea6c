"""Conversion of tables to parts of a bundle, in the same format for SQLite and PostgreSQL.

    rows of a table  --cut_rows-->  rows of each part, and their digest
    --write_part-->  JSON lines, compressed  --read_rows-->  the same rows

The hash of a row's key decides whether a part ends after the row. Therefore, an inserted, changed
or deleted row changes only its own part, and the previous bundle contains the other parts. Digests
of the rows identify these parts before encoding, which takes several times as long as reading.
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

#: Mean number of rows in a part, and size, in bytes, at which a part ends in any case.
_ROWS, _BYTES = 1024, 8 << 20
#: Maximum uncompressed size of a part in bytes; a row may be as large as a request.
_MOST_BYTES = 1 << 28
#: Number of rows to read or write at once; a signature may take 125,000 bytes.
_BLOCK = 200
#: Number of rows to hash at once.
_BATCH = 32

_encode = json.JSONEncoder(separators=(",", ":")).encode

#: Values of a row, in the order of the columns of its table.
Row = Sequence[Any]


def tables() -> list[Table]:
    """Return the tables of a bundle; a table follows all tables to which it refers.

    The table of pending events is omitted: `read_table` yields its rows as events.
    """
    return [table for table in metadata.sorted_tables if table is not pending_events]


def numbered(table: Table) -> bool:
    """Return whether the database numbers the rows of a table and never reuses a number."""
    return bool(table.dialect_options["sqlite"]["autoincrement"])


def column_names(table: Table) -> str:
    """Return the quoted names of all columns of a table, separated by commas."""
    return ", ".join(f'"{column.name}"' for column in table.columns)


def read_table(connection: Connection, table: Table) -> Iterator[Row]:
    """Yield all rows of a table in the order of their keys, with equal values for both databases.

    JSON documents are text, and Boolean values are integers. Events that PostgreSQL has not
    numbered yet get numbers after the last one.
    """
    server = connection.dialect.name == "postgresql"
    columns = ", ".join(
        f'"{column.name}"' + (_cast_suffix(column) if server else "") for column in table.columns
    )
    order = ", ".join(  # collation "C" compares text by bytes, like SQLite
        f'"{column.name}"' + (' COLLATE "C"' if server and isinstance(column.type, String) else "")
        for column in table.primary_key.columns
    )
    yield from fetch_rows(connection, f"SELECT {columns} FROM {table.name} ORDER BY {order}")
    if server and table is events:
        yield from _pending_events(connection)


def fetch_rows(connection: Connection, statement: str) -> Iterator[Row]:
    """Yield the result rows of a statement as tuples, fetched in blocks."""
    options = {"stream_results": True}
    with closing(connection.exec_driver_sql(statement, execution_options=options)) as result:
        while block := result.fetchmany(_BLOCK):
            yield from map(tuple, block)


def _cast_suffix(column: Column[Any]) -> str:
    if isinstance(column.type, JSON):
        return "::text"
    return "::integer" if isinstance(column.type, Boolean) else ""


def _pending_events(connection: Connection) -> Iterator[Row]:
    """Yield the events that PostgreSQL has not numbered yet; number them consecutively."""
    last = _last_server_number(connection, events.name)
    for number, row in enumerate(read_table(connection, pending_events), last + 1):
        yield (number, *row[1:])


def _last_server_number(connection: Connection, name: str) -> int:
    sequence = connection.exec_driver_sql(
        f"SELECT pg_get_serial_sequence('{name}', 'number')"
    ).scalar_one()
    statement = f"SELECT CASE WHEN is_called THEN last_value ELSE 0 END FROM {sequence}"
    return int(connection.exec_driver_sql(statement).scalar_one())


def last_numbers(connection: Connection) -> dict[str, int]:
    """Return the last assigned row number of each numbered table; 0 if there is none."""
    numbers = {table.name: 0 for table in tables() if numbered(table)}
    if connection.dialect.name == "sqlite":
        sequences = connection.exec_driver_sql(
            "SELECT name, seq FROM sqlite_sequence WHERE typeof(seq) = 'integer'"
        )
        return numbers | {name: seq for name, seq in sequences if name in numbers}
    numbers = {name: _last_server_number(connection, name) for name in numbers}
    pending = f"SELECT count(*) FROM {pending_events.name}"
    numbers[events.name] += int(connection.exec_driver_sql(pending).scalar_one())
    return numbers


def cut_rows(rows: Iterable[Row], keys: Sequence[int]) -> Iterator[tuple[list[Row], str]]:
    """Group rows into parts; yield the rows of each part and their digest.

    Parameters
    ----------
    rows : rows in the order of their keys
    keys : positions of the key columns in a row
    """
    key = itemgetter(*keys)
    part, size, hashed = list[Row](), 0, hashlib.sha256()
    for row in rows:
        part.append(row)
        ends = zlib.crc32(repr(key(row)).encode()) % _ROWS == 0
        if ends or len(part) % _BATCH == 0:
            size += _hash_batch(hashed, part)
        if ends or size >= _BYTES:
            yield part, hashed.hexdigest()
            part, size, hashed = [], 0, hashlib.sha256()
    if part:
        _hash_batch(hashed, part)
        yield part, hashed.hexdigest()


def _hash_batch(hashed: hashlib._Hash, part: list[Row]) -> int:
    """Add the last batch of rows of a part to its digest; return the batch's size in bytes."""
    first = (len(part) - 1) // _BATCH * _BATCH
    packed = marshal.dumps(part[first:], 2)  # later versions encode repeated objects by reference
    hashed.update(packed)
    return len(packed)


def write_part(columns: Sequence[str], rows: Iterable[Row]) -> bytes:
    """Return the bytes of a part: compressed lines of JSON with the column names and the rows."""
    from isal import isal_zlib

    lines = "\n".join([json.dumps(list(columns)), *map(_encode, rows)])
    return bytes(isal_zlib.compress(lines.encode(), 1))


def table_part(table: Table, rows: Iterable[Row]) -> bytes:
    """Encode rows of a table as the bytes of a part.

    Raises
    ------
    UnusableStore : If a value does not have its column's type, for example after manual edits.
    """
    try:
        return write_part(
            [column.name for column in table.columns], encoded_rows(table.columns, rows)
        )
    except (TypeError, ValueError) as error:
        raise UnusableStore(
            f"A row of table {table.name} cannot be read ({error}). Run `sceneprint fsck`."
        ) from error


def encoded_rows(columns: Iterable[Column[Any]], rows: Iterable[Row]) -> Iterator[Row]:
    """Convert rows of a database for JSON: bytes to base64, documents to text."""
    encoders = [_encoder(column) for column in columns]
    for row in rows:
        yield [x if f is None or x is None else f(x) for f, x in zip(encoders, row, strict=True)]


def _encoder(column: Column[Any]) -> Callable[[Any], Any] | None:
    """Return the function that encodes a driver's value for JSON; None if JSON supports it."""
    if isinstance(column.type, LargeBinary):
        return lambda value: base64.b64encode(value).decode()
    if isinstance(column.type, Boolean):
        return bool
    if isinstance(column.type, JSON):  # SQLite returns numbers in JSON as numbers
        return lambda value: value if isinstance(value, str) else json.dumps(value, sort_keys=True)
    return None


def read_rows(data: bytes, columns: Sequence[str]) -> Iterator[Row]:
    """Decode the rows of a part.

    Parameters
    ----------
    data : result of `write_part`
    columns : expected names of the columns

    Raises
    ------
    DamagedBundle : If the part is damaged or has other columns.
    """
    try:
        unpacker = zlib.decompressobj()
        text = unpacker.decompress(data, _MOST_BYTES)
        if not unpacker.eof or unpacker.unused_data:
            raise ValueError("it is too long or truncated")
        head, *lines = text.split(b"\n")
        if json.loads(head) != list(columns):
            raise ValueError("its columns differ")
        for line in lines:
            row = json.loads(line)
            if not isinstance(row, list) or len(row) != len(columns):
                raise ValueError("a row has a different number of columns")
            yield row
    except (zlib.error, ValueError, RecursionError) as error:
        raise DamagedBundle(
            f"A part of the bundle is damaged ({error}). Nothing was restored."
        ) from error


def decoded_rows(columns: Sequence[Column[Any]], rows: Iterable[Row]) -> Iterator[Row]:
    """Convert rows from `encoded_rows` to values of the columns' types.

    Raises
    ------
    DamagedBundle : If a value cannot be converted.
    """
    decoders = [_decoder(column) for column in columns]
    for row in rows:
        try:
            yield [None if x is None else f(x) for f, x in zip(decoders, row, strict=True)]
        except (TypeError, ValueError, binascii.Error) as error:
            raise DamagedBundle(
                f"A row of table {columns[0].table.name} in the bundle does not fit the schema "
                f"({error}). Nothing was restored."
            ) from error


@cache
def _decoder(column: Column[Any]) -> Callable[[Any], Any]:
    """Return the function that decodes a value of a column; it raises TypeError or ValueError."""
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
    """Insert rows from `decoded_rows` into a table.

    Raises
    ------
    DamagedBundle : If a row violates a constraint of the table.
    BundleError : If the database cannot store a row.
    """
    if connection.dialect.name == "sqlite":
        marks = ", ".join("?" * len(table.columns))
        statement = f"INSERT INTO {table.name} ({column_names(table)}) VALUES ({marks})"
        try:
            while block := [tuple(row) for row in islice(rows, _BLOCK)]:
                connection.exec_driver_sql(statement, block)
        except IntegrityError as error:
            raise _inconsistency(table, error.orig) from error
        return
    import psycopg

    driver: Any = connection.connection.cursor()
    statement = f"COPY {table.name} ({column_names(table)}) FROM STDIN"
    try:
        with driver as cursor, cursor.copy(statement) as copy:
            for row in rows:
                copy.write_row(row)
    except psycopg.IntegrityError as error:
        raise _inconsistency(table, error) from error
    except psycopg.DataError as error:
        # SQLite does not check values, so an edited file may contain any value
        raise BundleError(
            f"PostgreSQL cannot store a row of table {table.name} "
            f"({str(error).partition(chr(10))[0]}). Nothing was restored. Restore the bundle to a "
            "folder, correct the row there, and take a snapshot of the folder."
        ) from error


def _inconsistency(table: Table, error: object) -> DamagedBundle:
    return DamagedBundle(
        f"The rows of table {table.name} in the bundle are inconsistent "
        f"({str(error).partition(chr(10))[0]}). Nothing was restored. Restore another bundle."
    )


def set_numbers(connection: Connection, numbers: dict[str, int]) -> None:
    """Make every numbered table continue after its last assigned number in `numbers`."""
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
