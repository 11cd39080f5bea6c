"""Associations of sessions: begun, looked at, told as edges and graphs, and removed."""

from __future__ import annotations

from typing import Any

import numpy as np
from sqlalchemy import Connection

from sceneprint.engine.cursors import opened, row_of
from sceneprint.engine.posegraphs import pose_graph, tell_graph
from sceneprint.engine.sides import runs_of
from sceneprint.engine.sweeping import sweep_deleted
from sceneprint.engine.tasks import Tasks
from sceneprint.engine.transforms import transform
from sceneprint.engine.wire import sensor_frame, when
from sceneprint.errors import NotIndexed, UnknownJob
from sceneprint.graphs import information_of
from sceneprint.schemas import JobState, Page, Progress
from sceneprint.schemas.associations import (
    Association,
    AssociationResult,
    Edge,
    GraphFormat,
    NewAssociation,
)
from sceneprint.schemas.transforms import Transform
from sceneprint.store import Store
from sceneprint.store.associations import ASSOCIATE, Stop, remove_job, stops_of
from sceneprint.store.listing import find_job, list_jobs
from sceneprint.store.maps import find_map
from sceneprint.store.parts import items_of
from sceneprint.store.records import JobRow

#: Edges that are read at once where few of them are wanted.
_BLOCK = 500


class Associations:
    """Associations of the sessions of maps.

    Parameters
    ----------
    store, tasks : of the engine
    """

    def __init__(self, store: Store, tasks: Tasks) -> None:
        self._store, self._tasks = store, tasks

    def begin(self, map_name: str, asked: NewAssociation) -> Association:
        """Queue an association.

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : a session without frames, of several robots, or with too many frames.
        """
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
        total = len(runs_of(self._store, row, asked)[0])
        data = asked.model_dump(mode="json", exclude_unset=True)
        job = self._tasks.begin(ASSOCIATE, map_name, data)
        return Association(
            association_id=job.job_id, map=map_name, asked=asked, state=job.state,
            progress=Progress(done=0, total=total), result=None, error=None,
            created_at=job.created_at, finished_at=None,
        )  # fmt: skip

    def list_all(
        self, map_name: str, cursor: str | None = None, limit: int = 100
    ) -> Page[Association]:
        """Associations of a map, the newest first.

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : a cursor that was not given out.
        """
        seals = self._store.seals
        before = opened(seals, "job", cursor)
        with self._store.database.read() as connection:
            find_map(connection, map_name)
            found = list_jobs(connection, before, limit + 1, None, ASSOCIATE, [map_name])
        items = [_told(one.job, map_name) for one in found[:limit]]
        more = seals.seal("job", found[limit - 1].job.number) if len(found) > limit else None
        return Page[Association](items=items, next_cursor=more)

    def get(self, map_name: str, job_id: str) -> Association:
        """An association; UnknownMap or UnknownJob where there is none."""
        with self._store.database.read() as connection:
            return _told(_find(connection, map_name, job_id), map_name)

    def remove(self, map_name: str, job_id: str) -> None:
        """Forget an association with its edges; one that is not over is given up.

        Raises
        ------
        UnknownMap, UnknownJob : there is none.
        """
        with self._store.database.write() as connection:
            blobs = remove_job(connection, _find(connection, map_name, job_id))
        sweep_deleted(self._store, blobs)

    def edges(
        self, map_name: str, job_id: str, cursor: str | None = None, limit: int = 100,
        min_overlap: float = 0.0, *, consistent: bool | None = None,
    ) -> Page[Edge]:  # fmt: skip
        """Edges in the order in which they were found, also while more are; of frames that are
        there.

        Parameters
        ----------
        map_name, job_id : of the association
        cursor, limit : of the page
        min_overlap : least overlap
        consistent : those that loops confirm, or those that were outvoted; default: all

        Raises
        ------
        UnknownMap, UnknownJob : there is none.
        InvalidRequest : a cursor that was not given out.
        """
        after = row_of(cursor)
        at = 0 if after is None else after + 1
        found: list[Edge] = []
        with self._store.database.read() as connection:
            job = _find(connection, map_name, job_id)
            while len(found) <= limit:
                block = _items(connection, job, at, _BLOCK)
                stops = stops_of(connection, {item[s] for item in block for s in ("from", "to")})
                found += [
                    _edge(item, stops)
                    for item in block
                    if item["overlap"] >= min_overlap
                    and consistent in (None, item["consistent"])
                    and {item["from"], item["to"]} <= stops.keys()
                ]
                at += len(block)
                if len(block) < _BLOCK:
                    break
        more = str(found[limit - 1].number) if len(found) > limit else None
        return Page[Edge](items=found[:limit], next_cursor=more)

    def graph(
        self, map_name: str, job_id: str, kind: GraphFormat = "g2o", min_overlap: float = 0.0,
        *, odometry: bool = False, consistent: bool = False,
    ) -> str:  # fmt: skip
        """The pose graph of an association that is over, as a file of a kind.

        It has the edges of at least `min_overlap` that were not outvoted, or those alone that
        loops confirm (`consistent`); and with `odometry` one between each two consecutive frames.

        Raises
        ------
        UnknownMap, UnknownJob, NotIndexed : there is none, or it did not succeed.
        """
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
            job = _find(connection, map_name, job_id)
            if job.state != JobState.SUCCEEDED or job.result is None:
                raise NotIndexed(
                    f"Association {job.id} is {job.state}: its graph is there when it has "
                    f"succeeded. See GET /v1/maps/{row.name}/associations/{job.id}."
                )
            items = _items(connection, job, 0, job.result["edges"])
            progress = job.progress or {}
            numbers = [progress["source"], progress["target"]]
            stops = stops_of(connection, {number for run in numbers for number in run})
        runs = [[stops[n] for n in run if n in stops] for run in _distinct(numbers)]
        chosen = [
            item
            for item in items
            if item["overlap"] >= min_overlap
            and item["consistent"] is not False
            and (item["consistent"] or not consistent)
            and {item["from"], item["to"]} <= stops.keys()
        ]
        graph = pose_graph(runs, chosen, job.result["joins"], odometry=odometry)
        return tell_graph(graph, kind)


def _distinct(runs: list[list[int]]) -> list[list[int]]:
    return runs[:1] if runs[0] == runs[1] else runs


def _find(connection: Connection, map_name: str, job_id: str) -> JobRow:
    row = find_map(connection, map_name)
    message = (
        f"There is no association {job_id!r:.80} in map {row.name!r}. List them with "
        f"GET /v1/maps/{row.name}/associations."
    )
    try:
        job = find_job(connection, job_id)
    except UnknownJob:
        raise UnknownJob(message) from None
    if job.kind != ASSOCIATE or job.map_number != row.number:
        raise UnknownJob(message)
    return job


def _told(job: JobRow, map_name: str) -> Association:
    progress = None
    if job.progress is not None:
        progress = Progress(done=job.progress["done"], total=job.progress["total"])
    return Association(
        association_id=job.id, map=map_name, asked=NewAssociation.model_validate(job.data or {}),
        state=job.state, progress=progress,
        result=None if job.result is None else AssociationResult.model_validate(job.result),
        error=job.error, created_at=when(job.created_at), finished_at=when(job.finished_at),
    )  # fmt: skip


def _items(connection: Connection, job: JobRow, first: int, limit: int) -> list[dict[str, Any]]:
    """Edges with their numbers, and with what was made of them when the association was over."""
    unknown = {"consistent": None, "loops": None, "closed": None}
    if job.result is None:
        found = items_of(connection, job.number, first, limit)
        return [unknown | item | {"number": first + i} for i, item in enumerate(found)]
    # as many verdicts follow the edges
    count = job.result["edges"]
    limit = max(min(limit, count - first), 0)
    found = items_of(connection, job.number, first, limit)
    verdicts = items_of(connection, job.number, count + first, limit)
    return [
        item | verdict | {"number": first + i}
        for i, (item, verdict) in enumerate(zip(found, verdicts, strict=True))
    ]


def _pose(stop: Stop) -> Transform | None:
    if stop.pose is None or stop.parent is None:
        return None
    return transform(np.array(stop.pose), stop.parent, sensor_frame(stop.id, stop.kind))


def _edge(item: dict[str, Any], stops: dict[int, Stop]) -> Edge:
    here, there = stops[item["from"]], stops[item["to"]]
    T, information = np.array(item["T"]).reshape(4, 4), None
    if item["covariance"] is not None:
        whole = information_of(np.array(item["covariance"]).reshape(6, 6), T)
        information = whole.ravel().tolist()
    same = (
        "overlap", "residual_m", "residual_deg", "strength", "inliers", "ambiguity",
        "similarity", "consistent", "loops", "closed",
    )  # fmt: skip
    return Edge(
        from_pose=_pose(here), to_pose=_pose(there),
        number=item["number"], from_frame=here.id, to_frame=there.id,
        from_session=here.session, to_session=there.session,
        from_robot=here.robot, to_robot=there.robot,
        transform=transform(
            T, sensor_frame(there.id, there.kind), sensor_frame(here.id, here.kind)
        ),
        information=information, **{name: item[name] for name in same},
    )  # fmt: skip
