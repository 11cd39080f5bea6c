"""No byte of a deleted frame is left, some time after it was deleted: what deleting it left behind.

A deletion takes the frame out of all searches at once, and its rows and blobs when it can no longer
be undone. Left are then blobs of a process that died half way, surfaces, differences and answers
that the frame is part of, this node's indexes and what readers hold of it, and pages and log of
SQLite. On PostgreSQL dead rows are VACUUM's.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from sceneprint.engine.maps.selections import FrameUndo
from sceneprint.engine.reconstruction import ReconstructionJobs
from sceneprint.engine.results.kept_answers import KeptAnswers
from sceneprint.engine.results.stored_results import ResultValidity, StoredResults
from sceneprint.engine.sessions.session_differences import DifferenceJobs
from sceneprint.engine.upkeep.garbage_collection import collect_doomed_blobs
from sceneprint.engine.upkeep.index_upkeep import Upkeep
from sceneprint.errors import BusyIndex, SceneprintError, UnknownJob, UnknownMap
from sceneprint.store import Store
from sceneprint.store.maps import list_maps
from sceneprint.store.tables import MapRow

log = logging.getLogger(__name__)

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
    blobs : that were doomed, and left behind
    answers, reconstructions, differences : that showed what is gone
    indexes : that were made anew or removed
    """

    blobs: int
    answers: int
    reconstructions: int
    differences: int
    indexes: int


class Purging:
    """Removes what deletions leave behind on this node; any number of processes may.

    Parameters
    ----------
    store, upkeep, kept, kept_answers, undo, reconstructions, differences : of the engine
    purge_s : seconds after which nothing may be left
    """

    def __init__(
        self, store: Store, upkeep: Upkeep, kept: StoredResults, kept_answers: KeptAnswers,
        undo: FrameUndo, reconstructions: ReconstructionJobs, differences: DifferenceJobs,
        purge_s: float,
    ) -> None:  # fmt: skip
        self._store, self._upkeep, self._kept = store, upkeep, kept
        self._kept_answers, self._undo, self._reconstructions = kept_answers, undo, reconstructions
        self._differences = differences
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
        """Remove all that is left at once; no deletion can be undone afterwards.

        Raises
        ------
        BusyIndex : another process is building one that has to be made anew; the rest is removed.
        StoreError, OSError : as it cannot be removed; the rest is.
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

        tried(lambda: self._undo.purge(everything=before is None))
        standing = ResultValidity(self._store, restorable=True)
        with self._store.database.read() as connection:
            rows = [row for row in list_maps(connection) if wanted(row)]
        found = Purged(
            blobs=tried(lambda: collect_doomed_blobs(self._store, before, seconds)),
            reconstructions=tried(lambda: self._reconstructions.forget(standing)),
            differences=tried(self._differences.forget),
            answers=tried(lambda: self._kept.forget(standing.all_of))
            + tried(self._kept_answers.remove_spent),
            indexes=sum(tried(lambda row=row: self._index(row)) for row in rows),  # type: ignore[misc]
        )
        self._store.database.shrink_log()
        return found

    def _index(self, row: MapRow) -> int:
        start = time.monotonic()
        done = self._upkeep.purge(row)
        took = time.monotonic() - start
        if done:
            log.info("index purged", extra={"map": row.name, "seconds": round(took, 1)})
            self._upkeep.rest(row, PAUSE * took)
        return int(done)
