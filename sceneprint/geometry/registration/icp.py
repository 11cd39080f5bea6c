"""Refinement of a transform by point-to-plane ICP, and its covariance (Sec. III-E).

    points of the source, surface of the target, T  --refine-->  T, information
    refinements in both directions, T  --pair_covariance-->  covariance (6, 6)
    covariance  --free_directions-->  directions in which the surfaces can slide
    covariance, R, lever  --transform_covariance-->  covariance in another frame

Projective point-to-plane alignment compares each point with the plane that the target observed in
the direction of that point. The depth errors of structured-light sensors grow with z^2, so distant
points get a lower weight. If the target has no viewpoint, a point is compared with the plane of the
nearest point with a similar normal.

The error of T_parent_child is (x, y, z, rx, ry, rz), as in ROS's PoseWithCovariance: T_true =
[exp(r) R, t + x] to first order, with x in metres along the parent's axes, and the rotation vector
r in radians about them. The inverse of the Gauss-Newton information is not a covariance, because
the errors of neighbouring pixels are correlated: docs/uncertainty.md measures the effective number
of points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import disjoint_kernel, kernel
from sceneprint.geometry.registration.overlap import (
    lookup_target,
    nearest_alike,
    sample_points,
)
from sceneprint.geometry.rigid import (
    PoseAverage,
    apply_rotation,
    pose_spread,
    rotation_angle,
    solve_positive,
)
from sceneprint.geometry.surface.camera import (
    BLOCK,
    depth_of,
    gather,
    gather_pixels,
    growth_at,
    move_all,
    project_all,
    select_inside,
    transpose_points,
)
from sceneprint.types import PINHOLE, Floats, Floats32, Ints32, Ints64, Surface, kind_of


@dataclass(frozen=True)
class RefinementParameters:
    """Parameters of a refinement."""

    stride: int  #: stride of the source's pixels
    iterations: int  #: number of Gauss-Newton steps
    first_gate: float  #: maximum distance of a point from its plane in the first step, metres
    last_gate: float  #: maximum distance of a point from its plane in the last step, metres
    normal_cosine: float = 0.7  #: minimum cosine between corresponding normals
    reference_depth: float = 5.0**0.5  #: gates grow by max(1, (z / reference_depth)^growth)
    minimum_points: int = 20  #: minimum number of corresponding points
    growth: int = 2  #: exponent of noise growth: 2 for a depth sensor, 1 or 0 for a scanner
    weight_depth: float = 1.0  #: depth at which weights start to fall as 1 / z^4, metres
    nearest: float = 0.1  #: minimum depth of a point in the target's camera, metres
    reach: float = 0.25  #: maximum distance to a point of an unordered target, metres
    thinning: int = 1  #: stride of the points that the first iterations use
    last_iterations: int = 2  #: number of iterations that use all points


#: Parameters for a quick check of a hypothesis.
QUICK = RefinementParameters(10, 4, 0.25, 0.15)
#: Parameters for hypotheses, with few points and wide gates.
COARSE = RefinementParameters(5, 8, 0.25, 0.08)
#: Parameters for the best hypotheses.
FINE = RefinementParameters(2, 8, 0.08, 0.03, thinning=4)


@dataclass(frozen=True, eq=False)
class Refinement:
    """The result of a refinement.

    Parameters
    ----------
    T : (4, 4) T_target_source
    information : (6, 6) J^T W J per point, in rotation (radians) and translation (metres) about the
        target's origin
    points : number of points in the last step
    mean_square : mean weighted square of the residuals of the points, a measure of the noise
    """

    T: Floats
    information: Floats
    points: int
    mean_square: float


@kernel
def _add_point(
    A: Floats, g: Floats, row: Floats, x: float, y: float, z: float,
    mx: float, my: float, mz: float, residual: float, weight: float,
) -> None:  # fmt: skip
    """Add a transformed point (x, y, z) and a plane with normal m to the normal equations."""
    row[0], row[1], row[2] = y * mz - z * my, z * mx - x * mz, x * my - y * mx
    row[3], row[4], row[5] = mx, my, mz
    for a in range(6):
        wa = weight * row[a]
        g[a] -= wa * residual
        for b in range(a + 1):
            A[a, b] += wa * row[b]


@disjoint_kernel
def _nearest_in_line(
    points: Floats32, width: int, column: Ints32, line: Ints32, beside: int,
    x: Floats, y: Floats, z: Floats, count: int, nearest: Floats, best: Ints32,
) -> None:  # fmt: skip
    """Compare each point with three pixels, `beside` lines from its own; update its nearest pixel.

    `nearest` are squared distances, and `best` indices of pixels in row-major order.
    """
    for i in range(count):
        start, middle = (line[i] + beside) * width, column[i]
        # in a closed sphere, the last column adjoins the first column
        first = start + (middle - 1 if middle > 0 else width - 1)
        second = start + middle
        third = start + (middle + 1 if middle < width - 1 else 0)
        least, best_pixel = nearest[i], best[i]
        for place in (first, second, third):
            at = np.uint64(place) * np.uint64(3)
            a, b, c = points[at], points[at + np.uint64(1)], points[at + np.uint64(2)]
            ex, ey, ez = x[i] - a, y[i] - b, z[i] - c
            square = ex * ex + ey * ey + ez * ez
            nearer = (square < least) & ((c != 0) | (a != 0) | (b != 0))
            least = square if nearer else least
            best_pixel = np.int32(place) if nearer else best_pixel
        nearest[i], best[i] = least, best_pixel


@disjoint_kernel
def _nearest_on_rays(
    points: Floats32, width: int, camera: Floats, column: Ints32, line: Ints32,
    x: Floats, y: Floats, z: Floats, count: int, nearest: Floats, best: Ints32,
) -> None:  # fmt: skip
    """Write the nearest of the nine pinhole pixels around each point; see `_nearest_in_line`.

    A pixel's point lies on the pixel's ray, so only depths are looked up.
    """
    across, down, cx, cy = 1.0 / camera[2], 1.0 / camera[3], camera[4], camera[5]
    for i in range(count):
        least, best_pixel = 1e9, np.int32(-1)
        middle = line[i] * width + column[i]
        xn, yn = (column[i] - cx) * across, (line[i] - cy) * down
        for v in (-1, 0, 1):
            for u in (-1, 0, 1):
                place = middle + v * width + u
                depth = points[np.uint64(place) * np.uint64(3) + np.uint64(2)]
                ex, ey = x[i] - (xn + u * across) * depth, y[i] - (yn + v * down) * depth
                ez = z[i] - depth
                square = ex * ex + ey * ey + ez * ez
                nearer = (square < least) & (depth != 0)
                least = square if nearer else least
                best_pixel = np.int32(place) if nearer else best_pixel
        nearest[i], best[i] = least, best_pixel


@disjoint_kernel
def _weigh_points(
    source: Floats32, start: int, places: Ints32, points: Floats32, normals: Floats32,
    x: Floats, y: Floats, z: Floats, depth: Floats, nearest: Floats, best: Ints32, T: Floats,
    gate: float, numbers: Floats, count: int, rows: Floats, weights: Floats,
) -> None:  # fmt: skip
    """Write the Jacobians and residuals (7, n) of points at their nearest pixels, and the weights.

    A weight is negative if the point and the pixel do not correspond.
    """
    least_cosine, reference, power = numbers[3], numbers[4], numbers[6]
    per_depth = numbers[7]
    xx, xy, xz, yx, yy, yz = T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2]
    zx, zy, zz = T[2, 0], T[2, 1], T[2, 2]
    for i in range(count):
        at = np.uint64(max(best[i], 0)) * np.uint64(3)
        mx, my, mz = normals[at], normals[at + np.uint64(1)], normals[at + np.uint64(2)]
        residual = (
            (x[i] - points[at]) * mx + (y[i] - points[at + np.uint64(1)]) * my
            + (z[i] - points[at + np.uint64(2)]) * mz
        )  # fmt: skip
        limit = gate * growth_at(depth[i], reference, power)
        own = np.uint64(start + places[i])
        nx, ny, nz = source[3, own], source[4, own], source[5, own]
        cosine = (
            (xx * nx + xy * ny + xz * nz) * mx
            + (yx * nx + yy * ny + yz * nz) * my
            + (zx * nx + zy * ny + zz * nz) * mz
        )
        tukey = 1.0 - (residual / limit) ** 2
        far = depth[i] * per_depth
        weight = tukey * tukey / (0.25 + (source[6, own] + far**4) * 0.125)
        apart = (best[i] < 0) | (nearest[i] > 9.0 * limit * limit)
        apart = apart | (abs(residual) > limit) | (cosine < least_cosine)
        weights[i] = -1.0 if apart else weight
        rows[0, i] = y[i] * mz - z[i] * my
        rows[1, i] = z[i] * mx - x[i] * mz
        rows[2, i] = x[i] * my - y[i] * mx
        rows[3, i], rows[4, i], rows[5, i], rows[6, i] = mx, my, mz, residual


@disjoint_kernel
def _select_compatible(weights: Floats, count: int, places: Ints32) -> int:
    """Write the indices of all non-negative weights; return their number."""
    n_compatible = 0
    for i in range(count):
        places[n_compatible] = i
        n_compatible += 1 if weights[i] >= 0 else 0
    return n_compatible


@disjoint_kernel
def _add_all(rows: Floats, weights: Floats, places: Ints32, count: int, sums: Floats) -> None:
    """Add points to the normal equations, in order.

    `sums` (28,) contains the lower triangle of A by rows, -g and the weighted squares. The loop
    uses scalar variables: numba stores only scalars in registers.
    """
    r0, r1, r2, r3, r4, r5, r6 = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6]
    aa, ba, bb, ca, cb, cc = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    da, db, dc, dd = sums[6], sums[7], sums[8], sums[9]
    ea, eb, ec, ed, ee = sums[10], sums[11], sums[12], sums[13], sums[14]
    fa, fb, fc, fd, fe, ff = sums[15], sums[16], sums[17], sums[18], sums[19], sums[20]
    ga, gb, gc, gd, ge, gf, gg = (
        sums[21], sums[22], sums[23], sums[24], sums[25], sums[26], sums[27]
    )  # fmt: skip
    for k in range(count):
        i = np.uint64(places[k])
        a, b, c, d, e, f, g = r0[i], r1[i], r2[i], r3[i], r4[i], r5[i], r6[i]
        weight = weights[i]
        w = weight * a
        aa, ga = aa + w * a, ga + w * g
        w = weight * b
        ba, bb, gb = ba + w * a, bb + w * b, gb + w * g
        w = weight * c
        ca, cb, cc, gc = ca + w * a, cb + w * b, cc + w * c, gc + w * g
        w = weight * d
        da, db, dc, dd, gd = da + w * a, db + w * b, dc + w * c, dd + w * d, gd + w * g
        w = weight * e
        ea, eb, ec, ed, ee = ea + w * a, eb + w * b, ec + w * c, ed + w * d, ee + w * e
        ge += w * g
        w = weight * f
        fa, fb, fc, fd, fe = fa + w * a, fb + w * b, fc + w * c, fd + w * d, fe + w * e
        ff, gf = ff + w * f, gf + w * g
        gg += weight * g * g
    for k, value in enumerate(
        (aa, ba, bb, ca, cb, cc, da, db, dc, dd, ea, eb, ec, ed, ee, fa, fb, fc, fd, fe, ff,
         ga, gb, gc, gd, ge, gf, gg)
    ):  # fmt: skip
        sums[k] = value


@kernel
def _accumulate(
    source: Floats32, points: Floats32, normals: Floats32, camera: Floats, T: Floats, gate: float,
    numbers: Floats, room: Floats, indices: Ints32, A: Floats, g: Floats,
) -> tuple[int, float]:  # fmt: skip
    """Write the normal equations of a Gauss-Newton step on points (7, N).

    Return the number of points used and the sum of their weighted squared residuals. The terms of a
    block are computed together, so that the loop can be vectorized, and summed in order.
    """
    height, width = points.shape[0], points.shape[1]
    shown, facing = points.reshape(-1), normals.reshape(-1)
    # in a closed sphere, the first column adjoins the last column
    edge = 0.0 if camera[0] == 1 and camera[6] > 0 else 1.0
    moved, seen, inside, rows = room[:3], room[3:6], room[6:10], room[10:17]
    nearest, weights, sums, used = room[17], room[18], np.zeros(28), 0
    places, best, pixels = indices[0], indices[1], indices[2:]
    for start in range(0, source.shape[1], BLOCK):
        count = min(BLOCK, source.shape[1] - start)
        move_all(source, T, start, count, moved)
        project_all(camera, moved, count, seen)
        count = select_inside(seen, count, edge, width - edge, 1.0, height - 1.0, places)
        gather(moved, places, count, inside)
        gather(seen[2:], places, count, inside[3:])
        gather_pixels(seen, places, count, pixels)
        x, y, z = inside[0], inside[1], inside[2]
        if camera[0] == 0:
            _nearest_on_rays(
                shown, width, camera, pixels[0], pixels[1], x, y, z, count, nearest, best
            )
        else:
            nearest[:count] = 1e9
            best[:count] = -1
            for beside in range(-1, 2):
                _nearest_in_line(
                    shown, width, pixels[0], pixels[1], beside, x, y, z, count, nearest, best
                )
        _weigh_points(
            source, start, places, shown, facing, x, y, z, inside[3], nearest, best, T, gate,
            numbers, count, rows, weights,
        )  # fmt: skip
        count = _select_compatible(weights, count, places)
        _add_all(rows, weights, places, count, sums)
        used += count
    k = 0
    for a in range(6):
        for b in range(a + 1):
            A[a, b] = sums[k]
            k += 1
    for a in range(6):
        g[a] = -sums[21 + a]
    return used, sums[27]


@kernel
def _accumulate_near(
    source: Floats32, step: int, points: Floats32, normals: Floats32, camera: Floats,
    heads: Ints32, chain: Ints32, T: Floats, gate: float, numbers: Floats, A: Floats, g: Floats,
) -> tuple[int, float]:  # fmt: skip
    """Write the normal equations for a target with unordered points; see `_accumulate`."""
    least_cosine, kind, per_depth = numbers[3], numbers[8], numbers[7]
    row, at, facing = np.zeros(6), np.empty(3), np.empty(3)
    used, squares = 0, 0.0
    for i in range(0, len(source), step):
        for a in range(3):
            at[a] = T[a, 3]
            facing[a] = 0.0
            for b in range(3):
                at[a] += T[a, b] * source[i, b]
                facing[a] += T[a, b] * source[i, 3 + b]
        n, _ = nearest_alike(points, normals, camera, heads, chain, at, facing, least_cosine)
        if n < 0:
            continue
        mx, my, mz = normals[0, n, 0], normals[0, n, 1], normals[0, n, 2]
        residual = (
            (at[0] - points[0, n, 0]) * mx + (at[1] - points[0, n, 1]) * my
            + (at[2] - points[0, n, 2]) * mz
        )  # fmt: skip
        if abs(residual) > gate:
            continue
        tukey = 1.0 - (residual / gate) ** 2
        near = np.float32(depth_of(kind, source[i, 0], source[i, 1], source[i, 2]) * per_depth)
        weight = tukey * tukey / (0.25 + near**4 * 0.25)
        _add_point(A, g, row, at[0], at[1], at[2], mx, my, mz, residual, weight)
        squares += weight * residual * residual
        used += 1
    return used, squares


@kernel
def _refine_one(
    source: Floats32, whole: Floats32, few: Floats32, points: Floats32, normals: Floats32,
    camera: Floats, heads: Ints32, chain: Ints32, T: Floats, numbers: Floats,
    room: Floats, indices: Ints32, information: Floats,
) -> tuple[int, float]:  # fmt: skip
    """Refine T by Gauss-Newton steps.

    Return the number of points in the last step (0 if a step failed), and their mean weighted
    squared residual before that step. `whole` and `few` are the points of the last and of the first
    iterations.
    """
    iterations, minimum = int(numbers[0]), int(numbers[5])
    thinned = iterations - int(numbers[10])
    A, g, step = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    before, turn = np.zeros((3, 3)), np.zeros((3, 3))
    used, squares = 0, 0.0
    for iteration in range(iterations):
        share = iteration / max(iterations - 1, 1)
        gate = numbers[1] * (numbers[2] / numbers[1]) ** share
        each = int(numbers[9]) if iteration < thinned else 1
        A[:] = 0.0
        g[:] = 0.0
        if camera[0] == 2:
            used, squares = _accumulate_near(
                source, each, points, normals, camera, heads, chain, T, gate, numbers, A, g
            )
        else:
            own = few if iteration < thinned else whole
            used, squares = _accumulate(
                own, points, normals, camera, T, gate, numbers, room, indices, A, g
            )
        for a in range(6):
            for b in range(a):
                A[b, a] = A[a, b]
        if used * each < minimum:
            return 0, 0.0
        for a in range(6):
            for b in range(6):
                information[a, b] = A[a, b] / used
            # damping keeps T fixed in directions that no point constrains
            A[a, a] += 1e-6 * used
        if not solve_positive(A, g, step):
            return 0, 0.0
        for a in range(3):
            for b in range(3):
                before[a, b] = T[a, b]
        apply_rotation(before, step[:3], turn)
        for a in range(3):
            for b in range(3):
                T[a, b] = turn[a, b]
        apply_rotation(np.eye(3), step[:3], turn)
        x, y, z = T[0, 3], T[1, 3], T[2, 3]
        for a in range(3):
            T[a, 3] = turn[a, 0] * x + turn[a, 1] * y + turn[a, 2] * z + step[3 + a]
    return used, squares / max(used, 1)


@kernel
def _transpose_samples(source: Floats32, step: int, numbers: Floats) -> Floats32:
    """Return every `step`-th point as (7, n); the seventh row is the fourth power of its depth."""
    kind, per_depth = numbers[8], numbers[7]
    chosen = np.empty((7, (len(source) + step - 1) // step), np.float32)
    chosen[:6] = transpose_points(source, step)
    for i in range(chosen.shape[1]):
        depth = depth_of(kind, chosen[0, i], chosen[1, i], chosen[2, i])
        chosen[6, i] = np.float32(depth * per_depth) ** 4
    return chosen


@kernel
def refine_in_place(
    source: Floats32, points: Floats32, normals: Floats32, camera: Floats,
    heads: Ints32, chain: Ints32, transforms: Floats, numbers: Floats,
    information: Floats, used: Ints64, squares: Floats,
) -> None:  # fmt: skip
    """Refine n transforms (n, 4, 4) in place, and write what `_refine_one` returns for each."""
    room, indices = np.empty((19, BLOCK)), np.empty((4, BLOCK), np.int32)
    whole = few = _transpose_samples(source, 1, numbers)
    if int(numbers[9]) > 1 and int(numbers[0]) > int(numbers[10]):
        few = _transpose_samples(source, int(numbers[9]), numbers)
    for k in range(len(transforms)):
        used[k], squares[k] = _refine_one(
            source, whole, few, points, normals, camera, heads, chain, transforms[k], numbers,
            room, indices, information[k],
        )  # fmt: skip


@lru_cache(maxsize=32)
def kernel_numbers(p: RefinementParameters, kind: int) -> Floats:
    """Return the parameters and the kind of the source's camera as an array for kernels."""
    return np.array(
        [p.iterations, p.first_gate, p.last_gate, p.normal_cosine, p.reference_depth,
         p.minimum_points, p.growth, 1.0 / p.weight_depth, kind, p.thinning, p.last_iterations],
        float,
    )  # fmt: skip


def refine(
    source: Floats32, target: Surface, T_target_source: Floats, p: RefinementParameters,
    kind: int = PINHOLE,
) -> Refinement | None:  # fmt: skip
    """Refine a transform by aligning the source's points to the target's surface: Sec. III-E.

    Parameters
    ----------
    source : (N, 6) float32 result of `overlap.sample_points` with the stride of `p`
    target : (h, w) surface, or unordered points
    T_target_source : (4, 4) initial transform
    kind : kind of the source's camera (`camera.kind_of`); the weights depend on it

    Returns
    -------
    refinement : the result; None if a step is singular, or fewer than `minimum_points` points are
        within the gates
    """
    T, information, used, squares = _refine(source, target, T_target_source[None], p, kind)
    return Refinement(T[0], information[0], int(used[0]), float(squares[0])) if used[0] else None


def _refine(
    source: Floats32, target: Surface, transforms: Floats, p: RefinementParameters, kind: int
) -> tuple[Floats, Floats, Ints64, Floats]:
    """Refine transforms (n, 4, 4); return them with information, points and mean squares."""
    T, n = np.array(transforms, float), len(transforms)
    information, used, squares = np.zeros((n, 6, 6)), np.empty(n, np.int64), np.empty(n)
    t = lookup_target(target, p.nearest, p.reach)
    refine_in_place(source, *t, T, kernel_numbers(p, kind), information, used, squares)
    return T, information, used, squares


def refine_all(
    source: Surface, target: Surface, hypotheses: Floats, p: RefinementParameters
) -> Floats:
    """Refine hypotheses (n, 4, 4); return the successfully refined hypotheses."""
    return refine_with_index(source, target, hypotheses, p)[0]


def refine_with_index(
    source: Surface, target: Surface, hypotheses: Floats, p: RefinementParameters
) -> tuple[Floats, NDArray[np.intp]]:
    """Return the successfully refined hypotheses, and their indices in `hypotheses`."""
    points = sample_points(source, p.stride)
    T, _, used, _ = _refine(points, target, hypotheses, p, kind_of(source.camera))
    index = np.flatnonzero(used)
    return T[index], index


Method = Literal["information-scaled", "votes-and-spread"]
#: Name of the method that `pair_covariance` uses.
PAIR_METHOD: Method = "information-scaled"
#: Name of the method that `fuse_votes` uses.
PLACE_METHOD: Method = "votes-and-spread"

#: Indices that reorder (rotation, translation), as in a refinement, to (translation, rotation).
_SHIFT_FIRST = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])


@dataclass(frozen=True)
class CovarianceParameters:
    """Parameters of covariances; docs/uncertainty.md describes how they were tuned."""

    independent: float = 5.3  #: effective number of independent points per direction
    least_square: float = 1e-7  #: minimum mean weighted square, of the most accurate sensor
    most: float = 10.0  #: maximum deviation, reached in free directions, metres and radians
    lever: float = 1.0  #: length that counts as one radian, metres
    free: float = 30.0  #: minimum ratio of a free direction's deviation to the smallest deviation


@dataclass(frozen=True, eq=False)
class SlidingDirection:
    """A direction in which the surfaces hardly constrain the transform.

    Parameters
    ----------
    translation, rotation : (3,) each, in metres and radians; together a unit vector
    deviation : standard deviation in this direction, metres for translations, radians for rotations
    """

    translation: Floats
    rotation: Floats
    deviation: float


def cross_matrix(v: Floats) -> Floats:
    """Return the matrix [v]x (3, 3), for which [v]x @ u = v x u."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def adjoint(R: Floats, lever: Floats) -> Floats:
    """Return the matrix (6, 6) that transforms an error (x, r) to another frame.

    Parameters
    ----------
    R : (3, 3) rotation from the old parent's axes to the new parent's axes
    lever : (3,) vector from the old child's origin to the new child's origin, along the new axes
    """
    result = np.zeros((6, 6))
    result[:3, :3], result[3:, 3:] = R, R
    result[:3, 3:] = -cross_matrix(lever) @ R  # a rotation moves points away from the origin
    return result


def transform_covariance(covariance: Floats, R: Floats, lever: Floats) -> Floats:
    """Transform a covariance (6, 6) to other axes and to another point of the body: A S A^T.

    For T_a_b with rotation R and translation t, the arguments (R, lever) are:

    * (R_c_a, 0) for T_c_a T_a_b
    * (identity, R t_b_d) for T_a_b T_b_d
    * (R^T, -R^T t) for the inverse T_b_a

    T_c_a and T_b_d are assumed to be exact.
    """
    A = adjoint(R, lever)
    moved: Floats = A @ covariance @ A.T
    return (moved + moved.T) / 2


def pair_covariance(
    there: Refinement | None,
    back: Refinement | None,
    T: Floats,
    p: CovarianceParameters | None = None,
) -> Floats | None:
    """Return the covariance of a transform halfway between two refinements: Sec. III-E.

    Parameters
    ----------
    there, back : last refinement of T_match_query, and of its inverse; None for a refinement that
        failed
    T : (4, 4) T_match_query

    Returns
    -------
    (6, 6) covariance of T; None if both refinements failed
    """
    p = p or CovarianceParameters()
    information, squares = [], []
    # `there` has errors about the match's origin, `back` inverse errors in the query's axes
    for refinement, R, lever in (
        (there, np.eye(3), -T[:3, 3]), (back, T[:3, :3].T, np.zeros(3))
    ):  # fmt: skip
        if refinement is not None:
            A = adjoint(R, lever)
            ordered = refinement.information[_SHIFT_FIRST]
            information.append(A.T @ ordered @ A)
            squares.append(refinement.mean_square)
    if not information:
        return None
    noise = max(float(np.mean(squares)), p.least_square) / p.independent
    scale = _error_scale(p)
    precision = np.mean(information, axis=0) * np.outer(1 / scale, 1 / scale) / noise
    values, vectors = np.linalg.eigh((precision + precision.T) / 2)
    variances = 1 / np.maximum(values, 1 / p.most**2)
    result: Floats = (vectors * variances) @ vectors.T * np.outer(1 / scale, 1 / scale)
    return (result + result.T) / 2


def free_directions(
    covariance: Floats, p: CovarianceParameters | None = None
) -> tuple[SlidingDirection, ...]:
    """Return the directions whose deviation far exceeds the smallest deviation, largest first.

    A plane leaves three directions free: two translations within it, and the rotation about its
    normal. A corridor leaves one free, its axis; a corner leaves none.
    """
    p = p or CovarianceParameters()
    scale = _error_scale(p)
    values, vectors = np.linalg.eigh(covariance * np.outer(scale, scale))
    deviations = np.sqrt(np.maximum(values, 0.0))
    free = []
    for i in range(5, 0, -1):
        if deviations[i] > p.free * deviations[0]:
            towards = vectors[:, i] / scale
            length = float(np.linalg.norm(towards))
            towards = towards / length * np.sign(towards[np.abs(towards).argmax()])
            free.append(SlidingDirection(towards[:3], towards[3:], float(deviations[i]) * length))
    return tuple(free)


def fuse_votes(
    average: PoseAverage, poses: Floats, covariances: Floats, inflations: Floats
) -> tuple[PoseAverage, Floats]:
    """Fuse the votes that agree into the most likely pose; return it and its covariance (6, 6).

    All votes share the query, so only half of each covariance is independent. The spread of the
    votes is added, because it reflects the errors of the map's poses.

    Parameters
    ----------
    average : result of `average_poses`
    poses : (n, 4, 4) poses that were averaged
    covariances : (n, 6, 6) covariances of the poses
    inflations : (n,) factors of the covariances in the weights of the votes
    """
    members, own = poses[average.members], covariances[average.members]
    information = np.linalg.inv(own) / inflations[average.members, None, None]
    gains = np.linalg.solve(information.sum(axis=0), information)
    T, n = average.T.copy(), len(members)
    errors = np.array([pose_error(T, vote) for vote in members])
    step = np.einsum("nij,nj->i", gains, errors)
    apply_rotation(average.T[:3, :3], step[3:], T[:3, :3])
    T[:3, 3] += step[:3]
    values, vectors = np.linalg.eigh(own)
    roots = np.einsum("nij,nj,nkj->nik", vectors, np.sqrt(np.maximum(values, 0.0)), vectors)
    parts = gains @ roots
    shared = parts.sum(axis=0)
    covariance: Floats = (np.einsum("nij,nkj->ik", parts, parts) + shared @ shared.T) / 2
    if n > 1:
        errors = np.array([pose_error(T, vote) for vote in members])
        weighted = np.einsum("nij,nj->ni", gains, errors)
        covariance += weighted.T @ weighted * n / (n - 1)
    metres, radians = pose_spread(T, members)
    return replace(average, T=T, spread_m=metres, spread_rad=radians), covariance


def pose_error(T: Floats, true: Floats) -> Floats:
    """Return the error (x, y, z, rx, ry, rz) of a transform (4, 4), as this module defines it."""
    turn = true[:3, :3] @ T[:3, :3].T
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    sine = float(np.linalg.norm(axis))  # twice the sine of the angle
    angle = rotation_angle(turn)
    rotation = axis / 2 if sine < 1e-9 else axis / sine * angle
    return np.concatenate([true[:3, 3] - T[:3, 3], rotation])


def _error_scale(p: CovarianceParameters) -> Floats:
    """Return the factors that convert the six components of an error to metres."""
    return np.array([1.0, 1.0, 1.0, p.lever, p.lever, p.lever])
