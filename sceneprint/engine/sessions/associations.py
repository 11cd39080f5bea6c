"""Associations of sessions: begun, looked at, told as edges and graphs, and removed."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from sqlalchemy import Connection

from sceneprint.engine.jobs.map_jobs import BLOCK, MapJobs, page_of_items
from sceneprint.engine.jobs.tasks import Tasks
from sceneprint.engine.serializers import sensor_frame, transform, when
from sceneprint.errors import InvalidRequest, JoinStands
from sceneprint.formats.dataset import trajectory_row, trajectory_text
from sceneprint.formats.export import PoseEdge, g2o, information_of
from sceneprint.geometry.rigid import inverse, rotation_angle
from sceneprint.index.generation_files import Keys
from sceneprint.store import Store
from sceneprint.store.events import record_event
from sceneprint.store.frame_queries import (
    PathFrame,
    QueryOrigin,
    numbers_of_session,
    passing,
    stops_of,
)
from sceneprint.store.maps import find_map
from sceneprint.store.parent_joins import is_joined_by, undo_joins
from sceneprint.store.queue import items_of, replace_result
from sceneprint.store.tables import JobRow, MapRow
from sceneprint.types import Floats
from sceneprint_client.api import Page
from sceneprint_client.api.base import Transform
from sceneprint_client.api.sessions import (
    APART,
    Association,
    Edge,
    Graph,
    GraphFormat,
    NewAssociation,
    Vertex,
)
from sceneprint_client.api.sessions import GraphEdge as ToldEdge

#: Kind of the jobs.
ASSOCIATE = "associate"

# Which frames an association goes through, and which each of them may be found to be near.

#: Most frames of both sessions together: more are hours, and edges past what a page holds.
MOST_FRAMES = 5000


@dataclass(frozen=True, eq=False)
class Plan:
    """What a job goes through, fixed when it begins.

    Parameters
    ----------
    source, target : numbers of the frames, in the order of time; the same for loop closures
    taken : when each of `source` was taken, seconds since 1970; None where that is not known
    """

    source: list[int]
    target: list[int]
    taken: list[float | None]


def sessions_of(asked: NewAssociation) -> list[tuple[str, str | None]]:
    """Session and robot of both sides; one for loop closures."""
    robots: list[str | None] = [*(asked.robots or [])] or [None] * len(asked.sessions)
    return list(zip(asked.sessions, robots, strict=True))


def runs_of(store: Store, row: MapRow, asked: NewAssociation) -> list[list[PathFrame]]:
    """Frames of each of the sessions that pass the filter, in the order of time.

    Raises
    ------
    InvalidRequest : a session has no indexed frame, or frames of several robots; or there are too
        many frames.
    """
    sides, found = sessions_of(asked), []
    with store.database.read() as connection:
        numbers = [numbers_of_session(connection, row.number, *side) for side in sides]
        if asked.filter is not None:
            passed = passing(connection, row.number, asked.filter, QueryOrigin(None, None, None))
            kept = set(passed.tolist())
            numbers = [[number for number in own if number in kept] for own in numbers]
        if sum(map(len, numbers)) > MOST_FRAMES:
            raise InvalidRequest(
                f"The sessions have {sum(map(len, numbers))} frames, but an association takes at "
                f"most {MOST_FRAMES}. Narrow them with `filter`, for example by captured_after "
                "and captured_before.",
                (("sessions", "too many frames"),),
            )
        for own in numbers:
            stops = stops_of(connection, own)
            found.append([stops[number] for number in own if number in stops])
    for stops_found, (session, robot) in zip(found, sides, strict=True):
        robots = sorted({stop.robot or "" for stop in stops_found})
        if not robots:
            whose = "" if robot is None else f" of robot {robot!r:.80}"
            raise InvalidRequest(
                f"Session {session!r:.80}{whose} has no indexed frame in map {row.name!r} that "
                f"passes the filter. See GET /v1/maps/{row.name}/sessions.",
                (("sessions", "no indexed frame"),),
            )
        if len(robots) > 1:
            raise InvalidRequest(
                f"Session {session!r:.80} exists for several robots: {', '.join(robots)!r:.200}. "
                "Name one in `robots`.",
                (("robots", "needed"),),
            )
    return found


def eligible(asked: NewAssociation, plan: Plan, place: int) -> Keys:
    """Frames that one may be found to be near, rising: of the other session, or before it."""
    if len(asked.sessions) == 2:
        return np.sort(np.array(plan.target, np.int64))
    apart = asked.apart or (1 if asked.not_within_s is not None else APART)
    before = np.array(plan.target[: max(place - apart + 1, 0)], np.int64)
    if asked.not_within_s is not None:
        taken = np.array(plan.taken, float)  # NaN where not known, which is before nothing
        before = before[taken[: len(before)] < taken[place] - asked.not_within_s]
    return np.sort(before)


class AssociationJobs(MapJobs[Association]):
    """Associations of the sessions of maps."""

    def __init__(self, store: Store, tasks: Tasks) -> None:
        super().__init__(
            store, tasks, Association, kind=ASSOCIATE, noun="association", path="associations"
        )

    def begin(self, map_name: str, asked: NewAssociation) -> Association:
        """Queue an association.

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : a session without frames, of several robots, or with too many frames.
        """
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
        return self.queue(map_name, asked, len(runs_of(self._store, row, asked)[0]))

    def undo_join(self, map_name: str, job_id: str) -> Association:
        """Take back the join of an association: all frames have the poses that joins left give
        them, those of no join as they were sent. Without a join that stands nothing changes.

        Raises
        ------
        UnknownMap, UnknownJob, NotIndexed : there is none, or it did not succeed.
        """
        with self._store.database.write() as connection:
            job = self.find(connection, map_name, job_id)
            result = self.require_success(job, map_name, "its join can be undone")
            if job.map_number is not None and undo_joins(connection, job.map_number, job.id):
                joins = [
                    one if one["root"] is None else one | {"root": None, "undone": True}
                    for one in result["joins"]
                ]
                job = replace_result(connection, job, result | {"joins": joins})
                record_event(connection, "association.undone", map_name, None, job.id)
            return self.record(job, map_name)

    def check_removal(self, connection: Connection, job: JobRow) -> None:
        """Raise JoinStands where poses of the map follow from an association."""
        if job.map_number is not None and is_joined_by(connection, job.map_number, job.id):
            raise JoinStands(
                f"Association {job.id} joined parent frames of its map, and only with it this can "
                "be undone. Undo its join first: DELETE the path of the association with /join."
            )

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
        consistent : those that others support, or those that were outvoted; default: all

        Raises
        ------
        UnknownMap, UnknownJob : there is none.
        InvalidRequest : a cursor that was not given out.
        """
        with self._store.database.read() as connection:
            job = self.find(connection, map_name, job_id)

            def made(_: int, block: Sequence[dict[str, Any]]) -> list[Edge]:
                stops = stops_of(connection, {item[s] for item in block for s in ("from", "to")})
                return [
                    _edge(item, stops)
                    for item in block
                    if item["overlap"] >= min_overlap
                    and consistent in (None, item["consistent"])
                    and {item["from"], item["to"]} <= stops.keys()
                ]

            items, more = page_of_items(
                cursor, limit, lambda at: _items(connection, job, at, BLOCK), made,
                lambda edge: edge.number,
            )  # fmt: skip
        return Page[Edge](items=items, next_cursor=more)

    def graph(
        self, map_name: str, job_id: str, kind: GraphFormat = "g2o", min_overlap: float = 0.0,
        *, odometry: bool = False, consistent: bool = True,
    ) -> str:  # fmt: skip
        """Return the pose graph of an association that is over, as a file of a kind.

        It has the edges of at least `min_overlap` that a second edge or a join supports, or, unless
        `consistent`, all that were not outvoted; and with `odometry` one between each two
        consecutive frames.

        Raises
        ------
        UnknownMap, UnknownJob, NotIndexed : there is none, or it did not succeed.
        """
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
            job = self.find(connection, map_name, job_id)
            result = self.require_success(job, row.name, "its graph exists")
            items = _items(connection, job, 0, result["edges"])
            progress = job.progress or {}
            numbers = [progress["source"], progress["target"]]
            stops = stops_of(connection, {number for run in numbers for number in run})
        distinct = numbers[:1] if numbers[0] == numbers[1] else numbers
        runs = [[stops[n] for n in run if n in stops] for run in distinct]
        chosen = [
            item
            for item in items
            if item["overlap"] >= min_overlap
            and item["consistent"] is not False
            and (item["consistent"] or not consistent)
            and {item["from"], item["to"]} <= stops.keys()
        ]
        graph = pose_graph(runs, chosen, result["joins"], odometry=odometry)
        return graph_text(graph, kind)


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


def _pose(stop: PathFrame) -> Transform | None:
    if stop.pose is None or stop.parent is None:
        return None
    return transform(np.array(stop.pose), stop.parent, sensor_frame(stop.id, stop.kind))


def _edge(item: dict[str, Any], stops: dict[int, PathFrame]) -> Edge:
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
        from_robot=here.robot, to_robot=there.robot, from_name=here.name, to_name=there.name,
        transform=transform(
            T, sensor_frame(there.id, there.kind), sensor_frame(here.id, here.kind)
        ),
        information=information, **{name: item[name] for name in same},
    )  # fmt: skip


# The graph of an association: vertices in one frame as far as sessions are joined, and edges.
#
# frames, edges that were kept, joins  --pose_graph-->  PoseGraph  --graph_text-->  g2o, TUM, JSON

#: Deviation of an edge without a covariance of its own, metres and radians.
_UNTOLD = (0.05, math.radians(1.5))
#: Of odometry between two frames: of a step, and a share of the way and of the turn.
_STEP, _SHARE = (0.005, math.radians(0.2)), 0.02

MEDIA_TYPES = {"g2o": "text/x-g2o", "tum": "text/plain", "json": "application/json"}


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Frames and what holds them together.

    Parameters
    ----------
    stops : the vertices, run after run in the order of time
    poses : where each is; None where nothing tells
    frames : which frame each pose is in
    edges : between places of `stops`
    kinds : association or odometry, of each edge
    """

    stops: list[PathFrame]
    poses: list[Floats | None]
    frames: list[str | None]
    edges: list[PoseEdge]
    kinds: list[str]


def pose_graph(
    runs: Sequence[Sequence[PathFrame]], items: Sequence[Mapping[str, Any]],
    joins: Sequence[Mapping[str, Any]], *, odometry: bool,
) -> PoseGraph:  # fmt: skip
    """Put an association's graph together.

    Parameters
    ----------
    runs : frames of each session, in the order of time
    items : the edges, whose frames are all there
    joins : of the association's result
    odometry : whether to add an edge between each two consecutive frames with poses
    """
    stops = [stop for run in runs for stop in run]
    place = {stop.number: i for i, stop in enumerate(stops)}
    edges, kinds = [], []
    for item in items:
        # T_to_from: the frame that was found is the first vertex
        T, told = np.array(item["T"], float).reshape(4, 4), item["covariance"]
        covariance = _diagonal(*_UNTOLD) if told is None else np.array(told).reshape(6, 6)
        ends = place[item["to"]], place[item["from"]]
        edges.append(PoseEdge(*ends, T, information_of(covariance, T)))
    kinds = ["association"] * len(edges)
    if odometry:
        steps = [step for run in runs for step in _steps(run, place)]
        edges += steps
        kinds += ["odometry"] * len(steps)
    poses, frames = _placed(stops, edges, joins)
    return PoseGraph(stops, poses, frames, edges, kinds)


def _steps(run: Sequence[PathFrame], place: Mapping[int, int]) -> list[PoseEdge]:
    found = []
    for a, b in pairwise(run):
        if a.pose is None or b.pose is None or a.parent != b.parent:
            continue
        T = inverse(np.array(a.pose)) @ np.array(b.pose)
        metres = _STEP[0] + _SHARE * float(np.linalg.norm(T[:3, 3]))
        radians = _STEP[1] + _SHARE * rotation_angle(T[:3, :3])
        information = information_of(_diagonal(metres, radians), T)
        found.append(PoseEdge(place[a.number], place[b.number], T, information))
    return found


def _diagonal(metres: float, radians: float) -> Floats:
    return np.diag(np.repeat((metres**2, radians**2), 3))


def _placed(
    stops: Sequence[PathFrame], edges: Sequence[PoseEdge], joins: Sequence[Mapping[str, Any]]
) -> tuple[list[Floats | None], list[str | None]]:
    """Poses, moved into the frame of most by the joins; without a pose, by the first edge."""
    counted = Counter(stop.parent for stop in stops if stop.pose is not None)
    parents = sorted((name for name in counted if name), key=lambda name: (-counted[name], name))
    into: dict[str, tuple[str, Floats]] = {}  # T_root_parent, by parent
    for root in parents:
        if root in into:
            continue
        into[root] = (root, np.eye(4))
        waiting = deque([root])
        while waiting:
            here = waiting.popleft()
            for there, T in _joined(here, joins):
                if there not in into:
                    into[there] = (root, into[here][1] @ T)
                    waiting.append(there)
    poses: list[Floats | None] = [None] * len(stops)
    frames: list[str | None] = [None] * len(stops)
    for i, stop in enumerate(stops):
        if stop.pose is not None and stop.parent is not None:
            frames[i], T = into[stop.parent]
            poses[i] = T @ np.array(stop.pose)
    _spread(poses, frames, edges)
    return poses, frames


def _joined(here: str, joins: Sequence[Mapping[str, Any]]) -> list[tuple[str, Floats]]:
    """Frames that are joined to one, with T_here_there."""
    found = []
    for one in joins:
        if one["transform"] is None or one["from_parent"] == one["to_parent"] or one.get("undone"):
            continue
        T = np.array(one["transform"]["matrix"])
        if one["to_parent"] == here:
            found.append((one["from_parent"], T))
        if one["from_parent"] == here:
            found.append((one["to_parent"], inverse(T)))
    return found


def _spread(
    poses: list[Floats | None], frames: list[str | None], edges: Sequence[PoseEdge]
) -> None:
    """Give frames without a pose one by the edges that lead to them, nearest first."""
    near: dict[int, list[tuple[int, Floats]]] = {}
    for edge in edges:
        near.setdefault(edge.first, []).append((edge.second, edge.T))
        near.setdefault(edge.second, []).append((edge.first, inverse(edge.T)))
    waiting = deque(i for i, pose in enumerate(poses) if pose is not None)
    while waiting:
        i = waiting.popleft()
        here = poses[i]
        for j, T in near.get(i, []):
            if poses[j] is None and here is not None:
                poses[j], frames[j] = here @ T, frames[i]
                waiting.append(j)


def graph_text(graph: PoseGraph, kind: GraphFormat) -> str:
    """A graph as a file.

    A trajectory has the vertices with a stamp whose poses are in the frame of most. In g2o, where
    every vertex has a pose, one without stands at the origin.
    """
    if kind == "json":
        return _json(graph).model_dump_json()
    if kind == "tum":
        return _tum(graph)
    return g2o([np.eye(4) if pose is None else pose for pose in graph.poses], graph.edges)


def _main(graph: PoseGraph) -> str | None:
    """The frame that most poses are in."""
    counted = Counter(name for name in graph.frames if name is not None)
    return min(counted, key=lambda name: (-counted[name], name), default=None)


def _tum(graph: PoseGraph) -> str:
    main, stamps, stamped = _main(graph), *_stamps(graph)
    rows = [
        trajectory_row(stamp, pose)
        for stamp, pose, frame in zip(stamps, graph.poses, graph.frames, strict=True)
        if stamp is not None and pose is not None and frame == main
    ]
    comments = [
        f"poses of the sensors' frames in {main or 'no frame'}, metres",
        f"{len(rows)} poses; {len(graph.stops) - len(rows)} frames left out, as they have no "
        "stamp or are not joined to it",
        f"t: {stamped}" if rows else "empty: no frame with a stamp has a pose",
        "t tx ty tz qx qy qz qw",
    ]
    return trajectory_text(sorted(rows), comments)


def _stamps(graph: PoseGraph) -> tuple[Sequence[float | None], str]:
    """A stamp for each vertex, and what it is: its time; its place in the session where none has a
    time and all have places of their own; else its number.
    """
    times = [stop.captured_at for stop in graph.stops]
    if any(at is not None for at in times):
        return times, "captured_at, seconds since 1970"
    places = [stop.sequence for stop in graph.stops]
    if None not in places and len(set(places)) == len(places):
        return places, "sequence, place within the session"
    return range(len(places)), "number of the vertex, as in g2o"


def _json(graph: PoseGraph) -> Graph:
    vertices = [
        Vertex(
            vertex=i, frame_id=stop.id, robot=stop.robot, session=stop.session,
            captured_at=when(stop.captured_at), name=stop.name, sequence=stop.sequence,
            pose=(
                None if pose is None
                else transform(pose, frame or "", sensor_frame(stop.id, stop.kind))
            ),
        )
        for i, (stop, pose, frame) in enumerate(
            zip(graph.stops, graph.poses, graph.frames, strict=True)
        )
    ]  # fmt: skip
    edges = [
        ToldEdge.model_validate(
            {
                "kind": kind, "first": edge.first, "second": edge.second,
                "matrix": edge.T.tolist(), "information": edge.information.ravel().tolist(),
            }
        )
        for edge, kind in zip(graph.edges, graph.kinds, strict=True)
    ]  # fmt: skip
    return Graph(frame=_main(graph), vertices=vertices, edges=edges)
