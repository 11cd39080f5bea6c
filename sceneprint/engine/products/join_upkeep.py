"""Start the associations that may join the parent frames of a map, without anybody asking.

A map whose frames have poses in several parent frames gets an association of the largest session
of each of them with the largest one of its root, once none of its frames waits to be signed. It is
repeated only after the two sessions have grown, and never across a join that was undone.
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

#: Seconds between two looks at all maps.
LOOK_S = 5.0
#: Frames that either session needs: a strong join has ten votes from five frames of each.
LEAST_FRAMES = 5
#: How many times as many frames as in the last association of two sessions are worth another.
GROWTH = 1.25
#: Associations of a map that are looked at, the newest first.
_JOBS = 200


class JoinUpkeep:
    """Starts associations of maps with several parent frames if `auto`; any number of processes
    may.
    """

    def __init__(self, store: Store, bell: Wakeup, *, auto: bool) -> None:
        self._store, self._bell, self._auto = store, bell, auto
        self._next = 0.0
        self._settled: dict[int, int] = {}  # revisions of maps in which there was nothing to do

    def run(self) -> None:
        """Look at all maps, if it is time. Errors are logged, and the next look tries again."""
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
            log.warning("joins not looked for", extra={"error": str(error)})

    def _look(self, row: MapRow) -> bool:
        """Start an association of a map where one is due; return whether nothing is left to do."""
        with self._store.database.read() as connection:  # most often there is nothing: no lock
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
    """Return whether frames of a map wait to be signed: more of a session are about to come."""
    states = count_states(connection, row.number)
    return bool(states.get(FrameState.RECEIVED) or states.get(FrameState.SIGNING))


def _due(connection: Connection, row: MapRow) -> NewAssociation | None:
    """Return the association that may join a map's parent frames next, if there is one."""
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
    """Return the largest named session of each parent frame, that of the root first."""
    found: dict[str, ParentRun] = {}
    for one in runs:
        if one.session is not None and one.frames > found.get(one.parent, _NONE).frames:
            found[one.parent] = one
    return list(found.values())


_NONE = ParentRun("", None, None, 0, 0)


def _request(one: ParentRun, root: ParentRun) -> NewAssociation | None:
    """Return the association of two sessions, if it can be made."""
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
    """Return whether two sessions were not associated yet, or have grown since."""
    for job in jobs:
        before = NewAssociation.model_validate(job.data or {})
        if {*sessions_of(before)} == {*sessions_of(request)}:
            progress = job.progress or {}
            known = len(progress.get("source", ())) + len(progress.get("target", ()))
            return job.state == JobState.SUCCEEDED and total >= GROWTH * known
    return True
