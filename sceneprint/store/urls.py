"""Which databases a URL may mean: SQLite or PostgreSQL."""

from __future__ import annotations

from sqlalchemy import URL, make_url
from sqlalchemy.exc import ArgumentError

from sceneprint.errors import UnusableStore

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
