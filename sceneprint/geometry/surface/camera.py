"""Where a camera sees a point, for kernels: a pinhole, or a sphere about a viewpoint.

    camera  --camera_of-->  array        array, point  --project-->  column, line, depth

What a pinhole's noise and gates go by is depth along its axis; a sphere's, range. Both are called
depth here. A pixel that shows nothing has the point (0, 0, 0), and so no depth.
"""

from __future__ import annotations

import math

import numpy as np

from sceneprint.geometry.kernel import kernel
from sceneprint.types import Camera, Floats, Floats32, Intrinsics, Sphere

#: Kinds of camera; of what saw points that are in no order nothing is known.
PINHOLE, SPHERE, NOWHERE = 0, 1, 2
TURN = 2.0 * math.pi


def camera_of(camera: Camera | None, nearest: float) -> Floats:
    """A camera as kernels take it: (7,), its kind, `nearest`, and five numbers of that kind.

    Parameters
    ----------
    camera : None for points in no order
    nearest : points this near are not looked up, metres of depth
    """
    if isinstance(camera, Intrinsics):
        return np.array([PINHOLE, nearest, camera.fx, camera.fy, camera.cx, camera.cy, 0.0])
    if isinstance(camera, Sphere):
        closed = camera.width if camera.is_closed else 0
        return np.array(
            [SPHERE, nearest, camera.step, camera.left, camera.top, camera.pole, closed], float
        )
    return np.array([NOWHERE, nearest, 0.0, 0.0, 0.0, 0.0, 0.0])


def kind_of(camera: Camera | None) -> int:
    """The kind of a camera, as the first of `camera_of`."""
    return int(camera_of(camera, 0.0)[0])


@kernel
def depth_of(kind: float, x: float, y: float, z: float) -> float:
    """Depth of a point before the camera that saw it; 0 where that is not known."""
    if kind == 0:
        return z
    if kind == 1:
        return float(np.sqrt(x * x + y * y + z * z))
    return 0.0


@kernel
def _on_sphere(camera: Floats, x: float, y: float, z: float) -> tuple[float, float, float]:
    depth = np.sqrt(x * x + y * y + z * z)
    if not depth > camera[1]:
        return -1.0, -1.0, depth
    a, b, c = x, y, z
    if camera[5] == 1:
        a, b, c = z, x, y
    elif camera[5] == 0:
        a, b, c = y, z, x
    # asin is flat at the pole; this is not
    elevation = np.arctan2(c, np.sqrt(a * a + b * b))
    turn = TURN / camera[2]
    column = (np.arctan2(b, a) - camera[3]) / camera[2] + 0.5
    column -= np.floor(column / turn) * turn
    if column >= camera[6] > 0:  # what rounding left between the last column and the first
        column = 0.0
    return column, (camera[4] - elevation) / camera[2] + 0.5, depth


@kernel
def project(camera: Floats, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Column and line, of which the whole part is the pixel, and depth; -1 where too near."""
    if camera[0] == 0:
        if not z > camera[1]:
            return -1.0, -1.0, z
        return x / z * camera[2] + camera[4] + 0.5, y / z * camera[3] + camera[5] + 0.5, z
    return _on_sphere(camera, x, y, z)


@kernel
def depth_at(camera: Floats, points: Floats32, line: int, column: int) -> float:
    """Depth of what a pixel shows, 0 where nothing."""
    x, y, z = points[line, column, 0], points[line, column, 1], points[line, column, 2]
    return depth_of(camera[0], x, y, z)


@kernel
def grown(depth: float, reference: float, power: float) -> float:
    """What lengths grow by at a depth: (depth / reference)^power, power 0, 1 or 2, at least 1."""
    ratio = depth / reference
    if power == 2:
        return max(1.0, ratio * ratio)
    return max(1.0, ratio) if power == 1 else 1.0
