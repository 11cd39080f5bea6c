"""What queries search: each map's signatures, caught up with the database before every query.

A `Reader` holds one map: the newest generation of its index, and the tail of frames indexed after
it. What it hands out is a `View`, which never changes; catching up makes a new one beside it.
"""

from __future__ import annotations

import logging
import re
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from sceneprint.engine.signers import Signers
from sceneprint.index import Generation, Tail, newest, newest_number
from sceneprint.store.events import holds_anchor
from sceneprint.store.records import MapRow
from sceneprint.store.signatures import Change, changes_since
from sceneprint.types import Bytes

log = logging.getLogger(__name__)

#: Memory of all tails above which maps that were not asked for long are forgotten.
HELD_BYTES = 1 << 30
#: Seconds between two looks for a newer generation while the tail is long.
_LOOK_S = 1.0


@dataclass(frozen=True, eq=False)
class View:
    """A map as of one revision.

    Parameters
    ----------
    revision : of the map
    generation : of its index, or None
    tail : frames newer than it
    dead : frames of both that are deleted
    size : frames that can be found
    """

    revision: int
    generation: Generation | None
    tail: Tail
    dead: frozenset[int]
    size: int


def index_folder(indexes: Path, row: MapRow) -> Path:
    """Where the index of a map is: never that of another map, which may have had its name.

    And never that of another model, whose signatures are not comparable.
    """
    made = f"{row.number}-{round(1e6 * row.created_at):x}"
    return indexes / f"{row.name}-{made}-{row.model_id[:12]}"


def is_index_folder(name: str) -> bool:
    """Whether a folder is called as `index_folder` calls them."""
    return re.fullmatch(r"[a-z0-9][a-z0-9_-]{0,62}-\d+-[0-9a-f]+(-[0-9a-f]{12})?", name) is not None


def trusted(connection: Connection, row: MapRow, found: Generation | None) -> Generation | None:
    """A generation, unless the database was put back to a state before it, and went on."""
    if found is None or found.revision > row.revision:
        return None
    return found if holds_anchor(connection, found.anchor) else None


class Reader:
    """One map, searched by many threads.

    Parameters
    ----------
    connection : of the database
    row : of the map
    folder : of its index
    length : bytes of a signature
    tail_frames : length of the tail from which on a newer generation is looked for
    """

    def __init__(
        self, connection: Connection, row: MapRow, folder: Path, length: int, tail_frames: int
    ) -> None:
        self._folder, self._length = folder, length
        self._tail_frames, self._looked = tail_frames, 0.0
        self._lock = threading.Lock()
        self._tail = _Growing(length)
        self._dead: dict[int, int] = {}  # what was deleted after the generation, and when
        self._view = self._begin(trusted(connection, row, newest(folder, row.model_id, length)))

    @property
    def bytes_held(self) -> int:
        """Memory of the tail."""
        return self._tail.bytes_held

    def view(self, connection: Connection, row: MapRow) -> View:
        """The map as of the row's revision, or later."""
        if self._view.revision < row.revision:
            with self._lock:
                if self._view.revision < row.revision:
                    self._catch_up(connection, row)
        return self._view

    def _begin(self, generation: Generation | None) -> View:
        revision = 0 if generation is None else generation.revision
        return View(revision, generation, self._tail.tail(), frozenset(), len(generation or ()))

    def _catch_up(self, connection: Connection, row: MapRow) -> None:
        view = self._view
        for block in changes_since(connection, row, view.revision):
            for change in block:
                self._take(change)
        self._publish(view.generation, row.revision)
        if len(self._tail) >= self._tail_frames:
            self._swap(connection, row)

    def _take(self, change: Change) -> None:
        if change.deleted:
            self._dead[change.number] = change.revision  # a newer generation may hold it
        elif change.vector is None:
            # one frame must not cost the others; a worker's log says it too
            log.error("a damaged signature is passed over", extra={"frame_id": change.frame_id})
        elif change.number not in self._tail:  # an error may have ended the last time half way
            self._tail.append(change, np.frombuffer(change.vector, np.uint8))

    def _swap(self, connection: Connection, row: MapRow) -> None:
        """Take a newer generation, if a worker has published one, and keep the rest as tail."""
        if time.monotonic() - self._looked < _LOOK_S:
            return
        self._looked = time.monotonic()
        view = self._view
        own = None if view.generation is None else view.generation.number
        if newest_number(self._folder) == own:
            return
        found = newest(self._folder, row.model_id, self._length, known=view.generation)
        since = 0 if view.generation is None else view.generation.revision
        found = trusted(connection, row, found)
        if found is None or not since < found.revision <= view.revision:
            return
        self._tail = self._tail.after(found.revision)
        self._dead = {n: deleted for n, deleted in self._dead.items() if deleted > found.revision}
        self._publish(found, view.revision)

    def _publish(self, generation: Generation | None, revision: int) -> None:
        dead = frozenset(n for n in self._dead if n in self._tail or _holds(generation, n))
        size = len(generation or ()) + len(self._tail) - len(dead)
        self._view = View(revision, generation, self._tail.tail(), dead, size)


class Readers:
    """The readers of all maps that were asked.

    Parameters
    ----------
    signers : see Signers
    indexes : folder of all indexes
    tail_frames : see Reader
    """

    def __init__(self, signers: Signers, indexes: Path, tail_frames: int) -> None:
        self._signers, self._indexes, self._tail_frames = signers, indexes, tail_frames
        self._lock = threading.Lock()
        self._open: OrderedDict[str, tuple[int, Reader]] = OrderedDict()

    def view(self, connection: Connection, row: MapRow) -> View:
        """A map as of the row's revision, or later."""
        with self._lock:
            number, reader = self._open.get(row.name, (0, None))
            if reader is None or number != row.number:  # a map of that name was made anew
                length = self._signers(row.model_id).model.signature_bytes
                folder = index_folder(self._indexes, row)
                reader = Reader(connection, row, folder, length, self._tail_frames)
                self._open[row.name] = (row.number, reader)
            self._open.move_to_end(row.name)
            # the one that was asked longest ago first, and never the one that is asked now
            while len(self._open) > 1 and self._bytes_held() > HELD_BYTES:
                self._open.popitem(last=False)
        return reader.view(connection, row)

    def _bytes_held(self) -> int:
        return sum(reader.bytes_held for _, reader in self._open.values())

    def forget(self, name: str) -> None:
        """Give up what is held of a map that was deleted."""
        with self._lock:
            self._open.pop(name, None)


class _Growing:
    """A tail that is appended to behind what has been handed out of it."""

    def __init__(self, length: int) -> None:
        self._keys: NDArray[np.int64] = np.empty(64, np.int64)
        self._revisions: NDArray[np.int64] = np.empty(64, np.int64)
        self._rows: Bytes = np.empty((64, length), np.uint8)
        self._places: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self._places)

    def __contains__(self, key: int) -> bool:
        return key in self._places

    @property
    def bytes_held(self) -> int:
        return self._rows.nbytes

    def append(self, change: Change, row: Bytes) -> None:
        n = len(self._places)
        if n == len(self._keys):  # views keep the old arrays
            self._keys = np.concatenate([self._keys, np.empty_like(self._keys)])
            self._revisions = np.concatenate([self._revisions, np.empty_like(self._revisions)])
            self._rows = np.concatenate([self._rows, np.empty_like(self._rows)])
        self._keys[n], self._revisions[n], self._rows[n] = change.number, change.revision, row
        self._places[change.number] = n

    def after(self, revision: int) -> _Growing:
        """Those indexed after a revision, in arrays of their own."""
        kept = _Growing(self._rows.shape[1])
        for key, place in self._places.items():
            if self._revisions[place] > revision:
                change = Change(key, "", int(self._revisions[place]), None)
                kept.append(change, self._rows[place])
        return kept

    def tail(self) -> Tail:
        n = len(self._places)
        return Tail(self._keys[:n], self._rows[:n])


def _holds(generation: Generation | None, key: int) -> bool:
    return generation is not None and bool(generation.places.of(np.array([key]))[0] >= 0)
