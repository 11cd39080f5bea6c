"""Agreement of two surfaces under a transform (the evidence of Sec. III-E).

    points of the source, surface of the target, T  --agreements-->  inliers, violations
    Surface  --lookup_target-->  LookupTarget    LookupTarget, point  --nearest_alike-->  index
    Geometry  --plane_view-->  PlaneView         transforms  --plane_agreement-->  PlaneAgreement

Points are projected into the target's camera. A point in front of the target's surface violates
free space, because the target would have observed it. If the target has no viewpoint, points are
looked up by position, and free space is unknown.

Unordered points are stored in a hash table of cubes. Each cube is divided into small cubes that
store at most one point, which bounds the number of points in a cube.

A floor may fill half of a frame, but the coincidence of two floors is weak evidence for a
transform. Therefore, all patches in a plane together count as one patch.
"""

from __future__ import annotations

import math
import secrets
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import cached_per_frame, disjoint_kernel, kernel
from sceneprint.geometry.rigid import inverses
from sceneprint.geometry.surface.camera import (
    BLOCK,
    depth_at,
    depth_of,
    gather,
    gather_pixels,
    growth_at,
    move_all,
    project_all,
    select_inside,
    transpose_points,
)
from sceneprint.geometry.surface.cloud import Ints64, hash_key
from sceneprint.types import (
    Bytes,
    Floats,
    Floats32,
    Geometry,
    Ints32,
    Patches,
    Sphere,
    Surface,
    camera_of,
)

#: Number of small cubes per length of the reach; a cube of the hash table is two reaches wide.
FINENESS = 5.0


class LookupTarget(NamedTuple):
    """A surface prepared for look-ups; its fields are arguments of kernels.

    Parameters
    ----------
    points, normals : (h, w, 3); (1, N, 3) if unordered
    camera : (7,) result of `camera_of`; if unordered, the third number is the reach, and the fourth
        is the secret of the hash table
    heads, chain : index of the first point in each slot, and of the next point in the same slot; -1
        if none
    """

    points: Floats32
    normals: Floats32
    camera: Floats
    heads: Ints32
    chain: Ints32


@kernel
def _slot(i: int, j: int, k: int, slots: int, secret: int) -> int:
    """Return the slot of a cube (i, j, k) in a table with `slots` slots, a power of two."""
    return hash_key((((i << 21) + j) << 21) + k, secret) & (slots - 1)


@kernel
def _fill_table(points: Floats32, cube: float, secret: int, heads: Ints32, chain: Ints32) -> None:
    """Insert all points into the slots of their cubes."""
    for n in range(len(points)):
        slot = _slot(
            int(np.floor(points[n, 0] / cube)), int(np.floor(points[n, 1] / cube)),
            int(np.floor(points[n, 2] / cube)), len(heads), secret,
        )  # fmt: skip
        chain[n] = heads[slot]
        heads[slot] = n


@kernel
def nearest_alike(
    points: Floats32, normals: Floats32, camera: Floats, heads: Ints32, chain: Ints32,
    at: Floats, facing: Floats, least_cosine: float,
) -> tuple[int, float]:  # fmt: skip
    """Return the index of the nearest point within reach with a similar normal, and its squared
    distance; the index is -1 if there is none.
    """
    reach, secret, slots = camera[2], int(camera[3]), len(heads)
    cube = 2.0 * reach
    # a ball with the reach as its radius touches at most eight cubes
    i0 = int(np.floor(at[0] / cube - 0.5))
    j0 = int(np.floor(at[1] / cube - 0.5))
    k0 = int(np.floor(at[2] / cube - 0.5))
    best, least = -1, reach * reach
    for i in range(i0, i0 + 2):
        for j in range(j0, j0 + 2):
            for k in range(k0, k0 + 2):
                n = heads[_slot(i, j, k, slots, secret)]
                while n >= 0:
                    ex, ey, ez = (
                        at[0] - points[0, n, 0], at[1] - points[0, n, 1], at[2] - points[0, n, 2]
                    )  # fmt: skip
                    square = ex * ex + ey * ey + ez * ez
                    # the lower index wins a tie, whatever the order in the slot
                    if square < least or (square == least and best > n):
                        cosine = (
                            facing[0] * normals[0, n, 0]
                            + facing[1] * normals[0, n, 1]
                            + facing[2] * normals[0, n, 2]
                        )
                        if cosine > least_cosine:
                            best, least = n, square
                    n = chain[n]
    return best, least


@kernel
def _first_in_cubes(
    points: Floats32, cube: np.float32, secret: int, table: Ints32, cells: Ints64, firsts: Ints32
) -> int:
    """Write the index of the first point in each cube; return the number of indices.

    The number of slots of `table` is a power of two, and all contain -1; `cells` (N, 3) receives
    the cube of each point.
    """
    mask, count = len(table) - 1, 0
    for n in range(len(points)):
        i, j, k = (
            int(np.floor(points[n, 0] / cube)), int(np.floor(points[n, 1] / cube)),
            int(np.floor(points[n, 2] / cube)),
        )  # fmt: skip
        # hash twice, because three indices may not fit into one number
        slot = hash_key((hash_key((i << 32) ^ j, secret) << 19) + k, secret) & mask
        while True:
            other = table[slot]
            if other < 0:
                table[slot] = count
                cells[count, 0], cells[count, 1], cells[count, 2] = i, j, k
                firsts[count] = n
                count += 1
                break
            if cells[other, 0] == i and cells[other, 1] == j and cells[other, 2] == k:
                break
            slot = (slot + 1) & mask
    return count


def first_per_cube(points: Floats32, cube: float) -> Ints32:
    """Return the ascending indices of the first point in each cube of width `cube`, metres."""
    n = len(points)
    table = np.full(1 << max((2 * n - 1).bit_length(), 1), -1, np.int32)
    cells, firsts = np.empty((n, 3), np.int64), np.empty(n, np.int32)
    secret = secrets.randbits(62)
    count = _first_in_cubes(points, np.float32(cube), secret, table, cells, firsts)
    return firsts[:count].copy()


@cached_per_frame
def lookup_target(surface: Surface, nearest: float, reach: float) -> LookupTarget:
    """Prepare a surface for look-ups.

    Parameters
    ----------
    surface : surface of any kind
    nearest : minimum depth at which points are projected into the surface's camera, metres
    reach : maximum distance to an unordered point, metres
    """
    camera, none = camera_of(surface.camera, nearest), np.zeros(0, np.int32)
    if surface.camera is not None:
        return LookupTarget(surface.points, surface.normals, camera, none, none)
    secret = secrets.randbits(52)  # exact in float64
    camera[2:4] = reach, secret
    points, normals = surface.points[surface.valid], surface.normals[surface.valid]
    indices = first_per_cube(points, reach / FINENESS)
    points, normals = points[indices], normals[indices]
    slots = 1 << max(int(2 * len(points) - 1).bit_length(), 1)
    heads, chain = np.full(slots, -1, np.int32), np.full(len(points), -1, np.int32)
    _fill_table(points, 2.0 * reach, secret, heads, chain)
    return LookupTarget(points[None], normals[None], camera, heads, chain)


def thin_points(surface: Surface, most: int, cube: float = 0.0) -> Surface:
    """Reduce a surface's unordered points to at most `most`, evenly distributed.

    Parameters
    ----------
    surface : surface without a camera
    most : maximum number of points, at least 1
    cube : width of the cubes of the first grid, metres; 0 selects 1/4096 of the extent

    Returns
    -------
    surface : the first point in each cube of a sufficiently coarse grid, or all valid points if
        there are no more than `most`
    """
    points = surface.points[surface.valid]
    indices = np.arange(len(points), dtype=np.int32)
    cube = cube or float(np.ptp(points, axis=0).max(initial=0.0)) / 4096
    while len(indices) > most:
        # cubes that are wider by a factor of sqrt(2) halve the number of cubes that a surface
        # occupies
        cube *= max((len(indices) / most) ** 0.5, 1.02)
        indices = first_per_cube(points, cube) if cube > 0 else indices[:1]
    return Surface(
        points[indices][None],
        surface.normals[surface.valid][indices][None],
        np.ones((1, len(indices)), np.bool_),
        surface.areas[surface.valid][indices][None],
        None,
    )


#: Number of pixels in the surface of a depth image: 160 x 120.
DEPTH_PIXELS = 19_200


@dataclass(frozen=True)
class OverlapParameters:
    """Parameters of agreement; lengths grow by max(1, (z / `reference_depth`)^`growth`)."""

    surface_tolerance: float = 0.05  #: maximum distance from the target point's plane, metres
    point_tolerance: float = 0.15  #: maximum distance from the target's point, metres
    normal_cosine: float = 0.7  #: minimum cosine between normals that agree
    free_space_margin: float = 0.1  #: minimum distance of a violation from the surface, metres
    reference_depth: float = 5.0**0.5  #: depth from which tolerances grow, metres
    edge_px: int = 2  #: minimum distance of a violating point from a pixel that agrees, pixels
    stride: int = 5  #: stride of the pixels that are looked up
    growth: int = 2  #: exponent of noise growth: 2 for a depth sensor, 1 or 0 for a scanner
    nearest: float = 0.1  #: minimum depth of a point in the target's camera, metres


@dataclass(frozen=True)
class Overlap:
    """Numbers of a source's points that agree with a target and that violate its free space."""

    points: int  #: total number of points
    inliers: int  #: points on the target's surface with similar normals
    violations: int | None  #: points in the target's free space; None without a viewpoint

    @property
    def violation_share(self) -> float:
        """Return the share of violations among violations and inliers."""
        violations = self.violations or 0
        return violations / max(self.inliers + violations, 1)


@kernel
def _copy_valid(
    points: Floats32, normals: Floats32, valid: NDArray[np.bool_],
    rows: tuple[int, int], columns: tuple[int, int], out: Floats32,
) -> int:  # fmt: skip
    """Copy the points and normals of valid pixels to `out`, line by line; return their number.

    `rows` and `columns` are pairs of the first index and the step.
    """
    count = 0
    for y in range(rows[0], valid.shape[0], rows[1]):
        for x in range(columns[0], valid.shape[1], columns[1]):
            if valid[y, x]:
                for k in range(3):
                    out[count, k], out[count, 3 + k] = points[y, x, k], normals[y, x, k]
                count += 1
    return count


@cached_per_frame
def sample_points(surface: Surface, stride: int) -> Floats32:
    """Return the valid points and normals of every `stride`-th row and column, (N, 6) float32.

    Unless the stride is 1, it is increased for spheres with more than `DEPTH_PIXELS` pixels, so
    that frames of all sensors contribute about the same number of points.
    """
    if surface.spread is not None and stride > 1:
        points, normals = surface.spread.points[0], surface.spread.normals[0]
        each = max(round(stride * stride * len(points) / DEPTH_PIXELS), 1)
        both = np.concatenate([points, normals], axis=1)
        return np.ascontiguousarray(both[each // 2 :: each])
    if isinstance(surface.camera, Sphere) and stride > 1:
        more = surface.camera.width * surface.camera.height / DEPTH_PIXELS
        stride = round(stride * max(more, 1.0) ** 0.5)
    rows = columns = (stride // 2, stride)
    if surface.camera is None:
        rows, columns = (0, 1), (0, stride * stride)
    shape = surface.valid[rows[0] :: rows[1], columns[0] :: columns[1]].shape
    both = np.empty((shape[0] * shape[1], 6), np.float32)
    count = _copy_valid(surface.points, surface.normals, surface.valid, rows, columns, both)
    return both[:count].copy()


#: Verdicts on a point: not observed by the target, on its surface, or in its free space.
UNKNOWN, AGREES, VIOLATES = 0, 1, 2
#: Preliminary verdict of `_compare`; `_saw_through` replaces it.
_BEFORE = 3


@disjoint_kernel
def _compare(
    source: Floats32, start: int, places: Ints32, count: int, points: Floats32, normals: Floats32,
    camera: Floats, moved: Floats, pixels: Ints32, T: Floats, tolerances: Floats, verdicts: Bytes,
) -> None:  # fmt: skip
    """Write the verdict of each point's pixel; `_BEFORE` if the point lies in front of its surface.

    `places` are indices of `source` (6, N) relative to `start`; `moved` (4, n) and `pixels` (2, n)
    are transformed coordinates, depths and pixels of these points.
    """
    on_surface, on_point, least_cosine = tolerances[0], tolerances[1], tolerances[2]
    margin, reference, power = tolerances[3], tolerances[4], tolerances[6]
    xx, xy, xz, yx, yy, yz = T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2]
    zx, zy, zz = T[2, 0], T[2, 1], T[2, 2]
    nxs, nys, nzs, width, kind = source[3], source[4], source[5], points.shape[1], camera[0]
    shown, facing = points.reshape(-1), normals.reshape(-1)
    for i in range(count):
        at = np.uint64(pixels[1, i] * width + pixels[0, i]) * np.uint64(3)
        a, b, c = shown[at], shown[at + np.uint64(1)], shown[at + np.uint64(2)]
        mx, my, mz = facing[at], facing[at + np.uint64(1)], facing[at + np.uint64(2)]
        seen, depth = depth_of(kind, a, b, c), moved[3, i]
        dx, dy, dz = moved[0, i] - a, moved[1, i] - b, moved[2, i] - c
        plane = abs(dx * mx + dy * my + dz * mz)
        grow = growth_at(depth, reference, power)
        own = np.uint64(start + places[i])
        nx, ny, nz = nxs[own], nys[own], nzs[own]
        cosine = (
            (xx * nx + xy * ny + xz * nz) * mx
            + (yx * nx + yy * ny + yz * nz) * my
            + (zx * nx + zy * ny + zz * nz) * mz
        )
        gate = on_point * grow
        agrees = (plane < on_surface * grow) & (cosine > least_cosine)
        agrees = agrees & (dx * dx + dy * dy + dz * dz < gate * gate)
        before = (depth - seen < -margin * grow) & (plane > margin * grow)
        verdict = AGREES if agrees else (_BEFORE if before else UNKNOWN)
        verdicts[i] = verdict if seen > 0 else UNKNOWN


@kernel
def _saw_through(
    points: Floats32, camera: Floats, u: int, v: int, depth: float, tolerances: Floats
) -> bool:
    """Return whether a point lies in front of the surfaces of its pixel and of all adjacent pixels.

    At an edge, a neighbouring pixel may show the surface of the point.
    """
    height, width, edge = points.shape[0], points.shape[1], int(tolerances[5])
    nearest = depth_at(camera, points, v, u)
    for line in range(max(v - edge, 0), min(v + edge + 1, height)):
        for column in range(u - edge, u + edge + 1):
            beside = column
            if column < 0 or column >= width:
                if camera[0] == 0 or camera[6] == 0:
                    continue
                beside = column % width  # closed spheres have neighbours across the seam
            there = depth_at(camera, points, line, beside)
            if there > 0:
                nearest = min(nearest, there)
    margin: float = tolerances[3] * growth_at(depth, tolerances[4], tolerances[6])
    return depth < nearest - margin


@kernel
def _look_up_seen(
    source: Floats32, points: Floats32, normals: Floats32, camera: Floats, T: Floats,
    tolerances: Floats, verdicts: Bytes,
) -> None:  # fmt: skip
    """Write the verdicts (N,) of a target with a camera on points (6, N) under T."""
    height, width = points.shape[0], points.shape[1]
    moved, seen, inside = np.empty((3, BLOCK)), np.empty((3, BLOCK)), np.empty((4, BLOCK))
    places, pixels = np.empty(BLOCK, np.int32), np.empty((2, BLOCK), np.int32)
    own = np.empty(BLOCK, np.uint8)
    verdicts[:] = UNKNOWN
    for start in range(0, source.shape[1], BLOCK):
        count = min(BLOCK, source.shape[1] - start)
        move_all(source, T, start, count, moved)
        project_all(camera, moved, count, seen)
        count = select_inside(seen, count, 0.0, width, 0.0, height, places)
        gather(moved, places, count, inside)
        gather(seen[2:], places, count, inside[3:])
        gather_pixels(seen, places, count, pixels)
        _compare(
            source, start, places, count, points, normals, camera, inside, pixels, T, tolerances,
            own,
        )  # fmt: skip
        for i in range(count):
            verdict = own[i]
            if verdict == _BEFORE:
                u, v = pixels[0, i], pixels[1, i]
                through = _saw_through(points, camera, u, v, inside[3, i], tolerances)
                verdict = VIOLATES if through else UNKNOWN
            verdicts[start + places[i]] = verdict


@kernel
def _look_up_near(
    source: Floats32, points: Floats32, normals: Floats32, camera: Floats, heads: Ints32,
    chain: Ints32, T: Floats, tolerances: Floats, verdicts: Bytes,
) -> None:  # fmt: skip
    """Write AGREES or UNKNOWN for each of the points (N, 6) under T; the target is unordered.

    `camera` is the field of `LookupTarget`.
    """
    at, facing = np.empty(3), np.empty(3)
    for i in range(len(source)):
        verdicts[i] = UNKNOWN
        for a in range(3):
            at[a] = T[a, 3]
            facing[a] = 0.0
            for b in range(3):
                at[a] += T[a, b] * source[i, b]
                facing[a] += T[a, b] * source[i, 3 + b]
        n, _ = nearest_alike(points, normals, camera, heads, chain, at, facing, tolerances[2])
        if n < 0:
            continue
        plane = 0.0
        for a in range(3):
            plane += (at[a] - points[0, n, a]) * normals[0, n, a]
        if abs(plane) < tolerances[0]:
            verdicts[i] = AGREES


@kernel
def _look_up(
    source: Floats32, transposed: Floats32, points: Floats32, normals: Floats32, camera: Floats,
    heads: Ints32, chain: Ints32, T: Floats, tolerances: Floats, verdicts: Bytes,
) -> None:  # fmt: skip
    """Write the verdicts (N,) of a target on points (N, 6) under T; `transposed` is (6, N)."""
    if camera[0] == 2:
        _look_up_near(source, points, normals, camera, heads, chain, T, tolerances, verdicts)
    else:
        _look_up_seen(transposed, points, normals, camera, T, tolerances, verdicts)


@kernel
def weigh_overlap(
    source: Floats32, weights: Floats32, points: Floats32, normals: Floats32, camera: Floats,
    heads: Ints32, chain: Ints32, T: Floats, tolerances: Floats,
) -> tuple[float, float]:  # fmt: skip
    """Return the total weights of points (N, 6) that agree with a target and violate it under T."""
    out = np.empty((1, 2))
    _weigh_all(
        source, weights, points, normals, camera, heads, chain, T.reshape((1, 4, 4)), tolerances,
        out,
    )  # fmt: skip
    return out[0, 0], out[0, 1]


@kernel
def _weigh_all(
    source: Floats32, weights: Floats32, points: Floats32, normals: Floats32, camera: Floats,
    heads: Ints32, chain: Ints32, transforms: Floats, tolerances: Floats, out: Floats,
) -> None:  # fmt: skip
    """Write the total weights of inliers and of violations (n, 2) under each of n transforms."""
    transposed, verdicts = transpose_points(source, 1), np.empty(len(source), np.uint8)
    for k in range(len(transforms)):
        _look_up(
            source, transposed, points, normals, camera, heads, chain, transforms[k], tolerances,
            verdicts,
        )  # fmt: skip
        inliers, violations = 0.0, 0.0
        for i in range(len(source)):
            inliers += weights[i] if verdicts[i] == AGREES else 0.0
            violations += weights[i] if verdicts[i] == VIOLATES else 0.0
        out[k, 0], out[k, 1] = inliers, violations


@lru_cache(maxsize=32)
def tolerances(p: OverlapParameters) -> Floats:
    """Return the parameters as an array for kernels."""
    return np.array(
        [
            p.surface_tolerance, p.point_tolerance, p.normal_cosine,
            p.free_space_margin, p.reference_depth, p.edge_px, p.growth,
        ]
    )  # fmt: skip


def overlap_target(surface: Surface, p: OverlapParameters) -> LookupTarget:
    """Prepare a surface for `weigh_overlap`."""
    return lookup_target(surface, p.nearest, p.point_tolerance)


def agreements(
    source: Floats32,
    target: Surface,
    transforms: Floats,
    p: OverlapParameters,
    weights: Floats32 | None = None,
) -> Floats:
    """Return the total weights of inliers and violations, (n, 2), under n transforms: Sec. III-E.

    Parameters
    ----------
    source : (N, 6) float32 result of `sample_points`
    target : (h, w) surface; or unordered points, for which there are no violations
    transforms : (n, 4, 4) T_target_source
    weights : (N,) weights of the points; None gives each point a weight of 1
    """
    out = np.zeros((len(transforms), 2))
    w = np.ones(len(source), np.float32) if weights is None else weights
    t = overlap_target(target, p)
    _weigh_all(source, w, *t, np.ascontiguousarray(transforms), tolerances(p), out)
    return out


def look_up(
    source: Floats32, target: LookupTarget, T_target_source: Floats, tolerances: Floats
) -> Bytes:
    """Return a target's verdict on each point, (N,) uint8: UNKNOWN, AGREES or VIOLATES.

    Parameters
    ----------
    source : (N, 6) float32
    target : result of `overlap_target`
    tolerances : result of `tolerances`
    """
    verdicts = np.empty(len(source), np.uint8)
    T = np.ascontiguousarray(T_target_source)
    _look_up(source, np.ascontiguousarray(source.T), *target, T, tolerances, verdicts)
    return verdicts


@kernel
def count_verdicts(
    source: Floats32, points: Floats32, normals: Floats32, camera: Floats, heads: Ints32,
    chain: Ints32, T: Floats, tolerances: Floats, agree: Ints32, violate: Ints32,
) -> int:  # fmt: skip
    """Add a target's verdicts on points (N, 6) to the counts; return the number that agree."""
    verdicts, agreeing = np.empty(len(source), np.uint8), 0
    transposed = transpose_points(source, 1)
    _look_up(source, transposed, points, normals, camera, heads, chain, T, tolerances, verdicts)
    for i in range(len(source)):
        agree[i] += verdicts[i] == AGREES
        violate[i] += verdicts[i] == VIOLATES
        agreeing += verdicts[i] == AGREES
    return agreeing


def overlap_counts(
    source: Floats32, target: Surface, T_target_source: Floats, p: OverlapParameters
) -> Overlap:
    """Count the agreeing and violating points under a transform; see `agreements`."""
    inliers, violations = agreements(source, target, T_target_source[None], p)[0].tolist()
    has_viewpoint = target.camera is not None
    return Overlap(len(source), round(inliers), round(violations) if has_viewpoint else None)


@dataclass(frozen=True)
class PlaneParameters:
    """Limits within which two patches lie in the same plane."""

    coplanar: float = math.radians(15.0)  #: maximum angle between normals
    same_plane: float = 0.06  #: maximum distance of a patch from another patch's plane, metres


@dataclass(frozen=True, eq=False)
class PlaneView:
    """The patches of a frame, weighted so that all planes have equal weights.

    Parameters
    ----------
    points : (P, 6) float32, means and normals of the patches
    weights : (P,) float32; the weights of all patches in a plane have the sum 1
    """

    surface: Surface
    patches: Patches
    points: Floats32
    weights: Floats32


@dataclass(frozen=True, eq=False)
class PlaneAgreement:
    """Agreement of two frames under each of n transforms, with equal weights for all planes.

    Parameters
    ----------
    share : (n,) share of both frames that agrees, 0 to 1
    violations : (n,) violations of free space as a share of agreements and violations, 0 to 1
    """

    share: Floats
    violations: Floats


@kernel
def _count_coplanar(
    means: Floats, normals: Floats, cosine: float, apart: float, out: Ints32
) -> None:
    """Write how many patches lie in each patch's plane; means and normals are (3, P)."""
    x, y, z, nx, ny, nz = means[0], means[1], means[2], normals[0], normals[1], normals[2]
    for i in range(len(out)):
        ix, iy, iz, a, b, c = x[i], y[i], z[i], nx[i], ny[i], nz[i]
        count = 0
        for j in range(len(out)):
            offset = (x[j] - ix) * a + (y[j] - iy) * b + (z[j] - iz) * c
            alike = nx[j] * a + ny[j] * b + nz[j] * c > cosine
            count += 1 if alike & (abs(offset) < apart) else 0
        out[i] = max(count, 1)


def plane_weights(patches: Patches, p: PlaneParameters) -> Floats32:
    """Return the weights (P,) of patches: the inverse of the number of patches in their plane."""
    counts = np.zeros(len(patches), np.int32)
    means, normals = (np.ascontiguousarray(x.T) for x in (patches.means, patches.normals))
    _count_coplanar(means, normals, math.cos(p.coplanar), p.same_plane, counts)
    weights: Floats32 = (1.0 / counts).astype(np.float32)
    return weights


@cached_per_frame
def plane_view(geometry: Geometry, p: PlaneParameters) -> PlaneView:
    """Prepare a frame for `plane_agreement`."""
    patches = geometry.patches
    points = np.concatenate([patches.means, patches.normals], axis=1).astype(np.float32)
    return PlaneView(geometry.surface, patches, points, plane_weights(patches, p))


def plane_agreement(
    query: PlaneView, match: PlaneView, transforms: Floats, p: OverlapParameters
) -> PlaneAgreement:
    """Return the agreement of two frames under transforms (n, 4, 4) T_match_query."""
    there = agreements(query.points, match.surface, transforms, p, query.weights)
    back = agreements(match.points, query.surface, inverses(transforms), p, match.weights)
    both = there + back
    total = float(query.weights.sum(dtype=float) + match.weights.sum(dtype=float))
    return PlaneAgreement(both[:, 0] / total, both[:, 1] / np.maximum(both.sum(axis=1), 1e-9))
