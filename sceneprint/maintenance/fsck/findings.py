"""What a look at a data folder finds, and what it looks at."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

from sqlalchemy import Connection, func, select
from sqlalchemy.exc import DBAPIError

from sceneprint.errors import UnreadableModel, UnusableStore
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
#: Frames that are read in one transaction.
BLOCK = 256

T = TypeVar("T")


@dataclass(frozen=True)
class Finding:
    """Something in a data folder that is not as it should be.

    Parameters
    ----------
    kind : what it is, in kebab-case
    what : which record or file
    severity : see Severity
    means : what it means
    would : what a repair would do; None where there is nothing to be done
    map, frame_id, path : that it is about, where it is about one
    repair : does it, and says what it did; raises a SceneprintError where it cannot
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
    progress : see Progress
    counts : how much was looked at, by its name
    """

    settings: Settings
    store: Store
    map_name: str | None
    quick: bool
    grace_s: float
    progress: Progress
    counts: Counter[str] = field(default_factory=Counter)
    _models: dict[str, Model | None] = field(default_factory=dict)

    @property
    def quarantine(self) -> Path:
        """Where damaged bytes are moved to."""
        return self.settings.data_dir / "quarantine"

    def model(self, model_id: str) -> Model | None:
        """A model; None where it is missing or damaged, which is a finding of its own."""
        if model_id not in self._models:
            with self.store.database.read() as connection:
                wanted = select(models.c.content).where(models.c.id == model_id)
                content = connection.execute(wanted).scalar()
            try:
                found = None if content is None else parse_model(content, model_id)
            except UnreadableModel:
                found = None
            self._models[model_id] = found
        return self._models[model_id]

    def numbers(self, subject: str) -> Iterator[list[int]]:
        """Numbers of all frames that are looked at, in blocks; tells the progress of `subject`."""
        done, after = 0, 0
        with self.store.database.read() as connection:
            own = self._map_number(connection)
            here = frames.c.map_number == own if own is not None else frames.c.number > 0
            total = int(connection.execute(select(func.count()).where(here)).scalar_one())
        self.progress(subject, 0, total)
        while True:
            wanted = select(frames.c.number).where(here, frames.c.number > after)
            with self.store.database.read() as connection:
                found = connection.execute(wanted.order_by(frames.c.number).limit(BLOCK))
                block = list(found.scalars())
            if not block:
                return
            yield block
            done, after = done + len(block), block[-1]
            self.progress(subject, done, max(total, done))

    def _map_number(self, connection: Connection) -> int | None:
        return None if self.map_name is None else find_map(connection, self.map_name).number


def each(
    folder: Folder, numbers: list[int], read: Callable[[Connection, list[int]], list[T]]
) -> Iterator[T | tuple[int, Exception]]:
    """What is read of frames; of those that cannot be read, their numbers and the errors."""
    try:
        with folder.store.database.read() as connection:
            found = read(connection, numbers)
    except (ValueError, TypeError, KeyError, UnusableStore) as error:
        if not is_of_rows(error):
            raise
    else:
        yield from found
        return
    for number in numbers:  # one row that cannot be read must not hide the others
        try:
            with folder.store.database.read() as connection:
                found = read(connection, [number])
        except (ValueError, TypeError, KeyError, UnusableStore) as error:
            if not is_of_rows(error):
                raise
            yield number, error
        else:
            yield from found


def is_of_rows(error: Exception) -> bool:
    """Whether an error came of what is stored in the database, and not of the machine."""
    if not isinstance(error, UnusableStore):
        return True
    cause = error.__cause__
    if not isinstance(cause, DBAPIError):
        return False
    return isinstance(cause.orig, sqlite3.Error) or (
        getattr(cause.orig, "sqlstate", None) in _DAMAGED
    )
