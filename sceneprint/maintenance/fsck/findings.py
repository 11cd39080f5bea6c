"""Findings of a check, the checked folder, and functions that several checks share."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

from sqlalchemy import ColumnElement, Connection, Table, func, select
from sqlalchemy.exc import DBAPIError

from sceneprint.errors import StoreError, UnreadableModel, UnusableStore
from sceneprint.models import Model, parse_model
from sceneprint.settings import Settings
from sceneprint.store import Store
from sceneprint.store.maps import find_map
from sceneprint.store.tables import frames, models

#: damage: data is not as it was stored; leftover: data is not needed; note: known, or harmless.
Severity = Literal["damage", "leftover", "note"]
#: Function that is called with the checked subject, and its numbers of checked and all things.
Progress = Callable[[str, int, int], None]
#: SQLSTATEs of damaged pages and indexes of PostgreSQL.
_DAMAGED = ("XX001", "XX002")
#: Seconds in which an unreferenced file may belong to an unfinished upload.
GRACE_S = 3600.0
#: Number of rows to read in one transaction.
BLOCK = 64
#: Result of a repair that was not necessary any more.
GONE = "nothing: it was repaired or deleted meanwhile"
#: Reason why a blob cannot be moved.
BUSY_BLOBS = (
    "a backup is being taken, or another process removes blobs; run it again when that is done"
)

T = TypeVar("T")


@dataclass(frozen=True)
class Finding:
    """An error in a data folder.

    Parameters
    ----------
    kind : kind, in kebab-case
    what : the record or file
    means : consequence
    would : action of a repair; None: there is none
    map, frame_id, path : map, frame and file of the error, if any
    repair : function that repairs it and returns what it did; raises a SceneprintError if it fails
    done : what the repair did; None: there was none
    error : why the repair failed
    """

    kind: str
    what: str
    severity: Severity
    means: str
    would: str | None = None
    map: str | None = None
    frame_id: str | None = None
    path: Path | str | None = None
    repair: Callable[[], str] | None = field(default=None, compare=False, repr=False)
    done: str | None = None
    error: str | None = None

    @property
    def left(self) -> bool:
        """Whether the error remains."""
        return self.severity != "note" and self.done is None


@dataclass(frozen=True, eq=False)
class Folder:
    """A data folder under check.

    Parameters
    ----------
    settings : settings of the folder
    store : database and blobs
    map_name : map to check; None: all maps, and data of no map
    quick : whether to check only that things exist, without reading large ones
    grace_s : age below which a file may be an unfinished write, seconds
    counts : numbers of checked things, by name
    """

    settings: Settings
    store: Store
    map_name: str | None = None
    quick: bool = False
    grace_s: float = GRACE_S
    progress: Progress = field(default=lambda *_: None)
    counts: Counter[str] = field(default_factory=Counter)
    _models: dict[str, Model | None] = field(default_factory=dict)

    def model(self, model_id: str) -> Model | None:
        """Return a stored model; None if it is missing, or its file has another id."""
        if model_id not in self._models:
            with self.store.database.read() as connection:
                statement = select(models.c.content).where(models.c.id == model_id)
                content = connection.execute(statement).scalar()
            try:
                model = None if content is None else parse_model(content, model_id)
            except UnreadableModel:
                model = None
            self._models[model_id] = model if model and model.id == model_id else None
        return self._models[model_id]

    def numbers(
        self, subject: str, table: Table = frames, *where: ColumnElement[bool]
    ) -> Iterator[list[int]]:
        """Yield the numbers of all checked rows, in blocks, and report the progress."""
        done, after, number = 0, 0, table.c.number
        with self.store.database.read() as connection:
            if self.map_name is not None:
                own = find_map(connection, self.map_name).number
                where = (*where, table.c.map_number == own)
            total = int(connection.execute(select(func.count(number)).where(*where)).scalar_one())
        self.progress(subject, 0, total)
        while True:
            wanted = select(number).where(*where, number > after).order_by(number).limit(BLOCK)
            with self.store.database.read() as connection:
                block = list(connection.execute(wanted).scalars())
            if not block:
                return
            yield block
            done, after = done + len(block), block[-1]
            self.progress(subject, done, max(total, done))


def read_rows(
    folder: Folder, numbers: list[int], read: Callable[[Connection, list[int]], list[T]]
) -> Iterator[T | tuple[int, Exception]]:
    """Yield the rows of some numbers, or number and error of each that cannot be read."""
    try:
        with folder.store.database.read() as connection:
            rows = read(connection, numbers)
    except (ValueError, TypeError, KeyError, UnusableStore) as error:
        if not is_of_rows(error):
            raise
        if len(numbers) == 1:
            yield numbers[0], error
            return
    else:
        yield from rows
        return
    for number in numbers:  # one unreadable row must not hide the others
        yield from read_rows(folder, [number], read)


def is_of_rows(error: Exception) -> bool:
    """Return whether stored data caused an error, and not the machine."""
    if not isinstance(error, UnusableStore):
        return True
    cause = error.__cause__
    if not isinstance(cause, DBAPIError):
        return False
    return isinstance(cause.orig, sqlite3.Error) or (
        getattr(cause.orig, "sqlstate", None) in _DAMAGED
    )


def quarantine_blob(folder: Folder, digest: str) -> str:
    """Move a damaged blob away, and return a description.

    Raises
    ------
    StoreError : a backup needs all blobs, or another process is removing some.
    """
    with folder.store.blobs.removing() as allowed:
        if not allowed:
            raise StoreError(BUSY_BLOBS)
        place = folder.store.blobs.quarantine(digest, folder.settings.quarantine_dir)
    return "" if place is None else f"moved to {place}; "
