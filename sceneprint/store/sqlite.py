"""How SQLite is set up: what a connection is told when it opens, and how a transaction begins."""

from __future__ import annotations

from typing import Any

from sqlalchemy import URL, Connection, Engine, NullPool, create_engine, event

from sceneprint.store.sealed import Sealed, sealed_file

#: Seconds a writer waits for another, and waits after somebody has waited so long in vain.
BUSY_S, HELD_S = 10.0, 0.1
#: Seconds for which emptying the log waits for readers: writers wait for it meanwhile.
SHRINKING_S = 0.5


def open_sqlite(url: URL) -> tuple[Engine, Sealed | None]:
    """An engine whose connections are told what all are told, and where the file is read alone."""
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
    return engine, sealed


def configure_sqlite(connection: Any, _record: Any) -> None:
    """Tell a connection that may write what all of them are told."""
    connection.isolation_level = None  # transactions begin where `begin_sqlite` says
    for pragma in (
        "journal_mode = WAL",
        "synchronous = FULL",  # a commit that was acknowledged survives the power
        "foreign_keys = ON",
        "secure_delete = ON",  # what is deleted is written over, in pages that are given up too
        f"busy_timeout = {_milliseconds(BUSY_S)}",
        "cache_size = -32000",
    ):
        connection.execute(f"PRAGMA {pragma}").close()


def shrink_log(connection: Any) -> bool:
    """Empty the log when all that is in it is in the file; False where somebody is in the way.

    Else pages as they once were stay in it for as long as nothing is written over them.
    """
    connection.execute(f"PRAGMA busy_timeout = {_milliseconds(SHRINKING_S)}").close()
    try:
        busy, _, _ = connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
    finally:
        connection.execute(f"PRAGMA busy_timeout = {_milliseconds(BUSY_S)}").close()
    return not busy


def configure_sealed(connection: Any, _record: Any) -> None:
    """Tell a connection to a file that may be read alone."""
    connection.isolation_level = None


def begin_sqlite(connection: Connection) -> None:
    """Begin a transaction: of a writer at once with the lock, for which it waits so long."""
    wait_s: float | None = connection.get_execution_options().get("sceneprint_write")
    if wait_s is None:
        connection.exec_driver_sql("BEGIN")
        return
    if connection.get_execution_options().get("sceneprint_unchecked"):
        connection.exec_driver_sql("PRAGMA foreign_keys = OFF")  # within a transaction it is late
    # a reader that turns writer half way would fail where another wrote in between
    if wait_s == BUSY_S:
        connection.exec_driver_sql("BEGIN IMMEDIATE")
        return
    connection.exec_driver_sql(f"PRAGMA busy_timeout = {_milliseconds(wait_s)}")
    try:
        connection.exec_driver_sql("BEGIN IMMEDIATE")
    finally:
        connection.exec_driver_sql(f"PRAGMA busy_timeout = {_milliseconds(BUSY_S)}")


def _milliseconds(seconds: float) -> int:
    return int(1000 * seconds)
