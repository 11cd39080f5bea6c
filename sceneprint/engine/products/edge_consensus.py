"""Consensus of the edges of an association: verdicts on edges, and joins of parent frames.

edges, frames with poses  --finish_association-->  verdicts, joins
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.engine.serializers import transform
from sceneprint.geometry.session_join import (
    CycleParameters,
    EdgeVerdicts,
    JoiningParameters,
    LoopEdges,
    RobotPath,
    association_votes,
    join_sessions,
    judge_edges,
    robot_path,
)
from sceneprint.store.frame_queries import PathFrame
from sceneprint.types import Floats
from sceneprint_client.api.sessions import Join, NewAssociation

#: Weight of the vote of a weak edge, relative to a strong edge.
_WEAK = 0.5


def finish_association(
    items: list[dict[str, Any]], source: list[int], target: list[int], stops: dict[int, PathFrame],
    request: NewAssociation, scale: float = 1.0,
) -> tuple[list[dict[str, Any]], dict[str, int], list[dict[str, Any]]]:  # fmt: skip
    """Check the edges against each other, and join parent frames by votes of the edges.

    An edge is consistent if it forms a closed loop with an edge from another viewpoint, or agrees
    with the join of its two parent frames.

    Parameters
    ----------
    items : edges
    source, target : frame numbers of both runs, in chronological order
    stops : existing frames by number
    scale : length scale of the model, relative to that of a model for rooms

    Returns
    -------
    verdicts : verdict of each edge as an item, in the order of `items`
    counts : number of consistent, inconsistent and unchecked edges
    joins : joins as JSON
    """
    named = sorted({stop.parent for stop in stops.values() if stop.parent is not None})
    parents = {name: i for i, name in enumerate(named)}
    runs = _run(source, stops, parents), _run(target, stops, parents)
    places = [{number: i for i, number in enumerate(numbers)} for numbers in (source, target)]
    edges = LoopEdges(
        np.array([places[0][item["from"]] for item in items], np.int64),
        np.array([places[1][item["to"]] for item in items], np.int64),
        np.array([item["T"] for item in items], float).reshape(-1, 4, 4),
        np.array([1.0 if item["strength"] == "strong" else _WEAK for item in items]),
    )
    cycles = CycleParameters().scaled(scale)
    verdict = judge_edges(edges, *runs, cycles, within_run=len(request.sessions) == 1)
    numbers = JoiningParameters(view_m=cycles.view_m)
    joins, agree = _joins(items, edges, runs, verdict, stops, request, numbers)
    confirmed = verdict.supported | agree
    counts = {
        "consistent": int(confirmed.sum()), "inconsistent": int((~verdict.accepted).sum()),
        "unchecked": int((verdict.accepted & ~confirmed).sum()),
    }  # fmt: skip
    verdicts = [
        {"consistent": True if sure else None if ok else False, "loops": loops, "closed": closed}
        for sure, ok, loops, closed in zip(
            confirmed.tolist(), verdict.accepted.tolist(), verdict.loops.tolist(),
            verdict.closed.tolist(), strict=True,
        )
    ]  # fmt: skip
    return verdicts, counts, joins


def _run(numbers: list[int], stops: dict[int, PathFrame], parents: dict[str, int]) -> RobotPath:
    poses, owners = np.full((len(numbers), 4, 4), np.nan), np.full(len(numbers), -1, np.int64)
    for i, number in enumerate(numbers):
        stop = stops.get(number)
        if stop is not None and stop.pose is not None and stop.parent is not None:
            poses[i], owners[i] = stop.pose, parents[stop.parent]
    return robot_path(poses, owners)


def _joins(
    items: list[dict[str, Any]], edges: LoopEdges, runs: tuple[RobotPath, RobotPath],
    verdict: EdgeVerdicts, stops: dict[int, PathFrame], request: NewAssociation,
    numbers: JoiningParameters,
) -> tuple[list[dict[str, Any]], NDArray[np.bool_]]:  # fmt: skip
    """Return a join for each pair of parent frames with edges, and a mask of the agreeing edges."""
    between: dict[tuple[str, str], list[int]] = {}
    for i in np.flatnonzero(verdict.accepted).tolist():
        ends = [stops.get(items[i][side]) for side in ("from", "to")]
        a, b = (None if end is None or end.pose is None else end.parent for end in ends)
        # loop closures within one parent frame do not join frames
        if a is not None and b is not None and (len(request.sessions) == 2 or a != b):
            between.setdefault((a, b), []).append(i)
    joins, agree = [], np.zeros(len(items), np.bool_)
    for (a, b), chosen in sorted(between.items()):
        own: NDArray[np.intp] = np.array(chosen)
        source, target = edges.source[own], edges.target[own]
        poses: tuple[Floats, Floats] = (runs[0].poses[source], runs[1].poses[target])
        votes = association_votes(edges.transforms[own], *poses, source, target, edges.weights[own])
        join = join_sessions(votes, request.seed, numbers)
        agree[own] = join.agree & (join.T is not None)
        first, second = (stops[items[chosen[0]][side]] for side in ("from", "to"))
        joins.append(
            Join(
                from_session=first.session or "", to_session=second.session or "",
                from_robot=first.robot, to_robot=second.robot, from_parent=a, to_parent=b,
                transform=None if join.T is None else transform(join.T, b, a),
                strength=join.strength, support=join.support, votes=len(own), rival=join.rival,
                spread_m=None if join.T is None else join.spread_m,
                spread_deg=None if join.T is None else math.degrees(join.spread_rad),
                reason=join.reason,
            ).model_dump(mode="json")
        )  # fmt: skip
    return joins, agree
