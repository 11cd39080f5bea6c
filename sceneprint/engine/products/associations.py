"""Associations: matches between the frames of two sessions, or within a session.

sessions  --start-->  frames  --step-->  edges  --finish_association-->  verdicts, joins
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from sqlalchemy import Connection

from sceneprint.engine.jobs.tasks import LongJob, SliceResult, Swept
from sceneprint.engine.products.edge_consensus import finish_association
from sceneprint.engine.products.pose_graph import graph_text, pose_graph
from sceneprint.engine.products.product import StepwiseProducts
from sceneprint.engine.search.local_index import IndexView
from sceneprint.engine.search.up_vectors import known_ups
from sceneprint.engine.search.verification import thresholds
from sceneprint.engine.serializers import sensor_frame, transform
from sceneprint.engine.upkeep.repair import resign_frames
from sceneprint.errors import DamagedBlob, InvalidRequest, JoinStands, UnreadableGeometry
from sceneprint.formats.export import information_of
from sceneprint.geometry.retrieval.ranking import (
    Ranking,
    diversify,
    pairwise_distances,
    ranking_size,
    similarity,
)
from sceneprint.geometry.rigid import inverse
from sceneprint.geometry.validation.map_verification import (
    MapParameters,
    MapViews,
    median_contradiction,
)
from sceneprint.index.part_files import Keys
from sceneprint.models import Model
from sceneprint.pipeline import PairMatch, associate
from sceneprint.store.events import record_event
from sceneprint.store.frame_queries import (
    PathFrame,
    QueryOrigin,
    numbers_of_session,
    passing_frames,
    path_frames,
)
from sceneprint.store.maps import find_map, frames_of, geometry_blobs, unknown_map
from sceneprint.store.parent_joins import (
    ParentJoin,
    is_joined_by,
    join_parent,
    posed_runs,
    undo_joins,
)
from sceneprint.store.queue import items_of, replace_result
from sceneprint.store.signatures import stored_signatures
from sceneprint.store.tables import JobRow, MapRow
from sceneprint.types import Geometry
from sceneprint_client.api import Page
from sceneprint_client.api.base import Transform
from sceneprint_client.api.sessions import APART, Association, Edge, GraphFormat, NewAssociation

#: Maximum total number of frames in both sessions.
MOST_FRAMES = 5000
#: Number of frames of a session that are compared with the other session before a strong join.
CHECKED_FRAMES = 12
#: Maximum median share of contradicting surfaces in a strong join.
MOST_CONTRADICTION = 0.075


def sessions_of(request: NewAssociation) -> list[tuple[str, str | None]]:
    """Return the session and robot of each side of an association; a loop closure has one side."""
    robots: list[str | None] = [*(request.robots or [])] or [None] * len(request.sessions)
    return list(zip(request.sessions, robots, strict=True))


def runs_of(connection: Connection, row: MapRow, request: NewAssociation) -> list[list[PathFrame]]:
    """Return the frames of each session that pass the filter of a request, in chronological order.

    Raise InvalidRequest if a session has no such frame, or has frames of several robots, or the
    sessions have more than MOST_FRAMES frames.
    """
    sides, runs = sessions_of(request), []
    numbers = [numbers_of_session(connection, row.number, *side) for side in sides]
    if request.filter is not None:
        passed = passing_frames(
            connection, row.number, request.filter, QueryOrigin(None, None, None)
        )
        passing = set(passed.tolist())
        numbers = [[number for number in own if number in passing] for own in numbers]
    if sum(map(len, numbers)) > MOST_FRAMES:
        raise InvalidRequest(
            f"The sessions have {sum(map(len, numbers))} frames, but an association can have at "
            f"most {MOST_FRAMES}. Select fewer frames with `filter`, for example by captured_after "
            "and captured_before.",
            (("sessions", "too many frames"),),
        )
    for own in numbers:
        stops = path_frames(connection, own)
        runs.append([stops[number] for number in own if number in stops])
    for run, (session, robot) in zip(runs, sides, strict=True):
        robots = sorted({stop.robot or "" for stop in run})
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
                "Specify a robot in `robots`.",
                (("robots", "needed"),),
            )
    return runs


def eligible(request: NewAssociation, progress: Mapping[str, Any]) -> Keys:
    """Return the frame numbers to compare the next frame with, in ascending order.

    These are the frames of the other session, or far enough earlier frames of the same session.
    """
    place, target = progress["done"], progress["target"]
    if len(request.sessions) == 2:
        return np.sort(np.array(target, np.int64))
    apart = request.apart or (1 if request.not_within_s is not None else APART)
    before = np.array(target[: max(place - apart + 1, 0)], np.int64)
    if request.not_within_s is not None:
        times = np.array(progress["taken"], float)  # NaN if unknown, which makes comparisons false
        before = before[times[: len(before)] < times[place] - request.not_within_s]
    return np.sort(before)


class Associations(StepwiseProducts[NewAssociation, Association]):
    """Associations of sessions of maps."""

    kind = "associate"
    record = Association
    priority = 0
    item_count = "edges"

    def start(self, connection: Connection, row: MapRow, request: NewAssociation) -> dict[str, Any]:
        """Return the initial progress with the frames of both sessions; see `runs_of`."""
        runs = runs_of(connection, row, request)
        source, target = runs[0], runs[-1]
        return {
            "done": 0, "total": len(source), "validated": 0, "skipped": 0,
            "source": [stop.number for stop in source],
            "target": [stop.number for stop in target],
            "taken": [stop.captured_at for stop in source],
        }  # fmt: skip

    def step(
        self, task: LongJob, request: NewAssociation, progress: dict[str, Any]
    ) -> list[dict[str, Any]]:
        """Match the next frame, and return its edges; skip a deleted or damaged frame.

        Damaged frames are queued for signing.
        """
        number, among = progress["source"][progress["done"]], eligible(request, progress)
        if not len(among):
            return []
        row, model, view = self._view(task.of_map)
        with self._store.database.read() as connection:
            vectors = stored_signatures(connection, [number], row.model_id)
            alive = number in frames_of(connection, [number])
            blobs = geometry_blobs(connection, [number], row.model_id)
        geometry = self._geometry(row, number, blobs)
        if number not in vectors or not alive or geometry is None:
            if alive:  # the frame is damaged, not deleted
                resign_frames(self._store, row, [number], row.model_id)
            progress["skipped"] += 1
            return []
        among = among[view.has(among)]
        hits = view.search(
            np.frombuffer(vectors[number], np.uint8), ranking_size(len(among)), dead=view.dead,
            among=among, exact=True,
        )  # fmt: skip
        if not len(hits):
            return []
        shares = similarity(hits.distances, model.unrelated_distance)
        ranking = Ranking(hits.keys.astype(np.intp), hits.distances, shares)
        distances = pairwise_distances(view.signatures(hits.keys), view.metric)
        chosen = diversify(ranking.distances, distances, request.candidates).indices.tolist()
        with self._store.database.read() as connection:
            ups = known_ups(connection, [number, *ranking.indices.tolist()])
            blobs = geometry_blobs(connection, ranking.indices[chosen].tolist(), row.model_id)
        matches = associate(
            geometry, ranking, chosen, lambda key: self._geometry(row, key, blobs), request.k,
            request.seed, *thresholds(request.validation, model.parameters.validation),
            up=ups.get(number), up_of=ups.get,
        )  # fmt: skip
        progress["validated"] += len(matches)
        order = {number: i for i, number in enumerate(ranking.indices.tolist())}
        accepted = sorted(
            (match for match in matches if match.validation.status == "accepted"),
            key=lambda match: order[match.index],
        )
        return [
            _item(number, match)
            for match in accepted
            if match.validation.overlap >= request.min_overlap
        ]

    def finish(
        self, task: LongJob, request: NewAssociation, progress: dict[str, Any],
        items: list[dict[str, Any]],
    ) -> SliceResult:  # fmt: skip
        """Return the last slice, with verdicts on the edges and joins of the parent frames."""
        source, target = progress["source"], progress["target"]
        with self._store.database.read() as connection:
            edges = items_of(connection, task.job.number) + items
            stops = path_frames(connection, {*source, *target})
        model = self._context.signers(task.of_map.model_id).model
        scale = model.answer.map.same_m / MapParameters().same_m
        verdicts, counts, joins = finish_association(edges, source, target, stops, request, scale)
        for join in joins:
            if join["strength"] == "strong":
                share = self._contradiction(task.of_map, model, join, (source, target), stops)
                if share > MOST_CONTRADICTION:
                    join["strength"] = "weak"
                    join["reason"] += (
                        f", but {share:.0%} of the surfaces contradict each other: the places may "
                        "only look alike"
                    )
        rooted = self._rooted(task, joins) if request.join and len(request.sessions) == 2 else []
        result = {
            "frames": len(source), "skipped": progress["skipped"],
            "validated": progress["validated"], "edges": len(edges), **counts, "joins": joins,
        }  # fmt: skip
        return SliceResult(
            True, progress, items + verdicts, result=result, event="association.found",
            write=partial(_apply, task, rooted) if rooted else None,
        )  # fmt: skip

    def _contradiction(
        self, row: MapRow, model: Model, join: dict[str, Any], runs: tuple[list[int], list[int]],
        stops: dict[int, PathFrame],
    ) -> float:  # fmt: skip
        """Return the share of surfaces on which the sessions of a join contradict each other.

        In rooms that look alike, enough edges may agree on a wrong transform.
        """
        p, agreement = model.answer.map, model.parameters.validation.agreement
        own, others = (
            [n for n in run if n in stops and stops[n].parent == join[end] and stops[n].pose]
            for run, end in zip(runs, ("from_parent", "to_parent"), strict=True)
        )
        if len(own) > CHECKED_FRAMES:
            own = [own[i] for i in np.linspace(0, len(own) - 1, CHECKED_FRAMES).astype(int)]
        with self._store.database.read() as connection:
            blobs = geometry_blobs(connection, [*own, *others], row.model_id)
        views = MapViews(
            np.array([stops[n].pose for n in others]),
            lambda i: self._geometry(row, others[i], blobs), p, agreement,
            ahead=[not stops[n].is_cloud for n in others],
        )  # fmt: skip
        T = np.array(join["transform"]["matrix"])
        frames = (
            (geometry, T @ np.array(stops[n].pose))
            for n in own
            if (geometry := self._geometry(row, n, blobs)) is not None
        )
        return median_contradiction(frames, views, p, agreement)

    def _rooted(self, task: LongJob, joins: list[dict[str, Any]]) -> list[ParentJoin]:
        """Return the transforms of strong joins to the root, the parent frame with the oldest
        frames, at most one for each parent frame.

        Set the field `root` of these joins in `joins`.
        """
        with self._store.database.read() as connection:
            parents = [run.parent for run in posed_runs(connection, task.of_map.number)]
        place = {name: i for i, name in enumerate(dict.fromkeys(parents))}
        rooted: dict[str, ParentJoin] = {}
        for join in joins:
            ends = join["from_parent"], join["to_parent"]
            if join["strength"] != "strong" or ends[0] == ends[1] or not place.keys() >= {*ends}:
                continue
            root, parent = sorted(ends, key=place.__getitem__)
            T = np.array(join["transform"]["matrix"])
            if parent in rooted or root in rooted:
                continue
            join["root"] = root
            rooted[parent] = ParentJoin(parent, root, T if root == ends[1] else inverse(T))
        return list(rooted.values())

    def _geometry(self, row: MapRow, number: int, blobs: Mapping[int, str]) -> Geometry | None:
        """Return the geometry of a frame; None if it was deleted or is damaged."""
        if number not in blobs:
            return None
        try:
            return self._store.geometries.read(blobs[number])
        except (DamagedBlob, UnreadableGeometry):
            resign_frames(self._store, row, [number], row.model_id)
            return None

    def _view(self, of: MapRow) -> tuple[MapRow, Model, IndexView]:
        """Return the current row, model and index view of a map; raise UnknownMap if deleted."""
        row = of
        while True:  # repeat if the map switches its model while the signer is loaded
            model = self._context.signers(row.model_id).model
            with self._store.database.read() as connection:
                row = find_map(connection, of.name)
                if row.number != of.number:
                    raise unknown_map(of.name)
                if row.model_id == model.id:
                    return row, model, self._context.readers.view(connection, row)

    def undo_join(self, map_name: str, job_id: str) -> Association:
        """Undo the joins of an association, and return the association.

        The frames are moved to the poses that the remaining joins imply, or back to the uploaded
        poses. An association without joins does not change.

        Raises
        ------
        UnknownMap, UnknownJob : If the map or the association does not exist.
        NotIndexed : If the association has not succeeded.
        """
        with self._store.database.write() as connection:
            job = self.find(connection, map_name, job_id)
            result = self.require_success(job, "join")
            if job.map_number is not None and undo_joins(connection, job.map_number, job.id):
                joins = [
                    join if join["root"] is None else join | {"root": None, "undone": True}
                    for join in result["joins"]
                ]
                job = replace_result(connection, job, result | {"joins": joins})
                record_event(connection, "association.undone", map_name, None, job.id)
            return self.record_of(job, map_name)

    def check_removal(self, connection: Connection, job: JobRow) -> None:
        """Raise JoinStands if poses of the map depend on a join of an association."""
        if job.map_number is not None and is_joined_by(connection, job.map_number, job.id):
            raise JoinStands(
                f"Association {job.id} cannot be deleted, because it joined parent frames of the "
                "map. Undo the join first: send DELETE to the path of the association, followed "
                "by /join."
            )

    def items(
        self, connection: Connection, job: JobRow, first: int, limit: int
    ) -> list[dict[str, Any]]:
        """Return edges; they include their verdicts after the association has succeeded."""
        edges = super().items(connection, job, first, limit)
        verdicts = [dict[str, Any](consistent=None, loops=None, closed=None)] * len(edges)
        if job.result is not None:
            after = job.result["edges"] + first
            verdicts = items_of(connection, job.number, after, len(edges))
        return [item | verdict for item, verdict in zip(edges, verdicts, strict=True)]

    def edges(
        self, map_name: str, job_id: str, cursor: str | None = None, limit: int = 100,
        min_overlap: float = 0.0, *, consistent: bool | None = None,
    ) -> Page[Edge]:  # fmt: skip
        """Return a page of the edges between existing frames, in the order of their creation.

        Parameters
        ----------
        consistent : True selects supported edges, False outvoted edges, None all edges
        """

        def records(connection: Connection, block: list[dict[str, Any]]) -> list[Edge]:
            stops = path_frames(connection, {item[s] for item in block for s in ("from", "to")})
            return [
                _edge(item, stops)
                for item in block
                if item["overlap"] >= min_overlap
                and consistent in (None, item["consistent"])
                and {item["from"], item["to"]} <= stops.keys()
            ]

        items, more = self.page_of_items(map_name, job_id, cursor, limit, records)
        return Page[Edge](items=items, next_cursor=more)

    def graph(
        self, map_name: str, job_id: str, kind: GraphFormat = "g2o", min_overlap: float = 0.0,
        *, odometry: bool = False, consistent: bool = True,
    ) -> str:  # fmt: skip
        """Return the pose graph of an association as a text file.

        Parameters
        ----------
        min_overlap : minimum overlap of the edges
        kind : file format
        odometry : whether to add edges between consecutive frames
        consistent : True selects edges that another edge or a join supports; False selects all
            edges that were not outvoted

        Raises
        ------
        UnknownMap, UnknownJob, NotIndexed : If the map or the association does not exist, or the
            association has not succeeded.
        """
        with self._store.database.read() as connection:
            job = self.find(connection, map_name, job_id)
            result = self.require_success(job, "graph")
            items = self.items(connection, job, 0, result["edges"])
            progress = job.progress or {}
            numbers = [progress["source"], progress["target"]]
            stops = path_frames(connection, {number for run in numbers for number in run})
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


def _apply(task: LongJob, joins: list[ParentJoin], connection: Connection) -> list[str]:
    """Join parent frames in the commit that ends an association; return an empty list of blobs.

    Raise Swept if another association joined one of the parent frames, in which case the slice must
    be repeated.
    """
    for join in joins:
        if not join_parent(connection, task.of_map.number, join, task.job.id):
            raise Swept(f"Another association has joined {join.parent} or {join.root} meanwhile.")
    return []


def _item(number: int, match: PairMatch) -> dict[str, Any]:
    """Return an edge from frame `number` to a match as a JSON item to store."""
    v = match.validation
    T = np.eye(4) if v.T_match_query is None else v.T_match_query
    return {
        "from": number, "to": match.index, "T": T.ravel().tolist(),
        "covariance": None if v.covariance is None else v.covariance.ravel().tolist(),
        "overlap": v.overlap, "residual_m": v.residual_m,
        "residual_deg": math.degrees(v.residual_rad), "strength": v.strength,
        "inliers": v.inliers, "ambiguity": v.ambiguity, "similarity": match.similarity,
    }  # fmt: skip


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
