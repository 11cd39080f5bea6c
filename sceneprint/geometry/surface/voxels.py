"""Voxels of a cloud, each with a plane fitted to its neighbours (Sec. III).

    Cloud (N)  --voxels-->  Voxels (V), a Surface (1, V)
    inverse ranges (N), directions (N, 3), Links  --fit_inverse_planes-->  planes
    places (N, 3), Links                          --fit_planes-->          normals, feet
    places (N, 3), heights (N)                    --link_points-->         Links

Around a viewpoint, voxels grow with range, as in VCCS for the cloud of a single camera (Papon
2013): each fills a cell of a direction grid on the faces of a cube, and an interval of the
logarithm of range. Without a viewpoint, all cells have the same size. The grid is aligned with the
cloud's principal axes, so it rotates with the cloud.
"""

from __future__ import annotations

import math
import secrets
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import UselessFrame
from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.surface.cloud import (
    CloudParameters,
    average_cells,
    centroid,
    hash_key,
    principal_axes,
    select_in_range,
)
from sceneprint.types import Cloud, Floats, Floats32, Ints32, Surface

Ints64 = NDArray[np.int64]


@kernel
def solve(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, b: Floats, out: Floats
) -> float:
    """Solve A x = b for a symmetric A (3, 3); write x to `out` if det A > 0; return det A."""
    cxx, cxy, cxz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    det = xx * cxx + xy * cxy + xz * cxz
    if det > 0:
        cyy, cyz, czz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
        out[0] = (cxx * b[0] + cxy * b[1] + cxz * b[2]) / det
        out[1] = (cxy * b[0] + cyy * b[1] + cyz * b[2]) / det
        out[2] = (cxz * b[0] + cyz * b[1] + czz * b[2]) / det
    return det


@kernel
def fit_inverse_planes(
    q: Floats, u: Floats, offsets: Ints64, indices: Ints32, gates: Floats, limits: Floats,
    planes: Floats,
) -> None:  # fmt: skip
    """Fit the plane 1/r = a . u to the neighbours of each point, and write `a`; 0 without a plane.

    The first pass selects neighbours by range, the second by distance from the plane.
    """
    a, b = np.zeros(3), np.zeros(3)
    for i in range(len(q)):
        for turn in range(2):
            n = 1
            x, y, z, w = u[i, 0], u[i, 1], u[i, 2], q[i]
            gate = gates[0] * w if turn == 0 else gates[1] + gates[2] * w
            xx, xy, xz, yy, yz, zz = x * x, x * y, x * z, y * y, y * z, z * z
            b[0], b[1], b[2] = x * w, y * w, z * w
            for k in range(offsets[i], offsets[i + 1]):
                j = indices[k]
                x, y, z, w = u[j, 0], u[j, 1], u[j, 2], q[j]
                expected = q[i]
                if turn == 1:
                    expected = a[0] * x + a[1] * y + a[2] * z
                if not abs(w - expected) < gate:
                    continue
                n += 1
                xx += x * x
                xy += x * y
                xz += x * z
                yy += y * y
                yz += y * z
                zz += z * z
                b[0] += x * w
                b[1] += y * w
                b[2] += z * w
            det = solve(xx, xy, xz, yy, yz, zz, b, a)
            if n < limits[0] or det < limits[1] * float(n) ** 3:
                break
            if turn == 1:
                planes[i] = a


@kernel
def least_axis(m: Floats, values: Floats, axis: Floats) -> None:
    """Write the eigenvalues of a symmetric matrix, and the eigenvector of the smallest eigenvalue.

    The Jacobi method overwrites the matrix `m` (3, 3).
    """
    v = np.eye(3)
    for _ in range(8):
        for i in range(2):
            for j in range(i + 1, 3):
                if m[i, j] == 0.0:
                    continue
                theta = (m[j, j] - m[i, i]) / (2.0 * m[i, j])
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                if theta < 0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    one, other = m[k, i], m[k, j]
                    m[k, i], m[k, j] = c * one - s * other, s * one + c * other
                for k in range(3):
                    one, other = m[i, k], m[j, k]
                    m[i, k], m[j, k] = c * one - s * other, s * one + c * other
                for k in range(3):
                    one, other = v[k, i], v[k, j]
                    v[k, i], v[k, j] = c * one - s * other, s * one + c * other
    least = 0
    for d in range(3):
        values[d] = m[d, d]
        if m[d, d] < m[least, least]:
            least = d
    for d in range(3):
        axis[d] = v[d, least]


@kernel
def fit_planes(
    places: Floats, offsets: Ints64, indices: Ints32, gate: float, limits: Floats,
    normals: Floats, at: Floats,
) -> None:  # fmt: skip
    """Fit planes to the neighbours of each point; write their normals, towards the origin.

    Each point's projection onto its plane is written to `at`. The first pass uses all neighbours,
    the second only those near the plane. A normal is 0 if the neighbours do not determine a plane.
    """
    m, values, axis, mean = np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.zeros(3)
    for i in range(len(places)):
        for turn in range(2):
            n = 0
            first, second = np.zeros(3), np.zeros((3, 3))
            for k in range(offsets[i] - 1, offsets[i + 1]):
                j = i if k < offsets[i] else np.int64(indices[k])
                if turn == 1:
                    off = 0.0
                    for d in range(3):
                        off += axis[d] * (places[j, d] - mean[d])
                    if not abs(off) < gate:
                        continue
                n += 1
                for d in range(3):  # relative coordinates are precise even far from the origin
                    first[d] += places[j, d] - places[i, d]
                    for e in range(3):
                        second[d, e] += (places[j, d] - places[i, d]) * (
                            places[j, e] - places[i, e]
                        )
            if n < limits[0]:
                break
            for d in range(3):
                mean[d] = places[i, d] + first[d] / n
                for e in range(3):
                    m[d, e] = second[d, e] / n - first[d] / n * first[e] / n
            least_axis(m, values, axis)
            low = min(values[0], values[1], values[2])
            high = max(values[0], values[1], values[2])
            middle = values[0] + values[1] + values[2] - low - high
            if high * middle < limits[1]:
                break
            if turn == 1:
                towards, off = 0.0, 0.0
                for d in range(3):
                    towards -= axis[d] * places[i, d]
                    off += axis[d] * (places[i, d] - mean[d])
                for d in range(3):
                    normals[i, d] = axis[d] if towards >= 0 else -axis[d]
                    at[i, d] = places[i, d] - off * axis[d]


_REACH = 1 << 20


@dataclass(frozen=True, eq=False)
class Links:
    """The neighbours of N points; those of point i are `indices[offsets[i] : offsets[i + 1]]`.

    Parameters
    ----------
    offsets : (N + 1,) int64
    indices : (M,) int32
    """

    offsets: Ints64
    indices: Ints32

    def select(self, keep: NDArray[np.bool_], linked: NDArray[np.bool_]) -> Links:
        """Return the links in mask `linked` (M,) between points in mask `keep` (N,), renumbered."""
        number = np.cumsum(keep) - 1
        sources = np.repeat(keep, np.diff(self.offsets))
        selected = linked & sources & keep[self.indices]
        sums = np.concatenate([[0], np.cumsum(selected)])
        counts = np.diff(sums[self.offsets])[keep]
        offsets = np.concatenate([[0], np.cumsum(counts)])
        return Links(offsets, number[self.indices[selected]].astype(np.int32))

    def touching(
        self, places: Floats, reach: float, at: Floats, normals: Floats, gaps: Floats
    ) -> NDArray[np.bool_]:
        """Return a mask (M,) of the links that are short and do not cross a gap in the surface.

        Parameters
        ----------
        places : (N, 3) argument of `link_points`
        reach : maximum length of a link, in the units of `places`
        at, normals : (N, 3) points and normals of the planes
        gaps : (N,) distance from both planes beyond which a gap separates two points, metres
        """
        keep = np.empty(len(self.indices), np.bool_)
        _touch(places, reach * reach, at, normals, gaps, self.offsets, self.indices, keep)
        return keep


@kernel
def _grid(cells: Ints64, order: Ints64, secret: int, table: Ints64, starts: Ints64) -> int:
    """Insert the runs of points with equal cells into a hash table; return the number of runs."""
    mask = len(table) - 1
    n = 0
    for i in range(len(order)):
        key = cells[order[i]]
        if i > 0 and cells[order[i - 1]] == key:
            continue
        starts[n] = i
        at = hash_key(key, secret) & mask
        while table[at] >= 0:
            at = (at + 1) & mask
        table[at] = n
        n += 1
    starts[n] = len(order)
    return n


@kernel
def _link(
    places: Floats, heights: Floats, cells: Ints64, order: Ints64, secret: int, table: Ints64,
    starts: Ints64, n_cells: int, counts: Ints64, begins: Ints64,
) -> Ints32:  # fmt: skip
    """Return all points' neighbours in one array; write each point's first index and count."""
    mask = len(table) - 1
    indices = np.empty(16 * len(order) + 16, np.int32)
    total = 0
    around = np.empty(27, np.int64)
    span = 2 * _REACH
    for c in range(n_cells):
        key = cells[order[starts[c]]]
        count = 0
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                for dz in range(-1, 2):
                    neighbour = key + (dx * span + dy) * span + dz
                    at = hash_key(neighbour, secret) & mask
                    while table[at] >= 0:
                        if cells[order[starts[table[at]]]] == neighbour:
                            around[count] = table[at]
                            count += 1
                            break
                        at = (at + 1) & mask
        for k in range(starts[c], starts[c + 1]):
            i = order[k]
            x, y, z, h = places[i, 0], places[i, 1], places[i, 2], heights[i]
            begins[i] = total
            for f in range(count):
                a, b = starts[around[f]], starts[around[f] + 1]
                if total + b - a > len(indices):
                    longer = np.empty(2 * len(indices) + b - a, np.int32)
                    longer[:total] = indices[:total]
                    indices = longer
                for m in range(a, b):
                    j = order[m]
                    dx_, dy_, dz_ = places[j, 0] - x, places[j, 1] - y, places[j, 2] - z
                    if dx_ * dx_ + dy_ * dy_ + dz_ * dz_ >= 1.0 or j == i:
                        continue
                    if abs(heights[j] - h) >= 1.0:
                        continue
                    indices[total] = j
                    total += 1
            counts[i] = total - begins[i]
    return indices


@kernel
def _reorder(indices: Ints32, begins: Ints64, offsets: Ints64, out: Ints32) -> None:
    for i in range(len(begins)):
        for k in range(offsets[i + 1] - offsets[i]):
            out[offsets[i] + k] = indices[begins[i] + k]


def link_points(places: Floats, heights: Floats) -> Links:
    """Return all pairs of points whose distance and difference of heights are below 1.

    Parameters
    ----------
    places : (N, 3) positions in units of the reach, within 2^19 of the origin
    heights : (N,) heights in units of the gate
    """
    n = len(places)
    cell = np.clip(np.floor(places), -_REACH + 1, _REACH - 2).astype(np.int64) + _REACH
    cells = (cell[:, 0] * 2 * _REACH + cell[:, 1]) * 2 * _REACH + cell[:, 2]
    order = np.argsort(cells, kind="stable")
    table = np.full(1 << max((2 * n - 1).bit_length(), 1), -1, np.int64)
    starts, secret = np.empty(n + 1, np.int64), secrets.randbits(62)
    n_cells = _grid(cells, order, secret, table, starts)
    counts, begins = np.zeros(n, np.int64), np.zeros(n, np.int64)
    offsets = np.zeros(n + 1, np.int64)
    unordered = _link(places, heights, cells, order, secret, table, starts, n_cells, counts, begins)
    np.cumsum(counts, out=offsets[1:])
    indices = np.empty(int(offsets[-1]), np.int32)
    _reorder(unordered, begins, offsets, indices)
    return Links(offsets, indices)


@kernel
def _touch(
    places: Floats, square: float, at: Floats, normals: Floats, gaps: Floats, offsets: Ints64,
    indices: Ints32, keep: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Write whether the points of each link are close and one lies on the plane of the other."""
    for i in range(len(at)):
        for k in range(offsets[i], offsets[i + 1]):
            j = indices[k]
            x, y, z = (
                places[j, 0] - places[i, 0],
                places[j, 1] - places[i, 1],
                places[j, 2] - places[i, 2],
            )
            if x * x + y * y + z * z > square:
                keep[k] = False
                continue
            dx, dy, dz = at[j, 0] - at[i, 0], at[j, 1] - at[i, 1], at[j, 2] - at[i, 2]
            here = abs(dx * normals[i, 0] + dy * normals[i, 1] + dz * normals[i, 2])
            other = abs(dx * normals[j, 0] + dy * normals[j, 1] + dz * normals[j, 2])
            keep[k] = min(here, other) <= max(gaps[i], gaps[j])


#: Side of the square that has the area of the neighbourhood's disc, in radii.
_SQUARE = math.sqrt(math.pi)
#: Maximum distance between the means of adjacent cells, in cell sides.
_TOUCHING = 2.0
#: Maximum distance of points on a surface from its plane, in voxel sides.
_GAP = 0.25


@dataclass(frozen=True, eq=False)
class Voxels(Surface):
    """The surface of a cloud as V voxels, independent of the order of its points.

    Parameters
    ----------
    cloud : cloud from which the voxels were computed
    axes : (3, 3) principal axes, rows
    centre : (3,) viewpoint of the cloud, or its centroid if it has no viewpoint, metres
    sides : (V,) float32, widths of the voxels, metres
    links : links between voxels that touch, with no gap between their surfaces
    """

    cloud: Cloud
    axes: Floats
    centre: Floats
    sides: Floats32
    links: Links

    @property
    def plain(self) -> Surface:
        """Return a surface that contains the points and normals only."""
        return Surface(self.points, self.normals, self.valid, self.areas, None)


def voxels(cloud: Cloud, p: CloudParameters) -> Voxels:
    """Compute the voxels of a cloud, with normals towards the viewpoint.

    Parameters
    ----------
    cloud : cloud with points in metres

    Raises
    ------
    UselessFrame : If fewer than `minimum_points` points are within range, or fill fewer voxels
    """
    points = select_in_range(cloud, p)
    build = _angular_voxels if cloud.has_viewpoint else _metric_voxels
    return build(cloud, points, p)


def _angular_voxels(cloud: Cloud, points: Floats32, p: CloudParameters) -> Voxels:
    axes, centre = principal_axes(points), np.zeros(3)
    unit = max(p.minimum_range, 1e-9)
    means, side = average_cells(points, axes, centre, True, unit, p)
    _check_count(len(means), cloud, p)
    q, u = means[:, 0] / unit, np.ascontiguousarray(means[:, 1:])
    length = np.sqrt((u * u).sum(axis=1))
    rays = u / length[:, None]
    log_range = -np.log(q)
    reach = (2 * p.radius_px + 1) / _SQUARE * side
    places = rays / reach
    near = link_points(places, log_range / p.range_gate)
    gates = np.array([p.range_gate, p.noise_gate, p.plane_gate])
    limits = np.array([p.minimum_samples, p.minimum_spread * side**4])
    planes = np.zeros((len(q), 3))
    fit_inverse_planes(q, u, near.offsets, near.indices, gates, limits, planes)
    inverse = (planes * rays).sum(axis=1)
    norm = np.sqrt((planes * planes).sum(axis=1))
    within = (inverse * p.maximum_range * 2 > 1) & (inverse * p.minimum_range < 2)
    keep = (norm > 0) & within & (inverse >= p.minimum_cosine * norm)
    inverse, norm = np.where(keep, inverse, 1.0), np.where(keep, norm, 1.0)
    cosines = inverse / norm
    # the tangents of a cell's direction give its solid angle
    a = np.sort(np.abs(rays @ axes.T), axis=1)
    tangents = (a[:, :2] / a[:, 2:]) ** 2
    solid = side * side * ((1 + tangents).prod(axis=1) / (1 + tangents.sum(axis=1)) ** 1.5)
    gaps = np.maximum(p.noise_gate / inverse + p.plane_gate, side * _GAP) / inverse
    return _build(
        cloud, axes, centre, keep, near, places, _TOUCHING * side / reach,
        at=rays / inverse[:, None],
        normals=-planes / norm[:, None],
        areas=solid / (inverse * inverse * cosines),
        sides=side / inverse,
        gaps=gaps,
    )  # fmt: skip


def _metric_voxels(cloud: Cloud, points: Floats32, p: CloudParameters) -> Voxels:
    centre = centroid(points)
    axes = principal_axes((points - centre).astype(np.float32))
    unit = max(float(np.abs(points - centre).max()), 1e-9)
    means, side = average_cells(points, axes, centre, False, unit, p)
    _check_count(len(means), cloud, p)
    at = means[:, 1:] * unit
    reach = (2 * p.radius_px + 1) / _SQUARE * side
    places = at / reach
    near = link_points(places, np.zeros(len(places)))
    limits = np.array([p.minimum_samples, p.minimum_spread * side**4])
    normals, feet = np.zeros_like(at), at.copy()
    fit_planes(at, near.offsets, near.indices, side, limits, normals, feet)
    keep = (normals != 0).any(axis=1)
    # number of cells that a plane crosses per squared side
    crossed = np.where(keep, np.abs(normals @ axes.T).sum(axis=1), 1.0)
    return _build(
        cloud, axes, centre, keep, near, places, _TOUCHING * side / reach,
        at=feet + centre,
        normals=normals,
        areas=side * side / crossed,
        sides=np.full(len(at), side),
        gaps=np.full(len(at), side),
    )  # fmt: skip


def _check_count(n: int, cloud: Cloud, p: CloudParameters) -> None:
    if n < p.minimum_points:
        name = f"{cloud.name}: " if cloud.name else ""
        raise UselessFrame(
            f"{name}its {len(cloud.points)} points fill {n} voxels, but a surface requires "
            f"{p.minimum_points}. Send a cloud that shows more of the scene."
        )


def _build(
    cloud: Cloud, axes: Floats, centre: Floats, keep: NDArray[np.bool_], near: Links,
    places: Floats, reach: float, *, at: Floats, normals: Floats, areas: Floats, sides: Floats,
    gaps: Floats,
) -> Voxels:  # fmt: skip
    return Voxels(
        points=at[keep].astype(np.float32)[None],
        normals=normals[keep].astype(np.float32)[None],
        valid=np.ones((1, int(keep.sum())), np.bool_),
        areas=areas[keep].astype(np.float32)[None],
        camera=None,
        cloud=cloud,
        axes=axes,
        centre=centre,
        sides=sides[keep].astype(np.float32),
        links=near.select(keep, near.touching(places, reach, at, normals, gaps)),
    )
