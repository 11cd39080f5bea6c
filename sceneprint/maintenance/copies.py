"""The database in one file that nobody writes: made, checked, and asked what it refers to.

database in use  --open_source-->  Source  --copy-->  file  --open_copy-->  Connection of sqlite3

Of PostgreSQL it is a SQLite file as well: one format, whatever the store is kept in.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sqlalchemy import URL, make_url
from sqlalchemy.exc import ArgumentError

from sceneprint.errors import NewerSchema, SnapshotError, UnusableStore
from sceneprint.maintenance.exporting import Written, copy_server, server_bytes
from sceneprint.maintenance.manifests import Use
from sceneprint.schemas import FrameState
from sceneprint.store.looking import look_at
from sceneprint.store.revisions import known_revisions
from sceneprint.store.sealed import Sealed, sealed_file

#: Seconds to wait for whoever recovers the database.
BUSY_S = 30.0
#: What every blob that has to be there is for: (digest, number of the frame, upload | geometry);
#: and of those that are of jobs: (digest, number of the job, job).
_USES = (
    "SELECT blob AS digest, number, 'upload' AS role FROM frames WHERE state NOT IN"
    f" ('{FrameState.DELETED}', '{FrameState.REDUNDANT}')"
    " UNION ALL SELECT geometry, frame_number, 'geometry' FROM signatures"
)
_USES_OF_JOBS = "SELECT blob AS digest, job_number AS number, 'job' AS role FROM job_files"


@dataclass(frozen=True)
class Source:
    """A database to be copied.

    Parameters
    ----------
    place : of it, for messages; without a password
    bytes : it takes, about
    copy : writes one state of it into a file that is made; tells the bytes of that so far
    """

    place: str
    bytes: int
    copy: Callable[[Path, Written], None]


@contextmanager
def open_source(url: str) -> Iterator[Source]:
    """A database that may be in use; nothing is written to it.

    Raises
    ------
    SnapshotError : it is a SQLite database in memory.
    UnusableStore, NewerSchema : it is missing, cannot be read, or is of another schema.
    """
    path = _file_of(url)
    if path is not None:
        if not path.is_file():
            raise UnusableStore(f"{path}: there is no database. Name its folder with --data.")
        yield Source(str(path), path.stat().st_size, lambda to, _: copy_database(path, to))
        return
    with look_at(url) as database:
        yield Source(database.shown, server_bytes(database), partial(copy_server, database))


def _file_of(url: str) -> Path | None:
    """The file of a SQLite database; None: it is another, or `look_at` says what is wrong.

    Raises
    ------
    SnapshotError : it is in no file.
    """
    try:
        parsed = make_url(url)
    except (ArgumentError, ValueError):  # the URL may hold a password: it is not shown
        return None
    if parsed.get_backend_name() != "sqlite":
        return None
    name = parsed.database or ""
    if name in ("", ":memory:") or name.startswith("file:"):
        raise SnapshotError(
            "Snapshots are taken of PostgreSQL, and of SQLite databases that are named by their "
            "path."
        )
    return Path(name).absolute()


def copy_database(source: Path, to: Path) -> None:
    """Write one state of a database that is in use into a file of its own; nobody waits for it.

    Parameters
    ----------
    source : of a service that may run
    to : is made

    Raises
    ------
    UnusableStore : it is missing, cannot be read, or is damaged; or there is no room for it.
    """
    if not source.is_file():
        raise UnusableStore(f"{source}: there is no database. Name its folder with --data.")
    alone = sealed_file(URL.create("sqlite", database=str(source)))
    sealed = None if alone is None else Sealed(alone)  # SQLite could not write beside it
    before = None if sealed is None else sealed.state()
    try:
        connection = _connect(source, "mode=ro") if sealed is None else sealed.connect()
        connection.isolation_level = None
        with closing(connection):
            connection.execute("VACUUM INTO ?", (str(to),))
    except sqlite3.Error as error:
        raise UnusableStore(
            f"{source}: the database cannot be copied ({error}). See that it can be read and the "
            "disk has room; where it is damaged, restore an earlier snapshot."
        ) from error
    if sealed is not None:
        sealed.check(before)


@contextmanager
def open_copy(path: Path) -> Iterator[sqlite3.Connection]:
    """A database that nobody writes, to be read."""
    with closing(_connect(path, "mode=ro&immutable=1")) as connection:
        try:
            yield connection
        except sqlite3.Error as error:
            raise UnusableStore(
                f"{path}: the copy of the database cannot be read ({error}). Run `sceneprint "
                "fsck` on the store it was made of."
            ) from error


def check_plain(connection: sqlite3.Connection) -> str | None:
    """What a database of unknown origin holds beside tables and indexes; None where it is nothing.

    A view or a generated column runs what its author likes whenever a table is read, for ever, and
    a trigger whenever one is written.

    Parameters
    ----------
    connection : of `open_copy`; nothing of it has been read yet
    """
    asked = (
        "SELECT type, name FROM sqlite_master"
        " WHERE type NOT IN ('table', 'index') OR rootpage = 0 OR rootpage IS NULL LIMIT 1"
    )
    tables = "SELECT name FROM sqlite_master WHERE type = 'table'"
    try:
        odd = connection.execute(asked).fetchone()
        if odd is not None:  # without pages of its own: a view, a trigger, a virtual table
            return f"{odd[0]} {odd[1]!r:.80}"
        for (name,) in connection.execute(tables).fetchall():
            made = connection.execute(
                "SELECT name FROM pragma_table_xinfo(?) WHERE hidden <> 0", (name,)
            ).fetchone()
            if made is not None:
                return f"column {made[0]!r:.80} of {name!r:.80} is generated"
    except sqlite3.Error:
        pass  # who reads on says what is wrong
    return None


def check_copy(connection: sqlite3.Connection) -> str | None:
    """What is wrong with a database, in a few words; None where it is sound."""
    try:
        said = str(connection.execute("PRAGMA integrity_check(1)").fetchone()[0])
        if said != "ok":
            return said.replace("\n", " ")
        lost = connection.execute("PRAGMA foreign_key_check").fetchone()
    except sqlite3.Error as error:
        return str(error)
    return f"a row of {lost[0]} refers to one of {lost[2]} that is missing" if lost else None


def check_schema(connection: sqlite3.Connection, place: str) -> str:
    """The schema's revision.

    Parameters
    ----------
    connection : of `open_copy`
    place : what it is a copy of, for messages

    Raises
    ------
    NewerSchema : this version does not know it, nor what it refers to.
    UnusableStore : there is none.
    """
    try:
        ((revision,),) = connection.execute("SELECT version_num FROM alembic_version").fetchall()
    except (sqlite3.Error, ValueError) as error:
        raise UnusableStore(
            f"{place}: no database of sceneprint. Name another folder with --data."
        ) from error
    if revision not in known_revisions()[1]:
        raise NewerSchema(
            f"{place} has schema {revision!r:.40}, which this version of sceneprint does not "
            "know: a later one wrote it. Use that version."
        )
    return str(revision)


def counts(connection: sqlite3.Connection) -> dict[str, Any]:
    """How many maps, signatures, and frames in each state there are."""
    states = connection.execute("SELECT state, count(*) FROM frames GROUP BY state ORDER BY state")
    return {
        "maps": connection.execute("SELECT count(*) FROM maps").fetchone()[0],
        "frames": dict(states.fetchall()),
        "signatures": connection.execute("SELECT count(*) FROM signatures").fetchone()[0],
    }


def referred(connection: sqlite3.Connection) -> Iterator[str]:
    """Digests of all blobs that have to be there, each once, in order."""
    # as text, whatever a database that somebody has edited holds
    told = "CAST(digest AS TEXT) AS digest"
    asked = f"SELECT DISTINCT {told} FROM ({_every(connection)}) ORDER BY 1"
    for (digest,) in connection.execute(asked):
        yield digest


def _every(connection: sqlite3.Connection) -> str:
    return f"{_USES} UNION ALL {_USES_OF_JOBS}" if _has_job_files(connection) else _USES


def count_referred(connection: sqlite3.Connection) -> int:
    """How many they are."""
    asked = f"SELECT count(DISTINCT digest) FROM ({_every(connection)})"
    return int(connection.execute(asked).fetchone()[0])


def uses(connection: sqlite3.Connection, digest: str) -> tuple[Use, ...]:
    """Whose a blob is."""
    rows = connection.execute(
        "SELECT maps.name, frames.id, used.role FROM"
        f" ({_USES}) AS used JOIN frames ON frames.number = used.number"
        " JOIN maps ON maps.number = frames.map_number WHERE CAST(digest AS TEXT) = ?"
        " ORDER BY frames.number",
        (digest,),
    )
    of_frames = [Use(map=name, frame=frame, role=role) for name, frame, role in rows]
    if not _has_job_files(connection):
        return tuple(of_frames)
    rows = connection.execute(
        "SELECT maps.name, jobs.id FROM"
        f" ({_USES_OF_JOBS}) AS used JOIN jobs ON jobs.number = used.number"
        " JOIN maps ON maps.number = jobs.map_number WHERE CAST(digest AS TEXT) = ?"
        " ORDER BY jobs.number",
        (digest,),
    )
    return (*of_frames, *(Use(map=name, job=job, role="job") for name, job in rows))


def _has_job_files(connection: sqlite3.Connection) -> bool:
    """Whether the database is of a version that lets jobs refer to blobs."""
    asked = "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name = 'job_files'"
    return bool(connection.execute(asked).fetchone()[0])


def _connect(path: Path, how: str) -> sqlite3.Connection:
    return sqlite3.connect(
        f"file:{quote(str(path.absolute()))}?{how}", uri=True, timeout=BUSY_S, isolation_level=None
    )
