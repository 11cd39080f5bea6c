"""The database: opened, brought to its schema, and handed out as transactions.

URL  --open_database-->  Database  --read | write-->  Connection
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, Engine, NullPool, create_engine, event, make_url
from sqlalchemy.exc import ArgumentError

from sceneprint.errors import NewerSchema, ReadOnlyStore, StoreLocked, UnusableStore
from sceneprint.store.faults import explained
from sceneprint.store.revisions import known_revisions, migration_config, revision_of
from sceneprint.store.sealed import Sealed, sealed_file
from sceneprint.store.sqlite import (
    BUSY_S,
    HELD_S,
    begin_sqlite,
    configure_sealed,
    configure_sqlite,
)

#: Alembic keeps the migration that runs in a variable of its module.
_migrating = threading.Lock()


class Database:
    """Transactions on one database; safe to share between threads, not between processes.

    Parameters
    ----------
    engine : of SQLAlchemy
    sealed : where the file may be read alone
    """

    def __init__(self, engine: Engine, sealed: Sealed | None = None) -> None:
        self._engine, self._sealed = engine, sealed
        # of SQLite's writers of this process one asks for its lock, and the others wait here:
        # each of them would keep a connection from the readers
        self._turn = threading.Lock()
        self._held = False  # by another process, for longer than anybody should wait

    @property
    def is_sqlite(self) -> bool:
        """Whether one writer at a time holds the whole database."""
        return self._engine.dialect.name == "sqlite"

    @property
    def read_only(self) -> bool:
        """Whether it may be read alone, and every `write` raises ReadOnlyStore."""
        return self._sealed is not None

    def require_writable(self) -> None:
        """See that it may be written.

        Raises
        ------
        ReadOnlyStore : it may be read alone.
        """
        if self._sealed is not None:
            raise self._sealed.refusal()

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """A transaction that sees one state and changes nothing."""
        before = None if self._sealed is None else self._sealed.state()
        with explained(self._engine), self._engine.connect() as connection:
            yield connection
            if self._sealed is not None:
                self._sealed.check(before)

    @contextmanager
    def write(self, *, unchecked: bool = False) -> Iterator[Connection]:
        """A transaction that is committed at the end, or leaves no trace where it raises.

        Parameters
        ----------
        unchecked : let SQLite not look whether rows that others refer to are there: tables can be
            made anew then

        Raises
        ------
        ReadOnlyStore : it may be read alone.
        StoreLocked : another process writes for longer than BUSY_S; who comes after that waits
            for HELD_S only, until somebody gets through.
        StoreFull : the disk has no room.
        UnusableStore : it cannot be written for another reason.
        """
        self.require_writable()
        if not self.is_sqlite:
            with explained(self._engine), self._engine.begin() as connection:
                yield connection
            return
        if not self._turn.acquire(timeout=HELD_S if self._held else BUSY_S):
            raise StoreLocked(
                f"{self._engine.url!r}: other writers of this process have waited for long, and "
                "nothing was stored. Come back later."
            )
        try:
            with explained(self._engine), self._engine.connect() as connection:
                options: dict[str, Any] = {"sceneprint_write": HELD_S if self._held else BUSY_S}
                if unchecked:
                    options["sceneprint_unchecked"] = True
                    connection.detach()  # nobody else gets a connection that does not look
                writing = connection.execution_options(**options)
                with writing.begin():
                    self._held = False
                    yield writing
        except StoreLocked:
            self._held = True
            raise
        finally:
            self._turn.release()

    def close(self) -> None:
        """Give all connections back."""
        self._engine.dispose()


def is_there(url: str) -> bool:
    """Whether the database of a URL is a file that is there."""
    try:
        parsed = make_url(url)
    except (ArgumentError, ValueError):
        return False  # opening it says why
    place = parsed.database if parsed.get_backend_name() == "sqlite" else None
    return place is not None and Path(place).is_file()


def open_database(url: str) -> Database:
    """Open a database and bring it to the schema of this version.

    A SQLite file that may not be written is opened for reading.

    Parameters
    ----------
    url : of SQLAlchemy

    Raises
    ------
    UnusableStore : no such database, or it cannot be opened.
    ReadOnlyStore : it may be read alone, and an earlier version wrote it.
    NewerSchema : a later version of sceneprint wrote it; nothing is touched.
    """
    try:
        database, engine = _opened(make_url(url))
    # ValueError: a port that is no number. The URL may hold a password
    except (ArgumentError, ImportError, ValueError) as error:
        raise UnusableStore(
            f"{url.partition(':')[0]!r} is no database that can be opened ({error}). Set "
            "SCENEPRINT_DATABASE_URL to an SQLAlchemy URL, or leave it out for SQLite in the "
            "data folder."
        ) from error
    try:
        _migrate(database, engine)
    except BaseException:
        database.close()
        raise
    return database


def _opened(url: URL) -> tuple[Database, Engine]:
    if url.get_backend_name() != "sqlite":
        engine = create_engine(url, pool_pre_ping=True)
        return Database(engine), engine
    path, sealed = sealed_file(url), None
    if path is not None:
        sealed = Sealed(path)
        # each transaction opens the file in the way that is right then
        engine = create_engine(url, creator=sealed.connect, poolclass=NullPool)
    else:
        # SQLite waits for a writer itself, fairly enough; readers never wait in WAL
        engine = create_engine(url, connect_args={"timeout": BUSY_S}, pool_size=16, max_overflow=-1)
    event.listen(engine, "connect", configure_sqlite if sealed is None else configure_sealed)
    event.listen(engine, "begin", begin_sqlite)
    return Database(engine, sealed), engine


def _migrate(database: Database, engine: Engine) -> None:
    """Run what is missing of `migrations/`, in one transaction."""
    head, known = known_revisions()
    with database.read() as connection:
        current = _current(connection, known, engine)
    if current == head:
        return
    if database.read_only:
        raise ReadOnlyStore(
            f"{engine.url!r} has schema {current}, this version needs {head}, and the file is "
            "read-only. Open it once where it may be written, or use the version that wrote it."
        )
    with database.write(unchecked=True) as connection:  # another process may have been first
        if _current(connection, known, engine) != head:
            from alembic import command

            config = migration_config()
            config.attributes["connection"] = connection
            with _migrating:
                command.upgrade(config, "head")
            if database.is_sqlite:
                _require_whole(connection, engine)


def _require_whole(connection: Connection, engine: Engine) -> None:
    """What `unchecked` did not look at, looked at in the end."""
    if connection.exec_driver_sql("PRAGMA foreign_key_check").first() is not None:
        raise UnusableStore(
            f"{engine.url!r}: rows refer to others that are not there, so it is not brought to "
            "the schema of this version, and nothing was changed. Run `sceneprint fsck` of the "
            "version that wrote it."
        )


def _current(connection: Connection, known: frozenset[str], engine: Engine) -> str | None:
    current = revision_of(connection)
    if current is not None and current not in known:
        raise NewerSchema(
            f"{engine.url!r} has schema {current}, which this version of sceneprint does not "
            "know: a later one wrote it. Use that version, or another data folder."
        )
    return current
