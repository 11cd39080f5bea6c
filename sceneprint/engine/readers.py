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
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from sqlalchemy import Connection, select

from sceneprint.engine.choosing import Choosing
from sceneprint.engine.growing import Growing
from sceneprint.engine.shortlists import WHOLE, Shortlist
from sceneprint.engine.signers import Signers
from sceneprint.engine.views import View
from sceneprint.index import Generation, newest, newest_number
from sceneprint.store import Database
from sceneprint.store.events import holds_anchor
from sceneprint.store.maps import list_maps
from sceneprint.store.records import MapRow
from sceneprint.store.replica import require_primary
from sceneprint.store.signatures import Change, changes_since, count_indexed
from sceneprint.store.tables import maps
from sceneprint.store.vectors import count_newer

log = logging.getLogger(__name__)

#: Memory of all tails above which maps that were not asked for long are forgotten.
HELD_BYTES = 1 << 30
#: Seconds between two looks for a newer generation.
_LOOK_S = 1.0
#: Bytes of a generation's signatures up to which all are verified when it is opened: it takes a
#: second a gigabyte. Larger ones are verified by workers, in the background.
VERIFIED_BYTES = 256 << 20
#: Seconds between two looks for maps that are held and no longer there.
_TIDY_S = 10.0


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
    if found is None:
        return None
    if found.revision <= row.revision and holds_anchor(connection, found.anchor):
        return found
    require_primary("the state of an index")
    return None


class Reader:
    """One map, searched by many threads.

    Parameters
    ----------
    connection : of the database
    row : of the map
    folder : of its index
    length : bytes of a signature
    """

    def __init__(self, connection: Connection, row: MapRow, folder: Path, length: int) -> None:
        self._folder, self._length, self._model_id = folder, length, row.model_id
        self._looked = time.monotonic()
        self._lock = threading.Lock()
        self._tail = Growing(length, folder)
        self._dead: dict[int, int] = {}  # what was deleted after the generation, and when
        self._damaged: set[int] = set()
        self._unsound: int | None = None  # number of a generation that was found damaged
        self._view = self._begin(self._newest(connection, row, None))

    @property
    def bytes_held(self) -> int:
        """Memory of the tail."""
        return self._tail.bytes_held

    def lacks(self, connection: Connection, row: MapRow) -> int | None:
        """How many frames it has yet to read; None: with these it would hold too many."""
        view = self._view
        newer = max(row.revision - view.revision, 0)
        if len(view.tail) + newer > WHOLE:
            newer = count_newer(connection, row.number, view.revision, WHOLE + 1)
        return newer if len(view.tail) + newer <= WHOLE else None

    def is_outdated(self) -> bool:
        """Whether there is an index that this reader does not use."""
        return newest_number(self._folder) not in (None, self._view.number, self._unsound)

    def view(self, connection: Connection, row: MapRow) -> View:
        """The map as of the row's revision, or later."""
        behind = self._view.revision < row.revision
        if self._view.revision > row.revision:
            require_primary("what is held of a map")
        # who only looks for a newer generation waits for nobody
        if (behind or self._is_time()) and self._lock.acquire(blocking=behind):
            try:
                if self._view.revision < row.revision:
                    self._catch_up(connection, row)
                if self._is_time():
                    self._swap(connection, row)
            finally:
                self._lock.release()
        return self._view

    def purge(self, connection: Connection, row: MapRow) -> None:
        """Hold no signature of a deleted frame any more, but what the newest index has of it."""
        with self._lock:
            if self._view.revision < row.revision:
                self._catch_up(connection, row)
            self._swap(connection, row)
            gone = {number for number in self._dead if number in self._tail}
            if gone:
                self._tail = self._tail.without(gone)
                self._publish(self._view.generation, self._view.revision)

    def _is_time(self) -> bool:
        return time.monotonic() - self._looked >= _LOOK_S

    def _begin(self, generation: Generation | None) -> View:
        revision = 0 if generation is None else generation.revision
        size = len(generation or ())
        return View(self._model_id, revision, generation, self._tail.tail(), frozenset(), size)

    def _catch_up(self, connection: Connection, row: MapRow) -> None:
        view = self._view
        self._tail.reserve(count_indexed(connection, row.number, view.revision))
        for block in changes_since(connection, row, view.revision):
            for change in block:
                self._take(change)
        self._publish(view.generation, row.revision)

    def _take(self, change: Change) -> None:
        self._damaged.discard(change.number)
        if change.deleted:
            self._dead[change.number] = change.revision  # a newer generation may hold it
        elif change.vector is None:
            # one frame must not cost the others; a worker's log says it too
            log.error("a damaged signature is passed over", extra={"frame_id": change.frame_id})
            self._damaged.add(change.number)
        elif self._tail.revision_of(change.number) < change.revision:
            # else an error ended the last time half way
            if change.number in self._tail:  # signed anew, as it had been damaged
                self._tail = self._tail.without({change.number})
            self._tail.append(change, np.frombuffer(change.vector, np.uint8))
            self._dead.pop(change.number, None)  # rejected by a model, and tried again by another

    def _swap(self, connection: Connection, row: MapRow) -> None:
        """Take another generation, if a worker has published one, and keep the rest as tail."""
        self._looked = time.monotonic()
        view = self._view
        number, since = (0, 0) if view.generation is None else (
            view.generation.number, view.generation.revision
        )  # fmt: skip
        if newest_number(self._folder) in (None, number, self._unsound):
            return
        found = self._newest(connection, row, view.generation)
        # one of the same revision stands for one that was found damaged
        if found is None or found.number == number or not since <= found.revision <= view.revision:
            return
        self._tail = self._tail.after(found.revision)
        self._dead = {n: deleted for n, deleted in self._dead.items() if deleted > found.revision}
        self._publish(found, view.revision)

    def _newest(
        self, connection: Connection, row: MapRow, known: Generation | None
    ) -> Generation | None:
        found = newest(self._folder, row.model_id, self._length, known=known)
        if found is not None:
            old = set() if known is None else set(map(id, known.segments))
            new = [each for each in found.segments if id(each) not in old]
            small = sum(each.size for each in new) <= VERIFIED_BYTES
            if small and not all(each.is_sound() for each in new):
                log.error("a damaged index is not used", extra={"map": row.name})
                self._unsound = found.number
                return None
        return trusted(connection, row, found)

    def _publish(self, generation: Generation | None, revision: int) -> None:
        deleted = np.fromiter(self._dead, np.int64, len(self._dead))
        held = np.isin(deleted, self._tail.tail().keys)
        if generation is not None:
            held |= generation.places.of(deleted) >= 0
        dead = frozenset(deleted[held].tolist())
        tail, both = self._tail.tail(), 0
        if generation is not None:  # signed anew since
            both = int((generation.places.of(tail.keys) >= 0).sum())
        size = len(generation or ()) + len(tail) - both - len(dead)
        damaged = frozenset(self._damaged)
        self._view = View(self._model_id, revision, generation, tail, dead, size, damaged)


class Readers:
    """The readers of all maps that were asked.

    Parameters
    ----------
    signers : see Signers
    indexes : folder of all indexes
    choosing : which maps are searched in the database; none where it is not given
    """

    def __init__(self, signers: Signers, indexes: Path, choosing: Choosing | None = None) -> None:
        self._signers, self._indexes = signers, indexes
        self.choosing = choosing or Choosing("local")
        self._database, self._history = signers.database, signers.database.history
        self._lock = threading.Lock()
        self._open: OrderedDict[str, tuple[tuple[int, str], Reader]] = OrderedDict()
        self._tidied = time.monotonic()

    def views(
        self, connection: Connection, database: Database, rows: Sequence[MapRow]
    ) -> list[Shortlist]:
        """Maps of one model as of their rows' revisions, or later, each where it is searched best.

        Parameters
        ----------
        connection : a reading transaction of `database`
        rows : of the maps, one or more
        """
        found: dict[int, Shortlist] = {}
        if self.choosing.is_possible(connection):
            asked = self._others(connection, rows)
            length = self._signers(rows[0].model_id).model.signature_bytes if asked else 0
            found.update(self.choosing.stored(connection, database, asked, length))
        return [found.get(row.number) or self.view(connection, row) for row in rows]

    def _others(self, connection: Connection, rows: Sequence[MapRow]) -> list[MapRow]:
        """Maps of which this node would have to read much before it could search them."""
        if self.choosing.setting == "database":
            return list(rows)
        others, left = [], WHOLE
        for row in rows:
            reader = self._reader(connection, row)
            lacking = reader.lacks(connection, row)
            if lacking is None and reader.is_outdated():
                self.forget(row.name)  # it was asked long ago: another begins with the newest index
                lacking = self._reader(connection, row).lacks(connection, row)
            if lacking is None or lacking > left:
                others.append(row)
            else:
                left -= lacking
        return others

    def view(self, connection: Connection, row: MapRow) -> View:
        """A map as of the row's revision, or later, on this node."""
        reader = self._reader(connection, row)
        if self._is_time_to_tidy():
            self.tidy(connection)
        return reader.view(connection, row)

    def _reader(self, connection: Connection, row: MapRow) -> Reader:
        with self._lock:
            if self._history != self._database.history:  # revisions may be of other frames now
                self._history = self._database.history
                self._open.clear()
            held, reader = self._open.get(row.name, (None, None))
            wanted = (row.number, row.model_id)
            if reader is None or held != wanted:  # made anew, or signed with another model
                length = self._signers(row.model_id).model.signature_bytes
                folder = index_folder(self._indexes, row)
                reader = Reader(connection, row, folder, length)
                self._open[row.name] = (wanted, reader)
            self._open.move_to_end(row.name)
            # the one that was asked longest ago first, and never the one that is asked now
            while len(self._open) > 1 and self._bytes_held() > HELD_BYTES:
                self._open.popitem(last=False)
            return reader

    def _is_time_to_tidy(self) -> bool:
        with self._lock:
            return time.monotonic() - self._tidied >= _TIDY_S

    def _bytes_held(self) -> int:
        return sum(reader.bytes_held for _, reader in self._open.values())

    def forget(self, name: str) -> None:
        """Give up what is held of a map that was deleted."""
        with self._lock:
            self._open.pop(name, None)

    def purge(self, connection: Connection) -> None:
        """Hold nothing of deleted frames any more, beyond what the newest indexes have of them."""
        self.tidy(connection)
        with self._lock:
            held = list(self._open.items())
        rows = {row.name: row for row in list_maps(connection)}
        for name, (wanted, reader) in held:
            row = rows.get(name)
            if row is not None and (row.number, row.model_id) == wanted:
                reader.purge(connection, row)

    def tidy(self, connection: Connection) -> None:
        """Give up what is held of maps that another process deleted, or gave another model.

        Their files are gone, but take room on the disk and a descriptor each while mapped.
        """
        asked = select(maps.c.name, maps.c.number, maps.c.model_id)
        there = {row.name: (row.number, row.model_id) for row in connection.execute(asked)}
        self.choosing.remembered.tidy()
        with self._lock:
            self._tidied = time.monotonic()
            for name in [name for name, (held, _) in self._open.items() if there.get(name) != held]:
                del self._open[name]
