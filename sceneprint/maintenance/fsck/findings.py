"""What a look at a data folder finds, what it looks at, and what several repairs have in common."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

from sqlalchemy import Connection, func, select, update
from sqlalchemy.exc import DBAPIError

from sceneprint.atomic_files import make_folder, write_durable
from sceneprint.engine.upkeep.repair import PRIORITY, reason_of_loss
from sceneprint.errors import StoreError, UnreadableModel, UnusableStore
from sceneprint.models import Model, parse_model
from sceneprint.settings import Settings
from sceneprint.store import Store
from sceneprint.store.events import record_event
from sceneprint.store.maps import find_map, map_of, next_revision
from sceneprint.store.queue import enqueue
from sceneprint.store.reencoding_rows import REENCODE
from sceneprint.store.tables import frames, models
from sceneprint_client.api import FrameState

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
            named = self.map_name
            own = None if named is None else find_map(connection, named).number
            here = [] if own is None else [frames.c.map_number == own]
            asked = select(func.count(frames.c.number)).where(*here)
            total = int(connection.execute(asked).scalar_one())
        self.progress(subject, 0, total)
        while True:
            wanted = select(frames.c.number).where(*here, frames.c.number > after)
            with self.store.database.read() as connection:
                found = connection.execute(wanted.order_by(frames.c.number).limit(BLOCK))
                block = list(found.scalars())
            if not block:
                return
            yield block
            done, after = done + len(block), block[-1]
            self.progress(subject, done, max(total, done))


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


# What several repairs have in common: a frame that is signed again, bytes moved away.

#: What a repair says that finds nothing to do.
GONE = "nothing: it was well again, or gone, when it was to be repaired"


def sign_from_upload(folder: Folder, connection: Connection, number: int) -> str:
    """Let a frame that has no signature be signed from its upload; failed where that is gone.

    Parameters
    ----------
    folder : see Folder
    connection : of a writing transaction
    number : of the frame
    """
    found = connection.execute(
        update(frames)
        .where(frames.c.number == number)
        # it was kept once, whatever has come since that is like it
        .values(
            state=FrameState.RECEIVED,
            reason=None,
            indexed_at=None,
            novelty=None,
        )
        .returning(frames.c.id, frames.c.map_number, frames.c.blob)
    ).one()
    # readers and indexes that hold it learn that it is found no more, until it is signed
    connection.execute(
        update(frames)
        .where(frames.c.number == number)
        .values(revision=next_revision(connection, found.map_number))
    )
    name = map_of(connection, found.map_number).name
    condition = folder.store.blobs.condition(found.blob)
    if condition == "sound":
        job = enqueue(connection, "sign", number, PRIORITY)
        record_event(connection, "frame.received", name, found.id, job.id)
        return "a worker signs it again from its upload"
    reason = reason_of_loss(condition, found=False)
    connection.execute(
        update(frames)
        .where(frames.c.number == number)
        .values(state=FrameState.FAILED, reason=reason)
    )
    record_event(connection, "frame.failed", name, found.id)
    return f"it is failed: {reason}"


def sign_while_indexed(folder: Folder, connection: Connection, number: int, model_id: str) -> str:
    """Let an indexed frame be signed once more, where its upload is there."""
    blob = connection.execute(
        frames.select().with_only_columns(frames.c.blob).where(frames.c.number == number)
    ).scalar_one()
    condition = folder.store.blobs.condition(blob)
    if condition != "sound":
        return f"its upload is {condition}, so it cannot be made again: upload the frame again"
    enqueue(connection, REENCODE, number, PRIORITY, model_id)
    return "a worker makes it again from the upload"


#: Why a blob stays where it is.
BUSY_BLOBS = (
    "a snapshot is being taken, or another process removes blobs; run it again when that is done"
)


def quarantine_blob(folder: Folder, digest: str) -> str:
    """Move a damaged blob out of the way.

    Raises
    ------
    StoreError : a snapshot is being taken, which needs all blobs where they are, or another
        process removes some.
    """
    with folder.store.blobs.removing() as allowed:
        if not allowed:
            raise StoreError(BUSY_BLOBS)
        place = folder.store.blobs.quarantine(digest, folder.settings.quarantine_dir)
    return "" if place is None else f"moved to {place}; "


def quarantine_bytes(folder: Folder, name: str, data: bytes) -> Path:
    """Keep damaged bytes that are about to be removed from the database."""
    place = folder.settings.quarantine_dir / name
    make_folder(place.parent)
    write_durable(place, data)
    return place
