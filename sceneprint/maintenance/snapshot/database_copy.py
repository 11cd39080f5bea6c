"""The database in one file that nobody writes: made, checked, and asked what it refers to.

database in use  --open_source-->  Source  --Source.copy-->  file  --open_copy-->  its connection

Of PostgreSQL it is a SQLite file as well: one format, whatever the store is kept in.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sqlalchemy import (
    JSON,
    URL,
    Boolean,
    Connection,
    LargeBinary,
    String,
    Table,
    make_url,
)
from sqlalchemy.exc import ArgumentError

from sceneprint.errors import NewerSchema, SnapshotError, UnusableStore
from sceneprint.store.database import Database, known_revisions, open_database
from sceneprint.store.postgres.connection import allow
from sceneprint.store.read_only import look_at
from sceneprint.store.sqlite import ReadOnlyFile, read_only_file
from sceneprint.store.tables import metadata, pending_events
from sceneprint_client.api import FrameState

# The same rows in both databases: how they are asked for.
#
#     Form   --of_file | of_server-->  SQL
#
# Documents (JSON) travel as the text that they are: nothing is parsed and written anew.

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

    def of_server(self) -> str:
        """Return the same of PostgreSQL."""
        columns = ", ".join(
            f'"{one.name}"::text' if isinstance(one.type, JSON) else f'"{one.name}"'
            for one in self.table.columns
        )
        return f"SELECT {columns} FROM {self.table.name} ORDER BY {self._order(server=True)}"

    def for_server(self, row: Row) -> list[Any]:
        """A row of a SQLite file as PostgreSQL takes it."""
        values = list(row)
        for i in self._flags:
            values[i] = None if values[i] is None else bool(values[i])
        for i in self._documents:
            if isinstance(values[i], int | float):  # a bare number: SQLite keeps it as one
                values[i] = json.dumps(values[i])
        return values

    @cached_property
    def _flags(self) -> list[int]:
        return self.places(Boolean)

    @cached_property
    def _documents(self) -> list[int]:
        return self.places(JSON)

    def _order(self, *, server: bool) -> str:
        # SQLite orders texts by their bytes
        return ", ".join(
            f'"{one.name}"' + (' COLLATE "C"' if server and isinstance(one.type, String) else "")
            for one in self.table.primary_key.columns
        )


def rows_of_file(file: sqlite3.Connection, form: Form) -> Iterator[Row]:
    """All rows of a table, in the order of their keys."""
    with closing(file.cursor()) as cursor:
        cursor.arraysize = form.block
        cursor.execute(form.of_file())
        while block := cursor.fetchmany():
            yield from block


# The database of a fleet, written into a SQLite file of the same schema.
#
# PostgreSQL  --copy_server-->  file: the same rows, the same numbers, the same next numbers

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
        url = URL.create("sqlite", database=str(to))
        open_database(url.render_as_string(hide_password=False)).close()
        with closing(sqlite3.connect(to, isolation_level=None)) as file:
            # until it is whole nobody needs it: the archive that it becomes a part of is synced
            file.execute("PRAGMA journal_mode = OFF")
            file.execute("PRAGMA synchronous = OFF")
            indexes = _without_indexes(file)
            with database.read() as connection:
                allow(connection, 0)  # what is on the way may be large, and the disk slow
                for one in metadata.sorted_tables:
                    _copy(connection, file, Form(one), written, to)
                file.execute("BEGIN")
                file.execute("DELETE FROM sqlite_sequence")
                file.executemany("INSERT INTO sqlite_sequence VALUES (?, ?)", _numbers(connection))
                file.execute("COMMIT")
            for statement in indexes:
                file.execute(statement)
            number_pending_events(file)
    except sqlite3.Error as error:
        raise UnusableStore(
            f"{to.parent}: the database cannot be copied there ({error}). See that the disk has "
            "room, and try again."
        ) from error


def number_pending_events(file: sqlite3.Connection) -> None:
    """Number the events that were pending on PostgreSQL: in SQLite nobody would."""
    names = ", ".join(column.name for column in pending_events.c if column.name != "number")
    file.execute("BEGIN")
    file.execute(f"INSERT INTO events ({names}) SELECT {names} FROM pending_events ORDER BY number")
    file.execute("DELETE FROM pending_events")
    file.execute("COMMIT")


def rows_of_server(connection: Connection, form: Form) -> Iterator[Row]:
    """Yield all rows of a table, in the order of their keys; a block of them is held at a time."""
    options = {"stream_results": True}
    with closing(connection.exec_driver_sql(form.of_server(), execution_options=options)) as found:
        while block := found.fetchmany(form.block):
            yield from block


def _without_indexes(file: sqlite3.Connection) -> list[str]:
    """Drop what is quicker made in the end; returns the SQL that does."""
    asked = "SELECT name, sql FROM sqlite_master WHERE type = 'index' AND sql IS NOT NULL"
    found = file.execute(asked).fetchall()
    for name, _ in found:
        file.execute(f'DROP INDEX "{name}"')
    return [statement for _, statement in found]


def _copy(
    connection: Connection, file: sqlite3.Connection, form: Form, written: Written, to: Path
) -> None:
    marks = ", ".join("?" * len(form.table.columns))
    insert = f"INSERT INTO {form.table.name} ({form.names}) VALUES ({marks})"
    file.execute("BEGIN")
    file.execute(f"DELETE FROM {form.table.name}")  # a new database has a secret of its own
    waiting: list[Row] = []
    for row in rows_of_server(connection, form):
        waiting.append(tuple(row))
        if len(waiting) == form.block:
            file.executemany(insert, waiting)
            waiting.clear()
            written(to.stat().st_size)
    file.executemany(insert, waiting)
    file.execute("COMMIT")
    written(to.stat().st_size)


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


#: Seconds to wait for whoever recovers the database.
BUSY_S = 30.0
#: The digests of all blobs that have to be there.
_REFERRED = (
    "SELECT blob AS digest FROM frames WHERE deletion IS NOT NULL OR state NOT IN"
    f" ('{FrameState.DELETED}', '{FrameState.REDUNDANT}')"
    " UNION ALL SELECT geometry FROM signatures"
    " UNION ALL SELECT blob FROM job_files"
    " UNION ALL SELECT blob FROM surface_tiles WHERE blob IS NOT NULL"
    " UNION ALL SELECT draft FROM surface_tiles WHERE draft IS NOT NULL"
)


@dataclass(frozen=True)
class Source:
    """A database to be copied.

    Parameters
    ----------
    place : of it, for messages; without a password
    bytes : it takes, about
    copy : writes one state of it into a file that is made; tells the bytes of that so far
    """

    place: str
    bytes: int
    copy: Callable[[Path, Written], None]


@contextmanager
def open_source(url: str) -> Iterator[Source]:
    """A database that may be in use; nothing is written to it.

    Raises
    ------
    SnapshotError : it is a SQLite database in memory.
    UnusableStore, NewerSchema : it is missing, cannot be read, or is of another schema.
    """
    path = _file_of(url)
    if path is not None:
        if not path.is_file():
            raise UnusableStore(f"{path}: there is no database. Name its folder with --data.")
        yield Source(str(path), path.stat().st_size, lambda to, _: copy_database(path, to))
        return
    with look_at(url) as database:
        yield Source(database.shown, server_bytes(database), partial(copy_server, database))


def _file_of(url: str) -> Path | None:
    """The file of a SQLite database; None: it is another, or `look_at` says what is wrong.

    Raises
    ------
    SnapshotError : it is in no file.
    """
    try:
        parsed = make_url(url)
    except (ArgumentError, ValueError):  # the URL may hold a password: it is not shown
        return None
    if parsed.get_backend_name() != "sqlite":
        return None
    name = parsed.database or ""
    if name in ("", ":memory:") or name.startswith("file:"):
        raise SnapshotError(
            "Snapshots are taken of PostgreSQL, and of SQLite databases that are named by their "
            "path."
        )
    return Path(name).absolute()


def copy_database(source: Path, to: Path) -> None:
    """Write one state of a database that is in use into a file of its own; nobody waits for it.

    Parameters
    ----------
    source : of a service that may run
    to : is made

    Raises
    ------
    UnusableStore : it is missing, cannot be read, or is damaged; or there is no room for it.
    """
    if not source.is_file():
        raise UnusableStore(f"{source}: there is no database. Name its folder with --data.")
    alone = read_only_file(URL.create("sqlite", database=str(source)))
    sealed = None if alone is None else ReadOnlyFile(alone)  # SQLite could not write beside it
    before = None if sealed is None else sealed.state()
    try:
        connection = _connect(source, "mode=ro") if sealed is None else sealed.connect()
        connection.isolation_level = None
        with closing(connection):
            connection.execute("VACUUM INTO ?", (str(to),))
    except sqlite3.Error as error:
        raise UnusableStore(
            f"{source}: the database cannot be copied ({error}). See that it can be read and the "
            "disk has room; where it is damaged, restore an earlier snapshot."
        ) from error
    if sealed is not None:
        sealed.check(before)


def forget_answers(path: Path) -> None:
    """Let no query of a copy have an answer in a file, as the archive has none of these.

    Where the copy is damaged, whoever reads it says so.
    """
    with suppress(sqlite3.Error), closing(_connect(path, "mode=rw")) as file:
        file.execute("DELETE FROM queries WHERE NOT listed AND kept_at IS NULL")
        file.execute(
            "UPDATE queries SET bytes = 0, shown = NULL WHERE bytes > 0 AND kept_at IS NULL"
        )


@contextmanager
def open_copy(path: Path) -> Iterator[sqlite3.Connection]:
    """A database that nobody writes, to be read."""
    with closing(_connect(path, "mode=ro&immutable=1")) as connection:
        try:
            yield connection
        except sqlite3.Error as error:
            raise UnusableStore(
                f"{path}: the copy of the database cannot be read ({error}). Run `sceneprint "
                "fsck` on the store it was made of."
            ) from error


def check_plain(connection: sqlite3.Connection) -> str | None:
    """What a database of unknown origin holds beside tables and indexes; None where it is nothing.

    A view or a generated column runs what its author likes whenever a table is read, for ever, and
    a trigger whenever one is written.

    Parameters
    ----------
    connection : of `open_copy`; nothing of it has been read yet
    """
    asked = (
        "SELECT type, name FROM sqlite_master"
        " WHERE type NOT IN ('table', 'index') OR rootpage = 0 OR rootpage IS NULL LIMIT 1"
    )
    tables = "SELECT name FROM sqlite_master WHERE type = 'table'"
    try:
        odd = connection.execute(asked).fetchone()
        if odd is not None:  # without pages of its own: a view, a trigger, a virtual table
            return f"{odd[0]} {odd[1]!r:.80}"
        for (name,) in connection.execute(tables).fetchall():
            made = connection.execute(
                "SELECT name FROM pragma_table_xinfo(?) WHERE hidden <> 0", (name,)
            ).fetchone()
            if made is not None:
                return f"column {made[0]!r:.80} of {name!r:.80} is generated"
    except sqlite3.Error:
        pass  # who reads on says what is wrong
    return None


def check_copy(connection: sqlite3.Connection) -> str | None:
    """What is wrong with a database, in a few words; None where it is sound."""
    try:
        said = str(connection.execute("PRAGMA integrity_check(1)").fetchone()[0])
        if said != "ok":
            return said.replace("\n", " ")
        lost = connection.execute("PRAGMA foreign_key_check").fetchone()
    except sqlite3.Error as error:
        return str(error)
    return f"a row of {lost[0]} refers to one of {lost[2]} that is missing" if lost else None


def check_schema(connection: sqlite3.Connection, place: str) -> str:
    """The schema's revision.

    Parameters
    ----------
    connection : of `open_copy`
    place : what it is a copy of, for messages

    Raises
    ------
    NewerSchema : this version does not know it, nor what it refers to.
    UnusableStore : there is none.
    """
    try:
        ((revision,),) = connection.execute("SELECT version_num FROM alembic_version").fetchall()
    except (sqlite3.Error, ValueError) as error:
        raise UnusableStore(
            f"{place}: no database of sceneprint. Name another folder with --data."
        ) from error
    if revision not in known_revisions()[1]:
        raise NewerSchema(
            f"{place} has schema {revision!r:.40}, which this version of sceneprint does not "
            "know: a later one wrote it. Use that version."
        )
    return str(revision)


def counts(connection: sqlite3.Connection) -> dict[str, Any]:
    """How many maps, signatures, and frames in each state there are."""
    states = connection.execute("SELECT state, count(*) FROM frames GROUP BY state ORDER BY state")
    return {
        "maps": connection.execute("SELECT count(*) FROM maps").fetchone()[0],
        "frames": dict(states.fetchall()),
        "signatures": connection.execute("SELECT count(*) FROM signatures").fetchone()[0],
    }


def referred(connection: sqlite3.Connection) -> Iterator[str]:
    """Yield the digests of all blobs that have to be there, each once, in order."""
    # as text, whatever a database that somebody has edited holds
    asked = f"SELECT DISTINCT CAST(digest AS TEXT) AS digest FROM ({_REFERRED}) ORDER BY 1"
    for (digest,) in connection.execute(asked):
        yield digest


def count_referred(connection: sqlite3.Connection) -> int:
    """Return how many blobs `referred` yields."""
    asked = f"SELECT count(DISTINCT digest) FROM ({_REFERRED})"
    return int(connection.execute(asked).fetchone()[0])


def _connect(path: Path, how: str) -> sqlite3.Connection:
    return sqlite3.connect(
        f"file:{quote(str(path.absolute()))}?{how}", uri=True, timeout=BUSY_S, isolation_level=None
    )
