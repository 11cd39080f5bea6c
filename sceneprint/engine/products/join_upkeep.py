"""Automatic associations that may join the parent frames of a map.

In a map with poses in several parent frames, the largest session of each parent frame is associated
with the largest session of the root frame, once no frame waits for a signature. An association is
repeated only after its sessions have grown, and not at all if its join was undone.
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
#: Minimum number of frames in each session: a strong join has ten votes from five frames of each.
LEAST_FRAMES = 5
#: Factor by which the number of frames must grow before two sessions are associated again.
GROWTH = 1.25
#: Maximum number of a map's newest associations to consider.
_JOBS = 200


class JoinUpkeep:
    """Starter of associations if `auto` is set; any number of processes may run it."""

    def __init__(self, store: Store, bell: Wakeup, *, auto: bool) -> None:
        self._store, self._bell, self._auto = store, bell, auto
        self._next = 0.0
        self._settled: dict[int, int] = {}  # revisions of maps without due associations

    def run(self) -> None:
        """Check all maps if it is due; log errors, after which the next check tries again."""
        if not self._auto or time.monotonic() < self._next:
            return
        self._next = time.monotonic() + LOOK_S
        try:
            with self._store.database.read() as connection:
                rows = list_maps(connection)
            before, self._settled = self._settled, {}
            for row in rows:
                if before.get(row.number) == row.revision or self._look(row):
                    self._settled[row.number] = row.revision
        except SceneprintError as error:
            log.warning("search for joins failed", extra={"error": str(error)})

    def _look(self, row: MapRow) -> bool:
        """Start an association of a map if one is due; return whether it needs no further check."""
        with self._store.database.read() as connection:  # usually nothing is due, so do not lock
            if _is_busy(connection, row):
                return False
            if _due(connection, row) is None:
                return True
        with self._store.database.write(map_number=row.number) as connection:
            row = map_of_number(connection, row.number)
            request = _due(connection, row)  # another process may have been first
            if request is not None:
                data = request.model_dump(mode="json", exclude_unset=True)
                kind = Associations.kind
                enqueue(connection, kind, None, BACKGROUND, map_number=row.number, data=data)
        self._bell.ring()
        return False


def _is_busy(connection: Connection, row: MapRow) -> bool:
    """Return whether frames of a map wait for a signature."""
    states = count_states(connection, row.number)
    return bool(states.get(FrameState.RECEIVED) or states.get(FrameState.SIGNING))


def _due(connection: Connection, row: MapRow) -> NewAssociation | None:
    """Return the next association that may join parent frames of a map; None if none is due."""
    runs = posed_runs(connection, row.number)
    largest = _largest(runs)
    if len(largest) < 2:
        return None
    kind = Associations.kind
    jobs = [one.job for one in list_jobs(connection, None, _JOBS, None, kind, [row.name])]
    if any(not job.state.over for job in jobs):
        return None
    undone = undone_pairs(connection, row.number)
    root, *others = largest
    for one in others:
        if {one.parent, root.parent} in undone:
            continue
        request = _request(one, root)
        if request is not None and _is_worth(request, one.frames + root.frames, jobs):
            return request
    return None


def _largest(runs: Sequence[ParentRun]) -> list[ParentRun]:
    """Return the largest named session of each parent frame, the root's first."""
    runs_by_parent: dict[str, ParentRun] = {}
    for one in runs:
        if one.session is not None and one.frames > runs_by_parent.get(one.parent, _NONE).frames:
            runs_by_parent[one.parent] = one
    return list(runs_by_parent.values())


_NONE = ParentRun("", None, None, 0, 0)


def _request(one: ParentRun, root: ParentRun) -> NewAssociation | None:
    """Return the request to associate two sessions; None if they are too small or too large."""
    few = min(one.frames, root.frames) < LEAST_FRAMES
    if few or one.frames + root.frames > MOST_FRAMES:
        return None
    sides = {"sessions": [one.session, root.session], "robots": [one.robot, root.robot]}
    if None in sides["robots"]:
        del sides["robots"]
    try:
        return NewAssociation.model_validate(sides)
    except ValidationError:  # one session with poses in both parent frames
        return None


def _is_worth(request: NewAssociation, total: int, jobs: Sequence[JobRow]) -> bool:
    """Return whether two sessions were not associated yet, or have grown since then."""
    for job in jobs:
        before = NewAssociation.model_validate(job.data or {})
        if {*sessions_of(before)} == {*sessions_of(request)}:
            progress = job.progress or {}
            associated = len(progress.get("source", ())) + len(progress.get("target", ()))
            return job.state == JobState.SUCCEEDED and total >= GROWTH * associated
    return True
