"""The pose graph of an association, as a file for an optimiser.

frames, edges that were kept, joins  --pose_graph-->  PoseGraph  --graph_text-->  g2o, TUM, JSON
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from sceneprint.engine.serializers import sensor_frame, transform, when
from sceneprint.formats.dataset import trajectory_row, trajectory_text
from sceneprint.formats.export import PoseEdge, g2o, information_of
from sceneprint.geometry.rigid import inverse, rotation_angle
from sceneprint.store.frame_queries import PathFrame
from sceneprint.types import Floats
from sceneprint_client.api.sessions import Graph, GraphEdge, GraphFormat, Vertex

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
        GraphEdge.model_validate(
            {
                "kind": kind, "first": edge.first, "second": edge.second,
                "matrix": edge.T.tolist(), "information": edge.information.ravel().tolist(),
            }
        )
        for edge, kind in zip(graph.edges, graph.kinds, strict=True)
    ]  # fmt: skip
    return Graph(frame=_main(graph), vertices=vertices, edges=edges)
