"""A database brought to the schema of this version: by one process, while others wait."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from sqlalchemy import Connection, Engine

from sceneprint.errors import NewerSchema, ReadOnlyStore, UnusableStore
from sceneprint.store.faults import shown
from sceneprint.store.revisions import known_revisions, migration_config, revision_of

if TYPE_CHECKING:
    from sceneprint.store.database import Database

#: Alembic keeps the migration that runs in a variable of its module.
_migrating = threading.Lock()


def migrate(database: Database, engine: Engine) -> None:
    """Bring a database to the schema of this version, in one transaction.

    Raises
    ------
    ReadOnlyStore : it may be read alone, and an earlier version wrote it.
    NewerSchema : a later version of sceneprint wrote it; nothing is touched.
    UnusableStore : it cannot be written, or its rows refer to others that are not there.
    """
    head, known = known_revisions()
    with database.read() as connection:
        current = _current(connection, known, engine)
    if current == head:
        return
    if database.read_only:
        raise ReadOnlyStore(
            f"{shown(engine.url)} has schema {current}, this version needs {head}, and the file is "
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
            f"{shown(engine.url)}: rows refer to others that are not there, so it is not brought "
            "to the schema of this version, and nothing was changed. Run `sceneprint fsck` of the "
            "version that wrote it."
        )


def _current(connection: Connection, known: frozenset[str], engine: Engine) -> str | None:
    current = revision_of(connection)
    if current is not None and current not in known:
        raise NewerSchema(
            f"{shown(engine.url)} has schema {current}, which this version of sceneprint does not "
            "know: a later one wrote it. Use that version, or another data folder."
        )
    return current
