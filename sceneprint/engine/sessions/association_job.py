"""A session against another, or against itself, frame by frame: a job in slices.

plan  -->  frames, a slice at a time  -->  edges  --finish_association-->  verdicts, joins
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from sceneprint.engine.jobs.tasks import IsOver, LongJob, SliceResult, Swept
from sceneprint.engine.search.local_index import IndexView
from sceneprint.engine.search.retrieval import Readers
from sceneprint.engine.search.up_vectors import known_ups
from sceneprint.engine.search.verification import thresholds
from sceneprint.engine.serializers import transform
from sceneprint.engine.sessions.associations import Plan, eligible, runs_of
from sceneprint.engine.signers import Signers
from sceneprint.engine.upkeep.repair import resign_frames
from sceneprint.errors import DamagedBlob, UnreadableGeometry
from sceneprint.geometry.retrieval.ranking import (
    Ranking,
    diversify,
    pairwise_distances,
    ranking_size,
    similarity,
)
from sceneprint.geometry.rigid import inverse
from sceneprint.geometry.session_join import (
    CycleParameters,
    JoiningParameters,
    LoopEdges,
    RobotPath,
    Verdicts,
    join,
    run_of,
    verdicts,
    votes_of,
)
from sceneprint.geometry.validation.map_verification import MapParameters
from sceneprint.models import Model
from sceneprint.pipeline import PairMatch, associate
from sceneprint.store import Store
from sceneprint.store.frame_queries import PathFrame, stops_of
from sceneprint.store.maps import find_map, frames_of, geometry_blobs, unknown_map
from sceneprint.store.parent_joins import ParentJoin, join_parent, posed_runs
from sceneprint.store.queue import items_of
from sceneprint.store.signatures import stored_signatures
from sceneprint.store.tables import MapRow
from sceneprint.types import Floats, Geometry
from sceneprint_client.api.sessions import Join, NewAssociation

# What all edges of an association say together: which to believe, and how sessions lie.
#
# edges, frames with poses  --finish_association-->  verdicts, joins

#: What a vote of a weak edge counts beside that of a strong one.
_WEAK = 0.5


def finish_association(
    found: list[dict[str, Any]], source: list[int], target: list[int], stops: dict[int, PathFrame],
    asked: NewAssociation, scale: float = 1.0,
) -> tuple[list[dict[str, Any]], dict[str, int], list[dict[str, Any]]]:  # fmt: skip
    """Check edges against each other, and let those that stand vote.

    An edge is consistent if a loop with an edge of another viewpoint closes, or if it agrees with
    the join of the two parent frames that it leads between.

    Parameters
    ----------
    found : items of all edges
    source, target : numbers of the frames of both runs, in the order of time
    stops : what is known of them; deleted ones are missing
    asked : see NewAssociation
    scale : by which lengths of the model are longer than those for rooms

    Returns
    -------
    verdicts : one of each edge, in their order, as items
    counts : consistent, inconsistent, unchecked
    joins : as JSON
    """
    named = sorted({stop.parent for stop in stops.values() if stop.parent is not None})
    parents = {name: i for i, name in enumerate(named)}
    runs = _run(source, stops, parents), _run(target, stops, parents)
    places = [{number: i for i, number in enumerate(numbers)} for numbers in (source, target)]
    edges = LoopEdges(
        np.array([places[0][item["from"]] for item in found], np.int64),
        np.array([places[1][item["to"]] for item in found], np.int64),
        np.array([item["T"] for item in found], float).reshape(-1, 4, 4),
        np.array([1.0 if item["strength"] == "strong" else _WEAK for item in found]),
    )
    cycles = CycleParameters().scaled(scale)
    judged = verdicts(edges, *runs, cycles, within_run=len(asked.sessions) == 1)
    numbers = JoiningParameters(view_m=cycles.view_m)
    joins, agree = _joins(found, edges, runs, judged, stops, asked, numbers)
    confirmed = judged.supported | agree
    counts = {
        "consistent": int(confirmed.sum()), "inconsistent": int((~judged.kept).sum()),
        "unchecked": int((judged.kept & ~confirmed).sum()),
    }  # fmt: skip
    told = [
        {"consistent": True if sure else None if kept else False, "loops": loops, "closed": closed}
        for sure, kept, loops, closed in zip(
            confirmed.tolist(), judged.kept.tolist(), judged.loops.tolist(),
            judged.closed.tolist(), strict=True,
        )
    ]  # fmt: skip
    return told, counts, joins


def _run(numbers: list[int], stops: dict[int, PathFrame], parents: dict[str, int]) -> RobotPath:
    poses, owners = np.full((len(numbers), 4, 4), np.nan), np.full(len(numbers), -1, np.int64)
    for i, number in enumerate(numbers):
        stop = stops.get(number)
        if stop is not None and stop.pose is not None and stop.parent is not None:
            poses[i], owners[i] = stop.pose, parents[stop.parent]
    return run_of(poses, owners)


def _joins(
    found: list[dict[str, Any]], edges: LoopEdges, runs: tuple[RobotPath, RobotPath],
    judged: Verdicts, stops: dict[int, PathFrame], asked: NewAssociation,
    numbers: JoiningParameters,
) -> tuple[list[dict[str, Any]], NDArray[np.bool_]]:  # fmt: skip
    """A consensus of each two parent frames that edges lead between, and the edges that agree."""
    between: dict[tuple[str, str], list[int]] = {}
    for i in np.flatnonzero(judged.kept).tolist():
        ends = [stops.get(found[i][side]) for side in ("from", "to")]
        here, there = (None if end is None or end.pose is None else end.parent for end in ends)
        # loop closures within one frame correct its drift, and join nothing
        if here is not None and there is not None and (len(asked.sessions) == 2 or here != there):
            between.setdefault((here, there), []).append(i)
    told, agree = [], np.zeros(len(found), np.bool_)
    for (here, there), chosen in sorted(between.items()):
        own: NDArray[np.intp] = np.array(chosen)
        source, target = edges.source[own], edges.target[own]
        poses: tuple[Floats, Floats] = (runs[0].poses[source], runs[1].poses[target])
        votes = votes_of(edges.transforms[own], *poses, source, target, edges.weights[own])
        one = join(votes, asked.seed, numbers)
        agree[own] = one.agree & (one.T is not None)
        first, second = (stops[found[chosen[0]][side]] for side in ("from", "to"))
        told.append(
            Join(
                from_session=first.session or "", to_session=second.session or "",
                from_robot=first.robot, to_robot=second.robot, from_parent=here, to_parent=there,
                transform=None if one.T is None else transform(one.T, there, here),
                strength=one.strength, support=one.support, votes=len(own), rival=one.rival,
                spread_m=None if one.T is None else one.spread_m,
                spread_deg=None if one.T is None else math.degrees(one.spread_rad),
                reason=one.reason,
            ).model_dump(mode="json")
        )  # fmt: skip
    return told, agree


class Associating:
    """The handler of the jobs."""

    def __init__(self, store: Store, signers: Signers, readers: Readers) -> None:
        self._store, self._signers, self._readers = store, signers, readers

    def __call__(self, task: LongJob, is_over: IsOver) -> SliceResult:
        """A slice: at least one frame, or the conclusion."""
        asked = NewAssociation.model_validate(task.data)
        progress = dict(task.progress) or self._begin(task, asked)
        plan = Plan(progress["source"], progress["target"], progress["taken"])
        items: list[dict[str, Any]] = []
        while progress["done"] < len(plan.source):
            edges, tried = self._frame(task, asked, plan, progress["done"])
            items += edges
            progress["validated"] += tried or 0
            progress["skipped"] += tried is None
            progress["done"] += 1
            if is_over():
                return SliceResult(False, progress, items)
        with self._store.database.read() as connection:
            found = items_of(connection, task.job.number) + items
            stops = stops_of(connection, {*plan.source, *plan.target})
        scale = self._signers(task.of_map.model_id).model.answer.map.same_m / MapParameters().same_m
        judged, counts, joins = finish_association(
            found, plan.source, plan.target, stops, asked, scale
        )
        rooted = self._rooted(task, joins) if asked.join and len(asked.sessions) == 2 else []
        result = {
            "frames": len(plan.source), "skipped": progress["skipped"],
            "validated": progress["validated"], "edges": len(found), **counts,
            "joins": joins,
        }  # fmt: skip
        return SliceResult(
            True, progress, items + judged, result=result, event="association.found",
            write=partial(_apply, task, rooted) if rooted else None,
        )  # fmt: skip

    def _rooted(self, task: LongJob, joins: list[dict[str, Any]]) -> list[ParentJoin]:
        """Return what strong joins lead to: the parent frame whose frames came first is the root.

        Each of these joins comes to name it.
        """
        with self._store.database.read() as connection:
            parents = [run.parent for run in posed_runs(connection, task.of_map.number)]
        place = {name: i for i, name in enumerate(dict.fromkeys(parents))}
        found: dict[str, ParentJoin] = {}
        for one in joins:
            ends = one["from_parent"], one["to_parent"]
            if one["strength"] != "strong" or ends[0] == ends[1] or not place.keys() >= {*ends}:
                continue
            root, parent = sorted(ends, key=place.__getitem__)
            T = np.array(one["transform"]["matrix"])
            if parent in found or root in found:  # by a pair of frames before: one is enough
                continue
            one["root"] = root
            found[parent] = ParentJoin(parent, root, T if root == ends[1] else inverse(T))
        return list(found.values())

    def _begin(self, task: LongJob, asked: NewAssociation) -> dict[str, Any]:
        runs = runs_of(self._store, task.of_map, asked)
        source, target = runs[0], runs[-1]
        return {
            "done": 0, "total": len(source), "validated": 0, "skipped": 0,
            "source": [stop.number for stop in source],
            "target": [stop.number for stop in target],
            "taken": [stop.captured_at for stop in source],
        }  # fmt: skip

    def _frame(
        self, task: LongJob, asked: NewAssociation, plan: Plan, place: int
    ) -> tuple[list[dict[str, Any]], int | None]:
        """Edges of one frame, and how many candidates were tried; None where it is gone."""
        number = plan.source[place]
        among = eligible(asked, plan, place)
        if not len(among):
            return [], 0
        row, model, view = self._view(task.of_map)
        with self._store.database.read() as connection:
            vectors = stored_signatures(connection, [number], row.model_id)
            alive = number in frames_of(connection, [number])
            blobs = geometry_blobs(connection, [number], row.model_id)
        geometry = self._geometry(row, number, blobs)
        if number not in vectors or not alive or geometry is None:
            if alive:  # damaged, and made again behind this
                resign_frames(self._store, row, [number], row.model_id)
            return [], None
        among = among[view.has(among)]
        hits = view.search(
            np.frombuffer(vectors[number], np.uint8), ranking_size(len(among)), dead=view.dead,
            among=among, exact=True,
        )  # fmt: skip
        if not len(hits):
            return [], 0
        shares = similarity(hits.distances, model.unrelated_distance)
        ranking = Ranking(hits.keys.astype(np.intp), hits.distances, shares)
        distances = pairwise_distances(view.signatures(hits.keys), view.metric)
        chosen = diversify(ranking.distances, distances, asked.candidates).indices.tolist()
        with self._store.database.read() as connection:
            ups = known_ups(connection, [number, *ranking.indices.tolist()])
            blobs = geometry_blobs(connection, ranking.indices[chosen].tolist(), row.model_id)
        matches = associate(
            geometry, ranking, chosen, lambda key: self._geometry(row, key, blobs), asked.k,
            asked.seed, *thresholds(asked.validation, model.parameters.validation),
            up=ups.get(number), up_of=ups.get,
        )  # fmt: skip
        order = {number: i for i, number in enumerate(ranking.indices.tolist())}
        accepted = sorted(
            (one for one in matches if one.validation.status == "accepted"),
            key=lambda one: order[one.index],
        )
        # a frame that is deleted from here on is left out where edges are told
        edges = [
            _item(number, one) for one in accepted if one.validation.overlap >= asked.min_overlap
        ]
        return edges, len(matches)

    def _geometry(self, row: MapRow, number: int, blobs: Mapping[int, str]) -> Geometry | None:
        """The artifact of a frame, of those that `blobs` names; None where it is damaged."""
        if number not in blobs:  # deleted in the meantime
            return None
        try:
            return self._store.geometries.read(blobs[number])
        except (DamagedBlob, UnreadableGeometry):  # one frame must not cost the others
            resign_frames(self._store, row, [number], row.model_id)
            return None

    def _view(self, of: MapRow) -> tuple[MapRow, Model, IndexView]:
        """The map as it is now: frames of it may be deleted, and its model may change.

        Raises
        ------
        UnknownMap : it was deleted, whether or not another has its name.
        """
        row = of
        while True:  # its signer opened while no connection is held
            model = self._signers(row.model_id).model
            with self._store.database.read() as connection:
                row = find_map(connection, of.name)
                if row.number != of.number:
                    raise unknown_map(of.name)
                if row.model_id == model.id:
                    return row, model, self._readers.view(connection, row)


def _apply(task: LongJob, joins: list[ParentJoin], connection: Connection) -> list[str]:
    """Join parent frames in the commit that ends an association; no blob is of no use after it.

    Raises
    ------
    Swept : another association joined one of them meanwhile, and the end is concluded again.
    """
    for one in joins:
        if not join_parent(connection, task.of_map.number, one, task.job.id):
            raise Swept(f"Another association has joined {one.parent} or {one.root} meanwhile.")
    return []


def _item(number: int, match: PairMatch) -> dict[str, Any]:
    """An edge as it is kept."""
    v = match.validation
    T = np.eye(4) if v.T_match_query is None else v.T_match_query  # an accepted one has one
    return {
        "from": number, "to": match.index, "T": T.ravel().tolist(),
        "covariance": None if v.covariance is None else v.covariance.ravel().tolist(),
        "overlap": v.overlap, "residual_m": v.residual_m,
        "residual_deg": math.degrees(v.residual_rad), "strength": v.strength,
        "inliers": v.inliers, "ambiguity": v.ambiguity, "similarity": match.similarity,
    }  # fmt: skip
