"""Pose graphs of associations, as files for graph optimisers.

frames, edges, joins  --pose_graph-->  PoseGraph  --graph_text-->  g2o, TUM, JSON
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

#: Standard deviations of an edge without a covariance, metres and radians.
_DEVIATIONS = (0.05, math.radians(1.5))
#: Standard deviations of odometry: a constant (metres, radians) plus a share of distance and angle.
_STEP, _SHARE = (0.005, math.radians(0.2)), 0.02

MEDIA_TYPES = {"g2o": "text/x-g2o", "tum": "text/plain", "json": "application/json"}


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """A pose graph of frames.

    Parameters
    ----------
    stops : vertices: the frames of each run in chronological order
    poses : pose (4, 4) of each vertex; None if unknown
    frames : parent frame of each pose
    edges : edges between indexes of `stops`
    kinds : kind of each edge: association or odometry
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
    """Return the pose graph of an association.

    Parameters
    ----------
    runs : frames of each session, in chronological order
    items : items of the edges; their frames must be in `runs`
    joins : joins in the result of the association
    odometry : whether to add edges between consecutive frames with poses
    """
    stops = [stop for run in runs for stop in run]
    place = {stop.number: i for i, stop in enumerate(stops)}
    edges, kinds = [], []
    for item in items:
        # the matched frame is the first vertex, since T is T_to_from
        T, c = np.array(item["T"], float).reshape(4, 4), item["covariance"]
        covariance = _diagonal(*_DEVIATIONS) if c is None else np.array(c).reshape(6, 6)
        ends = place[item["to"]], place[item["from"]]
        edges.append(PoseEdge(*ends, T, information_of(covariance, T)))
    kinds = ["association"] * len(edges)
    if odometry:
        steps = [step for run in runs for step in _steps(run, place)]
        edges += steps
        kinds += ["odometry"] * len(steps)
    poses, frames = _place_vertices(stops, edges, joins)
    return PoseGraph(stops, poses, frames, edges, kinds)


def _steps(run: Sequence[PathFrame], place: Mapping[int, int]) -> list[PoseEdge]:
    edges = []
    for a, b in pairwise(run):
        if a.pose is None or b.pose is None or a.parent != b.parent:
            continue
        T = inverse(np.array(a.pose)) @ np.array(b.pose)
        metres = _STEP[0] + _SHARE * float(np.linalg.norm(T[:3, 3]))
        radians = _STEP[1] + _SHARE * rotation_angle(T[:3, :3])
        information = information_of(_diagonal(metres, radians), T)
        edges.append(PoseEdge(place[a.number], place[b.number], T, information))
    return edges


def _diagonal(metres: float, radians: float) -> Floats:
    return np.diag(np.repeat((metres**2, radians**2), 3))


def _place_vertices(
    stops: Sequence[PathFrame], edges: Sequence[PoseEdge], joins: Sequence[Mapping[str, Any]]
) -> tuple[list[Floats | None], list[str | None]]:
    """Return the pose and the parent frame of each vertex; None if unknown.

    Poses are converted to the most common parent frame among those that joins connect to theirs.
    Edges give poses to vertices without one.
    """
    counted = Counter(stop.parent for stop in stops if stop.pose is not None)
    parents = sorted((name for name in counted if name), key=lambda name: (-counted[name], name))
    into: dict[str, tuple[str, Floats]] = {}  # root and T_root_parent by parent
    for root in parents:
        if root in into:
            continue
        into[root] = (root, np.eye(4))
        waiting = deque([root])
        while waiting:
            here = waiting.popleft()
            for neighbour, T in _neighbours(here, joins):
                if neighbour not in into:
                    into[neighbour] = (root, into[here][1] @ T)
                    waiting.append(neighbour)
    poses: list[Floats | None] = [None] * len(stops)
    frames: list[str | None] = [None] * len(stops)
    for i, stop in enumerate(stops):
        if stop.pose is not None and stop.parent is not None:
            frames[i], T = into[stop.parent]
            poses[i] = T @ np.array(stop.pose)
    _spread(poses, frames, edges)
    return poses, frames


def _neighbours(parent: str, joins: Sequence[Mapping[str, Any]]) -> list[tuple[str, Floats]]:
    """Return the name and T_parent_neighbour (4, 4) of each parent frame that a join connects."""
    neighbours = []
    for join in joins:
        is_loop = join["from_parent"] == join["to_parent"]
        if join["transform"] is None or is_loop or join.get("undone"):
            continue
        T = np.array(join["transform"]["matrix"])
        if join["to_parent"] == parent:
            neighbours.append((join["from_parent"], T))
        if join["from_parent"] == parent:
            neighbours.append((join["to_parent"], inverse(T)))
    return neighbours


def _spread(
    poses: list[Floats | None], frames: list[str | None], edges: Sequence[PoseEdge]
) -> None:
    """Set unknown poses and parent frames by breadth-first search along the edges, in place."""
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
    """Return a graph as a text file.

    A TUM trajectory contains the vertices with time stamps and poses in the most common parent
    frame. In g2o, vertices without a pose are at the origin.
    """
    if kind == "json":
        return _json(graph).model_dump_json()
    if kind == "tum":
        return _tum(graph)
    return g2o([np.eye(4) if pose is None else pose for pose in graph.poses], graph.edges)


def _main(graph: PoseGraph) -> str | None:
    """Return the most common parent frame of the poses."""
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
        f"poses of sensor frames in {main or 'no frame'}, metres",
        f"{len(rows)} poses; {len(graph.stops) - len(rows)} frames without a stamp or a pose in "
        "this frame left out",
        f"t: {stamped}" if rows else "empty: no frame with a stamp has a pose",
        "t tx ty tz qx qy qz qw",
    ]
    return trajectory_text(sorted(rows), comments)


def _stamps(graph: PoseGraph) -> tuple[Sequence[float | None], str]:
    """Return a time stamp for each vertex, and the meaning of the stamps.

    Stamps are capture times if any vertex has one, else sequence numbers if they are distinct, else
    vertex numbers.
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
