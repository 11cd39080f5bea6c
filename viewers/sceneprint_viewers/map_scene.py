"""Entities of a map: points of posed frames, coloured by height, and the paths of runs.

Client, map  --map_runs-->  runs of posed frames  --map_entities-->  permanent entities
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sceneprint.errors import NotFound, NotIndexed
from sceneprint.geometry.rigid import transform_points
from sceneprint.types import Floats
from sceneprint_client import Client
from sceneprint_client.api import Frame, FrameState
from sceneprint_client.api.listing import Session
from sceneprint_client.api.results import MOST_DRAWN
from sceneprint_client.poses import rotation_of
from sceneprint_viewers.scene import (
    MAP_POINT_M,
    TRACK,
    EntityPath,
    LineSet,
    Moment,
    Placement,
    PointSet,
    SceneEntity,
    UpAxis,
    height_colours,
    point_size,
    sensor_outline,
    small_outline,
    up_of_sensors,
)

#: Default number of frames of a map whose points are drawn.
MAP_FRAMES = 120
#: Maximum number of drawn points of a map.
MAP_POINTS = 300_000
#: Maximum number of poses in the line of a run.
TRACK_POSES = 1000
#: Clocks for the order of a run: the capture time or, if it is unknown, the upload time.
CLOCKS: tuple[Literal["taken", "received"], ...] = ("taken", "received")
#: Maximum number of sessions, and of frames without a session, that are searched for posed frames.
MOST_LISTED = 1000


@dataclass(frozen=True, eq=False)
class PosedRun:
    """The frames of a run with poses in one parent frame.

    Parameters
    ----------
    name : display name
    frame_ids : ids in chronological order
    poses : (4, 4) T_parent_sensor of each frame
    cameras : whether the frames are depth images
    """

    name: str
    map_name: str
    parent_frame: str
    frame_ids: Sequence[str]
    poses: Sequence[Floats]
    cameras: bool


def map_runs(client: Client, map_name: str) -> list[PosedRun]:
    """Return the runs of a map with at most TRACK_POSES poses each.

    Raise UnknownMap if the map does not exist.
    """
    runs, unnamed = [], False
    for session in itertools.islice(client.sessions(map_name), MOST_LISTED):
        if session.session is None:
            unnamed = unnamed or session.with_pose > 0
        elif session.with_pose:
            runs += _runs_of_session(client, map_name, session)
    if unnamed:
        posed = client.frames(map_name, FrameState.INDEXED, has_pose=True)
        frames = itertools.islice(posed, MOST_LISTED)
        runs += listed_runs(frame for frame in frames if frame.session is None)
    return runs


def _runs_of_session(client: Client, map_name: str, session: Session) -> list[PosedRun]:
    """Return the run of a session in each parent frame."""
    runs = []
    for parent in session.parent_frames:
        for clock in CLOCKS:
            trajectory = client.trajectory(
                map_name, str(session.session), robot=session.robot, parent_frame=parent,
                most=TRACK_POSES, clock=clock,
            )  # fmt: skip
            if trajectory.frame_ids:
                break
        else:
            continue
        with suppress(NotFound):  # the frame was deleted
            kind = client.frame(map_name, trajectory.frame_ids[0]).kind
            name = _run_name(session.robot, session.session)
            poses, cameras = [_pose_of_row(row) for row in trajectory.poses], kind == "depth"
            runs.append(PosedRun(name, map_name, parent, trajectory.frame_ids, poses, cameras))
    return runs


def listed_runs(frames: Iterable[Frame]) -> list[PosedRun]:
    """Return the runs of the posed frames among `frames`, in the same order."""
    runs: defaultdict[tuple[str, str, str, bool], list[Frame]] = defaultdict(list)
    for frame in frames:
        if frame.pose is not None:
            name = _run_name(frame.robot, frame.session)
            runs[frame.map, frame.pose.parent_frame, name, frame.kind == "depth"].append(frame)
    return [
        PosedRun(
            name, map_name, parent, [frame.frame_id for frame in run],
            [np.array(frame.pose.matrix) for frame in run if frame.pose is not None], cameras,
        )
        for (map_name, parent, name, cameras), run in runs.items()
    ]  # fmt: skip


def _run_name(robot: str | None, session: str | None) -> str:
    return "/".join(part for part in (robot, session) if part is not None) or "no session"


def _pose_of_row(row: Sequence[float]) -> Floats:
    T = np.eye(4)
    T[:3, 3] = row[1:4]
    T[:3, :3] = rotation_of(np.array(row[4:8]))
    return T


def map_entities(
    client: Client, runs: Sequence[PosedRun], space: str, up: Floats | None, most: int
) -> list[SceneEntity]:
    """Return the permanent entities of runs in one space.

    Parameters
    ----------
    space : name of the space
    up : (3,) unit vector in the space; None estimates it from the sensors
    most : maximum number of frames whose points are fetched, evenly spaced along the runs
    """
    if up is None:
        up = up_of_runs(runs)
    entities = [SceneEntity((space,), UpAxis(up))]
    chosen = evenly_spaced(runs, most)
    if chosen:
        limit = points_of_each(len(chosen))
        clouds = [placed_points(client, *place, limit) for place in chosen]
        points = np.concatenate([*clouds, np.zeros((0, 3))])
        colours = height_colours(points, up)
        size_m = point_size(MAP_POINT_M, cameras=all(run.cameras for run in runs))
        entities.append(SceneEntity((space, "map", "points"), PointSet(points, colours, size_m)))
    for number, run in enumerate(runs, start=1):
        track = np.array([T[:3, 3] for T in run.poses])
        path = (space, "map", "tracks", f"{number} {run.name}")
        entities.append(SceneEntity(path, LineSet([track], [TRACK])))
    return entities


def points_of_each(frames: int) -> int:
    """Return the number of points per frame if `frames` frames are drawn."""
    return min(max(MAP_POINTS // frames, 1), MOST_DRAWN)


def up_of_runs(runs: Sequence[PosedRun]) -> Floats:
    """Return the axis (3,) that is probably up, estimated from the longest run."""
    longest = max(runs, key=lambda run: len(run.poses))
    return up_of_sensors(longest.poses, cameras=longest.cameras)


def up_of_map(client: Client, map_name: str) -> Floats | None:
    """Return the up vector (3,) of a map, or None if it is not set."""
    up = client.map(map_name).up
    return None if up is None else np.array([up.x, up.y, up.z])


def evenly_spaced(runs: Sequence[PosedRun], most: int) -> list[tuple[str, str, Floats]]:
    """Return map, frame id and pose of at most `most` frames, evenly spaced over all runs."""
    every = [
        (run.map_name, frame_id, T)
        for run in runs
        for frame_id, T in zip(run.frame_ids, run.poses, strict=True)
    ]
    count = min(most, len(every))
    places = np.unique(np.linspace(0, len(every) - 1, count).round().astype(int))
    return [every[i] for i in places]


def placed_points(client: Client, map_name: str, frame_id: str, T: Floats, limit: int) -> Floats:
    """Return at most `limit` points (N, 3) of a frame, transformed by T; none if the frame was
    deleted or is not indexed.
    """
    try:
        return transform_points(T, client.frame_points(map_name, frame_id, limit=limit).points)
    except (NotFound, NotIndexed):
        return np.zeros((0, 3))


def frames_scene(client: Client, frames: Sequence[Frame], most: int) -> Moment:
    """Return permanent entities of a map's frames: points by height, runs, and sensors.

    Parameters
    ----------
    frames : frames of one map, at least one; frames without a pose are omitted
    most : maximum number of frames that are drawn, evenly spaced
    """
    runs = listed_runs(frames)
    parents = sorted({run.parent_frame for run in runs})
    up = up_of_map(client, frames[0].map)
    entities: list[SceneEntity] = []
    for parent in parents:
        of_parent = [run for run in runs if run.parent_frame == parent]
        entities += map_entities(client, of_parent, parent, up, most // len(parents))
    chosen = {frame_id for _, frame_id, _ in evenly_spaced(runs, most)}
    for frame in frames:
        if frame.pose is not None and frame.frame_id in chosen:
            path = (frame.pose.parent_frame, "frames", frame.frame_id)
            placement = Placement(np.array(frame.pose.matrix), frame.pose.child_frame)
            entities.append(SceneEntity(path, placement))
            outline = small_outline(frame.intrinsics, TRACK)
            entities.append(SceneEntity((*path, "sensor"), outline))
    return Moment(entities)


def frame_scene(client: Client, frame: Frame) -> Moment:
    """Return permanent entities of a frame, in the parent frame of its pose or in sensor axes.

    Raise NotIndexed if the frame is not indexed.
    """
    optical = frame.kind == "depth"
    points = client.frame_points(frame.map, frame.frame_id).points
    path: EntityPath = (f"{frame.frame_id}.{'optical' if optical else 'sensor'}",)
    own_up = np.array([0.0, -1.0, 0.0] if optical else [0.0, 0.0, 1.0])
    entities, up = [], own_up
    if frame.pose is not None:
        T = np.array(frame.pose.matrix)
        path, up = (frame.pose.parent_frame, frame.frame_id), up_of_sensors([T], cameras=optical)
        entities.append(SceneEntity(path, Placement(T, frame.pose.child_frame)))
    colours, size_m = height_colours(points, own_up), point_size(MAP_POINT_M, cameras=optical)
    return Moment(
        [
            SceneEntity(path[:1], UpAxis(up)),
            *entities,
            SceneEntity((*path, "points"), PointSet(points, colours, size_m)),
            SceneEntity((*path, "sensor"), sensor_outline(frame.intrinsics, TRACK)),
        ]
    )
