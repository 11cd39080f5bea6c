"""What `sceneprint doctor` says of the database, which is only ever read."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit

from sceneprint.cli.findings import Finding

if TYPE_CHECKING:
    from sqlalchemy import URL, Engine

    from sceneprint.settings import Settings

_CHECK = "Check SCENEPRINT_DATABASE_URL, or the data folder."


def database(settings: Settings) -> Finding:
    """What is at the address of the database.

    Parameters
    ----------
    settings : whose database is looked at
    """
    from sqlalchemy import make_url
    from sqlalchemy.exc import SQLAlchemyError

    try:
        url = make_url(settings.database)
    except ValueError:  # what was taken for the port may be half of a password: it is not shown
        text = (
            "SCENEPRINT_DATABASE_URL: its port is no number. Correct it; in a password, "
            "@ : and / are written %40 %3A and %2F."
        )
        return _wrong(text)
    except SQLAlchemyError:
        return _wrong(f"cannot be opened (not an SQLAlchemy URL). {_CHECK}")
    try:
        return _sqlite(settings, url) if url.get_backend_name() == "sqlite" else _server(settings)
    except (SQLAlchemyError, ImportError) as error:
        reason = str(getattr(error, "orig", None) or error).partition("\n")[0]
        return _wrong(f"cannot be opened ({reason}). {_CHECK}")


def _sqlite(settings: Settings, url: URL) -> Finding:
    """The file, opened so that SQLite writes nothing, not even beside it."""
    from sqlalchemy import NullPool, create_engine

    path = _path_of(url)
    if path is None:
        text = "is in memory, so that every process would have one of its own. Name a file."
        return _wrong(text)
    if not path.exists():
        # the data folder is made with the file, another one is not
        if settings.database_url is not None and not path.parent.is_dir():
            return _wrong(f"the folder of {path} is missing. Make it, or name another file.")
        return Finding("ok", "database", f"none yet; {path} will be made by the first use")
    wal, shm = (path.with_name(path.name + end) for end in ("-wal", "-shm"))
    if wal.exists() and not shm.exists():  # reading it would make the latter
        text = f"{path} was not closed; the next use recovers it"
        return Finding("note", "database", text)
    # without a log nobody writes, and the file is all there is; with one, its index is not renewed
    how = "readonly_shm=1" if wal.exists() else "immutable=1"

    def connect() -> sqlite3.Connection:
        return sqlite3.connect(f"{path.as_uri()}?mode=ro&{how}", uri=True)

    found = _schema(create_engine(url, creator=connect, poolclass=NullPool))
    # a folder that may not be written is a finding of its own
    if (
        found.verdict != "WRONG"
        and os.access(path.parent, os.W_OK)
        and not os.access(path, os.W_OK)
    ):
        text = (
            f"{path} may be read and not written, so that nothing is taken. Check its permissions."
        )
        return _wrong(text)
    return found


def _server(settings: Settings) -> Finding:
    from sceneprint.errors import SceneprintError
    from sceneprint.store.database import reach_database
    from sceneprint.store.revisions import revision_of

    try:
        database = reach_database(settings.database)
        try:
            with database.read() as connection:
                return _compared(revision_of(connection), database.shown)
        finally:
            database.close()
    except SceneprintError as error:
        return _wrong(str(error))


def _path_of(url: URL) -> Path | None:
    """File of an SQLite URL; None: in memory."""
    name = url.database or ""
    if name.startswith("file:") and "uri" in url.query:
        if url.query.get("mode") == "memory":
            return None
        name = unquote(urlsplit(name).path)
    return None if name in ("", ":memory:") else Path(name).absolute()


def _schema(engine: Engine) -> Finding:
    """Compare the schema with the one of this version; the database is not touched."""
    from sceneprint.store.revisions import revision_of

    try:
        with engine.connect() as connection:
            found = revision_of(connection)
    finally:
        engine.dispose()
    return _compared(found, repr(engine.url))


def _compared(found: str | None, place: str) -> Finding:
    from sceneprint.store.revisions import known_revisions

    head, known = known_revisions()
    place = f"{place}, schema {found}"
    if found == head:
        return Finding("ok", "database", place)
    if found is None or found in known:
        return Finding("note", "database", f"{place}; the next use brings it to {head}")
    text = f"{place}: a later version of sceneprint wrote it. Use that version, or another folder."
    return _wrong(text)


def _wrong(text: str) -> Finding:
    return Finding("WRONG", "database", text)
