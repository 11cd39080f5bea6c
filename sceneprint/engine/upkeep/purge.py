"""Frames that are too old are deleted, and no byte of a deleted frame is left some time later.

maps with `retention_days`  --Retention.run-->  frames deleted for good, each with its event
frames deleted or redundant for some days  --Retention.run-->  no row of them or of their jobs

A deletion takes the frame out of all searches at once, and its rows and blobs when it can no longer
be undone. Left are then blobs of a process that died half way, surfaces, differences and answers
that the frame is part of, this node's indexes and what readers hold of it, and pages and log of
SQLite. On PostgreSQL dead rows are VACUUM's.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from sqlalchemy import Connection

from sceneprint.engine.context import Context
from sceneprint.engine.maps.tombstones import Tombstones
from sceneprint.engine.products.product import Products
from sceneprint.engine.results.query_log import QueryLog
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

#: Frames deleted in one commit: writers wait meanwhile, for some 20 ms.
AT_ONCE = 100
#: Seconds that one turn takes at most: frames are waiting to be signed.
TURN_S = 2.0
#: Seconds between two looks where nothing was left to do.
LOOK_S = 60.0
#: What the events say of why.
REASON = "retention"


class Retention:
    """Deletes frames that are too old, and rows of deleted and redundant frames after `rows_days`;
    any number of processes may.
    """

    def __init__(self, store: Store, rows_days: float) -> None:
        self._store, self._rows_s = store, DAY_S * rows_days
        self._next = 0.0

    def run(self, now: float | None = None) -> int:
        """Delete some of what is too old, where it is time to look; returns how many frames and
        rows of frames.

        Where that cannot be written, it is logged and tried again.

        Parameters
        ----------
        now : seconds since 1970; default: by the clock of the database, as that of one host that
            is wrong would delete what is young
        """
        if time.monotonic() < self._next:
            return 0
        self._next = time.monotonic() + LOOK_S
        try:
            until, removed = time.monotonic() + TURN_S, 0
            for found in chain(self._old_frames(now), self._ended_rows(now)):
                removed += found
                if found and time.monotonic() > until:
                    self._next = 0.0  # the next turn goes on
                    break
            return removed
        except SceneprintError as error:
            log.warning("retention failed", extra={"error": str(error)})
            return 0

    def _old_frames(self, at: float | None) -> Iterator[int]:
        """Delete frames, block by block; how many each."""
        with self._store.database.read() as connection:
            rows = aging_maps(connection)
        for row in rows:
            while (found := self._block(row, at)) > 0:
                yield found

    def _ended_rows(self, at: float | None) -> Iterator[int]:
        """Remove rows, block by block; how many each."""
        with self._store.database.read() as connection:
            before = (read_clock(connection) if at is None else at) - self._rows_s
            rows = maps_with_ended(connection, before)
        for row in rows:
            while found := self._write(row, lambda c, of: remove_ended(c, of, before, BLOCK)):
                log.info("ended rows removed", extra={"map": row.name, "frames": found})
                yield found

    def _write(self, row: MapRow, do: Callable[[Connection, int], int]) -> int:
        with self._store.database.write(map_number=row.number) as connection:
            return do(connection, row.number)

    def _block(self, row: MapRow, at: float | None) -> int:
        """Delete the oldest frames of a map, a few of them; returns how many."""
        if row.retention_days is None:
            return 0
        with self._store.database.read() as connection:  # most often there is none: no lock
            now = read_clock(connection) if at is None else at
            if not old_frames(connection, row.number, now - DAY_S * row.retention_days, 1):
                return 0
        with self._store.database.write(map_number=row.number) as connection:
            found = find_map(connection, row.name)  # it may have been told to keep them since
            if found.number != row.number or found.retention_days is None:
                return 0
            before = now - DAY_S * found.retention_days
            numbers = old_frames(connection, found.number, before, AT_ONCE)
            blobs = delete_frames(connection, found, numbers, REASON)
        collect_deleted_blobs(self._store, blobs)
        if numbers:
            log.info("old frames deleted", extra={"map": row.name, "frames": len(numbers)})
        return len(numbers)


class MemoryPurging:
    """Drops what this process holds of deleted maps and frames."""

    def __init__(self, context: Context) -> None:
        self._context, self._every_s = context, context.settings.purge_deadline_s / 2
        self._purged = time.monotonic()

    def run(self) -> None:
        """Drop what is held of deleted maps, and of deleted frames if it is time to look."""
        context, readers = self._context, self._context.readers
        context.query_log.tidy()  # this node may have no worker
        with context.store.database.read() as connection:
            if time.monotonic() - self._purged < self._every_s:
                readers.tidy(connection)
                return
            self._purged = time.monotonic()
            context.store.geometries.forget_older(self._every_s)
        context.indexes.purge_local()
        with context.store.database.read() as connection:
            readers.purge(connection)


#: Seconds for which a deletion is left to whoever began it.
_YOUNG_S = 60.0
#: Longest time for blobs that were left: frames wait to be signed.
_SWEEP_S = 20.0
#: Times that making an index anew takes, for which its map is left in peace afterwards: of a large
#: one it costs hours, and a deletion an hour would keep the workers at it forever.
PAUSE = 10.0


@dataclass(frozen=True)
class Purged:
    """What was removed.

    Parameters
    ----------
    blobs : that were doomed, and left behind; with files in quarantine
    answers, products : that showed what is gone
    indexes : that were made anew or removed
    """

    blobs: int
    answers: int
    products: int
    indexes: int


class Purging:
    """Removes what deletions leave behind on this node; any number of processes may.

    Parameters
    ----------
    purge_s : seconds after which nothing may be left
    quarantine : folder of damaged bytes that were set aside
    """

    def __init__(
        self, store: Store, upkeep: Upkeep, query_log: QueryLog, tombstones: Tombstones,
        products: Sequence[Products[Any, Any]], purge_s: float, quarantine: Path,
    ) -> None:  # fmt: skip
        self._store, self._upkeep, self._log = store, upkeep, query_log
        self._tombstones, self._quarantine = tombstones, quarantine
        self._products = products
        self._every_s = purge_s / 2  # what is deleted just after a look is gone in time too
        self._next = time.monotonic() + self._every_s

    def run(self) -> Purged | None:
        """Remove what is left, where it is time; what goes wrong is logged and tried again."""
        if time.monotonic() < self._next:
            return None
        self._next = time.monotonic() + self._every_s
        self._store.geometries.forget_older(self._every_s)
        before = time.time() - min(_YOUNG_S, self._every_s)
        return self._all(before, self._upkeep.is_rested, seconds=min(_SWEEP_S, self._every_s))

    def now(self) -> Purged:
        """Remove at once everything that deletions have left; none can be undone afterwards. Raise
        BusyIndex if another process is building an index that must be rebuilt, and StoreError or
        OSError if something cannot be removed; the rest is.
        """
        failed: list[Exception] = []
        found = self._all(None, lambda _: True, failed)
        if failed:
            raise failed[0]
        return found

    def _all(
        self, before: float | None, wanted: Callable[[MapRow], bool],
        failed: list[Exception] | None = None, seconds: float = math.inf,
    ) -> Purged:  # fmt: skip
        def tried(do: Callable[[], int]) -> int:
            try:
                return do()
            except (UnknownMap, UnknownJob):
                return 0  # deleted meanwhile: the next time
            except (SceneprintError, OSError, ValueError) as error:
                level = logging.INFO if isinstance(error, BusyIndex) else logging.ERROR
                log.log(level, "purge incomplete", extra={"error": str(error)})
                if failed is not None:
                    failed.append(error)
                return 0

        tried(lambda: self._tombstones.purge(everything=before is None))
        with self._store.database.read() as connection:
            rows = [row for row in list_maps(connection) if wanted(row)]
        found = Purged(
            blobs=tried(lambda: collect_doomed_blobs(self._store, before, seconds))
            + tried(lambda: collect_quarantined(self._store, self._quarantine)),
            products=sum(tried(one.forget) for one in self._products),
            answers=tried(self._log.purge),
            indexes=tried(lambda: self._swept(now=before is None))
            + sum(tried(lambda row=row: self._index(row)) for row in rows),  # type: ignore[misc]
        )
        self._store.database.shrink_log()
        return found

    def _swept(self, *, now: bool) -> int:
        """Of maps that are gone, nothing is shared."""
        self._upkeep.sweep(now=now)
        return 0

    def _index(self, row: MapRow) -> int:
        start = time.monotonic()
        done = self._upkeep.purge(row)
        took = time.monotonic() - start
        if done:
            log.info("index purged", extra={"map": row.name, "seconds": round(took, 1)})
            self._upkeep.rest(row, PAUSE * took)
        return int(done)
