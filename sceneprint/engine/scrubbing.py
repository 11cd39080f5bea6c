"""Reading the indexes of a machine again, a little at a time, and discarding what is damaged."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from sceneprint.index import scrub

log = logging.getLogger(__name__)

#: Seconds of reading in one step: frames wait meanwhile.
STEP_S = 0.25
#: Its date is when the last round was begun, by whichever worker.
_STAMP = ".scrubbed"


class Scrubber:
    """One round of all indexes after another, begun by one worker of the machine at a time.

    Parameters
    ----------
    indexes : folder of all indexes
    pause_s : seconds from the beginning of one round to that of the next
    """

    def __init__(self, indexes: Path, pause_s: float) -> None:
        self._indexes, self._pause_s = indexes, pause_s
        self._round: Iterator[Path | None] | None = None
        self._looked = -pause_s

    def step(self, folders: Sequence[Path]) -> Path | None:
        """Go on for a moment; begin a round where it is time.

        Parameters
        ----------
        folders : of the indexes that there are

        Returns
        -------
        the folder of a file that was damaged and has been removed: its index must be made anew
        """
        if self._round is None:
            if not self._is_time():
                return None
            self._round = _all(folders)
        until = time.monotonic() + STEP_S
        while time.monotonic() < until:
            try:
                damaged = next(self._round)
            except StopIteration:
                self._round = None
                return None
            if damaged is not None:
                log.error("a damaged file of an index is removed", extra={"path": str(damaged)})
                damaged.unlink(missing_ok=True)  # what names it is passed over from now on
                return damaged.parent
        return None

    def _is_time(self) -> bool:
        if time.monotonic() - self._looked < min(self._pause_s, 60):
            return False
        self._looked = time.monotonic()
        stamp = self._indexes / _STAMP
        try:
            if time.time() - stamp.stat().st_mtime < self._pause_s:
                return False
        except OSError:
            pass  # never yet
        try:
            self._indexes.mkdir(parents=True, exist_ok=True)
            stamp.touch()
        except OSError:
            return False  # a cache that cannot be written cannot be healed either
        return True


def _all(folders: Sequence[Path]) -> Iterator[Path | None]:
    for folder in folders:
        yield from scrub(folder)
