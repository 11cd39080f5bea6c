"""Verification of bundles, and restoration into an empty store.

    bundle  --verify_bundle-->  Bundle bundle  --restore_to_folder-->  data folder with SQLite
    bundle  --restore_to_server-->  empty PostgreSQL database, and its blob storage

Blobs are durable before the first row is written, and one transaction writes all rows. A killed
restore leaves no usable store, and continues when it is run again.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from itertools import zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory

from sqlalchemy import URL, Connection, Table

from sceneprint.atomic_files import folder_turn, make_folder, put_new, sync_folder
from sceneprint.bundle.backup import (
    LARGE,
    Bundle,
    ListedBlob,
    Progress,
    check_sound,
    in_order,
    listed_blobs,
    referred,
    summary_of,
)
from sceneprint.bundle.place import BundleManifest, BundlePlace
from sceneprint.bundle.rows import Row, decoded_rows, read_rows, set_numbers, tables, write_rows
from sceneprint.errors import BundleError, DamagedBundle, NewerSchema, UnusableStore
from sceneprint.settings import Settings
from sceneprint.store import Blobs, FolderBlobs, open_blobs
from sceneprint.store.blobs.object_client import open_objects
from sceneprint.store.blobs.object_store import BucketOwner
from sceneprint.store.database import Database, known_revisions, open_database, reach_database
from sceneprint.store.keys import list_keys, revoke_key
from sceneprint.store.opaque_ids import OpaqueIds, owner_of
from sceneprint.store.postgres.connection import allow
from sceneprint.store.tables import keys, secrets

#: Names, in a data folder, of the database, the blobs, and the folder for the unfinished database.
_DATABASE, _BLOBS, _WORK = "sceneprint.db", "blobs", ".restoring"
#: Tables that may have rows in an unused database: secrets, samples of a service's metrics, the
#: schema range, and the progress of a scrub.
_INITIAL_TABLES = ("secrets", "samples", "schema_range", "scrubs")
#: Maximum seconds for which a server still lists a closed connection.
_DISCONNECT_S = 5.0


class _Restoration:
    """A reader of a bundle; see `verify_bundle` for the parameters and errors."""

    def __init__(self, place: str, name: str | None, progress: Progress | None) -> None:
        self.place = BundlePlace.open(place)
        self.manifest: BundleManifest = self.place.read(name)
        revision, (head, _) = self.manifest.schema_revision, known_revisions()
        if revision != head:
            raise NewerSchema(
                f"The bundle has schema {revision!r:.40}, but this version requires {head}. "
                f"Restore it with sceneprint {self.manifest.sceneprint:.40}."
            )
        self._progress = progress or (lambda _done, _total: None)
        self._done = 0
        listed = self.manifest.blobs + self.manifest.lost
        rows = (part.rows for part in self.manifest.parts if part.kind != "blobs")
        self._total = max(sum(rows) + listed, 1)

    def blobs(self, blobs: Blobs | None) -> tuple[ListedBlob, ...]:
        """Copy all blobs, or only verify them if `blobs` is None; return the lost blobs."""
        lost, count, size, manifest = list[ListedBlob](), 0, 0, self.manifest

        def copy(entry: ListedBlob) -> ListedBlob:
            if entry.why is None:
                self._copy_blob(blobs, entry.digest, entry.bytes)
            return entry

        for entry in in_order(copy, listed_blobs(self.place, manifest)):
            if entry.why is None:
                count, size = count + 1, size + entry.bytes
            else:
                lost.append(entry)
            self._advance(1)
        if (count, size, len(lost)) != (manifest.blobs, manifest.blob_bytes, manifest.lost):
            raise self._mismatch("its blobs")
        return tuple(lost)

    def _copy_blob(self, blobs: Blobs | None, digest: str, size: int) -> None:
        """Copy a blob unless it is there, or only verify it; raise DamagedBundle if damaged."""
        place = self.place
        if blobs is None:
            condition = place.condition(digest)
            if condition != "sound":
                raise place.damaged(digest, f"is {condition}")
        elif blobs.condition(digest) == "sound":
            pass  # an earlier, killed restore copied it
        elif size <= LARGE:
            blobs.put(place.get(digest))
        else:
            with blobs.incoming() as blob:
                for chunk in place.chunks(digest):
                    blob.write(chunk)
                if blob.keep() != digest:
                    raise place.damaged(digest, "is damaged")

    def rows(self, connection: Connection, *, keep_keys: bool = True) -> None:
        """Write all rows into an empty database, in the caller's transaction, and verify them.

        Parameters
        ----------
        keep_keys : whether the bundle's keys remain valid; False revokes them in the same
            transaction

        Raises
        ------
        BundleError : If the database has rows, or cannot store a row.
        DamagedBundle : If rows are damaged or inconsistent.
        """
        allow(connection, 0)
        check_empty(connection)
        sqlite = connection.dialect.name == "sqlite"
        if sqlite:
            connection.exec_driver_sql("PRAGMA defer_foreign_keys = ON")
        for name in _INITIAL_TABLES:
            connection.exec_driver_sql(f"DELETE FROM {name}")
        for table in tables():
            write_rows(connection, table, self.read_table(table, counts=True))
        set_numbers(connection, self.manifest.numbers)
        manifest, names = self.manifest, ("maps", "frames", "signatures")
        summary = summary_of(connection)
        if any(summary[name] != getattr(manifest, name) for name in names):
            raise self._mismatch("its rows")
        try:
            check_sound(connection, self.place.shown)
        except UnusableStore as error:
            raise DamagedBundle(str(error)) from error
        listed = (entry.digest for entry in listed_blobs(self.place, manifest))
        if any(digest != other for digest, other in zip_longest(listed, referred(connection))):
            raise self._mismatch("the blobs that its rows refer to")
        # bundles contain no answers that are stored in files
        connection.exec_driver_sql("DELETE FROM queries WHERE NOT listed AND kept_at IS NULL")
        connection.exec_driver_sql(
            "UPDATE queries SET bytes = 0, shown = NULL WHERE bytes > 0 AND kept_at IS NULL"
        )
        if not keep_keys:
            for key in list_keys(connection):
                revoke_key(connection, key.name)

    def read_table(self, table: Table, *, counts: bool = False) -> Iterator[Row]:
        """Yield the rows of a table; with `counts`, they count as progress."""
        columns = [column.name for column in table.columns]
        parts = [part for part in self.manifest.parts if part.kind == f"rows/{table.name}"]
        for part, data in zip(
            parts, in_order(lambda part: self.place.get(part.digest), parts), strict=True
        ):
            rows = list(read_rows(data, columns))
            if len(rows) != part.rows:
                raise self._mismatch(f"its rows of table {table.name}")
            yield from decoded_rows([*table.columns], rows)
            if counts:
                self._advance(len(rows))

    def _mismatch(self, what: str) -> DamagedBundle:
        return DamagedBundle(
            f"{self.place.shown}: bundle {self.manifest.name} is damaged: {what} differ from its "
            "manifest. Nothing was restored. Restore another bundle."
        )

    def _advance(self, rows: int) -> None:
        self._done += rows
        self._progress(self._done, self._total)


def check_empty(connection: Connection) -> None:
    """Check that a database has no rows that a restore would overwrite.

    Raises
    ------
    BundleError : If a table has rows.
    """
    server = connection.dialect.name == "postgresql"
    for table in tables():
        name = table.name
        if name in _INITIAL_TABLES:
            continue
        if server and connection.exec_driver_sql(f"SELECT to_regclass('{name}')").scalar() is None:
            continue
        if connection.exec_driver_sql(f"SELECT 1 FROM {name} LIMIT 1").first() is not None:
            raise BundleError(
                f"The database has rows in its table {name}, and a restore does not "
                "overwrite them. Create an empty database (CREATE DATABASE), and set "
                "SCENEPRINT_DATABASE_URL to it."
            )


def list_bundle_keys(place: str, name: str | None = None) -> list[str]:
    """Return the names of the keys in a bundle. After a restore, these keys are valid again.

    Raises
    ------
    BundleError, DamagedBundle, NewerSchema : See `verify_bundle`.
    """
    at = list(keys.columns).index(keys.c.name)
    return sorted(str(row[at]) for row in _Restoration(place, name, None).read_table(keys))


def verify_bundle(place: str, name: str | None = None, progress: Progress | None = None) -> Bundle:
    """Check a bundle: read all of its parts, and write its rows into a temporary database.

    Parameters
    ----------
    place : folder, or URL of an object store
    name : name of the bundle; None selects the newest
    progress : see Progress

    Raises
    ------
    BundleError : If the bundle does not exist.
    DamagedBundle : If the bundle is damaged.
    NewerSchema : If a version with another schema wrote the bundle.
    """
    reading = _Restoration(place, name, progress)
    lost = reading.blobs(None)
    with TemporaryDirectory(prefix="sceneprint-verify-") as folder:
        _write_file(Path(folder) / _DATABASE, reading)
    return Bundle(reading.manifest, lost)


def restore_to_folder(
    place: str, folder: Path, name: str | None = None, progress: Progress | None = None,
    *, keep_keys: bool = True,
) -> Bundle:  # fmt: skip
    """Restore a bundle to a data folder; continue a killed restore if the folder contains one.

    Parameters
    ----------
    folder : missing or empty folder, or folder of a killed restore
    keep_keys : False revokes all keys of the bundle

    Raises
    ------
    BundleError : If the bundle does not exist, the folder is not empty, the disk is too small, or
        another process is restoring to the folder.
    DamagedBundle, NewerSchema : See `verify_bundle`.
    OSError : If the folder cannot be written.
    """
    folder = Path(os.path.realpath(folder))  # resolve a symbolic link, so that it is preserved
    _require_unused_folder(folder)
    reading, work = _Restoration(place, name, progress), folder / _WORK
    is_new = not folder.exists()
    with folder_turn(work) as mine:
        if not mine:
            raise BundleError(
                f"{folder}: another process is restoring to this folder. Wait until it ends."
            )
        for half in (folder / _BLOBS).rglob(".*.part"):  # unfinished files of a killed restore
            half.unlink()
        _require_space(folder, reading.manifest)
        with closing(FolderBlobs(folder / _BLOBS)) as blobs:
            lost = reading.blobs(blobs)
        _write_file(work / _DATABASE, reading, keep_keys=keep_keys)
        try:
            put_new(work / _DATABASE, folder / _DATABASE)  # completes the store
        except OSError as error:
            raise BundleError(
                f"{folder}: the restored database cannot be moved into this folder "
                f"({error.strerror}). Nothing was overwritten. Check the files in the folder and "
                "its permissions."
            ) from error
        shutil.rmtree(work)
    if is_new:
        sync_folder(folder.parent)
    return Bundle(reading.manifest, lost)


def _require_unused_folder(folder: Path) -> None:
    """Raise BundleError unless a folder is missing, empty, or left by a killed restore."""
    if not folder.is_dir():
        if os.path.lexists(folder):
            raise BundleError(f"{folder} is not a folder. Pass another path with --data.")
        return
    allowed = {"lost+found"} if os.path.ismount(folder) else set[str]()
    if (folder / _WORK).is_dir():
        allowed |= {_WORK, _BLOBS}
    names = sorted({path.name for path in folder.iterdir()} - allowed)
    if names:
        more = "" if len(names) <= 3 else f" and {len(names) - 3} more"
        raise BundleError(
            f"{folder} holds {', '.join(names[:3])}{more}, and a restore does not overwrite "
            "files. Pass another folder with --data, or move the files away."
        )


def _require_space(folder: Path, manifest: BundleManifest) -> None:
    """Raise BundleError if the disk has no room for the parts that are not restored yet."""
    restored = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    required, free = manifest.bytes - restored, shutil.disk_usage(folder).free
    if free < required:
        raise BundleError(
            f"{folder}: the bundle needs {required / 1e6:,.1f} MB, but only {free / 1e6:,.1f} MB "
            "are free. Free some space, or choose another folder."
        )


def _write_file(path: Path, reading: _Restoration, *, keep_keys: bool = True) -> None:
    """Write the rows of a bundle into a new SQLite file. No write-ahead log remains."""
    for old in path.parent.glob(f"{path.name}*"):
        old.unlink()
    url = URL.create("sqlite", database=str(path)).render_as_string(hide_password=False)
    with closing(open_database(url)) as database, database.write() as connection:
        reading.rows(connection, keep_keys=keep_keys)


def restore_to_server(
    place: str, settings: Settings, name: str | None = None, progress: Progress | None = None,
    *, keep_keys: bool = True,
) -> Bundle:  # fmt: skip
    """Restore a bundle to an empty PostgreSQL database and its blob storage.

    Parameters
    ----------
    settings : settings with the addresses of the database and of the blobs; a missing schema is
        created
    keep_keys : False revokes all keys of the bundle

    Raises
    ------
    BundleError : If the bundle does not exist, or if the database is in use, is not empty, or
        cannot store a row of the bundle.
    DamagedBundle, NewerSchema : See `verify_bundle`.
    UnusableStore : If the database or the blobs cannot be reached or written.
    """
    if isinstance(settings.blobs, Path) and settings.blob_dir.with_name(_DATABASE).exists():
        raise BundleError(  # the two stores would remove each other's blobs
            f"{settings.blob_dir.with_name(_DATABASE)} is the database of another store, whose "
            "blobs are in the same folder. Pass another folder with --data."
        )
    with closing(reach_database(settings.database)) as before:
        _require_unused_database(before)
    reading = _Restoration(place, name, progress)
    with closing(open_database(settings.database)) as database:
        names = list(reading.read_table(secrets))  # they identify the store
        owner = next((owner_of(value) for name, value in names if name == "seals"), "")
        with database.read() as connection:
            check_empty(connection)  # only then may the blobs' owner mark be replaced
        with _owner_mark(settings, owner, OpaqueIds(database).owner):
            with database.write() as connection:  # opening the blobs checks their owner
                check_empty(connection)
                connection.exec_driver_sql("DELETE FROM secrets")
                write_rows(connection, secrets, iter(names))
            blobs = open_blobs(settings.blobs, database, make=True)
            with closing(blobs), blobs.locks.block_removals():
                lost = reading.blobs(blobs)
                with database.write() as connection:
                    reading.rows(connection, keep_keys=keep_keys)
    return Bundle(reading.manifest, lost)


@contextmanager
def _owner_mark(settings: Settings, owner: str, before: str) -> Iterator[None]:
    """Mark blob storage as being restored for a store; then, as owned by the store.

    The original store has the same secret, but must not share its blobs with the restored store.
    """
    if isinstance(settings.blobs, Path):
        make_folder(settings.blobs)
        mark = BucketOwner.of_folder(settings.blobs)
    else:
        mark = BucketOwner(open_objects(settings.blobs))
    mark.begin(owner, before)
    yield
    mark.end(owner)


def _require_unused_database(database: Database) -> None:
    """Raise BundleError unless the database is empty and has no other connections of sceneprint.

    The check is repeated until _DISCONNECT_S: a server lists connections for a while after closing.
    """
    with database.read() as connection:
        check_empty(connection)
    end = time.monotonic() + _DISCONNECT_S
    statement = (
        "SELECT count(*) FROM pg_stat_activity WHERE datname = current_database()"
        " AND application_name = 'sceneprint' AND pid <> pg_backend_pid()"
    )
    while True:
        with database.read() as connection:
            others = connection.exec_driver_sql(statement).scalar_one()
        if not others:
            return
        if time.monotonic() >= end:
            raise BundleError(
                f"{database.shown} is in use by {others} connections of sceneprint. Stop "
                "the services and workers, and run the command again."
            )
        time.sleep(0.1)
