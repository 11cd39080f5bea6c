"""The database: opened, brought to its schema, and handed out as transactions.

URL  --open_database-->  Database  --read | write-->  Connection
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, Engine, create_engine, event, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, OperationalError

from sceneprint.errors import NewerSchema, UnusableStore

#: Seconds a writer waits for another before it gives up.
BUSY_S = 30.0
#: Alembic keeps the migration that runs in a variable of its module.
_migrating = threading.Lock()


class Database:
    """Transactions on one database; safe to share between threads, not between processes.

    Parameters
    ----------
    engine : of SQLAlchemy
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    @property
    def is_sqlite(self) -> bool:
        """Whether one writer at a time holds the whole database."""
        return self._engine.dialect.name == "sqlite"

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """A transaction that sees one state and changes nothing."""
        with _explained(self._engine), self._engine.connect() as connection:
            yield connection

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """A transaction that is committed at the end, or leaves no trace where it raises."""
        options: dict[str, Any] = {"sceneprint_write": True}
        with _explained(self._engine), self._engine.connect() as connection:
            writing = connection.execution_options(**options)
            with writing.begin():
                yield writing

    def close(self) -> None:
        """Give all connections back."""
        self._engine.dispose()


def open_database(url: str) -> Database:
    """Open a database and bring it to the schema of this version.

    Parameters
    ----------
    url : of SQLAlchemy

    Raises
    ------
    UnusableStore : no such database, or it cannot be opened or written.
    NewerSchema : a later version of sceneprint wrote it; nothing is touched.
    """
    try:
        parsed = make_url(url)
        if parsed.get_backend_name() == "sqlite":
            # SQLite waits for a writer itself, fairly enough; readers never wait in WAL
            engine = create_engine(parsed, connect_args={"timeout": BUSY_S}, pool_size=16)
            event.listen(engine, "connect", _configure_sqlite)
            event.listen(engine, "begin", _begin_sqlite)
        else:
            engine = create_engine(parsed, pool_pre_ping=True)
    # ValueError: a port that is no number. The URL may hold a password
    except (ArgumentError, ImportError, ValueError) as error:
        raise UnusableStore(
            f"{url.partition(':')[0]!r} is no database that can be opened ({error}). Set "
            "SCENEPRINT_DATABASE_URL to an SQLAlchemy URL, or leave it out for SQLite in the "
            "data folder."
        ) from error
    database = Database(engine)
    try:
        _migrate(database, engine)
    except BaseException:
        database.close()
        raise
    return database


def _configure_sqlite(connection: Any, _record: Any) -> None:
    connection.isolation_level = None  # transactions begin where `_begin_sqlite` says
    for pragma in (
        "journal_mode = WAL",
        "synchronous = FULL",  # a commit that was acknowledged survives the power
        "foreign_keys = ON",
        f"busy_timeout = {int(1000 * BUSY_S)}",
        "cache_size = -32000",
    ):
        connection.execute(f"PRAGMA {pragma}").close()


def _begin_sqlite(connection: Connection) -> None:
    # a reader that turns writer half way would fail where another wrote in between
    writing = connection.get_execution_options().get("sceneprint_write")
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writing else "BEGIN")


def _migrate(database: Database, engine: Engine) -> None:
    """Run what is missing of `migrations/`, in one transaction."""
    import migrations

    config = Config()
    config.set_main_option("script_location", str(Path(migrations.__file__).parent))
    scripts = ScriptDirectory.from_config(config)
    head, known = scripts.get_current_head(), {s.revision for s in scripts.walk_revisions()}
    with database.read() as connection:
        if _current(connection, known, engine) == head:
            return
    with database.write() as connection:  # another process may have been first
        if _current(connection, known, engine) != head:
            from alembic import command

            config.attributes["connection"] = connection
            with _migrating:
                command.upgrade(config, "head")


def _current(connection: Connection, known: set[str], engine: Engine) -> str | None:
    current = MigrationContext.configure(connection).get_current_revision()
    if current is not None and current not in known:
        raise NewerSchema(
            f"{engine.url!r} has schema {current}, which this version of sceneprint does not "
            "know: a later one wrote it. Use that version, or another data folder."
        )
    return current


@contextmanager
def _explained(engine: Engine) -> Iterator[None]:
    """Say which database a fault of the machine is about."""
    try:
        yield
    except OperationalError as error:
        raise UnusableStore(
            f"{engine.url!r}: {error.orig}. Check that the database is there, that it may be "
            "written, and that the disk has room."
        ) from error
    except DBAPIError as error:
        if "malformed" in str(error.orig) or "not a database" in str(error.orig):
            raise UnusableStore(
                f"{engine.url!r}: {error.orig}. Restore the data folder from a copy."
            ) from error
        raise
