"""Answers as moments of a scene: the query, its matches and its alternatives in the map.

Answer  --AnswerScene.add-->  Moment
Association  --association_scene-->  Moment with both sessions and their edges

The map contains only poses with evidence: accepted and ambiguous matches with the poses for which
they vote, and the pose of the answer or its alternatives. Rejected matches appear only in the text.
A query that is not found has a separate space.
"""

from __future__ import annotations

import itertools
import re
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from sceneprint.errors import NotFound, NotIndexed
from sceneprint.types import Floats
from sceneprint_client import Client
from sceneprint_client.api import Answer, Frame, Match, Transform
from sceneprint_client.api.base import CameraIntrinsics
from sceneprint_client.api.sessions import Association, Edge, Graph, Vertex
from sceneprint_viewers.map_scene import (
    MAP_FRAMES,
    PosedRun,
    evenly_spaced,
    map_entities,
    map_runs,
    placed_points,
    points_of_each,
    up_of_map,
    up_of_runs,
)
from sceneprint_viewers.scene import (
    CONFIRMED,
    MAP_POINT_M,
    MATCH_POINT_M,
    OUTVOTED,
    QUERY,
    QUERY_POINT_M,
    SESSIONS,
    STRONG,
    THIN_PX,
    TRACK,
    UNSURE,
    WEAK,
    Colour,
    EntityPath,
    LineSet,
    Moment,
    Placement,
    PointSet,
    SceneEntity,
    SceneStream,
    TextLabel,
    TextPage,
    UpAxis,
    height_colours,
    plain_colours,
    point_size,
    sensor_outline,
)

#: Pattern of ids that the service generates, and number of digits that labels show.
_GENERATED_ID = re.compile(r"[0-9a-f]{32}", re.ASCII)
SHORT_ID = 8
#: Path of the text about an answer, which is not a space.
SUMMARY: EntityPath = ("answer",)
#: Height of a label above its sensor, metres.
_LABEL_M = 0.12


@dataclass(frozen=True)
class PointLimits:
    """Maximum numbers of drawn points.

    Parameters
    ----------
    query : number of points of the query
    match : number of points of each match, and of the query at each alternative
    """

    query: int
    match: int


#: Limits for a single answer, and for each of many answers.
ONE, MANY = PointLimits(20_000, 6_000), PointLimits(5_000, 1_500)


class AnswerScene:
    """Writer of answers to a scene; it draws a map together with the first answer from the map.

    Parameters
    ----------
    stream : output of the scene
    limits : maximum numbers of points
    map_frames : number of frames of each map whose points are drawn; 0 draws no map
    """

    def __init__(
        self, stream: SceneStream, client: Client, limits: PointLimits = ONE,
        map_frames: int = MAP_FRAMES,
    ) -> None:  # fmt: skip
        self._stream, self._client = stream, client
        self._limits, self._map_frames = limits, map_frames
        self._drawn: set[str] = set()
        self._axes: set[str] = set()

    def add(
        self, answer: Answer, name: str, text: str, camera: CameraIntrinsics | None,
        index: int = 0, stamp_ns: int | None = None,
    ) -> None:  # fmt: skip
        """Add an answer as the next moment; first draw its maps that are not drawn yet.

        Parameters
        ----------
        answer : stored answer with the stage `validate`
        text : description of the answer
        camera : camera of the query; None for a cloud

        Raises
        ------
        UnknownQuery : If the service does not store the answer.
        """
        named = dict.fromkeys(match.map for match in placed(answer.matches))
        for map_name in answer.maps if len(answer.maps) == 1 else named:
            if map_name not in self._drawn:
                self._draw_map(map_name, several=len(answer.maps) > 1)
        drawing = _Drawing(self._client, answer, name, camera, self._limits)
        entities = [*drawing.entities(), SceneEntity(SUMMARY, TextPage(text))]
        axes = [axis for axis in drawing.axes() if axis.path[0] not in self._axes]
        if axes:
            self._axes |= {axis.path[0] for axis in axes}
            self._stream.write(Moment(axes))
        self._stream.write(Moment(entities, index, stamp_ns))

    def _draw_map(self, map_name: str, *, several: bool) -> None:
        """Draw the runs of a map as permanent entities, in a space for each parent frame."""
        self._drawn.add(map_name)
        runs = map_runs(self._client, map_name)
        parents = sorted({run.parent_frame for run in runs})
        up = up_of_map(self._client, map_name)
        for parent in parents:
            of_parent = [run for run in runs if run.parent_frame == parent]
            space = space_name(map_name, parent, several=several)
            most = self._map_frames // len(parents)
            self._axes.add(space)
            self._stream.write(Moment(map_entities(self._client, of_parent, space, up, most)))


def space_name(map_name: str, parent_frame: str, *, several: bool) -> str:
    """Return the name of the space of a parent frame; it contains the map if there are several."""
    return f"{map_name}: {parent_frame}" if several else parent_frame


def short_name(frame_id: str, name: str | None = None) -> str:
    """Return the name of a stored frame for labels: its file name, else its shortened id."""
    if name:
        return name.rpartition("/")[2]
    return frame_id[:SHORT_ID] if _GENERATED_ID.fullmatch(frame_id) else frame_id


def placed(matches: Sequence[Match]) -> list[Match]:
    """Return the matches whose transforms are accepted or ambiguous."""
    return [match for match in matches if match.validation.status in ("accepted", "ambiguous")]


class _Drawing:
    """A drawing of one answer."""

    def __init__(
        self, client: Client, answer: Answer, name: str, camera: CameraIntrinsics | None,
        limits: PointLimits,
    ) -> None:  # fmt: skip
        self._client, self._answer, self._name = client, answer, name
        self._camera, self._limits = camera, limits
        self._several = len(answer.maps) > 1
        self._points = np.zeros((0, 3))
        with suppress(NotIndexed):  # a query without validation has no geometry
            self._points = client.query_points(answer.query_id, limits.query).points

    def entities(self) -> list[SceneEntity]:
        """Return the entities of the query, its alternatives and its matches."""
        entities = [*self._query(), *self._alternatives()]
        for number, match in enumerate(placed(self._answer.matches), start=1):
            entities += self._match(match, f"{number}")
        return entities

    def axes(self) -> list[SceneEntity]:
        """Return the up axis of the query's space if the query has no pose in a map."""
        if self._answer.location is not None:
            return []
        space, _ = self._query_space()
        up = np.array([0.0, -1.0, 0.0] if self._answer.kind == "depth" else [0.0, 0.0, 1.0])
        return [SceneEntity((space,), UpAxis(up))]

    def _space(self, map_name: str | None, parent_frame: str) -> str:
        return space_name(map_name or "", parent_frame, several=self._several)

    def _query_space(self) -> tuple[str, Transform | None]:
        """Return the space of the query, and its pose there; None if it has a separate space."""
        location = self._answer.location
        if location is not None:
            return self._space(location.map, location.pose.parent_frame), location.pose
        if self._answer.status == "found":  # without poses, use the frame of the best match
            for match in placed(self._answer.matches):
                if match.transform is not None:
                    return match.transform.parent_frame, match.transform
        return f"query.{'optical' if self._answer.kind == 'depth' else 'sensor'}", None

    def _query(self) -> list[SceneEntity]:
        space, pose = self._query_space()
        path, label = (space, "query"), f"{self._name}: {self._answer.status.replace('_', ' ')}"
        entities = _sensor(path, self._points, self._camera, QUERY, label)
        if pose is None:
            return entities
        return [SceneEntity(path, Placement(np.array(pose.matrix), pose.child_frame)), *entities]

    def _alternatives(self) -> list[SceneEntity]:
        entities: list[SceneEntity] = []
        some = self._points[:: max(len(self._points) // self._limits.match, 1)]
        for number, place in enumerate(self._answer.alternatives, start=1):
            path = (self._space(place.map, place.pose.parent_frame), "alternatives", f"{number}")
            child = f"{place.pose.child_frame} alternative {number}"
            confidence = "" if place.confidence is None else f", confidence {place.confidence:.2f}"
            label = f"alternative {number}: support {place.support}{confidence}"
            entities.append(SceneEntity(path, Placement(np.array(place.pose.matrix), child)))
            entities += _sensor(path, some, self._camera, UNSURE, label)
        return entities

    def _match(self, match: Match, name: str) -> list[SceneEntity]:
        """Return a match at its pose in the map, with a line to the pose for which it votes.

        Its path contains its number instead of its id, so that many answers share few paths.
        """
        try:
            frame = self._client.frame(match.map, match.frame_id)
            points = self._client.frame_points(
                match.map, match.frame_id, limit=self._limits.match
            ).points
        except (NotFound, NotIndexed):  # the frame was deleted, or is being signed again
            return []
        path, placement = self._place_of_match(match, frame, name)
        if path is None:
            return []
        colour, label = _look_of_match(match)
        entities = [] if placement is None else [SceneEntity(path, placement)]
        entities += _sensor(path, points, frame.intrinsics, colour, label)
        if match.transform is not None:
            vote = np.array([np.zeros(3), np.array(match.transform.matrix)[:3, 3]])
            entities.append(SceneEntity((*path, "vote"), LineSet([vote], [colour])))
        return entities

    def _place_of_match(
        self, match: Match, frame: Frame, name: str
    ) -> tuple[EntityPath | None, Placement | None]:
        """Return path and placement of a match (None in the query's space), or None, None."""
        if frame.pose is not None:
            space = self._space(match.map, frame.pose.parent_frame)
            child = space_name(match.map, frame.pose.child_frame, several=self._several)
            placement = Placement(np.array(frame.pose.matrix), child)
            return (space, "matches", name), placement
        space, _ = self._query_space()
        if match.transform is not None and match.transform.parent_frame == space:
            return (space, "matches", name), None
        return None, None


def _look_of_match(match: Match) -> tuple[Colour, str]:
    """Return the colour of a match and its label: rank, name, strength or status, overlap."""
    v = match.validation
    colour = STRONG if v.strength == "strong" else WEAK
    if v.status == "ambiguous":
        colour = UNSURE
    overlap = "" if v.overlap is None else f" {v.overlap:.2f}"
    return (
        colour,
        f"#{match.rank} {short_name(match.frame_id, match.name)} {v.strength or v.status}{overlap}",
    )


def _sensor(
    path: EntityPath, points: Floats, camera: CameraIntrinsics | None, colour: Colour, label: str
) -> list[SceneEntity]:
    """Return points, outline and label of a sensor, in its coordinate frame."""
    colours = plain_colours(len(points), colour)
    base_m = QUERY_POINT_M if colour == QUERY else MATCH_POINT_M
    size_m = point_size(base_m, cameras=camera is not None)
    above = np.array([0.0, -_LABEL_M, 0.0] if camera is not None else [0.0, 0.0, _LABEL_M])
    return [
        SceneEntity((*path, "points"), PointSet(points, colours, size_m)),
        SceneEntity((*path, "sensor"), sensor_outline(camera, colour)),
        SceneEntity((*path, "label"), TextLabel(above, label, colour)),
    ]


# An association as a scene.

#: Maximum number of edges that are drawn.
MOST_EDGES = 20_000


def association_scene(client: Client, association: Association, text: str, most: int) -> Moment:
    """Return permanent entities for the result of a successful association.

    Frames have the poses of the pose graph. Joined sessions share one space. Otherwise each session
    has a separate space, and edges between sessions are not drawn.

    Parameters
    ----------
    text : description of the association
    most : maximum number of frames whose points are drawn
    """
    graph = Graph.model_validate_json(client.graph(association.map, association.job_id, "json"))
    runs = _runs(client, association, graph.vertices)
    spaces = sorted({run.parent_frame for run in runs})
    up_of_poses = up_of_map(client, association.map)
    entities = [SceneEntity(SUMMARY, TextPage(text))]
    for space in spaces:
        there = [run for run in runs if run.parent_frame == space]
        up = up_of_runs(there) if up_of_poses is None else up_of_poses
        entities.append(SceneEntity((space,), UpAxis(up)))
        alone = len(association.request.sessions) == 1
        for run in there:
            colour = TRACK if alone else SESSIONS[_names(association).index(run.name)]
            entities += _run_entities(client, run, up, colour, most // len(runs), alone=alone)
    edges = itertools.islice(client.edges(association.map, association.job_id), MOST_EDGES)
    entities += _edge_entities(edges, graph.vertices)
    return Moment(entities)


def _runs(client: Client, association: Association, vertices: list[Vertex]) -> list[PosedRun]:
    """Return the posed vertices by session and parent frame."""
    runs: defaultdict[tuple[str, str], list[Vertex]] = defaultdict(list)
    for vertex in vertices:
        if vertex.pose is not None:
            runs[_session_of(association, vertex), vertex.pose.parent_frame].append(vertex)
    return [
        PosedRun(
            name, association.map, space, [vertex.frame_id for vertex in run],
            [np.array(vertex.pose.matrix) for vertex in run if vertex.pose is not None],
            client.frame(association.map, run[0].frame_id).kind == "depth",
        )
        for (name, space), run in runs.items()
    ]  # fmt: skip


def _names(association: Association) -> list[str]:
    """Return the names of the sessions, in the order of the request."""
    robots: Sequence[str | None] = association.request.robots or [None] * len(
        association.request.sessions
    )
    pairs = zip(robots, association.request.sessions, strict=True)
    return [session if robot is None else f"{robot}/{session}" for robot, session in pairs]


def _session_of(association: Association, vertex: Vertex) -> str:
    """Return the name of a vertex's session, with its robot if the request names robots."""
    names, possible = _names(association), (vertex.session, f"{vertex.robot}/{vertex.session}")
    return next((name for name in names if name in possible), names[0])


def _run_entities(
    client: Client, run: PosedRun, up: Floats, colour: Colour, most: int, *, alone: bool
) -> list[SceneEntity]:
    """Return points and track of a session; a single session (`alone`) is coloured by height."""
    chosen = evenly_spaced([run], most)
    path = (run.parent_frame, "sessions", run.name)
    entities = []
    if chosen:
        limit = points_of_each(2 * len(chosen))
        points = np.concatenate([placed_points(client, *place, limit) for place in chosen])
        size_m = point_size(MAP_POINT_M, cameras=run.cameras)
        colours = height_colours(points, up) if alone else plain_colours(len(points), colour)
        entities.append(SceneEntity((*path, "points"), PointSet(points, colours, size_m)))
    track = np.array([T[:3, 3] for T in run.poses])
    return [*entities, SceneEntity((*path, "track"), LineSet([track], [colour]))]


def _edge_entities(edges: itertools.islice[Edge], vertices: list[Vertex]) -> list[SceneEntity]:
    """Return separate entities for confirmed, outvoted and unchecked edges, as lines."""
    poses = {vertex.frame_id: vertex.pose for vertex in vertices if vertex.pose is not None}
    kinds = {
        True: ("confirmed", CONFIRMED),
        False: ("outvoted", OUTVOTED),
        None: ("unchecked", TRACK),
    }
    strips: defaultdict[tuple[str, str, Colour], list[Floats]] = defaultdict(list)
    for edge in edges:
        a, b = poses.get(edge.from_frame), poses.get(edge.to_frame)
        if a is not None and b is not None and a.parent_frame == b.parent_frame:
            ends = np.array([np.array(pose.matrix)[:3, 3] for pose in (a, b)])
            strips[a.parent_frame, *kinds[edge.consistent]].append(ends)
    return [
        SceneEntity((space, "edges", kind), LineSet(lines, [colour] * len(lines), THIN_PX))
        for (space, kind, colour), lines in strips.items()
    ]
