"""The schemas that this version knows: the revisions of `migrations/`, and that of a database.

Alembic upgrades databases. It is neither asked which revisions there are nor needed for a new
SQLite file: importing it and running every migration takes a third of a second.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from secrets import token_bytes
from typing import TYPE_CHECKING

from sqlalchemy import URL, Connection, insert, inspect, make_url
from sqlalchemy.exc import ArgumentError

import migrations
from sceneprint.errors import UnusableStore
from sceneprint.store.tables import metadata, secrets

if TYPE_CHECKING:
    from alembic.config import Config

_FOLDER = Path(migrations.__file__).parent
#: How each file of `migrations/versions` says what it makes of what.
_SAYS = re.compile(r'^(revision|down_revision) = (?:"(\w+)"|None)$', re.MULTILINE)


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


def create_schema(connection: Connection) -> None:
    """Create all tables of this version in an empty SQLite database, as the migrations would."""
    head, _ = known_revisions()
    metadata.create_all(connection, checkfirst=False)
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
