"""`sceneprint doctor`: checks of this machine, the data folder and the service, with advice."""

from __future__ import annotations

import argparse
import ctypes
import errno
import os
import shlex
import shutil
import sqlite3
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit

from sceneprint import __version__
from sceneprint.atomic_files import nearest_folder, public_mode
from sceneprint.cli.checks import (
    APART_S,
    Check,
    Verdict,
    disk_check,
    seconds_apart,
    service_checks,
    version_check,
)
from sceneprint.cli.options import add_data_option, add_service_options, settings_of
from sceneprint.cli.output import count_of, one_line
from sceneprint.errors import SceneprintError
from sceneprint_client.http import DEFAULT_URL

if TYPE_CHECKING:
    from sqlalchemy import URL

    from sceneprint.settings import Settings
    from sceneprint.store import Database
    from sceneprint.store.database import SchemaRange

# Checks of the database, which do not write to it.

_CHECK = "Check SCENEPRINT_DATABASE_URL, or the data folder."


def database(settings: Settings) -> Check:
    """Return a check of the URL and schema of the database, and of the file of SQLite."""
    from sqlalchemy import make_url
    from sqlalchemy.exc import SQLAlchemyError

    from sceneprint.store.database import reach_database, schema_range_of

    try:
        url = make_url(settings.database)
    except ValueError:  # do not print the text after the colon, which may be part of a password
        return _wrong(
            "SCENEPRINT_DATABASE_URL: the port is not a number. Correct it; in a password, "
            "write @, : and / as %40, %3A and %2F."
        )
    except SQLAlchemyError:
        return _wrong(f"cannot be opened (not an SQLAlchemy URL). {_CHECK}")
    try:
        if url.get_backend_name() == "sqlite":
            return _sqlite_file(settings, url)
        server = reach_database(settings.database)
        try:
            with server.read() as connection:
                return _schema_check(schema_range_of(connection), server.shown)
        finally:
            server.close()
    except SceneprintError as error:
        return _wrong(str(error))
    except (SQLAlchemyError, ImportError) as error:
        reason = str(getattr(error, "orig", None) or error).partition("\n")[0]
        return _wrong(f"cannot be opened ({reason}). {_CHECK}")


def _sqlite_file(settings: Settings, url: URL) -> Check:
    """Return a check of a SQLite file, which is not written."""
    from sqlalchemy import NullPool, create_engine

    from sceneprint.store.database import schema_range_of

    path = _path_of(url)
    if path is None:
        return _wrong("is an in-memory database, which processes cannot share. Specify a file.")
    if not path.exists():
        # Only the data folder is created on first use.
        if settings.database_url is not None and not path.parent.is_dir():
            return _wrong(
                f"the folder of {path} does not exist. Create it, or specify another file."
            )
        return Check("ok", "database", f"none yet; the first use creates {path}")
    wal, shm = (path.with_name(path.name + end) for end in ("-wal", "-shm"))
    if wal.exists() and not shm.exists():  # reading would create the shm file
        text = f"{path} was not closed cleanly; the next use recovers it"
        return Check("note", "database", text)
    # Without a write-ahead log, the file is complete; with a log, the shared memory is only read.
    how = "readonly_shm=1" if wal.exists() else "immutable=1"

    def connect() -> sqlite3.Connection:
        return sqlite3.connect(f"{path.as_uri()}?mode=ro&{how}", uri=True)

    engine = create_engine(url, creator=connect, poolclass=NullPool)
    try:
        with engine.connect() as connection:
            check = _schema_check(schema_range_of(connection), repr(engine.url))
    finally:
        engine.dispose()
    # Another check reports a folder that is not writable.
    writable = os.access(path, os.W_OK) or not os.access(path.parent, os.W_OK)
    if check.verdict != "WRONG" and not writable:
        return _wrong(
            f"{path} is readable but not writable, so uploads fail. Check its permissions."
        )
    return check


def _path_of(url: URL) -> Path | None:
    """Return the file of a SQLite URL; None for a database in memory."""
    name = url.database or ""
    if name.startswith("file:") and "uri" in url.query:
        if url.query.get("mode") == "memory":
            return None
        name = unquote(urlsplit(name).path)
    return None if name in ("", ":memory:") else Path(name).absolute()


def _schema_check(schema: SchemaRange | None, place: str) -> Check:
    """Return a check that compares the schema of a database with that of this version."""
    from sceneprint.store.database import known_revisions

    head, revisions = known_revisions()
    shown = f"{place}, schema {None if schema is None else schema.revision}"
    if schema is None or (schema.revision in revisions and schema.revision != head):
        return Check("note", "database", f"{shown}; the next use migrates it to {head}")
    if schema.revision == head:
        return Check("ok", "database", shown)
    if schema.allows(head):
        text = f"{shown} of a later version, which this version can still use. Upgrade this one."
        return Check("note", "database", text)
    return _wrong(
        f"{shown}: it was written by a later version of sceneprint. Use that version, or another "
        "folder."
    )


def _wrong(text: str) -> Check:
    return Check("WRONG", "database", text)


# Checks of object stores, which write, read and delete a small object.


def object_stores(settings: Settings) -> Iterator[Check]:
    """Yield a check of each configured object store, which writes, reads and deletes an object."""
    from sceneprint.store.blobs.object_client import VARIABLES, check_objects, open_objects

    blobs = None if settings.blob_url is None else settings.blob_url.get_secret_value()
    for subject, setting, url in (
        ("blobs", "SCENEPRINT_BLOB_URL", blobs),
        ("indexes", "SCENEPRINT_INDEX_URL", settings.index_url),
    ):
        if url is None:
            continue
        try:
            objects = open_objects(url, setting)
            seconds = check_objects(objects)
        except SceneprintError as error:
            yield Check("WRONG", subject, str(error))
            continue
        begin = VARIABLES[url.partition(":")[0].lower()]
        of = f", with credentials from {begin}... in the environment" if begin else ""
        text = f"{objects.url}: written, read and deleted in {seconds:.2f} s{of}"
        yield Check("ok", subject, text)


# Checks of a database server, which do not write to it.

#: Settings that must be on so that acknowledged commits survive a power failure.
_DURABLE = ("fsync", "full_page_writes")
_SETTINGS = """
SELECT current_setting('server_version') AS version,
  current_setting('server_encoding') AS encoding,
  current_setting('fsync') AS fsync,
  current_setting('full_page_writes') AS full_page_writes,
  current_setting('synchronous_commit') AS synchronous_commit,
  current_setting('synchronous_standby_names') AS standbys,
  current_setting('data_checksums') AS checksums,
  current_setting('max_connections')::int
    - current_setting('superuser_reserved_connections')::int AS connections,
  (SELECT count(*) FROM pg_stat_activity WHERE backend_type = 'client backend') AS taken,
  pg_is_in_recovery() AS standby
"""


def server(settings: Settings) -> Iterator[Check]:
    """Yield checks of a PostgreSQL server; nothing for SQLite."""
    from sceneprint.store.database import reach_database

    database = reach_database(settings.database)
    try:
        if not database.is_sqlite:
            yield from _server_settings(database, settings)
    except SceneprintError as error:
        yield Check("WRONG", "database server", str(error))
    finally:
        database.close()


def _server_settings(database: Database, settings: Settings) -> Iterator[Check]:
    with database.read() as connection:
        values = dict(connection.exec_driver_sql(_SETTINGS).mappings().one())
        before = time.time()
        there = float(
            connection.exec_driver_sql("SELECT extract(epoch FROM clock_timestamp())").scalar_one()
        )
        after = time.time()
    text = f"PostgreSQL {values['version']}, {values['encoding']}"
    if values["standby"]:
        text += "; it is a read-only standby. Use the address of the primary."
        yield Check("WRONG", "database server", text)
        return
    yield Check("ok", "database server", text)
    yield _durability(values)
    yield _connections(values, settings)
    apart = seconds_apart(before, there, after)
    text = f"the server's clock differs from this machine's by {apart:.1f} s"
    if apart > APART_S:
        verdict: Verdict = "WRONG" if apart > settings.job_lease_s else "note"
        yield Check(verdict, "clock", f"{text}. Synchronize both with a time server.")
    else:
        yield Check("ok", "clock", text)


def _durability(values: Mapping[str, object]) -> Check:
    off = [name for name in _DURABLE if values[name] == "off"]
    if off:
        text = (
            f"{', '.join(off)} off: acknowledged data may be lost if the server's host fails. "
            "Turn it on."
        )
        return Check("WRONG", "durability", text)
    text = "commits survive a power failure"
    if values["standbys"] and values["synchronous_commit"] == "local":
        text += "; synchronous_commit is local, so commits do not wait for a standby. Turn it on."
        return Check("note", "durability", text)
    if values["standbys"]:
        text += (
            f", and the loss of the host, because commits wait for a standby ({values['standbys']})"
        )
    else:
        text += "; commits do not wait for a standby, so the last ones are lost if the disk fails"
    if values["checksums"] == "off":
        text += "; data_checksums are off, so a damaged page may go unnoticed"
        return Check("note", "durability", text)
    return Check("ok", "durability", text)


def _connections(values: Mapping[str, object], settings: Settings) -> Check:
    from sceneprint.store.postgres.connection import MOST

    most, in_use = int(str(values["connections"])), int(str(values["taken"]))
    # A worker uses one connection for work, one for its lease, one for wake-ups, and three for
    # locks of blobs and indexes. A service uses one per concurrent request, and three permanent
    # ones.
    needed = (
        6 * settings.workers
        + min(settings.concurrent_requests + settings.queued_requests, MOST)
        + 3
    )
    text = (
        f"{most} connections allowed (max_connections), {in_use} in use; a service and "
        f"{settings.workers} workers may use {needed}"
    )
    if in_use + needed > most:
        return Check("note", "connections", f"{text}. Raise max_connections, or run fewer workers.")
    return Check("ok", "connections", text)


# Checks of this machine, which change nothing.

#: Oldest SQLite version that the store can use (UPDATE ... RETURNING).
OLDEST_SQLITE = (3, 35, 0)
#: System libraries that open3d loads, and their Debian packages.
OPEN3D_LIBRARIES = {
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libgomp.so.1": "libgomp1",
}


def machine(settings: Settings) -> Iterator[Check]:
    """Yield checks of this machine, and of the folders and the database of the settings."""
    version = ".".join(map(str, sys.version_info[:3]))
    yield Check("ok", "python", f"{version}, sceneprint {__version__}")
    yield _sqlite_version()
    yield _kernels()
    yield from _tables(settings.cache_dir)
    yield from _folder(settings.data_dir)
    check = database(settings)
    yield check
    if check.verdict != "WRONG":
        yield from server(settings)
    yield from object_stores(settings)
    yield _decoders(settings)
    yield _open3d()


def _sqlite_version() -> Check:
    if sqlite3.sqlite_version_info < OLDEST_SQLITE:
        least = ".".join(map(str, OLDEST_SQLITE))
        text = f"{sqlite3.sqlite_version} is too old. Use a Python with SQLite {least} or later."
        return Check("WRONG", "sqlite", text)
    return Check("ok", "sqlite", sqlite3.sqlite_version)


def _kernels() -> Check:
    from sceneprint.geometry.signature.pair_features import machine_code_folder

    folder, compiled = machine_code_folder()
    if compiled:
        return Check("ok", "kernels", f"compiled, in {folder}")
    if folder and _may_write(Path(folder)):
        return Check(
            "note", "kernels", "not compiled yet; the first use compiles for half a minute"
        )
    text = (
        f"{folder or 'no folder'} is not writable, so every process compiles for a minute. "
        "Set NUMBA_CACHE_DIR to a writable folder."
    )
    return Check("note", "kernels", text)


def _decoders(settings: Settings) -> Check:
    """Return a check that a decoder starts and is confined."""
    if settings.decoders == 0:
        text = "uploads are decoded in service and workers (SCENEPRINT_DECODERS is 0)"
        return Check("note", "decoders", text)
    from sceneprint.decoders.pool import DecoderPool

    pool = DecoderPool(1, settings.decoder_memory_bytes, settings.decoder_timeout_s)
    try:
        pool.start()
        seccomp = next((process.seccomp for process in pool.processes()), None)
    finally:
        pool.close()
    if seccomp is None:
        text = "no decoder can be started, so uploads get 503; the log of the service says why"
        return Check("WRONG", "decoders", text)
    if not seccomp:
        text = "limits on memory and time. This kernel has no seccomp: confine the service itself"
        return Check("note", "decoders", text)
    return Check("ok", "decoders", "limits on memory and time, seccomp")


def _tables(cache_dir: Path) -> Iterator[Check]:
    from sceneprint.models import PRESETS, read_model
    from sceneprint.models.model_file import CACHE_VERSION

    for preset in PRESETS:
        subject, model = f"table {preset}", read_model(preset)
        path = cache_dir / f"table-v{CACHE_VERSION}-{model.id}.bin"
        if path.is_file():
            yield Check("ok", subject, str(path))
        elif _may_write(cache_dir):
            yield Check("note", subject, "not built yet; the first use builds it in seconds")
        else:
            text = (
                f"{cache_dir} is not writable, so every process rebuilds it. Set "
                "SCENEPRINT_CACHE_DIR to a writable folder."
            )
            yield Check("note", subject, text)


def _folder(data_dir: Path) -> Iterator[Check]:
    from sceneprint.settings import default_data_dir

    there = nearest_folder(data_dir)
    why = _unwritable(data_dir)
    if why == errno.ENOSPC:
        text = f"{data_dir} is on a full disk, so uploads fail. Free some space."
        yield Check("WRONG", "data folder", text)
    elif why is not None and (data_dir / "sceneprint.db").is_file():
        text = (
            f"{data_dir} is read-only ({os.strerror(why)}): `sceneprint serve` can answer "
            "queries from it but cannot accept uploads. Make it writable, or use another folder "
            "with --data."
        )
        yield Check("WRONG", "data folder", text)
    elif why is not None:
        text = (
            f"{data_dir} is not writable ({os.strerror(why)}). Check its permissions, or use "
            "another folder with --data."
        )
        yield Check("WRONG", "data folder", text)
    else:
        text = f"{data_dir} is writable" if there == data_dir else f"{data_dir} can be created"
        if data_dir == default_data_dir():
            text += ", the default of --data"
        yield Check("ok", "data folder", text)
    mode = public_mode(data_dir)
    if mode is not None:
        text = (
            f"{data_dir} has the permissions {mode:o}, so every user of this machine may read "
            f"frames and the hashes of keys. Run `chmod -R o-rwx {shlex.quote(str(data_dir))}`."
        )
        yield Check("note", "permissions", text)
    yield disk_check("disk", shutil.disk_usage(there).free)


def _open3d() -> Check:
    purpose = "only reconstructions and baselines need it"
    if find_spec("open3d") is None:
        return Check("note", "open3d", f"not installed; {purpose}: pip install open3d")
    missing = []
    for library, package in OPEN3D_LIBRARIES.items():
        try:
            ctypes.CDLL(library)
        except OSError:
            missing.append(package)
    if missing:
        packages = " ".join(missing)
        text = f"lacks system libraries; {purpose}: apt-get install {packages}"
        return Check("note", "open3d", text)
    return Check("ok", "open3d", "installed, with its system libraries")


def _may_write(folder: Path) -> bool:
    """Return whether a file can be created in a folder or, if it is missing, in its parent."""
    return _unwritable(folder) is None


def _unwritable(folder: Path) -> int | None:
    """Try to create a file in a folder; return the `errno`, or None on success."""
    try:  # permissions do not reveal read-only disks, and do not apply to root
        with tempfile.TemporaryFile(dir=nearest_folder(folder)) as file:
            file.write(b"x")  # full disks may have room for empty files
            file.flush()
        return None
    except OSError as error:
        return error.errno or errno.EIO


def add_doctor(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint doctor`."""
    add_data_option(command)
    add_service_options(command)
    command.set_defaults(run=run_doctor)


def run_doctor(options: argparse.Namespace) -> int:
    """Check this machine, the data folder and the service, and suggest fixes. With --url alone,
    check only that service: version, store, workers, queue, disk, clock and models. Nothing is
    changed. The exit code is 2 if something required is missing; optional parts are only noted.
    """
    settings, wrong = settings_of(options), 0
    # With only --url, skip the checks of this machine.
    stores = {"data_dir", "database_url", "blob_url"} & settings.model_fields_set
    here = machine(settings) if options.url is None or stores else ()
    for finding in (*here, *_service(options)):
        print(f"{finding.verdict:5}  {finding.subject:16}  {one_line(finding.text)}", flush=True)
        wrong += finding.verdict == "WRONG"
    print(f"{count_of(wrong, 'problem')} found" if wrong else "no problems found")
    return 2 if wrong else 0


def _service(options: argparse.Namespace) -> Iterator[Check]:
    """Yield checks of the service; if it does not respond, this is an error only with --url."""
    from sceneprint_client import Client

    url = options.url or DEFAULT_URL
    try:
        with Client(url, options.key) as client:
            if not client.healthy():
                text = f"no service responds at {url}; `sceneprint serve` starts one"
                yield Check("WRONG" if options.url else "note", "service", text)
            elif options.url is None:
                check = version_check(url, client.status())
                text = (
                    f"{check.text}. It may use another data folder: `sceneprint doctor --url "
                    f"{url}` checks the service itself"
                )
                yield Check(check.verdict, "service", text)
            else:
                yield from service_checks(client, url)
    except SceneprintError as error:
        yield Check("WRONG", "service", str(error))
