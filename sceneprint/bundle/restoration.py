"""Bundles restored into an empty store, SQLite and PostgreSQL alike, and verified.

    bundle  --verify_bundle-->  Bundle
    bundle  --restore_to_folder-->  data folder with SQLite
    bundle  --restore_to_server-->  empty database of PostgreSQL, and wherever its blobs are kept

Blobs are durable before the first row, and all rows are one transaction. A restore that was killed
leaves no store that anybody would take for a whole one, and goes on when it is run again.
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

from sqlalchemy import URL, Connection

from sceneprint.atomic_files import folder_turn, make_folder, put_new, sync_folder
from sceneprint.bundle.backup import (
    LARGE,
    Bundle,
    ListedBlob,
    LostBlob,
    Progress,
    check_sound,
    in_order,
    listed_blobs,
    referred,
    summary_of,
)
from sceneprint.bundle.place import BundleManifest, BundlePlace
from sceneprint.bundle.rows import Row, count_on, decoded_rows, read_rows, tables, write_rows
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

#: The database and the blobs of a data folder, and where they are until both are whole.
_DATABASE, _BLOBS, _WORK = "sceneprint.db", "blobs", ".restoring"
#: Tables of which a database that nobody has used holds rows: its secret, what a service counts,
#: who may write, and where a scrub stands.
_OF_ITSELF = ("secrets", "samples", "schema_range", "scrubs")
#: Seconds after which a server lists no connection that was closed before.
_NOTICED_S = 5.0


class _Restoration:
    """Reads one bundle.

    Parameters
    ----------
    place, name : of the bundle; None: the newest
    progress : called with the rows and blobs that are done, and all of them

    Raises
    ------
    BundleError, DamagedBundle : see `BundlePlace.read`.
    NewerSchema : another version wrote it.
    """

    def __init__(self, place: str, name: str | None, progress: Progress | None) -> None:
        self.place = BundlePlace.open(place)
        self.manifest: BundleManifest = self.place.read(name)
        revision, (head, _) = self.manifest.schema_revision, known_revisions()
        if revision != head:
            raise NewerSchema(
                f"The bundle has schema {revision!r:.40}, and this version works with {head}. "
                f"Restore it with sceneprint {self.manifest.sceneprint:.40}."
            )
        self._progress = progress or (lambda _done, _total: None)
        self._done = 0
        listed = self.manifest.blobs + self.manifest.lost
        rows = (one.rows for one in self.manifest.parts if one.kind != "blobs")
        self._total = max(sum(rows) + listed, 1)

    def blobs(self, blobs: Blobs | None) -> tuple[LostBlob, ...]:
        """Copy all blobs, or verify them alone; return those that the bundle does not hold."""
        lost, count, size = list[LostBlob](), 0, 0

        def take(one: ListedBlob) -> ListedBlob:
            if one[2] is None:
                self._take(blobs, *one[:2])
            return one

        for digest, length, why in in_order(take, listed_blobs(self.place, self.manifest)):
            if why is None:
                count, size = count + 1, size + length
            else:
                lost.append(LostBlob(digest, why))
            self._go_on(1)
        if (count, size, len(lost)) != (
            self.manifest.blobs, self.manifest.blob_bytes, self.manifest.lost,
        ):  # fmt: skip
            raise self._other("its list of blobs")
        return tuple(lost)

    def _take(self, blobs: Blobs | None, digest: str, size: int) -> None:
        place = self.place
        if blobs is None:
            condition = place.condition(digest)
            if condition != "sound":
                raise place.damaged(digest, f"is {condition}")
        elif blobs.condition(digest) == "sound":
            pass  # a restore that was killed has copied it
        elif size <= LARGE:
            blobs.put(place.get(digest))
        else:
            with blobs.incoming() as blob:
                for chunk in place.chunks(digest):
                    blob.write(chunk)
                if blob.keep() != digest:
                    raise place.damaged(digest, "is damaged")

    def rows(self, connection: Connection, *, keep_keys: bool = True) -> None:
        """Write all rows into an empty database, in a transaction of the caller's.

        Parameters
        ----------
        keep_keys : False revokes all keys of the bundle in the same transaction

        Raises
        ------
        BundleError : the database holds rows, or cannot hold one of these.
        DamagedBundle : the rows are not those that were written, or contradict each other.
        """
        allow(connection, 0)
        check_empty(connection)
        sqlite = connection.dialect.name == "sqlite"
        if sqlite:
            connection.exec_driver_sql("PRAGMA defer_foreign_keys = ON")
        for name in _OF_ITSELF:
            connection.exec_driver_sql(f"DELETE FROM {name}")
        for table in tables():
            read = self._read(table.name, [one.name for one in table.columns])
            write_rows(connection, table, decoded_rows([*table.columns], read))
        count_on(connection, self.manifest.numbers)
        found, manifest = summary_of(connection), self.manifest
        if any(found[name] != getattr(manifest, name) for name in ("maps", "frames", "signatures")):
            raise self._other("the rows that it holds")
        try:
            check_sound(connection, self.place.shown)
        except UnusableStore as error:
            raise DamagedBundle(str(error)) from error
        listed = (digest for digest, _, _ in listed_blobs(self.place, self.manifest))
        if any(one != other for one, other in zip_longest(listed, referred(connection))):
            raise self._other("the blobs that its rows refer to")
        # answers in files are not in a bundle
        connection.exec_driver_sql("DELETE FROM queries WHERE NOT listed AND kept_at IS NULL")
        connection.exec_driver_sql(
            "UPDATE queries SET bytes = 0, shown = NULL WHERE bytes > 0 AND kept_at IS NULL"
        )
        if not keep_keys:
            for key in list_keys(connection):
                revoke_key(connection, key.name)

    def key_names(self) -> list[str]:
        """Return the names of the keys in the bundle, sorted."""
        columns = [one.name for one in keys.columns]
        rows = self._read(keys.name, columns, counts=False)
        return sorted(str(row[columns.index("name")]) for row in rows)

    def secrets(self) -> list[Row]:
        """Return the rows of the secrets, which give a store its name."""
        columns = [one.name for one in secrets.columns]
        return list(
            decoded_rows([*secrets.columns], self._read(secrets.name, columns, counts=False))
        )

    def _read(self, table: str, columns: list[str], *, counts: bool = True) -> Iterator[Row]:
        parts = [one for one in self.manifest.parts if one.kind == f"rows/{table}"]
        for part, data in zip(
            parts, in_order(lambda one: self.place.get(one.digest), parts), strict=True
        ):
            found = list(read_rows(data, columns))
            if len(found) != part.rows:
                raise self._other(f"its rows of table {table}")
            yield from found
            if counts:
                self._go_on(len(found))

    def _other(self, what: str) -> DamagedBundle:
        return DamagedBundle(
            f"{self.place.shown}: bundle {self.manifest.name} is damaged: {what} differ from what "
            "its manifest says. Nothing was restored. Restore another bundle."
        )

    def _go_on(self, rows: int) -> None:
        self._done += rows
        self._progress(self._done, self._total)


def check_empty(connection: Connection) -> None:
    """See that a database of our schema, or of none, holds nothing that would be lost.

    Raises
    ------
    BundleError : it does.
    """
    server = connection.dialect.name == "postgresql"
    for table in tables():
        name = table.name
        if name in _OF_ITSELF:
            continue
        if server and connection.exec_driver_sql(f"SELECT to_regclass('{name}')").scalar() is None:
            continue
        if connection.exec_driver_sql(f"SELECT 1 FROM {name} LIMIT 1").first() is not None:
            raise BundleError(
                f"The database has rows in its table {name}, and nothing is overwritten. "
                "Make an empty one (CREATE DATABASE), and name it in SCENEPRINT_DATABASE_URL."
            )


def list_bundle_keys(place: str, name: str | None = None) -> list[str]:
    """Return the names of the keys in a bundle, which work again once it is restored.

    Parameters
    ----------
    place, name : see `verify_bundle`

    Raises
    ------
    BundleError, DamagedBundle, NewerSchema : As for `verify_bundle`.
    """
    return _Restoration(place, name, None).key_names()


def verify_bundle(place: str, name: str | None = None, progress: Progress | None = None) -> Bundle:
    """Read all of a bundle and check it; its rows are written into a temporary database.

    Parameters
    ----------
    place : folder or URL of an object store
    name : of the bundle; None: the newest
    progress : called with the rows and blobs that are done, and all of them

    Raises
    ------
    BundleError, DamagedBundle, NewerSchema : there is none, it is damaged, or another version's.
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
    """Make a data folder of a bundle; a restore that was killed there is gone on with.

    Parameters
    ----------
    place, name, progress : see `verify_bundle`
    folder : missing or empty
    keep_keys : False revokes all keys of the bundle

    Raises
    ------
    BundleError, DamagedBundle, NewerSchema : as for `verify_bundle`; or the folder holds something,
        has no room, or another process restores to it.
    OSError : the folder cannot be written.
    """
    folder = Path(os.path.realpath(folder))  # a link stays one
    _check_folder(folder)
    reading, work = _Restoration(place, name, progress), folder / _WORK
    is_new = not folder.exists()
    make_folder(work)
    with folder_turn(work) as mine:
        if not mine:
            raise BundleError(f"{folder}: another process restores to it.")
        if (folder / _BLOBS).exists():  # a restore was killed between two names, see `_put`
            (folder / _BLOBS).rename(work / _BLOBS)
        for half in work.glob(f"{_BLOBS}/*/.*"):  # of a restore that was killed
            half.unlink()
        _check_room(folder, reading.manifest, work)
        with closing(FolderBlobs(work / _BLOBS)) as blobs:
            lost = reading.blobs(blobs)
        _write_file(work / _DATABASE, reading, keep_keys=keep_keys)
        _put(work, folder)
    if is_new:
        sync_folder(folder.parent)
    return Bundle(reading.manifest, lost)


def _check_folder(folder: Path) -> None:
    """See that a folder is missing or empty, but for what killed restores have left."""
    if not folder.is_dir():
        if os.path.lexists(folder):
            raise BundleError(f"{folder} is no folder. Name another with --data.")
        return
    ours = {_WORK, "lost+found"} if os.path.ismount(folder) else {_WORK}
    if (folder / _WORK / _DATABASE).exists() and not (folder / _WORK / _BLOBS).exists():
        ours.add(_BLOBS)  # a restore was killed when its blobs had their name, and no database
    found = sorted({one.name for one in folder.iterdir()} - ours)
    if found:
        more = "" if len(found) <= 3 else f" and {len(found) - 3} more"
        raise BundleError(
            f"{folder} holds {', '.join(found[:3])}{more}, and nothing is overwritten. Name "
            "another folder with --data, or move away what is there."
        )


def _check_room(folder: Path, manifest: BundleManifest, work: Path) -> None:
    """See before long work that the disk has room for a bundle, less what is there of it."""
    there = sum(one.stat().st_size for one in work.rglob("*") if one.is_file())
    wanted, free = manifest.bytes - there, shutil.disk_usage(folder).free
    if free < wanted:
        raise BundleError(
            f"{folder}: what is in the bundle takes {wanted / 1e6:,.1f} MB, and {free / 1e6:,.1f} "
            "MB are free. Free some space, or choose another place."
        )


def _write_file(path: Path, reading: _Restoration, *, keep_keys: bool = True) -> None:
    """Write the rows of a bundle into a new SQLite file, which is durable and alone at the end."""
    for one in path.parent.glob(f"{path.name}*"):
        one.unlink()
    url = URL.create("sqlite", database=str(path)).render_as_string(hide_password=False)
    with closing(open_database(url)) as database, database.write() as connection:
        reading.rows(connection, keep_keys=keep_keys)


def _put(work: Path, folder: Path) -> None:
    """Move blobs and database to their names; the database comes last, and with it the store."""
    try:
        (work / _BLOBS).rename(folder / _BLOBS)
        put_new(work / _DATABASE, folder / _DATABASE)
        shutil.rmtree(work)
    except OSError as error:
        raise BundleError(
            f"{folder}: the bundle cannot be put there ({error.strerror}). Nothing was "
            "overwritten; see what has come to be there, and its permissions."
        ) from error


# PostgreSQL, and wherever its blobs are kept.


def restore_to_server(
    place: str, settings: Settings, name: str | None = None, progress: Progress | None = None,
    *, keep_keys: bool = True,
) -> Bundle:  # fmt: skip
    """Put all of a bundle into an empty database and where blobs are kept, or no row of it.

    Parameters
    ----------
    place, name, progress : see `verify_bundle`
    settings : whose database is PostgreSQL; its schema is made where there is none
    keep_keys : False revokes all keys of the bundle

    Raises
    ------
    BundleError : as for `verify_bundle`; or the database holds something, is in use, or cannot
        hold a row of the bundle.
    UnusableStore : database or blobs cannot be reached or written.
    """
    if isinstance(settings.blobs, Path) and settings.blob_dir.with_name(_DATABASE).exists():
        raise BundleError(  # either would remove blobs that only the other refers to
            f"{settings.blob_dir.with_name(_DATABASE)} is the database of another store, whose "
            "blobs lie beside it. Name another folder with --data."
        )
    with closing(reach_database(settings.database)) as before:
        _check_unused(before)
    reading = _Restoration(place, name, progress)
    with closing(open_database(settings.database)) as database:
        names = reading.secrets()
        owner = next((owner_of(value) for name, value in names if name == "seals"), "")
        with database.read() as connection:
            check_empty(connection)  # so what a service has marked with its name is nobody's
        with _marked(settings, owner, OpaqueIds(database).owner):
            with database.write() as connection:  # who keeps the blobs may ask whose they are
                check_empty(connection)
                connection.exec_driver_sql("DELETE FROM secrets")
                write_rows(connection, secrets, iter(names))
            blobs = open_blobs(settings.blobs, database, make=True)
            with closing(blobs), blobs.kept():
                lost = reading.blobs(blobs)
                with database.write() as connection:
                    reading.rows(connection, keep_keys=keep_keys)
    return Bundle(reading.manifest, lost)


@contextmanager
def _marked(settings: Settings, owner: str, before: str) -> Iterator[None]:
    """Hold the prefix of an object store, or a folder, while blobs are put there.

    The store that the backup was taken of has the same name: what it keeps must not be shared.
    """
    if isinstance(settings.blobs, Path):
        make_folder(settings.blobs)
        mark = BucketOwner.of_folder(settings.blobs)
    else:
        mark = BucketOwner(open_objects(settings.blobs))
    mark.begin(owner, before)
    yield
    mark.end(owner)


def _check_unused(database: Database) -> None:
    """See that the database holds nothing, and that nobody has it open, as far as it can tell.

    A connection that was closed is listed until the server has noticed, so it looks for a while.
    """
    with database.read() as connection:
        check_empty(connection)
    end = time.monotonic() + _NOTICED_S
    while others := _connections_of(database):
        if time.monotonic() >= end:
            raise BundleError(
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
