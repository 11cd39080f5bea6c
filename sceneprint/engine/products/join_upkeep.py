"""Automatic associations, which join the parent frames of a map.

In a map with several parent frames, the largest session of each parent frame is associated with the
largest session of the root frame, once no frame waits for a signature. An association is repeated
only after its sessions have grown, and never if its join was undone.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence

from pydantic import ValidationError
from sqlalchemy import Connection

from sceneprint.engine.products.associations import MOST_FRAMES, Associations, sessions_of
from sceneprint.engine.products.product import BACKGROUND
from sceneprint.errors import SceneprintError
from sceneprint.store import Store
from sceneprint.store.frames import count_states
from sceneprint.store.maps import list_maps, map_of_number
from sceneprint.store.parent_joins import ParentRun, posed_runs, undone_pairs
from sceneprint.store.queue import enqueue, list_jobs
from sceneprint.store.tables import JobRow, MapRow
from sceneprint.store.wakeup import Wakeup
from sceneprint_client.api import FrameState, JobState
from sceneprint_client.api.sessions import NewAssociation

log = logging.getLogger(__name__)

#: Seconds between checks of all maps.
LOOK_S = 5.0
#: Minimum number of frames in each session; a strong join needs votes from five frames of each.
LEAST_FRAMES = 5
#: Factor by which two sessions must grow before they are associated again.
GROWTH = 1.25
#: Number of newest associations to consider per map.
_JOBS = 200


class JoinUpkeep:
    """Scheduler of associations; several processes may run it. Without `auto`, it is disabled."""

    def __init__(self, store: Store, bell: Wakeup, *, auto: bool) -> None:
        self._store, self._bell, self._auto = store, bell, auto
        self._next = 0.0
        self._settled: dict[int, int] = {}  # revisions of maps that need no check

    def run(self) -> None:
        """Check all maps, at most every LOOK_S seconds; log errors instead of raising them."""
        if not self._auto or time.monotonic() < self._next:
            return
        self._next = time.monotonic() + LOOK_S
        try:
            with self._store.database.read() as connection:
                rows = list_maps(connection)
            before, self._settled = self._settled, {}
            for row in rows:
                if before.get(row.number) == row.revision or self._queue_next(row):
                    self._settled[row.number] = row.revision
        except SceneprintError as error:
            log.warning("search for joins failed", extra={"error": str(error)})

    def _queue_next(self, row: MapRow) -> bool:
        """Queue the next association of a map, once all frames are signed; wake a worker.

        Return True if there is nothing to associate until the map changes.
        """
        with self._store.database.read() as connection:  # usually none is due: avoid a write lock
            states = count_states(connection, row.number)
            if states.get(FrameState.RECEIVED) or states.get(FrameState.SIGNING):
                return False
            if _next_association(connection, row) is None:
                return True
        with self._store.database.write(map_number=row.number) as connection:
            row = map_of_number(connection, row.number)
            request = _next_association(connection, row)  # check again under the lock
            if request is not None:
                data = request.model_dump(mode="json", exclude_unset=True)
                kind = Associations.kind
                enqueue(connection, kind, None, BACKGROUND, map_number=row.number, data=data)
        self._bell.ring()
        return False


def _next_association(connection: Connection, row: MapRow) -> NewAssociation | None:
    """Return a request to associate the largest session of a parent frame with that of the root.

    Return None while an association runs, or if all pairs were undone, have an unsuitable size, or
    have not grown since their last association.
    """
    runs = posed_runs(connection, row.number)
    largest = _largest(runs)
    if len(largest) < 2:
        return None
    kind = Associations.kind
    jobs = [listed.job for listed in list_jobs(connection, None, _JOBS, None, kind, [row.name])]
    if any(not job.state.over for job in jobs):
        return None
    undone = undone_pairs(connection, row.number)
    root, *others = largest
    for run in others:
        if {run.parent, root.parent} in undone:
            continue
        request = _request(run, root)
        if request is not None and _is_worth(request, run.frames + root.frames, jobs):
            return request
    return None


def _largest(runs: Sequence[ParentRun]) -> list[ParentRun]:
    """Return the largest named session of each parent frame, starting with the root frame."""
    largest: dict[str, ParentRun] = {}
    for run in runs:
        if run.session is not None and run.frames > largest.setdefault(run.parent, run).frames:
            largest[run.parent] = run
    return list(largest.values())


def _request(run: ParentRun, root: ParentRun) -> NewAssociation | None:
    """Return a request to associate two sessions; None if their sizes do not permit it."""
    few = min(run.frames, root.frames) < LEAST_FRAMES
    if few or run.frames + root.frames > MOST_FRAMES:
        return None
    sides = {"sessions": [run.session, root.session], "robots": [run.robot, root.robot]}
    if None in sides["robots"]:
        del sides["robots"]
    try:
        return NewAssociation.model_validate(sides)
    except ValidationError:  # the same session has poses in both parent frames
        return None


def _is_worth(request: NewAssociation, total: int, jobs: Sequence[JobRow]) -> bool:
    """Return whether two sessions were never associated, or have grown enough since then."""
    for job in jobs:
        before = NewAssociation.model_validate(job.data or {})
        if {*sessions_of(before)} == {*sessions_of(request)}:
            progress = job.progress or {}
            associated = len(progress.get("source", ())) + len(progress.get("target", ()))
            return job.state == JobState.SUCCEEDED and total >= GROWTH * associated
    return True
