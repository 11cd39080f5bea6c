"""Read-only access to databases and blobs for inspection, without creating or writing files."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from urllib.parse import unquote, urlsplit

from sqlalchemy import URL, Engine, create_engine, event

from sceneprint.errors import UnusableStore
from sceneprint.store import Blobs, FolderBlobs, open_blobs
from sceneprint.store.database import (
    Database,
    current_revision,
    database_url,
    known_revisions,
)
from sceneprint.store.postgres.connection import open_postgres
from sceneprint.store.sqlite import begin_sqlite


@contextmanager
def inspect_database(url: str) -> Iterator[Database]:
    """Open a database, which may be in use, without leaving changes, logs or locks.

    Raises
    ------
    UnusableStore : If there is no database, its schema is older, or another process wrote to the
        file while it was read without locks, so that the data may be wrong.
    NewerSchema : If a later version of sceneprint wrote the database.
    """
    parsed = database_url(url)
    path = _file_of(parsed) if parsed.get_backend_name() == "sqlite" else None
    if path is not None:
        engine, alone = _open_engine(parsed, path)
    elif parsed.get_backend_name() == "sqlite":
        engine, alone = create_engine(parsed), False
    else:
        engine, alone = open_postgres(parsed), False
    before = None if path is None else _state(path)
    database = Database(engine)
    try:
        require_present_schema(database)
        yield database
    finally:
        database.close()
        if alone and path is not None and _state(path) != before:
            raise UnusableStore(
                f"Another process wrote to {path} while it was read without locks, so the results "
                "may be wrong. Run the command again."
            )


def require_present_schema(database: Database) -> None:
    """Check that a database has the schema of this version, without migrating it.

    Raises
    ------
    UnusableStore, NewerSchema : If the database has another schema.
    """
    head, _ = known_revisions()
    with database.read() as connection:
        revision = current_revision(connection)
    if revision != head:
        raise UnusableStore(
            f"{database.shown} has schema {revision}, but this version needs {head}. Run "
            "`sceneprint migrate`."
        )


def _open_engine(url: URL, path: Path) -> tuple[Engine, bool]:
    """Return an engine that does not write, and whether it reads the file without locks."""
    if not path.is_file():
        raise UnusableStore(
            f"{path}: There is no database. Specify the data folder with --data, or check "
            "SCENEPRINT_DATABASE_URL."
        )
    wal, shm = _beside(path, "-wal"), _beside(path, "-shm")
    # without a log, no process uses the file; with one, reading would create a missing log index
    alone = not wal.exists()
    how = "&immutable=1" if alone else "&readonly_shm=1" if shm.exists() else ""

    def connect() -> sqlite3.Connection:
        connection = sqlite3.connect(
            f"{path.as_uri()}?mode=ro{how}", uri=True, timeout=30.0, check_same_thread=False
        )
        connection.isolation_level = None  # `begin_sqlite` begins transactions
        return connection

    engine = create_engine(url, creator=connect)
    event.listen(engine, "begin", begin_sqlite)
    return engine, alone


def _file_of(url: URL) -> Path | None:
    """Return the file of a SQLite URL; None for a database in memory."""
    name = url.database or ""
    if name.startswith("file:"):
        name = unquote(urlsplit(name).path)
    return None if name in ("", ":memory:") else Path(name).absolute()


def _state(path: Path) -> tuple[object, ...]:
    status = path.stat()
    return _beside(path, "-wal").exists(), status.st_mtime_ns, status.st_size, status.st_ino


def _beside(path: Path, end: str) -> Path:
    return path.with_name(path.name + end)


@contextmanager
def inspect_blobs(place: Path | str, database: Database) -> Iterator[Blobs]:
    """Open the blobs of a database without creating a missing folder or claiming a prefix.

    Parameters
    ----------
    place : folder, or URL of an object store

    Raises
    ------
    UnusableStore : If the folder is missing, or the blobs belong to another database.
    """
    if isinstance(place, Path):
        require_folder(place)
        yield FolderBlobs(place, make=False)
        return
    with closing(open_blobs(place, database, claim=False)) as blobs:
        yield blobs


def require_folder(place: Path) -> None:
    """Check that a folder of blobs exists, that is, that its disk is mounted.

    Raises
    ------
    UnusableStore : If the folder is missing.
    """
    if not place.is_dir():
        raise UnusableStore(
            f"{place}: The folder does not exist. Specify the data folder with --data, check that "
            "its disk is mounted, or restore a backup."
        )
