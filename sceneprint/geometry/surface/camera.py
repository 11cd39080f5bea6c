"""Where a camera sees a point, for kernels: a pinhole, or a sphere about a viewpoint.

    camera  --camera_of-->  array        array, point  --project-->  column, line, depth

    points (6, N)  --move_all, project_all, within, gather_pixels-->  pixels, a block at a time

What a pinhole's noise and gates go by is depth along its axis; a sphere's, range. Both are called
depth here. A pixel that shows nothing has the point (0, 0, 0), and so no depth.
"""

from __future__ import annotations

import math

import numpy as np

from sceneprint.geometry.kernel import disjoint_kernel, kernel
from sceneprint.types import Camera, Floats, Floats32, Intrinsics, Ints32, Sphere

#: Kinds of camera; of what saw points that are in no order nothing is known.
PINHOLE, SPHERE, NOWHERE = 0, 1, 2
TURN = 2.0 * math.pi
#: Points that kernels work on at once: their numbers stay in the first level of the cache.
BLOCK = 256


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
def transposed(source: Floats32, step: int) -> Floats32:
    """Every `step`-th of some points (N, 6), number by number: (6, n)."""
    chosen = np.empty((6, (len(source) + step - 1) // step), np.float32)
    for a in range(6):
        for i in range(chosen.shape[1]):
            chosen[a, i] = source[i * step, a]
    return chosen


@disjoint_kernel
def move_all(points: Floats32, T: Floats, first: int, count: int, out: Floats) -> None:
    """Points `first` and on of (6, N) under a transform: (3, n)."""
    for a in range(3):
        x, y, z, own = points[0], points[1], points[2], out[a]
        xx, xy, xz, shift = T[a, 0], T[a, 1], T[a, 2], T[a, 3]
        for i in range(count):
            n = np.uint64(first + i)
            own[i] = xx * x[n] + xy * y[n] + xz * z[n] + shift


@disjoint_kernel
def project_all(camera: Floats, points: Floats, count: int, out: Floats) -> None:
    """Column, line and depth of points, (3, n) each: `project` of several at once."""
    x, y, z, column, line, depth = points[0], points[1], points[2], out[0], out[1], out[2]
    for i in range(count):
        column[i], line[i], depth[i] = project(camera, x[i], y[i], z[i])


@disjoint_kernel
def within(
    projected: Floats, count: int, left: float, right: float, top: float, bottom: float,
    places: Ints32,
) -> int:  # fmt: skip
    """Indices of points with a column in [left, right) and a line in [top, bottom); how many."""
    column, line, found = projected[0], projected[1], 0
    for i in range(count):
        inside = (column[i] >= left) & (line[i] >= top) & (column[i] < right) & (line[i] < bottom)
        places[found] = i
        found += 1 if inside else 0
    return found


@disjoint_kernel
def gather(values: Floats, places: Ints32, count: int, out: Floats) -> None:
    """The rows (m, n) of numbers at some places."""
    for a in range(len(values)):
        own, chosen = values[a], out[a]
        for i in range(count):
            chosen[i] = own[np.uint64(places[i])]


@disjoint_kernel
def gather_pixels(projected: Floats, places: Ints32, count: int, out: Ints32) -> None:
    """The pixels, columns and lines, of points at some places: (2, n)."""
    for a in range(2):
        own, chosen = projected[a], out[a]
        for i in range(count):
            chosen[i] = np.int32(own[np.uint64(places[i])])


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
