"""A surface as a sensor at a pose sees it: what is nearer hides what is behind; holes stay missing.

surface, pose  --Renderer.view-->  depth (H, W) of a camera, or points (K, 3) of a scanner
"""

from __future__ import annotations

import numpy as np

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.rigid import inverse
from sceneprint.geometry.surface.camera import project
from sceneprint.geometry.surface.range_image import directions
from sceneprint.geometry.views.parameters import ViewParameters
from sceneprint.types import Floats, Floats32, Intrinsics, ReferenceSurface, camera_of


@kernel
def _splat(points: Floats32, T: Floats, camera: Floats, size: float, image: Floats32) -> None:
    """Draw each point as a square as wide as `size` at its depth; the nearest stays."""
    height, width = image.shape
    closed = camera[0] == 1
    focal = 1.0 / camera[2] if closed else camera[2]
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        column, line, depth = project(
            camera,
            T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
            T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
            T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
        )
        if not camera[1] < depth < camera[7]:
            continue
        half = min(size * focal / depth / 2, 8.0)
        if line + half < 0 or line - half >= height:
            continue
        if not closed and (column + half < 0 or column - half >= width):
            continue
        for v in range(max(int(line - half), 0), min(int(line + half) + 1, height)):
            for u in range(int(np.floor(column - half)), int(np.floor(column + half)) + 1):
                if closed:
                    u = u % width
                elif u < 0 or u >= width:
                    continue
                if image[v, u] == 0 or depth < image[v, u]:
                    image[v, u] = depth


class Renderer:
    """A surface made ready to be looked at.

    Parameters
    ----------
    surface : see ReferenceSurface
    parameters : of the sensor
    """

    def __init__(self, surface: ReferenceSurface, parameters: ViewParameters) -> None:
        self._p = parameters
        points = np.ascontiguousarray(surface.points, np.float32)
        if surface.triangles is not None:
            points = points[surface.triangles].mean(axis=1, dtype=np.float32)
        self._points = points

    def view(self, T_map_sensor: Floats) -> Floats32:
        """Return what the sensor sees at a pose.

        Parameters
        ----------
        T_map_sensor : (4, 4), in the coordinates of the surface without its offset

        Returns
        -------
        depth : (H, W) float32, metres along the optical axis, 0 where missing; of a camera
        points : (K, 3) float32, metres, in the sensor's axes; of a scanner
        """
        p = self._p
        image = np.zeros((p.camera.height, p.camera.width), np.float32)
        camera = np.append(camera_of(p.camera, p.nearest), p.farthest)
        _splat(self._points, inverse(T_map_sensor), camera, 0.05, image)
        if isinstance(p.camera, Intrinsics):
            return image
        seen = image > 0
        points: Floats32 = (directions(p.camera)[seen] * image[seen][:, None]).astype(np.float32)
        return points
