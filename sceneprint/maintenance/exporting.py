"""The database of a fleet, written into a SQLite file of the same schema.

PostgreSQL  --copy_server-->  file: the same rows, the same numbers, the same next numbers
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

from sqlalchemy import URL, Connection

from sceneprint.errors import UnusableStore
from sceneprint.maintenance.columns import Form, Row, Sum, rows_of_file
from sceneprint.store.database import Database, open_database
from sceneprint.store.postgres import allow
from sceneprint.store.tables import metadata

#: Bytes written so far.
Written = Callable[[int], None]


def server_bytes(database: Database) -> int:
    """Bytes that our tables take in PostgreSQL, with their indexes."""
    names = ", ".join(f"pg_total_relation_size('{one.name}')" for one in metadata.sorted_tables)
    with database.read() as connection:
        found = connection.exec_driver_sql(f"SELECT {names.replace(', ', ' + ')}").scalar_one()
    return int(found)


def copy_server(database: Database, to: Path, written: Written) -> None:
    """Write one state of a database that is in use into a file of its own; nobody waits for it.

    Parameters
    ----------
    database : PostgreSQL, of the schema of this version
    to : is made
    written : told of the bytes of the file so far

    Raises
    ------
    UnusableStore : it cannot be read to its end, or the file not be written.
    """
    try:
        _make_empty(to)
        with closing(sqlite3.connect(to, isolation_level=None)) as file:
            # until it is whole nobody needs it: the archive that it becomes a part of is synced
            file.execute("PRAGMA journal_mode = OFF")
            file.execute("PRAGMA synchronous = OFF")
            indexes = _without_indexes(file)
            with database.read() as connection:
                allow(connection, 0)  # what is on the way may be large, and the disk slow
                sums = [_copy(connection, file, Form(one), written, to)
                        for one in metadata.sorted_tables]  # fmt: skip
                file.execute("BEGIN")
                file.execute("DELETE FROM sqlite_sequence")
                file.executemany("INSERT INTO sqlite_sequence VALUES (?, ?)", _numbers(connection))
                file.execute("COMMIT")
            for statement in indexes:
                file.execute(statement)
            for table, known in zip(metadata.sorted_tables, sums, strict=True):
                _check(file, Form(table), known)
    except sqlite3.Error as error:
        raise UnusableStore(
            f"{to.parent}: the database cannot be copied there ({error}). See that the disk has "
            "room, and try again."
        ) from error


def rows_of_server(connection: Connection, form: Form, *, hashed: bool = False) -> Iterator[Row]:
    """All rows of a table, in the order of their keys; a block of them at a time."""
    asked, streamed = form.of_server(hashed=hashed), {"stream_results": True}
    with closing(connection.exec_driver_sql(asked, execution_options=streamed)) as found:
        while block := found.fetchmany(form.block):
            yield from block


def _make_empty(path: Path) -> None:
    open_database(
        URL.create("sqlite", database=str(path)).render_as_string(hide_password=False)
    ).close()


def _without_indexes(file: sqlite3.Connection) -> list[str]:
    """Drop what is quicker made in the end; returns the SQL that does."""
    asked = "SELECT name, sql FROM sqlite_master WHERE type = 'index' AND sql IS NOT NULL"
    found = file.execute(asked).fetchall()
    for name, _ in found:
        file.execute(f'DROP INDEX "{name}"')
    return [statement for _, statement in found]


def _copy(
    connection: Connection, file: sqlite3.Connection, form: Form, written: Written, to: Path
) -> tuple[int, str]:
    total = Sum(form)
    marks = ", ".join("?" * len(form.table.columns))
    insert = f"INSERT INTO {form.table.name} ({form.names}) VALUES ({marks})"
    file.execute("BEGIN")
    file.execute(f"DELETE FROM {form.table.name}")  # a new database has a secret of its own
    waiting: list[Row] = []
    for row in total.over(rows_of_server(connection, form)):
        waiting.append(tuple(row))
        if len(waiting) == form.block:
            file.executemany(insert, waiting)
            waiting.clear()
            written(to.stat().st_size)
    file.executemany(insert, waiting)
    file.execute("COMMIT")
    written(to.stat().st_size)
    return total.told


def _numbers(connection: Connection) -> Iterator[tuple[str, int]]:
    """The highest number that each table has ever given out."""
    for table in metadata.sorted_tables:
        if not Form(table).counts:
            continue
        named = f"SELECT pg_get_serial_sequence('{table.name}', 'number')"
        sequence = connection.exec_driver_sql(named).scalar_one()
        asked = f"SELECT last_value, is_called FROM {sequence}"
        last, is_called = connection.exec_driver_sql(asked).one()
        if is_called:
            yield table.name, last


def _check(file: sqlite3.Connection, form: Form, known: tuple[int, str]) -> None:
    found = Sum(form)
    for row in rows_of_file(file, form):
        found.add(row)
    if found.told != known:
        raise UnusableStore(
            f"The copy of table {form.table.name} is not what the database holds: "
            f"{found.told[0]} rows, where {known[0]} were read. Take the snapshot again; where "
            "this comes again, see the disk it is written to."
        )
