"""Rendering of a surface from the pose of a sensor, with occlusion and holes.

    surface, pose  --Renderer.view-->  depth (H, W) of a camera, or points (K, 3) of a scanner

For a scanner, the six faces of a cube around it are rendered.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.rigid import inverse
from sceneprint.geometry.views.parameters import ViewParameters
from sceneprint.geometry.views.raster import draw_discs, draw_triangles, pinhole
from sceneprint.geometry.views.samples import (
    average_cells,
    bounding_balls,
    project_to_planes,
    sort_into_blocks,
)
from sceneprint.types import Floats, Floats32, Intrinsics, Ints32, ReferenceSurface

#: Radius of the disc of a point, as a share of the spacing of points.
_OVERLAP = 0.7
#: Radius of the disc of a point on no plane, such as on a wire or a leaf, as a share of the
#: spacing.
_LONELY = 0.3
#: Width of the cells whose points determine a normal, in spacings of points.
_NEIGHBOURHOOD = 3.0
#: Side of a block, as a share of the sensor's range.
_BLOCK = 1.0 / 20.0
#: Minimum share of a view's pixels that show a side of the surface; a smaller share is hidden.
LEAST_SIDE = 0.3


def cube_faces(size: int) -> tuple[Intrinsics, Floats]:
    """Return the camera of a face of a cube around the sensor, and R_sensor_face (6, 3, 3).

    Parameters
    ----------
    size : number of pixels along an edge
    """
    camera = Intrinsics(size, size, size / 2, size / 2, (size - 1) / 2, (size - 1) / 2)
    turns = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            ahead, right = np.zeros(3), np.zeros(3)
            ahead[axis], right[(axis + 1) % 3] = sign, 1.0
            turns.append(np.stack([right, np.cross(ahead, right), ahead], axis=1))
    return camera, np.array(turns)


def rays_of(camera: Intrinsics) -> Floats32:
    """Return rays of depth 1 through the centres of the pixels, (H, W, 3)."""
    rays = np.ones((camera.height, camera.width, 3), np.float32)
    rays[..., 0] = (np.arange(camera.width) - camera.cx) / camera.fx
    rays[..., 1] = ((np.arange(camera.height) - camera.cy) / camera.fy)[:, None]
    return rays


class Renderer:
    """Renders a surface as a sensor sees it."""

    def __init__(self, surface: ReferenceSurface, parameters: ViewParameters) -> None:
        self._p = p = parameters
        # numba would compile the kernels a second time for read-only arrays
        points = np.require(surface.points, np.float32, ["C", "W"])
        side = p.farthest * _BLOCK
        if surface.triangles is None:
            points = average_cells(points, p.grain)
            points, normals, spacing = project_to_planes(points, _NEIGHBOURHOOD * p.grain)
            share = np.where((normals != 0).any(axis=1), _OVERLAP, _LONELY)
            radii = (share * np.maximum(spacing, p.grain)).astype(np.float32)
            order, self._blocks = sort_into_blocks(points, side, radii)
            self._points, self._normals, self._radii = points[order], normals[order], radii[order]
            self._triangles: Ints32 | None = None
        else:
            triangles = np.require(surface.triangles, np.int32, ["C", "W"])
            middles = np.empty((len(triangles), 3), np.float32)
            reach = np.empty(len(triangles), np.float32)
            bounding_balls(points, triangles, middles, reach)
            order, self._blocks = sort_into_blocks(middles, side, reach)
            self._points, self._triangles = points, triangles[order]
        if p.camera is None:
            self._camera, self._faces = cube_faces(max(math.ceil(2.0 / p.step), 8))
        else:
            self._camera, self._faces = p.camera, np.eye(3)[None]
        self._rays = rays_of(self._camera)
        self._lengths = np.linalg.norm(self._rays, axis=2)
        up = np.einsum("hwi,fi->fhw", self._rays, self._faces[:, 2]) / self._lengths
        self._wanted = (p.camera is not None) | (np.abs(up) <= math.sin(p.elevation))

    def view(self, T_map_sensor: Floats) -> Floats32:
        """Render the surface at a pose.

        Parameters
        ----------
        T_map_sensor : (4, 4), in the coordinates of the surface without its offset

        Returns
        -------
        depth : (H, W) float32, metres along the optical axis, 0 if missing; for a camera
        points : (K, 3) float32, metres, in the sensor's axes; for a scanner
        """
        drawn = [self._face(T_map_sensor, R) for R in self._faces]
        depth, back = (np.stack(images) for images in zip(*drawn, strict=True))
        ranges = depth * self._lengths if self._p.camera is None else depth
        seen = (ranges >= self._p.nearest) & (ranges <= self._p.farthest) & self._wanted
        share = float(back[seen].mean()) if seen.any() else 0.0
        if share < LEAST_SIDE:
            seen &= ~back
        elif share > 1.0 - LEAST_SIDE:  # the mesh is inside out
            seen &= back
        if self._p.camera is not None:
            shown: Floats32 = np.where(seen[0], depth[0], np.float32(0.0))
            return shown
        points = [
            (self._rays[mask] * image[mask][:, None]) @ R.T.astype(np.float32)
            for image, mask, R in zip(depth, seen, self._faces, strict=True)
        ]
        return np.concatenate(points)

    def _face(self, T_map_sensor: Floats, R: Floats) -> tuple[Floats32, NDArray[np.bool_]]:
        """Return the depth of each pixel (inf if empty), and a mask of pixels that show a back."""
        turn = np.eye(4)
        turn[:3, :3] = R
        T, camera = inverse(T_map_sensor @ turn), pinhole(self._camera)
        depth = np.full((self._camera.height, self._camera.width), np.inf, np.float32)
        starts, ends = self._blocks.in_view(T, camera, depth.shape, self._p.farthest)
        if self._triangles is None:
            item = np.full(depth.shape, -1, np.int32)
            draw_discs(
                self._points, self._normals, self._radii, starts, ends, T, camera, depth, item
            )
            return depth, np.zeros(depth.shape, np.bool_)
        back = np.zeros(depth.shape, np.uint8)
        draw_triangles(self._points, self._triangles, starts, ends, T, camera, depth, back)
        return depth, back.astype(np.bool_)
