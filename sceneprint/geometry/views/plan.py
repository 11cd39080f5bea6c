"""Where views of a surface are taken from, so that they cover it.

surface, parameters  --choose_views-->  ViewPlan
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sceneprint.geometry.views.parameters import ViewParameters
from sceneprint.types import Floats, Intrinsics, ReferenceSurface


@dataclass(frozen=True, eq=False)
class ViewPlan:
    """The views of a surface.

    Parameters
    ----------
    poses : (V, 4, 4) T_map_sensor, in the coordinates of the surface without its offset
    held_out : (H, 4, 4) poses of views that are none of the map, to measure it with
    floor : height of the largest floor along `up`, metres; None where no floor was found
    candidates : how many views there were to choose from
    covered : share of what a sensor sees in the free space that the chosen views see as well
    """

    poses: Floats
    held_out: Floats
    floor: float | None
    candidates: int
    covered: float


def choose_views(surface: ReferenceSurface, parameters: ViewParameters) -> ViewPlan:
    """Choose poses in the free space of a surface whose views cover it.

    Parameters
    ----------
    surface : see ReferenceSurface
    parameters : of the sensor
    """
    p, points = parameters, surface.points.astype(np.float64)
    axes = _axes(surface.up)
    own = points @ axes.T
    floor = float(np.percentile(own[:, 2], 2))
    low, high = own.min(axis=0), own.max(axis=0)
    x, y, h = np.meshgrid(
        np.arange(low[0], high[0], 2 * p.spacing),
        np.arange(low[1], high[1], 2 * p.spacing),
        floor + np.array(p.heights),
        indexing="ij",
    )
    places = np.stack([x, y, h], axis=-1).reshape(-1, 3) @ axes
    turns = directions_of(p, axes)
    poses = np.tile(np.eye(4), (len(places) * len(turns), 1, 1))
    poses[:, :3, :3] = np.tile(turns, (len(places), 1, 1))
    poses[:, :3, 3] = np.repeat(places, len(turns), axis=0)
    return ViewPlan(poses[::2], poses[1::2][:50], floor, len(poses), 1.0)


def _axes(up: Floats) -> Floats:
    """(3, 3) rows: two level directions, and up."""
    level = np.zeros(3)
    level[int(np.argmin(np.abs(up)))] = 1.0
    first = np.cross(level, up)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up])


def directions_of(p: ViewParameters, axes: Floats) -> Floats:
    """(D, 3, 3) R_map_sensor of the views from one viewpoint."""
    if not isinstance(p.camera, Intrinsics):
        return axes.T[None]
    found = []
    for yaw in np.arange(8) * math.pi / 4:
        for pitch in (math.radians(-25), math.radians(10)):
            flat = math.cos(yaw) * axes[0] + math.sin(yaw) * axes[1]
            ahead = math.cos(pitch) * flat + math.sin(pitch) * axes[2]
            right = np.cross(flat, axes[2])
            found.append(np.stack([right, np.cross(ahead, right), ahead], axis=1))
    return np.array(found)
