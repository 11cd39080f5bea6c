"""Measures of the surface and the volume that several views observe (the paper's last figure).

A view is a frame with the pose T_query_view. All lengths are metres in the query's frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.rigid import inverse, transform_points
from sceneprint.types import Bytes, DepthFrame, Floats, Floats32, Ints32

#: Tolerance within which a view's depth agrees with a point: metres plus a share of the depth.
AGREES_M, AGREES_SHARE = 0.05, 0.03
#: Minimum edge length of the cells of a volume, metres, and maximum number of cells.
CELL_M, MOST_CELLS = 0.05, 2_000_000


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A triangulated surface.

    Parameters
    ----------
    points : (N, 3) float64, metres
    normals : (N, 3) float64, unit length, towards the observed side
    triangles : (M, 3) int32, indices of points, counter-clockwise from the observed side
    """

    points: Floats
    normals: Floats
    triangles: Ints32

    def areas(self) -> Floats:
        """Return the areas of the triangles, (M,), square metres."""
        a, b, c = (self.points[self.triangles[:, i]] for i in range(3))
        areas: Floats = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        return areas


def camera_of(view: DepthFrame) -> Floats:
    """Return the camera of a view for kernels, (16,): T_view_query (R, t), fx, fy, cx, cy.

    Raises
    ------
    ValueError : If the view has no pose
    """
    if view.pose is None:
        raise ValueError(f"The view {view.name!r} has no pose. Pass views with T_query_view.")
    T, k = inverse(view.pose), view.intrinsics
    return np.concatenate([T[:3, :3].ravel(), T[:3, 3], (k.fx, k.fy, k.cx, k.cy)])


@kernel
def _depth_error(point: Floats, camera: Floats, depth: Floats32) -> tuple[float, float]:
    """Return a point's distance behind the view's surface (inf if unobserved) and its depth."""
    x = camera[0] * point[0] + camera[1] * point[1] + camera[2] * point[2] + camera[9]
    y = camera[3] * point[0] + camera[4] * point[1] + camera[5] * point[2] + camera[10]
    z = camera[6] * point[0] + camera[7] * point[1] + camera[8] * point[2] + camera[11]
    if not z > 1e-3:
        return np.inf, 0.0
    u = np.floor(camera[12] * x / z + camera[14] + 0.5)
    v = np.floor(camera[13] * y / z + camera[15] + 0.5)
    if not (u >= 0 and v >= 0 and u < depth.shape[1] and v < depth.shape[0]):
        return np.inf, 0.0
    measured = depth[int(v), int(u)]
    if not measured > 0:
        return np.inf, 0.0
    return z - measured, z


@kernel
def _first_seen(
    points: Floats, camera: Floats, depth: Floats32, view: int, metres: float, share: float,
    first: Ints32, nearest: Floats, nearest_view: Ints32,
) -> None:  # fmt: skip
    for i in range(len(points)):
        error, z = _depth_error(points[i], camera, depth)
        if first[i] < 0 and abs(error) <= metres + share * z:
            first[i] = view
        if abs(error) < nearest[i]:
            nearest[i], nearest_view[i] = abs(error), view


def first_seen(
    points: Floats,
    views: Sequence[DepthFrame],
    metres: float = AGREES_M,
    share: float = AGREES_SHARE,
) -> tuple[Ints32, Ints32]:
    """Return the index of the first view that sees each point.

    Parameters
    ----------
    points : (N, 3)
    views : views in their order
    metres, share : depth tolerance; see AGREES_M

    Returns
    -------
    first : (N,) index of the view; -1 if no view sees the point
    nearest : (N,) index of the view whose surface is nearest along its ray; 0 if there is none
    """
    first, nearest = np.full(len(points), -1, np.int32), np.zeros(len(points), np.int32)
    error = np.full(len(points), np.inf)
    points = np.ascontiguousarray(points, np.float64)
    for i, view in enumerate(views):
        _first_seen(points, camera_of(view), view.depth, i, metres, share, first, error, nearest)
    return first, nearest


def share_seen(points: Floats, views: Sequence[DepthFrame]) -> float:
    """Return the share of points that at least one view sees; 0 if there are no points."""
    first, _ = first_seen(points, views)
    return float((first >= 0).mean()) if len(points) else 0.0


def first_views(mesh: TriangleMesh, views: Sequence[DepthFrame], tolerance: float) -> Ints32:
    """Return the index (N,) of the first view that sees each point of a mesh fused from `views`.

    Parameters
    ----------
    views : views in their order
    tolerance : maximum distance of the fused surface from a view's depth, metres
    """
    first, nearest = first_seen(mesh.points, views, tolerance, 0.0)
    # a point between two pixels or at an edge may not agree with any pixel
    return np.where(first >= 0, first, nearest).astype(np.int32)


def added_areas(mesh: TriangleMesh, first: Ints32, views: int) -> Floats:
    """Return the area (V,) that each view adds to the preceding views, square metres.

    A triangle counts for the first view that sees one of its corners; the sum is the area of the
    mesh.

    Parameters
    ----------
    first : (N,) result of `first_views`
    views : number of views
    """
    if not len(mesh.triangles):
        return np.zeros(views)
    view = first[mesh.triangles].min(axis=1)
    areas: Floats = np.bincount(view, mesh.areas(), minlength=views).astype(np.float64)
    return areas


@kernel
def _mark(
    seen: Bytes, low: Floats, cell: float, camera: Floats, depth: Floats32, slack: float
) -> None:
    nx, ny, nz = seen.shape
    point = np.empty(3)
    for i in range(nx):
        point[0] = low[0] + (i + 0.5) * cell
        for j in range(ny):
            point[1] = low[1] + (j + 0.5) * cell
            for k in range(nz):
                if seen[i, j, k]:
                    continue
                point[2] = low[2] + (k + 0.5) * cell
                error, _ = _depth_error(point, camera, depth)
                if error <= slack:
                    seen[i, j, k] = 1


def observed_volume(views: Sequence[DepthFrame]) -> tuple[float, float]:
    """Return the volume between the cameras and the surfaces, and the edge length of its cells.

    The volume is in cubic metres, the edge length in metres. Distant views enlarge the cells.

    Parameters
    ----------
    views : views with depth 0 for missing samples
    """
    corners = [
        transform_points(view.pose, _outline(view)) for view in views if view.pose is not None
    ]
    everything = np.concatenate(corners) if corners else np.zeros((0, 3))
    if not len(everything):
        return 0.0, CELL_M
    low, size = everything.min(axis=0), np.ptp(everything, axis=0)
    cell = max(CELL_M, float(np.prod(np.maximum(size, CELL_M)) / MOST_CELLS) ** (1 / 3))
    seen = np.zeros(tuple(np.ceil(size / cell).astype(int) + 1), np.uint8)
    for view in views:
        _mark(seen, low, cell, camera_of(view), view.depth, cell / 2)
    return float(seen.sum()) * cell**3, cell


def _outline(view: DepthFrame) -> Floats:
    """Return the camera centre and the corners of the view cone at the maximum depth, (5, 3)."""
    k, far = view.intrinsics, float(view.depth.max(initial=0.0))
    if not far > 0:
        return np.zeros((0, 3))
    y, x = np.meshgrid((-0.5, k.height - 0.5), (-0.5, k.width - 0.5))
    rays = np.stack([(x.ravel() - k.cx) / k.fx, (y.ravel() - k.cy) / k.fy, np.ones(4)], axis=1)
    return np.concatenate([np.zeros((1, 3)), rays * far])
