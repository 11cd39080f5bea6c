"""Retention of frames, and purges of all bytes of deleted frames.

maps with `retention_days`  --Retention.run-->  old frames are deleted permanently, with events
frames deleted or redundant for some days  --Retention.run-->  their rows and jobs are removed

Searches exclude a deleted frame at once. Its rows and blobs are removed when its deletion can no
longer be undone. A purge removes the remaining data: blobs of killed processes, products and
answers that contain the frame, its signature in local indexes and readers, and free pages and the
log of SQLite. On PostgreSQL, VACUUM removes dead rows.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import chain

from sceneprint.engine.context import Context
from sceneprint.engine.maps.tombstones import Tombstones
from sceneprint.engine.products.reconstruction import Reconstructions
from sceneprint.engine.products.session_differences import Differences
from sceneprint.engine.upkeep.garbage_collection import (
    collect_deleted_blobs,
    collect_doomed_blobs,
    collect_quarantined,
)
from sceneprint.engine.upkeep.index_upkeep import Upkeep
from sceneprint.errors import BusyIndex, SceneprintError, UnknownJob, UnknownMap
from sceneprint.store import Store
from sceneprint.store.deletion import (
    BLOCK,
    DAY_S,
    aging_maps,
    delete_frames,
    maps_with_ended,
    old_frames,
    remove_ended,
)
from sceneprint.store.maps import find_map, list_maps
from sceneprint.store.queue import read_clock
from sceneprint.store.tables import MapRow

log = logging.getLogger(__name__)

#: Maximum number of frames to delete in one commit (about 20 ms).
AT_ONCE = 100
#: Maximum duration of a call, during which jobs wait, seconds.
TURN_S = 2.0
#: Seconds between checks after all old frames and rows were deleted.
LOOK_S = 60.0
#: Reason of the deletion in events.
REASON = "retention"


class Retention:
    """Deletion of old frames, and removal of rows; several processes may run it at the same time.

    Parameters
    ----------
    rows_days : age in days at which rows of deleted and redundant frames are removed
    """

    def __init__(self, store: Store, rows_days: float) -> None:
        self._store, self._rows_s = store, DAY_S * rows_days
        self._next = 0.0

    def run(self, now: float | None = None) -> int:
        """If due, delete old frames and rows for about TURN_S seconds; return their number.

        If any remain, the next call continues. Errors are logged; a later call retries.

        Parameters
        ----------
        now : current time, seconds since 1970; None reads the clock of the database
        """
        if time.monotonic() < self._next:
            return 0
        self._next = time.monotonic() + LOOK_S
        try:
            until, removed = time.monotonic() + TURN_S, 0
            for count in chain(self._old_frames(now), self._ended_rows(now)):
                removed += count
                if count and time.monotonic() > until:
                    self._next = 0.0  # the next call continues
                    break
            return removed
        except SceneprintError as error:
            log.warning("retention failed", extra={"error": str(error)})
            return 0

    def _old_frames(self, at: float | None) -> Iterator[int]:
        """Delete old frames in blocks, and yield the size of each block."""
        with self._store.database.read() as connection:
            rows = aging_maps(connection)
        for row in rows:
            while (count := self._block(row, at)) > 0:
                yield count

    def _ended_rows(self, at: float | None) -> Iterator[int]:
        """Remove old rows in blocks, and yield the size of each block."""
        with self._store.database.read() as connection:
            before = (read_clock(connection) if at is None else at) - self._rows_s
            rows = maps_with_ended(connection, before)
        for row in rows:
            count = BLOCK
            while count:
                with self._store.database.write(map_number=row.number) as connection:
                    count = remove_ended(connection, row.number, before, BLOCK)
                if count:
                    log.info("ended rows removed", extra={"map": row.name, "frames": count})
                    yield count

    def _block(self, row: MapRow, at: float | None) -> int:
        """Delete a block of the oldest frames of a map, and return its size."""
        if row.retention_days is None:
            return 0
        with self._store.database.read() as connection:  # usually none exist: avoid a write lock
            now = read_clock(connection) if at is None else at
            if not old_frames(connection, row.number, now - DAY_S * row.retention_days, 1):
                return 0
        with self._store.database.write(map_number=row.number) as connection:
            current = find_map(connection, row.name)  # its retention may have changed
            if current.number != row.number or current.retention_days is None:
                return 0
            before = now - DAY_S * current.retention_days
            numbers = old_frames(connection, current.number, before, AT_ONCE)
            blobs = delete_frames(connection, current, numbers, REASON)
        collect_deleted_blobs(self._store, blobs)
        if numbers:
            log.info("old frames deleted", extra={"map": row.name, "frames": len(numbers)})
        return len(numbers)


class MemoryPurging:
    """Removal of data of deleted maps and frames from the memory of this process."""

    def __init__(self, context: Context) -> None:
        self._context, self._every_s = context, context.settings.purge_deadline_s / 2
        self._purged = time.monotonic()

    def run(self) -> None:
        """Free the memory of deleted maps and, at intervals, of deleted frames.

        At these intervals, remove local indexes that still contain deleted frames. Also remove
        surplus queries and answers.
        """
        context, readers = self._context, self._context.readers
        context.query_log.tidy()  # nodes without workers need this
        with context.store.database.read() as connection:
            if time.monotonic() - self._purged < self._every_s:
                readers.tidy(connection)
                return
            self._purged = time.monotonic()
            context.store.geometries.forget_older(self._every_s)
        context.indexes.purge_local()
        with context.store.database.read() as connection:
            readers.purge(connection)


#: Minimum age, in seconds, of doomed blobs to remove here; the deleting process removes younger
#: ones.
_YOUNG_S = 60.0
#: Maximum duration of the removal of doomed blobs, during which jobs wait, seconds.
_SWEEP_S = 20.0
#: Pause before the next purge of an index, as a multiple of the duration of the last purge.
PAUSE = 10.0


@dataclass(frozen=True)
class Purged:
    """Counts of the objects that a purge removed or rebuilt.

    Parameters
    ----------
    blobs : doomed and quarantined blobs
    answers, products : answers and products that contained deleted frames
    indexes : rebuilt indexes
    """

    blobs: int
    answers: int
    products: int
    indexes: int


class Purging:
    """Purge of deleted frames on a node; several processes may run it at the same time."""

    def __init__(self, context: Context, upkeep: Upkeep) -> None:
        settings, store = context.settings, context.store
        self._context, self._upkeep = context, upkeep
        self._tombstones = Tombstones(store, settings.undo_window_s, context.bell.ring)
        self._products = Reconstructions(context), Differences(context)
        # half of the deadline, since a deletion may follow just after a purge
        self._every_s = settings.purge_deadline_s / 2
        self._next = time.monotonic() + self._every_s

    def run(self) -> Purged | None:
        """Purge deleted frames if due, else return None; log errors."""
        if time.monotonic() < self._next:
            return None
        self._next = time.monotonic() + self._every_s
        self._context.store.geometries.forget_older(self._every_s)
        return self._purge_all(now=False)[0]

    def now(self) -> Purged:
        """Purge all deleted frames, whose deletion then cannot be undone; return the counts.

        Raises
        ------
        BusyIndex : If another process is building an index that must be rebuilt.
        StoreError, OSError : If something cannot be removed; raised after the rest was removed.
        """
        purged, failed = self._purge_all(now=True)
        if failed:
            raise failed[0]
        return purged

    def _purge_all(self, *, now: bool) -> tuple[Purged, list[Exception]]:
        """Purge what is due, or everything if `now` is set; return the counts and the errors."""
        failed = list[Exception]()

        def attempt(do: Callable[[], int | None]) -> int:
            try:
                return do() or 0
            except (UnknownMap, UnknownJob):
                return 0
            except (SceneprintError, OSError, ValueError) as error:
                level = logging.INFO if isinstance(error, BusyIndex) else logging.ERROR
                log.log(level, "purge incomplete", extra={"error": str(error)})
                failed.append(error)
                return 0

        context, store = self._context, self._context.store
        before = None if now else time.time() - min(_YOUNG_S, self._every_s)
        seconds = math.inf if now else min(_SWEEP_S, self._every_s)
        attempt(lambda: self._tombstones.purge(everything=now))
        with store.database.read() as connection:
            rows = [row for row in list_maps(connection) if now or self._upkeep.is_purge_due(row)]
        purged = Purged(
            blobs=attempt(lambda: collect_doomed_blobs(store, before, seconds))
            + attempt(lambda: collect_quarantined(store, context.settings.quarantine_dir)),
            products=sum(attempt(product.forget) for product in self._products),
            answers=attempt(context.query_log.purge),
            indexes=attempt(partial(context.indexes.sweep, now=now))
            + sum(attempt(partial(self._purge_index, row)) for row in rows),
        )
        store.database.shrink_log()
        return purged, failed

    def _purge_index(self, row: MapRow) -> int:
        start = time.monotonic()
        done = self._upkeep.purge(row)
        seconds = time.monotonic() - start
        if done:
            log.info("index purged", extra={"map": row.name, "seconds": round(seconds, 1)})
            self._upkeep.postpone_purge(row, PAUSE * seconds)
        return int(done)
