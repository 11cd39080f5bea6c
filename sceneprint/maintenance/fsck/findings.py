"""What a check of a data folder finds, what it looks at, and what several repairs share."""

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

#: damage: something is not as it was stored; leftover: something that nobody needs;
#: note: known, or harmless.
Severity = Literal["damage", "leftover", "note"]
#: Called with what is being looked at, how much of it is done, and how much there is.
Progress = Callable[[str, int, int], None]
#: What PostgreSQL says of pages and of indexes that are damaged.
_DAMAGED = ("XX001", "XX002")
#: Seconds in which a file that nothing refers to may be part of an upload that goes on.
GRACE_S = 3600.0
#: Rows that are read in one transaction.
BLOCK = 64
#: What a repair says that finds nothing to do.
GONE = "nothing: it was well again, or gone, when it was to be repaired"
#: Why a blob stays where it is.
BUSY_BLOBS = (
    "a backup is being taken, or another process removes blobs; run it again when that is done"
)

T = TypeVar("T")


@dataclass(frozen=True)
class Finding:
    """Something in a data folder that is not as it should be.

    Parameters
    ----------
    kind : what it is, in kebab-case
    what : the record or file
    means : what it means
    would : what a repair would do; None where there is nothing to be done
    map, frame_id, path : that it is about, where it is about one
    repair : does it, and says what it did; raises a SceneprintError where it cannot
    done : what the repair did; None where none was wanted, or there is none
    error : why it could not be repaired
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
        """Whether something is still to be done."""
        return self.severity != "note" and self.done is None


@dataclass(frozen=True, eq=False)
class Folder:
    """A data folder that is looked at.

    Parameters
    ----------
    settings : that name it
    store : its database and blobs
    map_name : the map to look at; None: all, and what belongs to none
    quick : see only what is there, and read nothing large
    grace_s : seconds since its last change in which a file may be somebody's unfinished work
    counts : how much was looked at, by its name
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
        """Return a stored model; None where it is missing, or its file does not give its id."""
        if model_id not in self._models:
            with self.store.database.read() as connection:
                wanted = select(models.c.content).where(models.c.id == model_id)
                content = connection.execute(wanted).scalar()
            try:
                found = None if content is None else parse_model(content, model_id)
            except UnreadableModel:
                found = None
            self._models[model_id] = found if found and found.id == model_id else None
        return self._models[model_id]

    def numbers(
        self, subject: str, table: Table = frames, *where: ColumnElement[bool]
    ) -> Iterator[list[int]]:
        """Yield the numbers of all rows that are looked at, in blocks, and report the progress."""
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
    """Yield what is read of rows; of those that cannot be read, their numbers and the errors."""
    try:
        with folder.store.database.read() as connection:
            found = read(connection, numbers)
    except (ValueError, TypeError, KeyError, UnusableStore) as error:
        if not is_of_rows(error):
            raise
        if len(numbers) == 1:
            yield numbers[0], error
            return
    else:
        yield from found
        return
    for number in numbers:  # one row that cannot be read must not hide the others
        yield from read_rows(folder, [number], read)


def is_of_rows(error: Exception) -> bool:
    """Return whether an error came of what is stored in the database, and not of the machine."""
    if not isinstance(error, UnusableStore):
        return True
    cause = error.__cause__
    if not isinstance(cause, DBAPIError):
        return False
    return isinstance(cause.orig, sqlite3.Error) or (
        getattr(cause.orig, "sqlstate", None) in _DAMAGED
    )


def quarantine_blob(folder: Folder, digest: str) -> str:
    """Move a damaged blob out of the way.

    Raises
    ------
    StoreError : a backup is being taken, which needs all blobs where they are, or another
        process removes some.
    """
    with folder.store.blobs.removing() as allowed:
        if not allowed:
            raise StoreError(BUSY_BLOBS)
        place = folder.store.blobs.quarantine(digest, folder.settings.quarantine_dir)
    return "" if place is None else f"moved to {place}; "
