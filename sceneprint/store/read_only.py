"""A database opened to be looked at: nothing is written, where SQLite allows not even beside it.

URL  --look_at-->  Database, of which `read` works
"""

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
def look_at(url: str) -> Iterator[Database]:
    """Open a database that may be in use, and change nothing: no schema, no log, no lock left.

    Raises
    ------
    UnusableStore : there is none; of an older schema; or, at the end, one that nobody used at
        the beginning was written meanwhile: what was read may be wrong.
    NewerSchema : a later version of sceneprint wrote it.
    """
    parsed = database_url(url)
    path = _file_of(parsed) if parsed.get_backend_name() == "sqlite" else None
    if path is not None:
        engine, alone = _open_engine(parsed, path)
    elif parsed.get_backend_name() == "sqlite":
        engine, alone = create_engine(parsed), False
    else:
        engine, alone = open_postgres(parsed), False  # of which `read` alone is asked
    before = None if path is None else _state(path)
    database = Database(engine)
    try:
        require_present_schema(database)
        yield database
    finally:
        database.close()
        if alone and path is not None and _state(path) != before:
            raise UnusableStore(
                f"{path} was written while it was looked at, which nobody did at first: what was "
                "found may be wrong. Run it again."
            )


def require_present_schema(database: Database) -> None:
    """See that a database has the schema that this version works with; it is not brought there.

    Raises
    ------
    UnusableStore, NewerSchema : it has another.
    """
    head, _ = known_revisions()
    with database.read() as connection:
        found = current_revision(connection)
    if found != head:
        raise UnusableStore(
            f"{database.shown} has schema {found}, and this version works with {head}. Any "
            "other use of it, such as `sceneprint serve`, brings it there."
        )


def _open_engine(url: URL, path: Path) -> tuple[Engine, bool]:
    """An engine that writes nothing; and whether the file is read as if nobody could change it."""
    if not path.is_file():
        raise UnusableStore(
            f"{path}: there is no database. Name the data folder with --data, or see that "
            "SCENEPRINT_DATABASE_URL is right."
        )
    wal, shm = _beside(path, "-wal"), _beside(path, "-shm")
    # without a log nobody has it open, and the file is all there is. A log whose index is gone
    # cannot be read without making that
    alone = not wal.exists()
    how = "&immutable=1" if alone else "&readonly_shm=1" if shm.exists() else ""

    def connect() -> sqlite3.Connection:
        connection = sqlite3.connect(
            f"{path.as_uri()}?mode=ro{how}", uri=True, timeout=30.0, check_same_thread=False
        )
        connection.isolation_level = None  # transactions begin where `begin_sqlite` says
        return connection

    engine = create_engine(url, creator=connect)
    event.listen(engine, "begin", begin_sqlite)
    return engine, alone


def _file_of(url: URL) -> Path | None:
    """File of a SQLite URL; None: in memory."""
    name = url.database or ""
    if name.startswith("file:"):
        name = unquote(urlsplit(name).path)
    return None if name in ("", ":memory:") else Path(name).absolute()


def _state(path: Path) -> tuple[object, ...]:
    found = path.stat()
    return _beside(path, "-wal").exists(), found.st_mtime_ns, found.st_size, found.st_ino


def _beside(path: Path, end: str) -> Path:
    return path.with_name(path.name + end)


# Blobs opened for maintenance: what is missing is not made.


@contextmanager
def opened_blobs(place: Path | str, database: Database) -> Iterator[Blobs]:
    """Open the blobs of a database.

    Parameters
    ----------
    place : folder, or URL of an object store
    database : whose they are

    Raises
    ------
    UnusableStore : there is no such folder, or they are another database's.
    """
    if isinstance(place, Path):
        require_folder(place)
        yield FolderBlobs(place, make=False)
        return
    with closing(open_blobs(place, database, claim=False)) as blobs:
        yield blobs


def require_folder(place: Path) -> None:
    """See that a folder of blobs is there: a disk that is not mounted is not made up for.

    Raises
    ------
    UnusableStore : it is not.
    """
    if not place.is_dir():
        raise UnusableStore(
            f"{place}: there is no such folder. Name the data folder with --data, see that its "
            "disk is mounted, or restore a backup."
        )
