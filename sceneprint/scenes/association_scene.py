"""An association as a scene: both sessions where it places them, and the edges between them.

Association  --association_scene-->  Moment
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from sceneprint.scenes.answer_scene import SUMMARY
from sceneprint.scenes.appearance import (
    CONFIRMED,
    MAP_POINT_M,
    OUTVOTED,
    SESSIONS,
    THIN_PX,
    TRACK,
    height_colours,
    plain_colours,
    point_size,
)
from sceneprint.scenes.map_scene import (
    PosedRun,
    evenly_taken,
    placed_points,
    points_of_each,
    up_of_runs,
)
from sceneprint.scenes.scene import (
    Colour,
    LineSet,
    Moment,
    PointSet,
    SceneEntity,
    TextPage,
    UpAxis,
)
from sceneprint.types import Floats
from sceneprint_client import Client
from sceneprint_client.api.sessions import Association, Edge, Graph, Vertex

#: Edges that are drawn.
MOST_EDGES = 20_000


def association_scene(client: Client, told: Association, text: str, most: int) -> Moment:
    """What an association that has succeeded came to, at all times.

    Frames lie where the pose graph has them: in one space where the sessions are joined, else each
    session in its own, and then edges between the two cannot be drawn.

    Parameters
    ----------
    client : to fetch with
    told : the association
    text : about it, for people
    most : frames whose points are drawn
    """
    graph = Graph.model_validate_json(client.graph(told.map, told.association_id, "json"))
    runs = _runs(client, told, graph.vertices)
    spaces = sorted({run.parent_frame for run in runs})
    given = client.map(told.map).up
    entities = [SceneEntity(SUMMARY, TextPage(text))]
    for space in spaces:
        there = [run for run in runs if run.parent_frame == space]
        up = up_of_runs(there) if given is None else np.array([given.x, given.y, given.z])
        entities.append(SceneEntity((space,), UpAxis(up)))
        alone = len(told.asked.sessions) == 1
        for run in there:
            colour = TRACK if alone else SESSIONS[_names(told).index(run.name)]
            entities += _run_entities(client, run, up, colour, most // len(runs), alone=alone)
    edges = itertools.islice(client.edges(told.map, told.association_id), MOST_EDGES)
    entities += _edge_entities(edges, graph.vertices)
    return Moment(entities)


def _runs(client: Client, told: Association, vertices: list[Vertex]) -> list[PosedRun]:
    """The posed vertices by session and the frame that they lie in; named after the session's
    place among those that were asked.
    """
    found: defaultdict[tuple[str, str], list[Vertex]] = defaultdict(list)
    for one in vertices:
        if one.pose is not None:
            found[_session_of(told, one), one.pose.parent_frame].append(one)
    return [
        PosedRun(
            name, told.map, space, [one.frame_id for one in run],
            [np.array(one.pose.matrix) for one in run if one.pose is not None],
            client.frame(told.map, run[0].frame_id).kind == "depth",
        )
        for (name, space), run in found.items()
    ]  # fmt: skip


def _names(told: Association) -> list[str]:
    """What the sessions are called, the first that was asked first."""
    robots: Sequence[str | None] = told.asked.robots or [None] * len(told.asked.sessions)
    pairs = zip(robots, told.asked.sessions, strict=True)
    return [session if robot is None else f"{robot}/{session}" for robot, session in pairs]


def _session_of(told: Association, vertex: Vertex) -> str:
    """What the session of a vertex is called."""
    names, known = _names(told), (vertex.session, f"{vertex.robot}/{vertex.session}")
    return next((name for name in names if name in known), names[0])


def _run_entities(
    client: Client, run: PosedRun, up: Floats, colour: Colour, most: int, *, alone: bool
) -> list[SceneEntity]:
    """Points and line of a session: by height where there is no other to tell it from."""
    chosen = evenly_taken([run], most)
    path = (run.parent_frame, "sessions", run.name)
    entities = []
    if chosen:
        limit = points_of_each(2 * len(chosen))
        points = np.concatenate([placed_points(client, *one, limit) for one in chosen])
        size_m = point_size(MAP_POINT_M, cameras=run.cameras)
        colours = height_colours(points, up) if alone else plain_colours(len(points), colour)
        entities.append(SceneEntity((*path, "points"), PointSet(points, colours, size_m)))
    track = np.array([T[:3, 3] for T in run.poses])
    return [*entities, SceneEntity((*path, "track"), LineSet([track], [colour]))]


def _edge_entities(edges: itertools.islice[Edge], vertices: list[Vertex]) -> list[SceneEntity]:
    """Lines between frames that edges join: confirmed, outvoted and unchecked ones apart."""
    poses = {one.frame_id: one.pose for one in vertices if one.pose is not None}
    kinds = {
        True: ("confirmed", CONFIRMED),
        False: ("outvoted", OUTVOTED),
        None: ("unchecked", TRACK),
    }
    strips: defaultdict[tuple[str, str, Colour], list[Floats]] = defaultdict(list)
    for edge in edges:
        a, b = poses.get(edge.from_frame), poses.get(edge.to_frame)
        if a is not None and b is not None and a.parent_frame == b.parent_frame:
            ends = np.array([np.array(one.matrix)[:3, 3] for one in (a, b)])
            strips[a.parent_frame, *kinds[edge.consistent]].append(ends)
    return [
        SceneEntity((space, "edges", kind), LineSet(lines, [colour] * len(lines), THIN_PX))
        for (space, kind, colour), lines in strips.items()
    ]
