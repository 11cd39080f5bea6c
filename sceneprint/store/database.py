"""The database: opening, migration to the schema of this version, and transactions.

URL  --open_database-->  Database  --read | write-->  Connection
"""

from __future__ import annotations

import re
import threading
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from secrets import token_bytes
from typing import TYPE_CHECKING, Any

from sqlalchemy import URL, Connection, Engine, event, insert, inspect, make_url, select, text
from sqlalchemy.exc import ArgumentError

import migrations
from sceneprint.errors import NewerSchema, ReadOnlyStore, StoreLocked, UnusableStore
from sceneprint.process import current_tenant
from sceneprint.store.database_errors import database_label, fault_of
from sceneprint.store.postgres import connection as postgres
from sceneprint.store.sqlite import (
    BUSY_S,
    HELD_S,
    ReadOnlyFile,
    WriterLine,
    open_sqlite,
    read_only_file,
    shrink_log,
)
from sceneprint.store.tables import metadata, schema_range, secrets
from sceneprint.turns import ThreadTurns

if TYPE_CHECKING:
    import psycopg
    from alembic.config import Config


_FOLDER = Path(migrations.__file__).parent
#: Pattern of the lines of a migration that state its revision and its predecessor.
_REVISIONS = re.compile(r'^(revision|down_revision) = (?:"(\w+)"|None)$', re.MULTILINE)
#: Connection option of a transaction that writes to single maps, concurrently with others.
MAPS_OPTION = "sceneprint_maps"
#: Maximum number of concurrent writers of single maps in a process.
MAP_WRITERS = 8


def migration_config() -> Config:
    """Return the Alembic configuration with the path of `migrations/`."""
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(_FOLDER))
    return config


@cache
def known_revisions() -> tuple[str, frozenset[str]]:
    """Return the schema revision of this version, and all revisions that it can migrate from."""
    parents: dict[str, str] = {}
    for path in _FOLDER.glob("versions/*.py"):
        names = dict(_REVISIONS.findall(path.read_text(encoding="utf-8")))
        if "revision" in names:
            parents[names["revision"]] = names["down_revision"]
    (head,) = parents.keys() - parents.values()
    return head, frozenset(parents)


def revision_of(connection: Connection) -> str | None:
    """Return the schema revision of a database; None without a schema."""
    if not inspect(connection).has_table("alembic_version"):
        return None
    statement = "SELECT version_num FROM alembic_version"
    revision: str | None = connection.exec_driver_sql(statement).scalar_one_or_none()
    return revision


@dataclass(frozen=True)
class SchemaRange:
    """Schema revision of a store, and the revisions that may write to it.

    Parameters
    ----------
    least : oldest revision whose processes may write to the store
    """

    revision: str
    least: str

    def allows(self, own: str) -> bool:
        """Return whether a process of revision `own` may use the store.

        Revisions have four digits, so they can be compared as texts.
        """
        return self.revision == own or (
            self.revision.isdecimal() and self.least <= own < self.revision
        )


def schema_range_of(connection: Connection) -> SchemaRange | None:
    """Return the schema range of a database; None if it has no schema."""
    revision = revision_of(connection)
    if revision is None:
        return None
    if not inspect(connection).has_table(schema_range.name):  # database of another program
        return SchemaRange(revision, revision)
    return SchemaRange(revision, connection.execute(select(schema_range)).scalar_one())


def require_schema(connection: Connection) -> None:
    """Check that this process may still write to the store.

    Raises
    ------
    NewerSchema : If a later version has migrated the store since this process opened it.
    """
    _check_schema(connection.engine, connection.exec_driver_sql(postgres.SCHEMA).one())


def _check_schema(engine: Engine, row: Any) -> None:
    schema, own = SchemaRange(*row), known_revisions()[0]
    if schema.allows(own):
        return
    what = "later" if schema.revision > own else "earlier"
    raise NewerSchema(
        f"{database_label(engine.url)} was migrated to schema {schema.revision} of a {what} "
        f"version of sceneprint while this process, which needs {own}, was running. Nothing was "
        "stored. Stop this process, and start the version of the other processes."
    )


def create_schema(connection: Connection) -> None:
    """Create all tables of this version in an empty database, and record the revision."""
    head, _ = known_revisions()
    metadata.create_all(connection, checkfirst=False)
    if connection.dialect.name == "postgresql":
        for statement in postgres.NUMBERING:
            connection.exec_driver_sql(statement)
    connection.execute(insert(schema_range).values(least_revision=head))
    connection.execute(insert(secrets).values(name="seals", value=token_bytes(32)))
    connection.exec_driver_sql(
        "CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL, "
        "CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num))"
    )
    connection.execute(text("INSERT INTO alembic_version VALUES (:head)"), {"head": head})


#: Schemes of PostgreSQL URLs. Hosting providers issue URLs with the short schemes.
_SERVERS = ("postgresql", "postgres", "postgresql+psycopg")


def database_url(url_text: str) -> URL:
    """Parse the URL of a SQLite or PostgreSQL database.

    Raises
    ------
    UnusableStore : If the URL is not valid. The message contains only its scheme.
    """
    kind = url_text.partition(":")[0]
    try:
        if kind in _SERVERS:
            if url_text.count("@") > 1:  # SQLAlchemy would parse part of the password as the host
                raise ValueError("an @ in a password")
            return make_url(url_text).set(drivername="postgresql+psycopg")
        url = make_url(url_text)
        is_sqlite = url.get_backend_name() == "sqlite"
    # ValueError: the port, possibly part of a password, is not a number
    except (ArgumentError, ValueError):
        raise UnusableStore(
            f"The database URL that starts with {kind!r:.80} is not valid. Set "
            "SCENEPRINT_DATABASE_URL to a URL such as "
            "postgresql+psycopg://user:password@host/name, with @ : and / in a password written "
            "as %40, %3A and %2F; or unset it for SQLite in the data folder."
        ) from None
    if not is_sqlite:
        raise UnusableStore(
            f"{kind!r:.80} is not a supported database. Set SCENEPRINT_DATABASE_URL to "
            "postgresql+psycopg://user:password@host/database, or unset it for SQLite in the "
            "data folder."
        )
    return url


#: Lock for migrations, since Alembic stores the running migration in a module variable.
_migrating = threading.Lock()


def migrate(database: Database) -> None:
    """Migrate a database to the schema of this version, in one transaction.

    Raises
    ------
    ReadOnlyStore : If the database is read-only, and an earlier version wrote it.
    NewerSchema : If a later version of sceneprint wrote the database; nothing is changed.
    UnusableStore : If the database cannot be written, or a foreign key refers to a missing row.
    """
    head, _ = known_revisions()
    with database.read() as connection:
        current = current_revision(connection)
    if current == head:
        return
    if database.read_only:
        raise ReadOnlyStore(
            f"{database.shown} has schema {current}, but this version needs {head}, and the file "
            "is read-only. Open it once from a writable disk, or use the version that wrote it."
        )
    with database.write(unchecked=True) as connection:
        current = current_revision(connection)
        if current is None:
            create_schema(connection)
        elif current != head:
            from alembic import command

            config = migration_config()
            config.attributes["connection"] = connection
            if not database.is_sqlite:
                # wait for writers without a turn
                connection.exec_driver_sql("SELECT version_num FROM alembic_version FOR UPDATE")
            with _migrating:
                command.upgrade(config, "head")
            # check foreign keys, since `unchecked` has turned them off
            if (
                database.is_sqlite
                and connection.exec_driver_sql("PRAGMA foreign_key_check").first() is not None
            ):
                raise UnusableStore(
                    f"{database.shown}: Some rows refer to missing rows, so the database was not "
                    "migrated, and nothing was changed. Run `sceneprint fsck` of the version that "
                    "wrote the database."
                )


def current_revision(connection: Connection) -> str | None:
    """Return the schema revision of a database; None without a schema.

    For a later schema that this version may use, return the revision of this version.

    Raises
    ------
    NewerSchema : If a later version of sceneprint wrote the database, and this one cannot use it.
    """
    stored, (head, revisions) = schema_range_of(connection), known_revisions()
    if stored is None:
        return None
    if stored.revision in revisions:
        return stored.revision
    if stored.allows(head):
        return head
    raise NewerSchema(
        f"{database_label(connection.engine.url)} has schema {stored.revision} of a later version "
        "of sceneprint. Use that version, or another data folder."
    )


class Database:
    """Transactions on a database; safe to share between threads, but not between processes.

    Parameters
    ----------
    sealed : reader of the database file if it is read-only, else None
    """

    def __init__(self, engine: Engine, sealed: ReadOnlyFile | None = None) -> None:
        self._engine, self._sealed = engine, sealed
        # readers use one snapshot, as all transactions of SQLite do
        self._readers = engine if self.is_sqlite else engine.execution_options(
            isolation_level="REPEATABLE READ", postgresql_readonly=True
        )  # fmt: skip
        # writers on PostgreSQL begin their transactions explicitly, see `postgres.begin`
        self._writers = engine if self.is_sqlite else engine.execution_options(
            isolation_level="AUTOCOMMIT"
        )  # fmt: skip
        # one writer of this process waits at the database; the others wait here without connections
        self._turns, self._map_turns = ThreadTurns(1), ThreadTurns(MAP_WRITERS)
        file = None if sealed is not None else self.file
        self._line = None if file is None else WriterLine(file.parent)
        self._held = False  # whether another process has held the lock for longer than BUSY_S
        self._guarded = False
        self._schema = postgres.KnownSchema(self._check_schema)
        #: Timeline of the PostgreSQL server at the last connection; None for SQLite. A promoted
        #: standby starts a new timeline and may lack the last commits, so cached rows of the former
        #: timeline are invalid.
        self.history: str | None = None
        if not self.is_sqlite:
            event.listen(engine, "connect", self._note_history)

    def _note_history(self, connection: Any, _record: object) -> None:
        self.history = postgres.timeline_of(connection) or self.history

    @property
    def dialect(self) -> str:
        """Kind of database: `sqlite` or `postgresql`."""
        return self._engine.dialect.name

    @property
    def is_sqlite(self) -> bool:
        """Return whether the database is SQLite: a local file with one writer at a time."""
        return self.dialect == "sqlite"

    @property
    def shown(self) -> str:
        """Name of the database for messages, without a password."""
        return database_label(self._engine.url)

    @property
    def file(self) -> Path | None:
        """Path of the database file; None for a server or a database in memory."""
        name = self._engine.url.database if self.is_sqlite else None
        return Path(name).absolute() if name and name != ":memory:" else None

    @property
    def read_only(self) -> bool:
        """Return whether the database is open read-only, so that `write` raises ReadOnlyStore."""
        return self._sealed is not None

    @property
    def turned_read_only(self) -> bool:
        """Return whether the file became read-only, for example on a remounted disk."""
        return self.is_sqlite and read_only_file(self._engine.url) is not None

    def require_writable(self) -> None:
        """Raise ReadOnlyStore if the database is read-only."""
        if self._sealed is not None:
            raise self._sealed.refusal()

    def guard_schema(self) -> None:
        """Make all later calls of `write` check that this version may use the schema."""
        self._guarded = True

    def require_schema(self) -> None:
        """Raise NewerSchema if a later version has migrated the store to an incompatible schema."""
        if self._guarded:
            with self.read() as connection:
                require_schema(connection)

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """Run a transaction that reads a single snapshot and changes nothing.

        Raise UnusableStore if another process writes to a read-only file in the meantime.
        """
        before = None if self._sealed is None else self._sealed.state()
        with self.translate_errors(), self._readers.connect() as connection:
            yield connection
            if self._sealed is not None:
                self._sealed.check(before)

    @contextmanager
    def write(
        self, *, unchecked: bool = False, turn: bool = True, map_number: int | None = None,
        single: bool = False,
    ) -> Iterator[Connection]:  # fmt: skip
        """Run a transaction that is committed at the end, or rolled back after an exception.

        Parameters
        ----------
        unchecked : whether to turn off foreign key checks in SQLite, so that tables can be rebuilt,
            and to extend the time limits on PostgreSQL
        turn : whether other writers wait until the commit. Without a turn, change only locked rows,
            and record no events. SQLite ignores the parameter
        map_number : number of the only map that the transaction writes to. On PostgreSQL, writers
            of other maps then do not wait. Do not change rows that maps share, and record events
            with `record_event`
        single : whether the transaction is a single statement. With `map_number`, PostgreSQL then
            waits for the turn, executes and commits in one round trip. SQLite ignores the parameter

        Raises
        ------
        ReadOnlyStore : If the database is read-only.
        StoreLocked : If another process has been writing for longer than BUSY_S. Later writers then
            wait for HELD_S only, until one succeeds.
        StoreFull : If the disk is full.
        NewerSchema : See `require_schema`.
        UnusableStore : If the database cannot be written for another reason.
        """
        self.require_writable()
        if not turn and not self.is_sqlite:
            with self._write_out_of_turn() as connection:
                yield connection
            return
        if self.is_sqlite:
            map_number = None
        wait_s = (HELD_S if self.is_sqlite else postgres.HELD_S) if self._held else BUSY_S
        if unchecked and not self.is_sqlite:
            wait_s = postgres.MIGRATION_S
        with (
            self._take_thread_turn(self._turns if map_number is None else self._map_turns, wait_s),
            self.translate_errors(),
            self._writers.connect() as connection,
        ):
            if single and map_number is not None:
                with self._write_single(connection, [map_number], wait_s, None) as writing:
                    yield writing
            else:
                with self._write_in_turn(connection, wait_s, map_number, unchecked) as writing:
                    yield writing
            if not self.is_sqlite:
                postgres.require_synchronous(writing)

    @contextmanager
    def write_maps(self, map_numbers: Collection[int], wait_s: float) -> Iterator[Connection]:
        """Run a transaction of a single statement that writes to several maps on PostgreSQL.

        Only one thread of a process may call this at a time. See `write`.

        Parameters
        ----------
        wait_s : maximum seconds to wait for each map; writers of the other maps wait meanwhile

        Raises
        ------
        MapsInUse : If a map is still in use after `wait_s`; nothing is written.
        ReadOnlyStore and others : See `write`.
        """
        self.require_writable()
        turn_s = postgres.HELD_S if self._held else BUSY_S
        # take no turn among the threads of this process: the statement would wait for their maps
        with self._note_locks(), self.translate_errors(), self._writers.connect() as connection:
            with self._write_single(connection, map_numbers, turn_s, wait_s) as writing:
                yield writing
            postgres.require_synchronous(writing)

    @contextmanager
    def _write_single(
        self, connection: Connection, map_numbers: Collection[int], wait_s: float,
        maps_wait_s: float | None,
    ) -> Iterator[Connection]:  # fmt: skip
        """Run a transaction of a single statement; see `SingleStatement`."""
        schema = self._schema if self._guarded else None
        only = postgres.SingleStatement(map_numbers, wait_s, maps_wait_s, schema)
        options: dict[str, Any] = {MAPS_OPTION: True, postgres.SINGLE: only}
        writing = connection.execution_options(**options)
        postgres.forget_warnings(writing)
        yield writing
        self._held = False

    @contextmanager
    def _write_out_of_turn(self) -> Iterator[Connection]:
        """Run a transaction without a turn on PostgreSQL."""
        # lock the schema, for which a migration waits
        checks = (f"{postgres.SCHEMA} FOR KEY SHARE",) if self._guarded else ()
        with self.translate_errors(), self._writers.begin() as connection:
            row = postgres.begin(connection, *checks)
            if row is not None:
                self._check_schema(row)
            yield connection

    @contextmanager
    def _take_thread_turn(self, turns: ThreadTurns, wait_s: float) -> Iterator[None]:
        """Wait for a turn among the threads of this process; raise StoreLocked after `wait_s`."""
        tenant = current_tenant()
        if not turns.acquire(tenant, wait_s):
            raise StoreLocked(
                f"{self.shown}: Timed out waiting for other writers in this process. Nothing was "
                "stored. Try again later."
            )
        try:
            with self._note_locks():
                yield
        finally:
            turns.release(tenant)

    @contextmanager
    def _note_locks(self) -> Iterator[None]:
        """Shorten the wait of later writers after a writer timed out; see `write`."""
        try:
            yield
        except StoreLocked:
            self._held = True
            raise

    @contextmanager
    def _write_in_turn(
        self, connection: Connection, wait_s: float, map_number: int | None, unchecked: bool
    ) -> Iterator[Connection]:
        """Run a transaction that takes a turn, and commit it at the end."""
        options: dict[str, Any] = {
            "sceneprint_write": wait_s,
            "sceneprint_line": self._line,
            MAPS_OPTION: map_number is not None,
        }
        if unchecked and self.is_sqlite:
            options["sceneprint_unchecked"] = True
            connection.detach()  # a connection without checks must not be reused
        writing = connection.execution_options(**options)
        with writing.begin():
            checked, row = self._guarded and not unchecked, None
            if not self.is_sqlite:  # in SQLite, the transaction itself is the turn
                schema = postgres.SCHEMA if checked else None
                row = postgres.take_turn(writing, wait_s, schema, map_number)
            self._held = False
            if row is not None:
                self._check_schema(row)
            elif checked:
                require_schema(writing)
            yield writing

    def _check_schema(self, row: Any) -> None:
        _check_schema(self._engine, row)

    def shrink_log(self) -> bool:
        """Empty SQLite's log, which may contain deleted data; return False if the log is in use."""
        if not self.is_sqlite or self.read_only:
            return True
        with self.translate_errors():
            connection = self._engine.raw_connection()
            try:
                return shrink_log(connection.driver_connection)
            finally:
                connection.close()

    def translate_errors(self) -> AbstractContextManager[None]:
        """Translate errors of the database within the context to errors of the store."""
        return translate_errors(self._engine)

    def driver_connection(self) -> psycopg.Connection[Any]:
        """Return a new connection to PostgreSQL that commits each statement immediately.

        The connection is for session state, such as LISTEN and session locks. The caller must close
        it, and execute statements within `translate_errors`.

        Raises
        ------
        UnusableStore : If the server cannot be reached.
        ValueError : If the database is SQLite.
        """
        if self.is_sqlite:
            raise ValueError(f"{self.shown} has no sessions")
        import psycopg

        with self.translate_errors():
            args, named = self._engine.dialect.create_connect_args(self._engine.url)
            options = {**postgres.connect_options(self._engine.url), **named}
            connection = psycopg.connect(*args, **options, autocommit=True)
            try:
                postgres.configure(connection)
            except BaseException:
                connection.close()
                raise
        return connection

    def close(self) -> None:
        """Close all connections; connections in use are closed when they are returned."""
        pool = self._engine.pool
        self._engine.dispose()
        event.listen(pool, "checkin", _close_connection)
        pool.dispose()  # closes connections that were returned meanwhile
        if self._line is not None:
            self._line.close()


def _close_connection(connection: Any, _record: object) -> None:
    if connection is not None:
        connection.close()


def database_exists(url: str) -> bool:
    """Return whether the database of a URL exists: a SQLite file, or a schema on a server.

    Raises
    ------
    UnusableStore : If the server cannot be reached.
    """
    try:
        parsed = database_url(url)
    except UnusableStore:
        return False  # the error appears when the database is opened
    if parsed.get_backend_name() == "sqlite":
        return parsed.database is not None and Path(parsed.database).is_file()
    database = reach_database(url)
    try:
        with database.read() as connection:
            return revision_of(connection) is not None
    finally:
        database.close()


def reach_database(url_text: str) -> Database:
    """Open a database without checking its schema or contacting its server.

    Raises
    ------
    UnusableStore : If the URL is not valid.
    """
    url = database_url(url_text)
    if url.get_backend_name() == "sqlite":
        return Database(*open_sqlite(url))
    return Database(postgres.open_postgres(url))


def open_database(url: str) -> Database:
    """Open a database and migrate it to the schema of this version, unless the file is read-only.

    Raises
    ------
    UnusableStore : If the database cannot be opened.
    ReadOnlyStore : If the database is read-only, and an earlier version wrote it.
    NewerSchema : If a later version of sceneprint wrote the database; nothing is changed.
    """
    database = reach_database(url)
    try:
        migrate(database)
        database.guard_schema()
    except BaseException:
        database.close()
        raise
    return database


@contextmanager
def translate_errors(engine: Engine) -> Iterator[None]:
    """Translate errors of a database within the context to errors of the store."""
    try:
        yield
    except Exception as error:
        fault = fault_of(engine, error)
        if fault is None:
            raise
        raise fault from error
