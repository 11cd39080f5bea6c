"""How a parent frame is seen from above: its up, and the axes of a plan.

map, frames of one parent frame  --parent_axes-->  PlanAxes
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sqlalchemy import Connection

from sceneprint.engine.search.up_vectors import parent_up
from sceneprint.store.frame_queries import stops_of
from sceneprint.store.tables import MapRow
from sceneprint.types import Floats
from sceneprint_client.api.coverage import UpSource

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
    """(2, 3) axes of a plan seen from above: the first along the parent's x axis, or its y axis
    where that is nearly vertical.

    Parameters
    ----------
    up : (3,) unit vector
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
    stops = [stop for stop in stops_of(connection, numbers).values() if stop.pose is not None]
    if not stops:  # all were deleted meanwhile
        return PlanAxes(np.eye(3)[:2], "cameras")
    poses = np.array([stop.pose for stop in stops])
    return PlanAxes(plan_axes(upright(poses, [stop.is_cloud for stop in stops])), "cameras")
