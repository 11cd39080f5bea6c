"""Which way is up: in the frames of a search, and in a parent frame that is seen from above.

frame numbers  --known_ups-->  unit vectors in the frames' sensors
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

#: Ups that differ by more are not those of one gravity, even with noise.
AGREE = math.radians(10.0)
#: Frames with pose and up that a map's up is learnt from, at least: one alone may be wrong.
_FEWEST = 3


def known_ups(connection: Connection, numbers: Iterable[int]) -> dict[int, Floats]:
    """Up in the sensors of frames, as far as it is known.

    A frame has its own, as it was sent; else that of its map's parent frames, where its pose is
    known: the one that the map was given, or the one that most of these frames agree on.

    Parameters
    ----------
    numbers : of frames; the more there are, the better a map's up is learnt

    Returns
    -------
    ups : (3,) unit vectors by number; without frames that contradict themselves, and whose map
        does not decide it
    """
    found: dict[tuple[int, str | None], list[FrameUp]] = {}
    for one in frame_ups(connection, numbers):
        found.setdefault((one.map_number, one.parent), []).append(one)
    return {number: up for group in found.values() for number, up in _of_parent(group).items()}


def parent_up(connection: Connection, numbers: Iterable[int]) -> Floats | None:
    """Up in the parent frame of frames that share one: as the map was given it, or learnt.

    Parameters
    ----------
    numbers : of frames whose poses lead to one parent frame

    Returns
    -------
    up : (3,) unit vector; None where the map has none, and too few frames say or agree
    """
    group = frame_ups(connection, numbers)
    return _shared_up(group)[0] if group else None


def _of_parent(group: Sequence[FrameUp]) -> dict[int, Floats]:
    """Ups of frames of one parent frame."""
    shared, sure = _shared_up(group)
    ups = {}
    for one in group:
        own = None if one.up is None else np.array(one.up)
        implied = None
        if shared is not None and one.pose is not None:
            implied = np.array(one.pose)[:3, :3].T @ shared
        if own is None or implied is None:
            known = implied if own is None else own
        else:
            known = own if own @ implied >= math.cos(AGREE) else implied if sure else None
        if known is not None:
            ups[one.number] = known
    return ups


def _shared_up(group: Sequence[FrameUp]) -> tuple[Floats | None, bool]:
    """Up in the parent frame, and whether it outweighs that of a single frame."""
    if group[0].map_up is not None:
        return np.array(group[0].map_up), True
    told = [
        np.array(one.pose)[:3, :3] @ np.array(one.up)
        for one in group
        if one.pose is not None and one.up is not None
    ]
    if len(told) < _FEWEST:
        return None, False
    return mean_direction(np.stack(told), AGREE), True


# How a parent frame is seen from above: its up, and the axes of a plan.

#: Frames that the vertical is learnt from, about.
_UP_FRAMES = 200


@dataclass(frozen=True, eq=False)
class PlanAxes:
    """How a parent frame is seen from above.

    Parameters
    ----------
    axes : (2, 3) unit vectors to the right and to the top of the plan, in the parent frame
    up_from : whence up is known
    """

    axes: Floats
    up_from: UpSource


def plan_axes(up: Floats) -> Floats:
    """Return (2, 3) axes of a plan seen from above: the first along the parent's x axis, or its y
    axis if x is nearly vertical.
    """
    along = np.eye(3)[int(abs(up[0]) > 0.9)]
    right = along - (along @ up) * up
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right)])


def upright(poses: Floats, clouds: Sequence[bool]) -> Floats:
    """The axis (3,) of a parent frame, or its opposite, nearest to the sensors' own up.

    Robots hold sensors upright: -y of a camera, z of a scanner.

    Parameters
    ----------
    poses : (n, 4, 4) T_parent_sensor
    clouds : (n,) of point clouds
    """
    own = np.where(np.array(clouds)[:, None], poses[:, :3, 2], -poses[:, :3, 1])
    mean = own.mean(axis=0)
    axis = int(np.argmax(np.abs(mean)))
    up: Floats = np.eye(3)[axis] * (1.0 if mean[axis] >= 0 else -1.0)
    return up


def parent_axes(connection: Connection, row: MapRow, numbers: Sequence[int]) -> PlanAxes:
    """How to see from above the parent frame that the poses of some frames lead to."""
    numbers = numbers[:: max(len(numbers) // _UP_FRAMES, 1)]
    if (up := parent_up(connection, numbers)) is not None:
        return PlanAxes(plan_axes(up), "frames" if row.up is None else "map")
    stops = [stop for stop in path_frames(connection, numbers).values() if stop.pose is not None]
    if not stops:  # all were deleted meanwhile
        return PlanAxes(np.eye(3)[:2], "cameras")
    poses = np.array([stop.pose for stop in stops])
    return PlanAxes(plan_axes(upright(poses, [stop.is_cloud for stop in stops])), "cameras")
