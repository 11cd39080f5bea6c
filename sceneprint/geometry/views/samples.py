"""Samples of a surface: points with normals, approximately one per cell of a grid.

points (N, 3)  --average_cells-->  points (n, 3)
points (n, 3)  --project_to_planes-->  points (n, 3), normals (n, 3), spacing (n,)
surface, cell  --surfels-->  Surfels
points (n, 3)  --sort_into_blocks-->  order (n,), Blocks
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.surface.voxels import least_axis
from sceneprint.types import Floats, Floats32, Ints32, Ints64, ReferenceSurface

#: Maximum number of cells per axis: three indices must fit into one key.
_MOST_CELLS = 1 << 20
#: Maximum ratio of the smallest to the middle variance of neighbours that lie on a plane.
_FLAT = 0.15
#: Half the maximum number of samples of a mesh. If a mesh has more triangles, some of those that
#: are small enough for a single sample are skipped.
_MOST_SAMPLES = 2_000_000


def cell_keys(points: Floats32, cell: float) -> tuple[Ints64, Ints64]:
    """Return the key of each point's cell, and the number of cells along each axis.

    Parameters
    ----------
    points : (N, 3) metres
    cell : side of a cell, metres

    Returns
    -------
    keys : (N,), (x * shape[1] + y) * shape[2] + z; the outermost cells on each side are empty
    shape : (3,) number of cells
    """
    low = points.min(axis=0).astype(np.float64) - cell
    shape = np.floor((points.max(axis=0) - low) / cell).astype(np.int64) + 2
    keys = np.zeros(len(points), np.int64)
    for axis in range(3):
        keys *= shape[axis]
        keys += np.floor((points[:, axis] - low[axis]) / cell).astype(np.int64)
    return keys, shape


def fitting_cell(points: Floats32, cell: float) -> float:
    """Return `cell`, the side of a cell, enlarged if keys could not number all cells."""
    return max(cell, float(np.ptp(points, axis=0).max(initial=0.0)) / (_MOST_CELLS - 4))


def average_cells(points: Floats32, cell: float) -> Floats32:
    """Return the mean of the points in each cell, (n, 3); the mean of a single point is exact.

    Parameters
    ----------
    points : (N, 3), N >= 1
    cell : side of a cell, metres
    """
    keys, _ = cell_keys(points, fitting_cell(points, cell))
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    starts = np.flatnonzero(np.append(True, keys[1:] != keys[:-1]))
    counts = np.diff(np.append(starts, len(keys)))
    result = np.empty((len(starts), 3), np.float32)
    for axis in range(3):
        sums = np.add.reduceat(points[order, axis].astype(np.float64), starts)
        result[:, axis] = sums / counts
    return result


@kernel
def _fit_cells(
    points: Floats32, order: Ints64, starts: Ints64, keys: Ints64, shape: Ints64, flat: float,
    normals: Floats32, heights: Floats, crowds: Floats,
) -> None:  # fmt: skip
    """Fit a plane n . x = h to the points around each cell; write n, h and the points per cell."""
    m, values, axis = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for cell in range(len(keys)):
        first, second, n, cells = np.zeros(3), np.zeros((3, 3)), 0, 0
        at = order[starts[cell]]
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                neighbour = keys[cell] + (dx * shape[1] + dy) * shape[2]
                k = np.searchsorted(keys, neighbour - 1)
                while k < len(keys) and keys[k] <= neighbour + 1:
                    cells += 1
                    for i in range(starts[k], starts[k + 1]):
                        j = order[i]
                        n += 1
                        for a in range(3):
                            da = points[j, a] - points[at, a]
                            first[a] += da
                            for b in range(a + 1):
                                second[a, b] += da * (points[j, b] - points[at, b])
                    k += 1
        crowds[cell] = n / cells
        for a in range(3):
            for b in range(a + 1):
                m[a, b] = second[a, b] / n - first[a] / n * first[b] / n
                m[b, a] = m[a, b]
        least_axis(m, values, axis)
        low, high = min(values[0], values[1], values[2]), max(values[0], values[1], values[2])
        middle = values[0] + values[1] + values[2] - low - high
        if n >= 4 and low <= flat * middle:
            for a in range(3):
                normals[cell, a] = axis[a]
                heights[cell] += axis[a] * (points[at, a] + first[a] / n)


def project_to_planes(points: Floats32, cell: float) -> tuple[Floats32, Floats32, Floats32]:
    """Project each point of a cloud onto the plane of its neighbours.

    Drift makes the walls of a map thick; without projection, a rendered sensor would see the
    nearest points of the walls instead of their middle.

    Parameters
    ----------
    points : (N, 3), N >= 1
    cell : side of a cell, metres; neighbours are the points in the cell and in adjacent cells

    Returns
    -------
    moved : (N, 3); points whose neighbours lie on no plane are not moved
    normals : (N, 3) normals of either sign; 0 if the neighbours lie on no plane
    spacing : (N,) spacing that the neighbours would have if evenly distributed on a plane, metres
    """
    cell = fitting_cell(points, cell)
    keys, shape = cell_keys(points, cell)
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    starts = np.flatnonzero(np.append(True, ordered[1:] != ordered[:-1]))
    normals, crowds = np.zeros((len(starts), 3), np.float32), np.zeros(len(starts))
    heights = np.zeros(len(starts))
    ends = np.append(starts, len(keys))
    _fit_cells(points, order, ends, ordered[starts], shape, _FLAT, normals, heights, crowds)
    index = np.searchsorted(ordered[starts], keys)
    spacing = (cell / np.sqrt(crowds)).astype(np.float32)
    towards = normals[index]
    off = np.einsum("ij,ij->i", points.astype(np.float64), towards) - heights[index]
    moved = (points - off[:, None] * towards).astype(np.float32)
    return moved, towards, spacing[index]


@dataclass(frozen=True, eq=False)
class Surfels:
    """Pieces of a surface, approximately one per occupied cell.

    Parameters
    ----------
    points : (S, 3) float32, metres
    normals : (S, 3) float32 unit vectors, towards the front of a mesh or to either side of a cloud;
        0 if unknown
    cell : side of a cell, metres
    one_sided : whether normals point to the front
    """

    points: Floats32
    normals: Floats32
    cell: float
    one_sided: bool


def surfels(surface: ReferenceSurface, cell: float, most: int) -> Surfels:
    """Sample pieces of a surface, one per cell and main direction of the normal.

    Parameters
    ----------
    cell : side of a cell, metres; it grows until at most `most` pieces remain
    most : maximum number of pieces
    """
    if surface.triangles is None:
        points = average_cells(surface.points, cell / 6)
        points, normals, _ = project_to_planes(points, cell / 2)
    else:
        points, normals = _sample_mesh(surface.points, surface.triangles, cell / 2)
    cell = fitting_cell(points, cell)
    while True:
        keys, _ = cell_keys(points, cell)
        towards = np.abs(normals).argmax(axis=1)
        towards += 3 * (normals[np.arange(len(normals)), towards] < 0)
        _, first = np.unique(keys * 6 + towards, return_index=True)
        if len(first) <= most:
            break
        cell *= max(math.sqrt(len(first) / most), 1.05)
    return Surfels(points[first], normals[first], cell, surface.triangles is not None)


@kernel
def _count_samples(points: Floats32, triangles: Ints32, step: float, every: int) -> float:
    """Return an upper bound on the number of samples that `_write_samples` writes."""
    total = 0.0
    for m in range(len(triangles)):
        a, b, c = points[triangles[m, 0]], points[triangles[m, 1]], points[triangles[m, 2]]
        along = np.ceil(np.sqrt(((b - a) ** 2).sum()) / step)
        across = np.ceil(np.sqrt(((c - a) ** 2).sum()) / step)
        count = max(along, 1.0) * max(across, 1.0)
        if count > 1.0 or m % every == 0:
            total += count
    return total


@kernel
def _write_samples(
    points: Floats32, triangles: Ints32, step: float, every: int, places: Floats32,
    normals: Floats32,
) -> int:  # fmt: skip
    """Write points on a grid over each triangle (the centre of a small one), and their normals."""
    n = 0
    for m in range(len(triangles)):
        a, b, c = points[triangles[m, 0]], points[triangles[m, 1]], points[triangles[m, 2]]
        u, v = b - a, c - a
        x, y, z = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
        area = np.sqrt(x * x + y * y + z * z)
        if not area > 0:
            continue
        along = max(int(np.ceil(np.sqrt((u * u).sum()) / step)), 1)
        across = max(int(np.ceil(np.sqrt((v * v).sum()) / step)), 1)
        if along * across == 1 and m % every != 0:
            continue
        for i in range(along):
            for j in range(across):
                s, t = (i + 1 / 3) / along, (j + 1 / 3) / across
                if s + t >= 1.0:
                    continue
                for k in range(3):
                    places[n, k] = a[k] + s * u[k] + t * v[k]
                normals[n, 0], normals[n, 1], normals[n, 2] = x / area, y / area, z / area
                n += 1
    return n


def _sample_mesh(points: Floats32, triangles: Ints32, step: float) -> tuple[Floats32, Floats32]:
    """Sample points and normals on a mesh at a spacing of `step`, or wider for large meshes."""
    points = np.require(points, np.float32, ["C", "W"])
    triangles = np.require(triangles, np.int32, ["C", "W"])
    every = max(len(triangles) // _MOST_SAMPLES, 1)
    while (total := _count_samples(points, triangles, step, every)) > 2 * _MOST_SAMPLES:
        step *= 1.3
    places = np.empty((int(total), 3), np.float32)
    normals = np.empty((int(total), 3), np.float32)
    n = _write_samples(points, triangles, step, every, places, normals)
    return places[:n], normals[:n]


@kernel
def bounding_balls(points: Floats32, triangles: Ints32, middles: Floats32, reach: Floats32) -> None:
    """Write each triangle's centroid (m, 3), and its largest distance from a corner (m,)."""
    for m in range(len(triangles)):
        for axis in range(3):
            total = 0.0
            for corner in range(3):
                total += float(points[triangles[m, corner], axis])
            middles[m, axis] = total / 3.0
        most = 0.0
        for corner in range(3):
            square = 0.0
            for axis in range(3):
                square += (points[triangles[m, corner], axis] - middles[m, axis]) ** 2
            most = max(most, square)
        reach[m] = np.sqrt(most)


@dataclass(frozen=True, eq=False)
class Blocks:
    """Items sorted by position, so that most invisible items can be skipped.

    Parameters
    ----------
    starts, ends : (B,) range of each block among the items
    centres : (B, 3) metres
    radii : (B,) radii of balls that contain the blocks, metres
    """

    starts: Ints64
    ends: Ints64
    centres: Floats
    radii: Floats

    def in_view(
        self, T: Floats, camera: Floats, shape: tuple[int, ...], farthest: float
    ) -> tuple[Ints64, Ints64]:
        """Return the starts and ends of the blocks that may be visible to a camera.

        Parameters
        ----------
        T : (4, 4) T_camera_points
        camera : fx, fy, cx, cy
        shape : height and width of the image
        farthest : maximum depth, metres
        """
        x, y, z = (self.centres @ T[:3, :3].T + T[:3, 3]).T
        r = self.radii
        visible = (z > -r) & (z - r < farthest)
        for along, focal, middle, size in (
            (x, camera[0], camera[2], shape[1]), (y, camera[1], camera[3], shape[0]),
        ):  # fmt: skip
            for slope, sign in ((-(middle + 0.5) / focal, 1.0), ((size - middle) / focal, -1.0)):
                # a block is invisible if it lies more than its radius beyond a side of the view
                visible &= sign * (along - slope * z) > -r * math.sqrt(1.0 + slope * slope)
        return self.starts[visible], self.ends[visible]


def sort_into_blocks(points: Floats32, side: float, extents: Floats32) -> tuple[Ints64, Blocks]:
    """Sort items into blocks; return their order and the blocks.

    Parameters
    ----------
    points : (N, 3) centres of the items
    side : side of a block, metres
    extents : (N,) maximum distance of each item's points from its centre, metres
    """
    side = fitting_cell(points, side)
    keys, _ = cell_keys(points, side)
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    starts = np.flatnonzero(np.append(True, ordered[1:] != ordered[:-1]))
    ends = np.append(starts[1:], len(order))
    own = points[order].astype(np.float64)
    low, high = np.minimum.reduceat(own, starts), np.maximum.reduceat(own, starts)
    reach = np.maximum.reduceat(extents[order].astype(np.float64), starts)
    radii = np.linalg.norm(high - low, axis=1) / 2 + reach
    return order, Blocks(starts, ends, (low + high) / 2, radii)
