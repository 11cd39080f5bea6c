"""A SQLite file written into the empty database of a fleet, in one transaction.

file  --copy_into-->  PostgreSQL: the same rows, the same numbers, the same next numbers
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from typing import Any

from sqlalchemy import Connection

from sceneprint.errors import SnapshotError
from sceneprint.maintenance.columns import Form, Row, Sum, rows_of_file
from sceneprint.maintenance.exporting import rows_of_server
from sceneprint.store.postgres import allow
from sceneprint.store.tables import metadata, secrets
from sceneprint.store.vectors import drop_tables

#: What a database of which nobody has made use holds: its secret, and what a service counts.
_OF_ITSELF = ("secrets", "samples")


def copy_into(connection: Connection, file: sqlite3.Connection) -> None:
    """Write all rows of a file; each table is read again and compared.

    Parameters
    ----------
    connection : of a writing transaction
    file : of the schema of this version

    Raises
    ------
    SnapshotError : the database holds something, or did not keep what was written.
    """
    allow(connection, 0)
    check_empty(connection)
    drop_tables(connection)  # of vectors, which a copy of signatures does not make
    for name in _OF_ITSELF:
        connection.exec_driver_sql(f"DELETE FROM {name}")
    # foreign keys ask for the order
    for table in metadata.sorted_tables:
        form = Form(table)
        written = Sum(form)
        _write(connection, form, written.over(rows_of_file(file, form)))
        found = Sum(form)
        for row in rows_of_server(connection, form, hashed=True):
            found.add(row)
        if found.told != written.told:
            raise SnapshotError(
                f"Table {table.name} holds {found.told[0]} rows that are not the "
                f"{written.told[0]} that were written. Nothing was restored; see the "
                "server's log."
            )
    # anybody may write anything there
    asked = "SELECT name, seq FROM sqlite_sequence WHERE typeof(seq) = 'integer'"
    given = dict(file.execute(asked))
    for table in metadata.sorted_tables:
        if Form(table).counts:
            _count_on(connection, table.name, given.get(table.name, 0))


def take_secrets(connection: Connection, file: sqlite3.Connection) -> None:
    """Let an empty database have the secrets of a file."""
    connection.exec_driver_sql("DELETE FROM secrets")
    form = Form(secrets)
    _write(connection, form, rows_of_file(file, form))


def check_empty(connection: Connection) -> None:
    """See that a database of our schema, or of none, holds nothing that would be lost.

    Raises
    ------
    SnapshotError : it does.
    """
    for table in metadata.sorted_tables:
        if table.name in _OF_ITSELF:
            continue
        if connection.exec_driver_sql(f"SELECT to_regclass('{table.name}')").scalar() is None:
            continue
        if connection.exec_driver_sql(f"SELECT 1 FROM {table.name} LIMIT 1").first() is not None:
            raise SnapshotError(
                f"The database has rows in its table {table.name}, and nothing is overwritten. "
                "Make an empty one (CREATE DATABASE), and name it in SCENEPRINT_DATABASE_URL."
            )


def _write(connection: Connection, form: Form, rows: Iterator[Row]) -> None:
    driver: Any = connection.connection.cursor()
    with driver as cursor, cursor.copy(f"COPY {form.table.name} ({form.names}) FROM STDIN") as copy:
        for row in rows:
            copy.write_row(form.for_server(row))


def _count_on(connection: Connection, name: str, given: int) -> None:
    """Let the next number be one that was never given out."""
    asked = f"SELECT coalesce(max(number), 0) FROM {name}"
    last = max(given, int(connection.exec_driver_sql(asked).scalar_one()))
    connection.exec_driver_sql(
        f"SELECT setval(pg_get_serial_sequence('{name}', 'number'), {max(last, 1)}, "
        f"{'true' if last else 'false'})"
    )
