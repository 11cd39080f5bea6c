"""Findings of a check, the checked folder, and functions shared by the checks."""

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

#: damage: stored data is lost or changed; leftover: data is superfluous; note: the finding is
#: harmless or recorded.
Severity = Literal["damage", "leftover", "note"]
#: Callback that receives the subject, the number of checked objects, and their total number.
Progress = Callable[[str, int, int], None]
#: SQLSTATE codes with which PostgreSQL reports damaged pages and indexes.
_DAMAGED = ("XX001", "XX002")
#: Age, in seconds, below which an unreferenced file may belong to an unfinished upload.
GRACE_S = 3600.0
#: Number of rows to read in one transaction.
BLOCK = 64
#: Result of a repair that is no longer necessary.
GONE = "nothing: the data was repaired or deleted meanwhile"
#: Error text if a blob cannot be moved.
BUSY_BLOBS = (
    "a backup or another process that removes blobs is running; run the check again after it ends"
)

T = TypeVar("T")


@dataclass(frozen=True)
class Finding:
    """A fault in a data folder.

    Parameters
    ----------
    kind : identifier in kebab case
    what : description of the faulty record or file
    means : consequence of the fault
    would : description of the possible repair; None if there is none
    map, frame_id, path : map, frame and file of the fault; None if it has none
    repair : function that repairs the fault, and returns a description; raises SceneprintError if
        the repair fails
    done : description of the completed repair; None before a repair
    error : reason why the repair failed
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
        """Return whether the fault remains."""
        return self.severity != "note" and self.done is None


@dataclass(frozen=True, eq=False)
class Folder:
    """The data folder to check.

    Parameters
    ----------
    store : database and blobs
    map_name : map to check; None checks all maps, and data without a map
    quick : whether to check only that blobs and rows exist, without reading their content
    grace_s : age, in seconds, below which unreferenced files are ignored
    counts : number of checked objects by subject
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
        """Return a stored model; None if it is missing or damaged."""
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
        """Yield the numbers of all rows to check, in blocks, and report the progress."""
        done, after, number = 0, 0, table.c.number
        with self.store.database.read() as connection:
            if self.map_name is not None:
                own = find_map(connection, self.map_name).number
                where = (*where, table.c.map_number == own)
            total = int(connection.execute(select(func.count(number)).where(*where)).scalar_one())
        self.progress(subject, 0, total)
        while True:
            query = select(number).where(*where, number > after).order_by(number).limit(BLOCK)
            with self.store.database.read() as connection:
                block = list(connection.execute(query).scalars())
            if not block:
                return
            yield block
            done, after = done + len(block), block[-1]
            self.progress(subject, done, max(total, done))


def read_rows(
    folder: Folder, numbers: list[int], read: Callable[[Connection, list[int]], list[T]]
) -> Iterator[T | tuple[int, Exception]]:
    """Yield the results of `read` for some rows, and number and error of each unreadable row.

    If the rows cannot be read at once, `read` gets them one by one. Other errors propagate.
    """
    try:
        with folder.store.database.read() as connection:
            rows = read(connection, numbers)
    except (ValueError, TypeError, KeyError, UnusableStore) as error:
        if not is_data_damage(error):
            raise
        if len(numbers) == 1:
            yield numbers[0], error
            return
    else:
        yield from rows
        return
    for number in numbers:  # one by one, since an unreadable row makes the whole block fail
        yield from read_rows(folder, [number], read)


def is_data_damage(error: Exception) -> bool:
    """Return whether an error is caused by damaged data, not by the machine."""
    if not isinstance(error, UnusableStore):
        return True
    cause = error.__cause__
    if not isinstance(cause, DBAPIError):
        return False
    return isinstance(cause.orig, sqlite3.Error) or (
        getattr(cause.orig, "sqlstate", None) in _DAMAGED
    )


def quarantine_blob(folder: Folder, digest: str) -> str:
    """Move a damaged blob to quarantine; return a description of the move.

    Raises
    ------
    StoreError : If a backup or another process that removes blobs is running.
    """
    with folder.store.blobs.locks.removing() as allowed:
        if not allowed:
            raise StoreError(BUSY_BLOBS)
        place = folder.store.blobs.quarantine(digest, folder.settings.quarantine_dir)
    return "" if place is None else f"moved to {place}; "
