"""Up vectors in sensor frames and in parent frames, and axes of plans.

frame numbers  --known_ups-->  unit vectors in the sensor frames
map, frames of one parent frame  --parent_axes-->  PlanAxes
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from sqlalchemy import Connection

from sceneprint.geometry.rigid import mean_direction
from sceneprint.store.frame_queries import FrameUp, frame_ups, path_frames
from sceneprint.store.tables import MapRow
from sceneprint.types import Floats
from sceneprint_client.api.coverage import UpSource

#: Maximum angle between agreeing up vectors, radians.
AGREE = math.radians(10.0)
#: Minimum number of frames to estimate the up vector of a parent frame.
_FEWEST = 3


def known_ups(connection: Connection, numbers: Iterable[int]) -> dict[int, Floats]:
    """Return the known up vectors in the sensor frames.

    A frame with a pose but without an up vector inherits the up vector of its parent frame: the
    setting of the map, or the consensus of the frames in the parent frame.

    Parameters
    ----------
    numbers : frame numbers; more frames improve the consensus

    Returns
    -------
    ups : (3,) unit vectors by frame number, without frames whose up vector contradicts an uncertain
        up vector of the parent frame
    """
    groups: dict[tuple[int, str | None], list[FrameUp]] = {}
    for frame in frame_ups(connection, numbers):
        groups.setdefault((frame.map_number, frame.parent), []).append(frame)
    return {number: up for group in groups.values() for number, up in _of_parent(group).items()}


def parent_up(connection: Connection, numbers: Iterable[int]) -> Floats | None:
    """Return the up vector of a parent frame: the setting of the map, or the consensus of frames.

    Parameters
    ----------
    numbers : frame numbers of frames with poses in this parent frame

    Returns
    -------
    up : (3,) unit vector; None if the map has no setting and too few frames agree
    """
    group = frame_ups(connection, numbers)
    return _shared_up(group)[0] if group else None


def _of_parent(group: Sequence[FrameUp]) -> dict[int, Floats]:
    shared, sure = _shared_up(group)
    ups = {}
    for frame in group:
        own = None if frame.up is None else np.array(frame.up)
        implied = None
        if shared is not None and frame.pose is not None:
            implied = np.array(frame.pose)[:3, :3].T @ shared
        if own is None or implied is None:
            up = implied if own is None else own
        else:
            up = own if own @ implied >= math.cos(AGREE) else implied if sure else None
        if up is not None:
            ups[frame.number] = up
    return ups


def _shared_up(group: Sequence[FrameUp]) -> tuple[Floats | None, bool]:
    """Return the up vector of a parent frame, and whether it overrides those of single frames."""
    if group[0].map_up is not None:
        return np.array(group[0].map_up), True
    ups = [
        np.array(frame.pose)[:3, :3] @ np.array(frame.up)
        for frame in group
        if frame.pose is not None and frame.up is not None
    ]
    if len(ups) < _FEWEST:
        return None, False
    return mean_direction(np.stack(ups), AGREE), True


#: Approximate number of frames to estimate an up vector.
_UP_FRAMES = 200


@dataclass(frozen=True, eq=False)
class PlanAxes:
    """Axes of the plan of a parent frame.

    Parameters
    ----------
    axes : (2, 3) unit vectors that point right and up in the plan, in the parent frame
    up_from : source of the up vector
    """

    axes: Floats
    up_from: UpSource


def plan_axes(up: Floats) -> Floats:
    """Return the axes (2, 3) of a plan; right is along x, or y if x is nearly vertical."""
    along = np.eye(3)[int(abs(up[0]) > 0.9)]
    right = along - (along @ up) * up
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right)])


def upright(poses: Floats, clouds: Sequence[bool]) -> Floats:
    """Return the signed coordinate axis (3,) of a parent frame nearest to the up axes of sensors.

    Sensors are assumed to be upright: up is -y of a camera, and z of a scanner.

    Parameters
    ----------
    poses : (n, 4, 4) T_parent_sensor
    clouds : (n,) mask of point clouds
    """
    own = np.where(np.array(clouds)[:, None], poses[:, :3, 2], -poses[:, :3, 1])
    mean = own.mean(axis=0)
    axis = int(np.argmax(np.abs(mean)))
    up: Floats = np.eye(3)[axis] * (1.0 if mean[axis] >= 0 else -1.0)
    return up


def parent_axes(connection: Connection, row: MapRow, numbers: Sequence[int]) -> PlanAxes:
    """Return the axes of a plan in the parent frame of the frames `numbers`."""
    numbers = numbers[:: max(len(numbers) // _UP_FRAMES, 1)]
    if (up := parent_up(connection, numbers)) is not None:
        return PlanAxes(plan_axes(up), "frames" if row.up is None else "map")
    stops = [stop for stop in path_frames(connection, numbers).values() if stop.pose is not None]
    if not stops:  # all frames were deleted
        return PlanAxes(np.eye(3)[:2], "cameras")
    poses = np.array([stop.pose for stop in stops])
    return PlanAxes(plan_axes(upright(poses, [stop.is_cloud for stop in stops])), "cameras")
