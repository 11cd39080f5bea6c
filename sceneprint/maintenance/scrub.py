"""The scrub: verification of all stored bytes at a low rate, to find damage early.

    frames of the store  --Scrub.run, a slice every 4 s-->  reported damage, repaired signatures

The scrub applies the checks of `sceneprint fsck` to frames. Workers rebuild damaged signatures and
artifacts from uploads. Other damage is only reported, because its repair requires an operator.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace

from sceneprint.engine.upkeep.repair import resign_frames
from sceneprint.errors import NotFound, SceneprintError
from sceneprint.maintenance.fsck.check import check_frames
from sceneprint.maintenance.fsck.findings import Finding, Folder
from sceneprint.settings import Settings
from sceneprint.store import Store
from sceneprint.store.events import record_event
from sceneprint.store.maps import find_frame, find_map
from sceneprint.store.queue import read_clock
from sceneprint.store.scrub_rows import (
    SLICE_S,
    ScrubRow,
    claim_slice,
    next_frames,
    read_scrub,
    record_slice,
)

log = logging.getLogger(__name__)

#: Number of frames per block, and maximum duration of a slice, seconds.
AT_ONCE, TURN_S = 16, 0.2
#: Seconds between the start of a process and its first slice.
BEGIN_S = 60.0


class Scrub:
    """The scrub of a store in slices; several processes may run it at the same time.

    Parameters
    ----------
    settings : `blob_check_mb_per_s` limits the total rate of all workers of the store
    """

    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings, self._store = settings, store
        self._budget = int(settings.blob_check_mb_per_s * 1e6 * SLICE_S)
        self._next = time.monotonic() + BEGIN_S

    def run(self, may_go_on: Callable[[], bool] = lambda: True) -> ScrubRow | None:
        """Verify the next slice if it is due. Errors are logged; the slice is then repeated later.

        Parameters
        ----------
        may_go_on : function that is called after each block; the slice ends if it returns False

        Returns
        -------
        row : progress of the scrub; None if no slice is due or possible, or after an error
        """
        is_resting = time.monotonic() < self._next
        if self._budget <= 0 or self._store.database.read_only or is_resting:
            return None
        self._next = time.monotonic() + SLICE_S
        try:
            with self._store.database.read() as connection:  # usually none is due: avoid a lock
                row = read_scrub(connection)
                if row is not None and not row.is_due(read_clock(connection)):
                    return None
            with self._store.database.write() as connection:
                row = claim_slice(connection)
            return None if row is None else self._read(row, may_go_on)
        except SceneprintError as error:
            log.warning("scrub incomplete", extra={"error": str(error)})
            return None

    def _read(self, row: ScrubRow, may_go_on: Callable[[], bool]) -> ScrubRow:
        """Check blocks of frames until the slice is over; record and return the progress."""
        until, folder = time.monotonic() + TURN_S, Folder(self._settings, self._store)
        damaged, finished, over = 0, False, False
        while not over:  # at least one block, so that each pass ends
            with self._store.database.read() as connection:
                numbers = next_frames(connection, row.position, AT_ONCE)
            if not numbers:
                finished = True
                break
            for finding in check_frames(folder, numbers):
                if finding.severity == "damage":
                    damaged += 1
                    self._report(finding)
            row = replace(row, position=numbers[-1])
            spent = folder.counts["bytes"] >= self._budget
            over = spent or time.monotonic() >= until or not may_go_on()
        row = replace(
            row, blobs=row.blobs + folder.counts["blobs"],
            bytes=row.bytes + folder.counts["bytes"], damaged=row.damaged + damaged,
        )  # fmt: skip
        with self._store.database.write() as connection:
            record_slice(connection, row, finished=finished)
        if finished:
            about = {"blobs": row.blobs, "bytes": row.bytes, "damaged": row.damaged}
            log.info("scrub finished", extra=about)
        return row

    def _report(self, finding: Finding) -> None:
        """Log a finding; record an event for an upload, or schedule derived data to be rebuilt."""
        about = {"map": finding.map, "frame_id": finding.frame_id, "finding": finding.kind}
        log.error("damage found", extra=about | {"means": finding.means})
        if finding.map is None or finding.frame_id is None:
            return
        try:
            with self._store.database.read() as connection:
                row = find_map(connection, finding.map)
                frame = find_frame(connection, row, finding.frame_id)
        except NotFound:
            return
        if finding.kind.endswith("-upload"):
            with self._store.database.write() as connection:
                record_event(connection, "frame.damaged", row.name, frame.id, upload=True)
        elif finding.kind.endswith(("-artifact", "-signature")):
            resign_frames(self._store, row, [frame.number], row.model_id)
