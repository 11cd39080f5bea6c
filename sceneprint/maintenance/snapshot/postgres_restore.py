"""A snapshot put into the store of a fleet: PostgreSQL for the rows, and wherever blobs are kept.

archive  --restore_to_fleet-->  an empty database with all rows, and every blob

All is verified before anything is written; blobs are durable before the first row, and the rows
are one transaction. Whoever is killed half way leaves an empty database, which is restored into
again.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import (
    URL,
    Connection,
)

from sceneprint.atomic_files import make_folder
from sceneprint.errors import DamagedSnapshot, SnapshotError
from sceneprint.maintenance.snapshot.creation import Progress, Snapshot
from sceneprint.maintenance.snapshot.database_copy import (
    Form,
    Row,
    open_copy,
    referred,
    rows_of_file,
)
from sceneprint.maintenance.snapshot.files import DATABASE, full_disk_explained, staging
from sceneprint.maintenance.snapshot.restoration import blobs_of, unpack
from sceneprint.settings import Settings
from sceneprint.store import Blobs, open_blobs
from sceneprint.store.blobs.object_client import open_objects
from sceneprint.store.blobs.object_store import BucketOwner
from sceneprint.store.database import Database, open_database, reach_database
from sceneprint.store.opaque_ids import OpaqueIds
from sceneprint.store.postgres.connection import allow
from sceneprint.store.tables import metadata, secrets

# A SQLite file written into the empty database of a fleet, in one transaction.
#
# file  --copy_into-->  PostgreSQL: the same rows, the same numbers, the same next numbers

#: What a database of which nobody has made use holds: its secret, what a service counts, who may
#: write, and where a scrub stands.
_OF_ITSELF = ("secrets", "samples", "schema_range", "scrubs")
#: Seconds after which a server lists no connection that was closed before.
_NOTICED_S = 5.0


def copy_into(connection: Connection, file: sqlite3.Connection) -> None:
    """Write all rows of a file.

    Parameters
    ----------
    connection : of a writing transaction
    file : of the schema of this version

    Raises
    ------
    SnapshotError : the database holds something.
    """
    allow(connection, 0)
    check_empty(connection)
    for name in _OF_ITSELF:
        connection.exec_driver_sql(f"DELETE FROM {name}")
    # foreign keys ask for the order
    for table in metadata.sorted_tables:
        form = Form(table)
        _write(connection, form, rows_of_file(file, form))
    # anybody may write anything there
    asked = "SELECT name, seq FROM sqlite_sequence WHERE typeof(seq) = 'integer'"
    given = dict(file.execute(asked))
    for table in metadata.sorted_tables:
        if Form(table).counts:
            _count_on(connection, table.name, given.get(table.name, 0))


def take_secrets(connection: Connection, file: sqlite3.Connection) -> None:
    """Let an empty database have the secrets of a file."""
    connection.exec_driver_sql("DELETE FROM secrets")
    form = Form(secrets)
    _write(connection, form, rows_of_file(file, form))


def check_empty(connection: Connection) -> None:
    """See that a database of our schema, or of none, holds nothing that would be lost.

    Raises
    ------
    SnapshotError : it does.
    """
    for table in metadata.sorted_tables:
        if table.name in _OF_ITSELF:
            continue
        if connection.exec_driver_sql(f"SELECT to_regclass('{table.name}')").scalar() is None:
            continue
        if connection.exec_driver_sql(f"SELECT 1 FROM {table.name} LIMIT 1").first() is not None:
            raise SnapshotError(
                f"The database has rows in its table {table.name}, and nothing is overwritten. "
                "Make an empty one (CREATE DATABASE), and name it in SCENEPRINT_DATABASE_URL."
            )


def _write(connection: Connection, form: Form, rows: Iterator[Row]) -> None:
    import psycopg

    driver: Any = connection.connection.cursor()
    name = form.table.name
    try:
        with driver as cursor, cursor.copy(f"COPY {name} ({form.names}) FROM STDIN") as copy:
            for row in rows:
                copy.write_row(form.for_server(row))
    except psycopg.DataError as error:
        # SQLite keeps what it is given: a file that somebody has edited may hold anything
        raise SnapshotError(
            f"PostgreSQL cannot hold a row of table {name} ({str(error).partition(chr(10))[0]}), "
            "and nothing was restored. Restore it to a folder, mend the row there, and take "
            "another snapshot."
        ) from error


def _count_on(connection: Connection, name: str, given: int) -> None:
    """Let the next number be one that was never given out."""
    asked = f"SELECT coalesce(max(number), 0) FROM {name}"
    last = max(given, int(connection.exec_driver_sql(asked).scalar_one()))
    connection.exec_driver_sql(
        f"SELECT setval(pg_get_serial_sequence('{name}', 'number'), {max(last, 1)}, "
        f"{'true' if last else 'false'})"
    )


#: Blobs that are written at once, and bytes above which one goes alone and in parts.
_AT_ONCE, _LARGE = 8, 8 << 20
_STAGING = ".restoring-"


def restore_to_fleet(
    archive: Path, settings: Settings, progress: Progress | None = None
) -> Snapshot:
    """Put all of a snapshot into an empty database and where blobs are kept, or no row of it.

    Parameters
    ----------
    archive : of `take_snapshot`
    settings : whose database is PostgreSQL; its schema is made where there is none
    progress : told of bytes done and bytes in all; the archive is read twice

    Raises
    ------
    SnapshotError : the archive is none, or damaged; the database holds something or is in use; or
        PostgreSQL cannot hold a row of the archive.
    UnusableStore : database or blobs cannot be reached or written.
    NewerSchema : a later version wrote the archive, or made the database.
    """
    tell: Progress = progress or (lambda _done, _total: None)
    _check_folder(settings)
    before = reach_database(settings.database)
    try:
        _check_target(before)
    finally:
        before.close()
    make_folder(settings.data_dir)
    with full_disk_explained(settings.data_dir), staging(settings.data_dir, _STAGING) as made:
        snapshot = unpack(
            archive, made, lambda done, total: tell(done, 2 * total), with_blobs=False
        )
        path = made / DATABASE
        _bring_here(path)
        owner = _owner_of(path)
        with open_copy(path) as file:
            database = open_database(settings.database)
            try:
                with _marked(settings, database, owner):
                    _fill(
                        database, file, settings, snapshot,
                        lambda done, total: tell(total + done, 2 * total),
                    )  # fmt: skip
            finally:
                database.close()
    return snapshot


def _check_folder(settings: Settings) -> None:
    """See that the folder of blobs is not that of an embedded store.

    Either would remove blobs that only the other refers to.
    """
    if not isinstance(settings.blobs, Path):
        return  # it is marked with whose it is
    path = settings.blob_dir.with_name(DATABASE)
    if path.exists():
        raise SnapshotError(
            f"{path} is the database of another store, whose blobs lie beside it. Name another "
            "folder with --data."
        )


def _check_target(database: Database) -> None:
    """See that the database holds nothing, and that nobody has it open, as far as it can tell.

    A connection that was closed is listed until the server has noticed, so it looks for a while.
    """
    with database.read() as connection:
        check_empty(connection)
    end = time.monotonic() + _NOTICED_S
    while others := _connections_of(database):
        if time.monotonic() >= end:
            raise SnapshotError(
                f"{database.shown} is in use: {others} connections of sceneprint. Stop its "
                "services and workers, and try again."
            )
        time.sleep(0.1)


def _connections_of(database: Database) -> int:
    """Return how many other connections of sceneprint the server lists."""
    with database.read() as connection:
        return int(
            connection.exec_driver_sql(
                "SELECT count(*) FROM pg_stat_activity WHERE datname = current_database()"
                " AND application_name = 'sceneprint' AND pid <> pg_backend_pid()"
            ).scalar_one()
        )


def _bring_here(path: Path) -> None:
    """Bring a database to the schema of this version."""
    url = URL.create("sqlite", database=str(path))
    open_database(url.render_as_string(hide_password=False)).close()


def _owner_of(path: Path) -> str:
    """What the store is called whose database it is."""
    url = URL.create("sqlite", database=str(path))
    with closing(reach_database(url.render_as_string(hide_password=False))) as database:
        return OpaqueIds(database).owner


@contextmanager
def _marked(settings: Settings, database: Database, owner: str) -> Iterator[None]:
    """Have the prefix of an object store, or a folder, to oneself while blobs are put there.

    The store that the snapshot was taken of has the same name: what it keeps must not be shared.
    """
    if isinstance(settings.blobs, Path):
        make_folder(settings.blobs)
        mark = BucketOwner.of_folder(settings.blobs)
    else:
        mark = BucketOwner(open_objects(settings.blobs))
    with database.read() as connection:
        check_empty(connection)  # so what a service has marked with its name is nobody's
    mark.begin(owner, OpaqueIds(database).owner)
    yield
    mark.end(owner)


def _fill(
    database: Database, file: sqlite3.Connection, settings: Settings, snapshot: Snapshot,
    tell: Progress,
) -> None:  # fmt: skip
    with database.write() as connection:  # who keeps the blobs may ask whose they are
        check_empty(connection)
        take_secrets(connection, file)
    blobs = open_blobs(settings.blobs, database, make=True)
    with closing(blobs), blobs.kept():
        lost = {one.digest for one in snapshot.damaged}
        wanted = (digest for digest in referred(file) if digest not in lost)
        _put_all(blobs, snapshot.path, wanted, tell)
        with database.write() as connection:
            copy_into(connection, file)


def _put_all(blobs: Blobs, archive: Path, wanted: Iterable[str], tell: Progress) -> None:
    """Keep all blobs, a few at once: each waits for its disk, or for the network.

    The archive may have been changed, or be another one, since it was verified.
    """
    waiting: dict[Future[str], str] = {}

    def require(same: bool) -> None:
        if not same:
            raise DamagedSnapshot(f"{archive} was changed while it was restored. Try again.")

    def kept(done: Iterable[Future[str]]) -> None:
        for one in [*done]:
            require(one.result() == waiting.pop(one))

    with ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="put") as pool:
        for digest, size, chunks in blobs_of(archive, wanted, tell):
            if size > _LARGE:
                with blobs.incoming() as blob:
                    for chunk in chunks:
                        blob.write(chunk)
                    require(blob.keep() == digest)
                continue
            waiting[pool.submit(blobs.put, b"".join(chunks))] = digest
            if len(waiting) >= 2 * _AT_ONCE:
                kept(wait(waiting, return_when=FIRST_COMPLETED).done)
        kept(waiting)
