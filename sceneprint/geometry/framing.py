"""The camera of a range image: which pole, how wide, and where its pixels look.

points (N, 3)  --angles_of-->  azimuth, elevation, range  --framed-->  Sphere
"""

from __future__ import annotations

import math

import numpy as np

from sceneprint.cameras import Sphere
from sceneprint.geometry.clouds import CloudParameters
from sceneprint.geometry.kernel import kernel
from sceneprint.types import Floats, Floats32

#: Closer to an axis than this a point is near its poles: cosine of 30 degrees.
_NEAR_POLE = math.cos(math.radians(30.0))
#: An empty wedge of fewer pixels does not end the image.
_WEDGE_PX = 8


def directions(camera: Sphere) -> Floats:
    """Unit vectors (h, w, 3) through the centres of the pixels, in the sensor's axes."""
    azimuth = camera.left + camera.step * np.arange(camera.width)
    elevation = camera.top - camera.step * np.arange(camera.height)
    rays = np.empty((camera.height, camera.width, 3))
    a, b = (camera.pole + 1) % 3, (camera.pole + 2) % 3
    rays[..., a] = np.cos(elevation)[:, None] * np.cos(azimuth)
    rays[..., b] = np.cos(elevation)[:, None] * np.sin(azimuth)
    rays[..., camera.pole] = np.sin(elevation)[:, None]
    return rays


def pole_of(points: Floats32) -> int:
    """The axis, z, y, x where they tie, that the fewest points are near."""
    lengths = np.linalg.norm(points, axis=1)
    near = [int(np.count_nonzero(np.abs(points[:, c]) > _NEAR_POLE * lengths)) for c in range(3)]
    return min((2, 1, 0), key=lambda axis: near[axis])


@kernel
def to_angles(points: Floats32, pole: int, out: Floats) -> None:
    """Azimuth, elevation and range of each point."""
    first, second = (pole + 1) % 3, (pole + 2) % 3
    for i in range(len(points)):
        a, b = float(points[i, first]), float(points[i, second])
        c = float(points[i, pole])
        flat = a * a + b * b
        out[i, 0] = np.arctan2(b, a)
        out[i, 1] = np.arctan2(c, np.sqrt(flat))
        out[i, 2] = np.sqrt(flat + c * c)


def framed(angles: Floats, pole: int, p: CloudParameters) -> Sphere:
    """The camera that shows all points, of steps so long that it has pixels for them."""
    low, high = float(angles[:, 1].min()), float(angles[:, 1].max())
    step = p.image_angle
    while True:
        around = math.ceil(2 * math.pi / step)
        column = ((angles[:, 0] + math.pi) * (around / (2 * math.pi))).astype(np.int64) % around
        seen = np.flatnonzero(np.bincount(column, minlength=around))
        ends = np.append(seen, seen[0] + around)
        widest = int(np.diff(ends).argmax())
        unit = 2 * math.pi / around
        height = max(math.ceil((high - low) / unit), 1)
        top = (high + low) / 2 + (height - 1) / 2 * unit
        if ends[widest + 1] - ends[widest] <= _WEDGE_PX:
            first, width = 0, around
        else:  # the image begins where the widest wedge without points ends
            first = int(ends[widest + 1])
            width = max(int(ends[widest]) + around - first + 1, 2)
        if width * height <= p.maximum_pixels:
            left = math.remainder(-math.pi + (first + 0.5) * unit, 2 * math.pi)
            return Sphere(width, height, unit, left, top, pole)
        step *= max(math.sqrt(width * height / p.maximum_pixels), 1.01)
