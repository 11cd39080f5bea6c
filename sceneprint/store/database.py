"""The database: opened, brought to its schema, and handed out as transactions.

URL  --open_database-->  Database  --read | write-->  Connection
"""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, Engine, event

from sceneprint.errors import NewerSchema, ReadOnlyStore, StoreLocked, UnusableStore
from sceneprint.store.database_errors import database_label
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

if TYPE_CHECKING:
    import psycopg
import re
from functools import cache
from secrets import token_bytes
from typing import TYPE_CHECKING

from sqlalchemy import URL, insert, inspect, make_url, select, update
from sqlalchemy.exc import ArgumentError

import migrations
from sceneprint.process import current_tenant
from sceneprint.store.database_errors import fault_of
from sceneprint.store.tables import metadata, schema_range, secrets
from sceneprint.turns import ThreadTurns

if TYPE_CHECKING:
    from alembic.config import Config


_FOLDER = Path(migrations.__file__).parent
#: How each file of `migrations/versions` says what it makes of what.
_SAYS = re.compile(r'^(revision|down_revision) = (?:"(\w+)"|None)$', re.MULTILINE)


#: Option of a connection: whether its transaction writes to single maps, and others to others.
MAPS_OPTION = "sceneprint_maps"
#: Writers of single maps at once in a process: each keeps a connection from the readers.
MAP_WRITERS = 8


def migration_config() -> Config:
    """What Alembic needs to find `migrations/`."""
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(_FOLDER))
    return config


@cache
def known_revisions() -> tuple[str, frozenset[str]]:
    """The revision that this version works with, and all that it can bring there."""
    made: dict[str, str] = {}
    for path in _FOLDER.glob("versions/*.py"):
        said = dict(_SAYS.findall(path.read_text(encoding="utf-8")))
        if "revision" in said:
            made[said["revision"]] = said["down_revision"]
    (head,) = made.keys() - made.values()
    return head, frozenset(made)


def revision_of(connection: Connection) -> str | None:
    """Revision of a database; None: nobody has made a schema in it."""
    if not inspect(connection).has_table("alembic_version"):
        return None
    found: str | None = connection.exec_driver_sql(
        "SELECT version_num FROM alembic_version"
    ).scalar_one_or_none()
    return found


@dataclass(frozen=True)
class SchemaRange:
    """The processes that may use a store.

    Parameters
    ----------
    revision : the schema of the store
    least : the oldest revision whose processes may write to it
    """

    revision: str
    least: str

    def allows(self, own: str) -> bool:
        """Return whether a process that works with the revision `own` may use the store as it is.

        Revisions are numbers of four digits, so that they sort as texts.
        """
        return self.revision == own or (
            self.revision.isdecimal() and self.least <= own < self.revision
        )


def schema_range_of(connection: Connection) -> SchemaRange | None:
    """Return which processes may use a database; None if it has no schema yet."""
    revision = revision_of(connection)
    if revision is None:
        return None
    if not inspect(connection).has_table(schema_range.name):  # another program's database
        return SchemaRange(revision, revision)
    return SchemaRange(revision, connection.execute(select(schema_range)).scalar_one())


def require_schema(connection: Connection) -> None:
    """See that a store has not been brought beyond what this process may write.

    Raises
    ------
    NewerSchema : it has, since this process opened it; nothing may be written.
    """
    row = connection.exec_driver_sql(postgres.SCHEMA).one()
    _allow_schema(connection.engine, SchemaRange(*row))


def _allow_schema(engine: Engine, found: SchemaRange) -> None:
    own = known_revisions()[0]
    if not found.allows(own):
        raise _outdated(engine, found, own)


def _outdated(engine: Engine, found: SchemaRange, own: str) -> NewerSchema:
    what = "later" if found.revision > own else "earlier"
    return NewerSchema(
        f"{database_label(engine.url)} was brought to schema {found.revision} of a "
        f"{what} version of sceneprint while this process ran, and this process works with {own}. "
        "Nothing was stored. Stop this process, and start the version that the others run."
    )


def create_schema(connection: Connection) -> None:
    """Create all tables of this version in an empty SQLite database, as the migrations would."""
    head, _ = known_revisions()
    metadata.create_all(connection, checkfirst=False)
    connection.execute(insert(schema_range).values(least_revision=head))
    connection.execute(insert(secrets).values(name="seals", value=token_bytes(32)))
    connection.exec_driver_sql(
        "CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL, "
        "CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num))"
    )
    connection.exec_driver_sql("INSERT INTO alembic_version VALUES (?)", (head,))


# Which databases a URL may mean: SQLite or PostgreSQL.

#: What a URL of a server begins with; the short ones are what providers hand out.
_SERVERS = ("postgresql", "postgres", "postgresql+psycopg")


def database_url(given: str) -> URL:
    """The URL of a database, of one of the two kinds that are known.

    Raises
    ------
    UnusableStore : it is none, or of no such kind; the message repeats nothing of it but the kind.
    """
    kind = given.partition(":")[0]
    try:
        if kind in _SERVERS:
            return _of_server(given)
        url = make_url(given)
        is_sqlite = url.get_backend_name() == "sqlite"
    # ValueError: a port that is no number, and may be half of a password
    except (ArgumentError, ValueError):
        raise UnusableStore(
            f"{kind!r:.80} begins no URL of a database that can be opened. Set "
            "SCENEPRINT_DATABASE_URL to one, such as postgresql+psycopg://user:password@host/name, "
            "with @ : and / in a password written as %40, %3A and %2F; or leave it out for SQLite "
            "in the data folder."
        ) from None
    if not is_sqlite:
        raise UnusableStore(
            f"{kind!r:.80} is no database that is known. Set SCENEPRINT_DATABASE_URL to "
            "postgresql+psycopg://user:password@host/database, or leave it out for SQLite in the "
            "data folder."
        )
    return url


def _of_server(given: str) -> URL:
    if given.count("@") > 1:  # the rest would be taken for the name of a host, and be told
        raise ValueError("an @ in a password")
    return make_url(given).set(drivername="postgresql+psycopg")


# A database brought to the schema of this version: by one process, while others wait.

#: Alembic keeps the migration that runs in a variable of its module.
_migrating = threading.Lock()


def migrate(database: Database) -> None:
    """Bring a database to the schema of this version, in one transaction.

    Raises
    ------
    ReadOnlyStore : it may be read alone, and an earlier version wrote it.
    NewerSchema : a later version of sceneprint wrote it; nothing is touched.
    UnusableStore : it cannot be written, or its rows refer to others that are not there.
    """
    head, _ = known_revisions()
    with database.read() as connection:
        current = current_revision(connection)
    if current == head:
        return
    if database.read_only:
        raise ReadOnlyStore(
            f"{database.shown} has schema {current}, this version needs {head}, and "
            "the file is read-only. Open it once where it may be written, or use the version that "
            "wrote it."
        )
    with database.write(unchecked=True) as connection:  # another process may have been first
        current = current_revision(connection)
        if current is None and database.is_sqlite:
            create_schema(connection)
        elif current != head:
            from alembic import command

            config = migration_config()
            config.attributes["connection"] = connection
            if not database.is_sqlite and current is not None:
                # who writes out of turn ends first, and who comes later finds the new schema
                connection.exec_driver_sql("SELECT version_num FROM alembic_version FOR UPDATE")
            with _migrating:
                command.upgrade(config, "head")
            if current is None:  # no process of an earlier version has it open
                connection.execute(update(schema_range).values(least_revision=head))
            # what `unchecked` did not look at, looked at in the end
            if (
                database.is_sqlite
                and connection.exec_driver_sql("PRAGMA foreign_key_check").first() is not None
            ):
                raise UnusableStore(
                    f"{database.shown}: rows refer to others that are not there, so it is "
                    "not brought to the schema of this version, and nothing was changed. Run "
                    "`sceneprint fsck` of the version that wrote it."
                )


def current_revision(connection: Connection) -> str | None:
    """Revision of a database that this version knows; None: nobody has made a schema in it.

    Of a later version's schema that this one may write to, it is the revision of this version.

    Raises
    ------
    NewerSchema : a later version of sceneprint wrote it, and this one may not use it.
    """
    found, (head, known) = schema_range_of(connection), known_revisions()
    if found is None:
        return None
    if found.revision in known:
        return found.revision
    if found.allows(head):
        return head
    raise NewerSchema(
        f"{database_label(connection.engine.url)} has schema {found.revision}, which this version "
        "of sceneprint does not know: a later one wrote it. Use that version, or another data "
        "folder."
    )


class Database:
    """Transactions on one database; safe to share between threads, not between processes.

    Parameters
    ----------
    engine : of SQLAlchemy
    sealed : where the file may be read alone
    """

    def __init__(self, engine: Engine, sealed: ReadOnlyFile | None = None) -> None:
        self._engine, self._sealed = engine, sealed
        # what a transaction sees is one state on both: in SQLite any does
        self._readers = engine if self.is_sqlite else engine.execution_options(
            isolation_level="REPEATABLE READ", postgresql_readonly=True
        )  # fmt: skip
        # of PostgreSQL they begin their transactions themselves, see `postgres.begin`
        self._writers = engine if self.is_sqlite else engine.execution_options(
            isolation_level="AUTOCOMMIT"
        )  # fmt: skip
        # of the writers of this process one asks for the turn, and the others wait here: each of
        # them would keep a connection from the readers
        self._turns, self._map_turns = ThreadTurns(1), ThreadTurns(MAP_WRITERS)
        file = None if sealed is not None else self.file
        self._line = None if file is None else WriterLine(file.parent)
        self._held = False  # by another process, for longer than anybody should wait
        self._guarded = False
        self._schema = postgres.KnownSchema(self._check_schema)
        #: Timeline that the PostgreSQL server writes, as of the last connection: a promoted standby
        #: begins another, and may lack what was committed last. What is held in memory of the one
        #: before must then be given up. None of SQLite.
        self.history: str | None = None
        if not self.is_sqlite:
            event.listen(engine, "connect", self._note_history)

    def _note_history(self, connection: Any, _record: object) -> None:
        self.history = postgres.timeline_of(connection) or self.history

    @property
    def dialect(self) -> str:
        """Which database it is: `sqlite` or `postgresql`."""
        return self._engine.dialect.name

    @property
    def is_sqlite(self) -> bool:
        """Whether it is a file of this machine, of which one writer at a time holds the whole."""
        return self.dialect == "sqlite"

    @property
    def shown(self) -> str:
        """Which database it is, to be told: without a password."""
        return database_label(self._engine.url)

    @property
    def file(self) -> Path | None:
        """Its file; None of a server, and of what is in memory."""
        name = self._engine.url.database if self.is_sqlite else None
        return Path(name).absolute() if name and name != ":memory:" else None

    @property
    def read_only(self) -> bool:
        """Whether it may be read alone, and every `write` raises ReadOnlyStore."""
        return self._sealed is not None

    @property
    def turned_read_only(self) -> bool:
        """Whether its file may be read alone by now: disks turn read-only under those who use them,
        and the system says so before anybody writes.
        """
        return self.is_sqlite and read_only_file(self._engine.url) is not None

    def require_writable(self) -> None:
        """See that it may be written.

        Raises
        ------
        ReadOnlyStore : it may be read alone.
        """
        if self._sealed is not None:
            raise self._sealed.refusal()

    def guard_schema(self) -> None:
        """From now on, have each `write` see that the schema is one that this version may use."""
        self._guarded = True

    def require_schema(self) -> None:
        """See that this process may still write; NewerSchema where another version migrated it."""
        if self._guarded:
            with self.read() as connection:
                require_schema(connection)

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """A transaction that sees one state and changes nothing."""
        before = None if self._sealed is None else self._sealed.state()
        with self.explained(), self._readers.connect() as connection:
            yield connection
            if self._sealed is not None:
                self._sealed.check(before)

    @contextmanager
    def write(
        self, *, unchecked: bool = False, turn: bool = True, map_number: int | None = None,
        single: bool = False,
    ) -> Iterator[Connection]:  # fmt: skip
        """A transaction that is committed at the end, or leaves no trace where it raises.

        Parameters
        ----------
        unchecked : let SQLite not look whether rows that others refer to are there: tables can be
            made anew then. PostgreSQL has no such haste then, as to wait for a turn or to answer
        turn : whether others wait until it is committed. Without it, on PostgreSQL, only rows may
            be touched that are held against others, and no event may be told; SQLite has no
            writers but in turn
        map_number : of the only map that is written to. On PostgreSQL writers of other maps do not
            wait then, so that no row may be touched that is of several maps, but for inserting one;
            `record_event` is the way to tell an event
        single : whether it is of one statement, which PostgreSQL then takes in its turn, executes
            and commits in one round trip: it is committed when it has an answer. It has no say on
            SQLite, nor for several maps

        Raises
        ------
        ReadOnlyStore : it may be read alone.
        StoreLocked : another process writes for longer than BUSY_S; who comes after that waits
            for HELD_S only (of the database's kind), until somebody gets through.
        StoreFull : the disk has no room.
        NewerSchema : another version has brought it beyond what this process may write.
        UnusableStore : it cannot be written for another reason.
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
            self._threads_turn(self._turns if map_number is None else self._map_turns, wait_s),
            self.explained(),
            self._writers.connect() as connection,
        ):
            if single and map_number is not None:
                with self._single(connection, [map_number], wait_s, None) as writing:
                    yield writing
            else:
                with self._begun(connection, wait_s, map_number, unchecked) as writing:
                    yield writing
            if not self.is_sqlite:
                postgres.require_synchronous(writing)

    @contextmanager
    def write_maps(self, map_numbers: Collection[int], wait_s: float) -> Iterator[Connection]:
        """As `write` of a single statement, which writes to some maps at once, PostgreSQL. One
        thread of a process does at a time.

        Parameters
        ----------
        map_numbers : of the only maps that are written to
        wait_s : seconds to wait for one of them. Writers of the others wait for that, too

        Raises
        ------
        MapsInUse : it was not free by then; nothing was written.
        ReadOnlyStore and others : see `write`.
        """
        self.require_writable()
        turn_s = postgres.HELD_S if self._held else BUSY_S
        # not in the turn among threads: whoever leads, it is of many tenants, and would wait for
        # the maps of its own that are in use
        with self._locks_noted(), self.explained(), self._writers.connect() as connection:
            with self._single(connection, map_numbers, turn_s, wait_s) as writing:
                yield writing
            postgres.require_synchronous(writing)

    @contextmanager
    def _single(
        self, connection: Connection, map_numbers: Collection[int], wait_s: float,
        maps_wait_s: float | None,
    ) -> Iterator[Connection]:  # fmt: skip
        """A transaction of one statement; see `SingleStatement`."""
        known = self._schema if self._guarded else None
        only = postgres.SingleStatement(map_numbers, wait_s, maps_wait_s, known)
        options: dict[str, Any] = {MAPS_OPTION: True, postgres.SINGLE: only}
        writing = connection.execution_options(**options)
        postgres.forget_warnings(writing)
        yield writing
        self._held = False

    @contextmanager
    def _write_out_of_turn(self) -> Iterator[Connection]:
        """As `write`, for which nobody waits; PostgreSQL."""
        # a migration begins once what holds its row is over
        asked = (f"{postgres.SCHEMA} FOR KEY SHARE",) if self._guarded else ()
        with self.explained(), self._writers.begin() as connection:
            row = postgres.begin(connection, *asked)
            if row is not None:
                self._check_schema(row)
            yield connection

    @contextmanager
    def _threads_turn(self, turns: ThreadTurns, wait_s: float) -> Iterator[None]:
        """The turn among the threads of this process."""
        tenant = current_tenant()
        if not turns.acquire(tenant, wait_s):
            raise StoreLocked(
                f"{self.shown}: other writers of this process have waited for long, and "
                "nothing was stored. Come back later."
            )
        try:
            with self._locks_noted():
                yield
        finally:
            turns.release(tenant)

    @contextmanager
    def _locks_noted(self) -> Iterator[None]:
        """Have those that come next wait for less where a lock could not be had."""
        try:
            yield
        except StoreLocked:
            self._held = True
            raise

    @contextmanager
    def _begun(
        self, connection: Connection, wait_s: float, map_number: int | None, unchecked: bool
    ) -> Iterator[Connection]:
        """A transaction in its turn, committed at the end."""
        options: dict[str, Any] = {
            "sceneprint_write": wait_s,
            "sceneprint_line": self._line,
            MAPS_OPTION: map_number is not None,
        }
        if unchecked and self.is_sqlite:
            options["sceneprint_unchecked"] = True
            connection.detach()  # nobody else gets a connection that does not look
        writing = connection.execution_options(**options)
        with writing.begin():
            checked = self._guarded and not unchecked
            self._begin_writing(writing, wait_s, map_number, checked=checked)
            yield writing

    def _begin_writing(
        self, writing: Connection, wait_s: float, map_number: int | None, *, checked: bool
    ) -> None:
        """Have the turn, which SQLite gave with the transaction, and see that it may be used."""
        row = None
        if not self.is_sqlite:
            row = postgres.take_turn(
                writing, wait_s, postgres.SCHEMA if checked else None, map_number
            )
        self._held = False
        if row is not None:
            self._check_schema(row)
        elif checked:
            require_schema(writing)

    def _check_schema(self, row: Any) -> None:
        _allow_schema(self._engine, SchemaRange(*row))

    def shrink_log(self) -> bool:
        """Leave nothing of what was deleted in SQLite's log; False where that has to wait."""
        if not self.is_sqlite or self.read_only:
            return True
        with self.explained():
            connection = self._engine.raw_connection()
            try:
                return shrink_log(connection.driver_connection)
            finally:
                connection.close()

    def explained(self) -> AbstractContextManager[None]:
        """Within it, what the database or its driver raises is told in our words."""
        return explained(self._engine)

    def driver_connection(self) -> psycopg.Connection[Any]:
        """A connection to PostgreSQL that commits each statement at once, for whom it is opened.

        What lasts as long as a connection does, such as LISTEN and locks of a session, needs one
        that nobody else is given. Who asked closes it, and asks within `explained`.

        Raises
        ------
        UnusableStore : the server cannot be reached.
        """
        if self.is_sqlite:
            raise ValueError(f"{self.shown} has no connections but those of its file")
        import psycopg

        with self.explained():
            args, given = self._engine.dialect.create_connect_args(self._engine.url)
            options = {**postgres.connect_options(self._engine.url), **given}
            found = psycopg.connect(*args, **options, autocommit=True)
            try:
                postgres.configure(found)
            except BaseException:
                found.close()
                raise
        return found

    def close(self) -> None:
        """Close all connections; those in use, when they are given back."""
        pool = self._engine.pool
        self._engine.dispose()  # the old pool would leave the others to the collector
        event.listen(pool, "checkin", _close_connection)
        pool.dispose()  # those that were given back meanwhile
        if self._line is not None:
            self._line.close()


def _close_connection(connection: Any, _record: object) -> None:
    if connection is not None:
        connection.close()


def is_there(url: str) -> bool:
    """Whether the database of a URL is a file that is there, or a server's that has a schema.

    Raises
    ------
    UnusableStore : the server cannot be asked.
    """
    try:
        parsed = database_url(url)
    except UnusableStore:
        return False  # opening it says why
    if parsed.get_backend_name() == "sqlite":
        return parsed.database is not None and Path(parsed.database).is_file()
    database = reach_database(url)
    try:
        with database.read() as connection:
            return revision_of(connection) is not None
    finally:
        database.close()


def reach_database(given: str) -> Database:
    """A database as it is: no schema is made or looked at, and a server is not yet asked.

    Raises
    ------
    UnusableStore : the URL is none of a database that is known.
    """
    url = database_url(given)
    if url.get_backend_name() == "sqlite":
        return Database(*open_sqlite(url))
    return Database(postgres.open_postgres(url))


def open_database(url: str) -> Database:
    """Open a database and bring it to the schema of this version.

    A SQLite file that may not be written is opened for reading.

    Raises
    ------
    UnusableStore : no such database, or it cannot be opened.
    ReadOnlyStore : it may be read alone, and an earlier version wrote it.
    NewerSchema : a later version of sceneprint wrote it; nothing is touched.
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
def explained(engine: Engine) -> Iterator[None]:
    """Say which database a fault is about, of what kind it is, and what to do."""
    try:
        yield
    except Exception as error:
        found = fault_of(engine, error)
        if found is None:
            raise
        raise found from error
