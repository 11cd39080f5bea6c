"""Retention: frames that are older than their map keeps them are deleted, some at a time.

maps with `retention_days`  --Retention.run-->  frames deleted for good, each with its event
"""

from __future__ import annotations

import logging
import time

from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.errors import SceneprintError
from sceneprint.store import Store
from sceneprint.store.deletion import DAY_S, aging_maps, delete_frames, old_frames
from sceneprint.store.maps import find_map
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
    """Deletes what is too old; any number of processes may."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._next = 0.0

    def run(self, now: float | None = None) -> int:
        """Delete some of what is too old, where it is time to look; returns how many frames.

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
            with self._store.database.read() as connection:
                rows = aging_maps(connection)
            until, deleted = time.monotonic() + TURN_S, 0
            for row in rows:
                while (found := self._block(row, now)) > 0:
                    deleted += found
                    if time.monotonic() > until:
                        self._next = 0.0  # the next turn goes on
                        return deleted
            return deleted
        except SceneprintError as error:
            log.warning("retention failed", extra={"error": str(error)})
            return 0

    def _block(self, row: MapRow, at: float | None) -> int:
        """Delete the oldest frames of a map, a few of them; returns how many."""
        if row.retention_days is None:
            return 0
        with self._store.database.read() as connection:  # most often there is none: no lock
            now = read_clock(connection) if at is None else at
            if not old_frames(connection, row.number, now - DAY_S * row.retention_days, 1):
                return 0
        with self._store.database.write() as connection:
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
