"""Sec. III-E, refinement: point-to-plane ICP, from a transform to the best one near it.

    points of the source, surface of the target, T  --refine-->  T, information
    Refined there, Refined back, T  --pair_covariance-->  covariance (6, 6)
    covariance  --free_directions-->  Free: along what the surfaces can slide
    covariance, R, lever  --transported-->  covariance told in another frame

Projective point-to-plane alignment: every point is compared with the plane that the target saw in
its direction. Depth errors of structured-light sensors grow with z^2, so far points weigh less.
Where the target has no viewpoint, a point is compared with the plane of the nearest one that faces
the same way; all else is the same.

The covariance is what the last refinement knows, scaled to the errors that are made. The error of
T_parent_child is (x, y, z, rx, ry, rz): what must be added to its translation, metres along the
parent's axes, and the rotation vector, radians about the parent's axes, that must be put before its
rotation, T_true = [exp(r) R, t + x]. It is what ROS means in PoseWithCovariance. Errors are small:
what is of second order in them is left out. The inverse of Gauss-Newton's information alone is no
covariance: neighbouring pixels err together, so thousands of them say no more than a few. How many:
docs/uncertainty.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sceneprint.geometry.kernel import disjoint_kernel, kernel
from sceneprint.geometry.registration.overlap import LookupTarget, nearest_alike, sampled, target_of
from sceneprint.geometry.rigid import PoseAverage, apply_rotation, rotation_angle, solve_positive
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
from sceneprint.types import PINHOLE, Floats, Floats32, Ints32, Surface, kind_of


@dataclass(frozen=True)
class RefinementParameters:
    """The numbers of one refinement."""

    stride: int  #: of the source's pixels
    iterations: int
    first_gate: float  #: farther from the plane a point is forgotten, metres, at first
    last_gate: float  #: and at last
    normal_cosine: float = 0.7  #: of the angle between normals that may belong together
    reference_depth: float = 5.0**0.5  #: gates grow by max(1, (z / this)^growth)
    minimum_points: int = 20  #: fewer fix no transform
    growth: int = 2  #: 2 as a depth sensor's noise, 1 or 0 as a scanner's
    weight_depth: float = 1.0  #: where weights begin to fall as 1 / z^4, metres
    nearest: float = 0.1  #: points this near the target's camera are not compared, metres
    reach: float = 0.25  #: to a point of a target in no order, metres
    thinning: int = 1  #: of the points, only every such one takes part at first
    last_iterations: int = 2  #: in which all do


#: To see whether it leads anywhere.
QUICK = RefinementParameters(10, 4, 0.25, 0.15)
#: For hypotheses: few points, wide gates.
COARSE = RefinementParameters(5, 8, 0.25, 0.08)
#: For the best of them.
FINE = RefinementParameters(2, 8, 0.08, 0.03, thinning=4)


@dataclass(frozen=True, eq=False)
class Refined:
    """What a refinement came to.

    Parameters
    ----------
    T : (4, 4) T_target_source
    information : (6, 6) J^T W J per point used: turn (radians), then shift (metres), about the
        target's origin
    points : that took part in the last step
    mean_square : weighted square of their residuals, per point used: the noise of this very pair,
        in the weights of `information`
    """

    T: Floats
    information: Floats
    points: int
    mean_square: float


@kernel
def _add(
    A: Floats, g: Floats, row: Floats, x: float, y: float, z: float,
    mx: float, my: float, mz: float, residual: float, weight: float,
) -> None:  # fmt: skip
    """One point's share of the normal equations: (x, y, z) moved, on a plane with that normal."""
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
    """Of the three pixels in a line beside that of each point: the nearest one that shows
    anything, if it is nearer than `nearest`; that squared, and its index in the flat map.
    """
    for i in range(count):
        start, middle = (line[i] + beside) * width, column[i]
        # the last column of a closed sphere has the first for its neighbour
        first = start + (middle - 1 if middle > 0 else width - 1)
        second = start + middle
        third = start + (middle + 1 if middle < width - 1 else 0)
        least, found = nearest[i], best[i]
        for place in (first, second, third):
            at = np.uint64(place) * np.uint64(3)
            a, b, c = points[at], points[at + np.uint64(1)], points[at + np.uint64(2)]
            ex, ey, ez = x[i] - a, y[i] - b, z[i] - c
            square = ex * ex + ey * ey + ez * ez
            nearer = (square < least) & ((c != 0) | (a != 0) | (b != 0))
            least = square if nearer else least
            found = np.int32(place) if nearer else found
        nearest[i], best[i] = least, found


@disjoint_kernel
def _weighed(
    source: Floats32, start: int, places: Ints32, points: Floats32, normals: Floats32,
    x: Floats, y: Floats, z: Floats, depth: Floats, nearest: Floats, best: Ints32, T: Floats,
    gate: float, numbers: Floats, count: int, rows: Floats, weights: Floats,
) -> None:  # fmt: skip
    """Rows of the Jacobian and residuals, (7, n), of points with their nearest pixels; weights,
    negative where the two do not belong together.
    """
    least_cosine, reference, power = numbers[3], numbers[4], numbers[6]
    per_depth, kind = numbers[7], numbers[8]
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
        near = np.float32(
            depth_of(kind, source[0, own], source[1, own], source[2, own]) * per_depth
        )
        far = depth[i] * per_depth
        weight = tukey * tukey / (0.25 + (near**4 + far**4) * 0.125)
        apart = (best[i] < 0) | (nearest[i] > 9.0 * limit * limit)
        apart = apart | (abs(residual) > limit) | (cosine < least_cosine)
        weights[i] = -1.0 if apart else weight
        rows[0, i] = y[i] * mz - z[i] * my
        rows[1, i] = z[i] * mx - x[i] * mz
        rows[2, i] = x[i] * my - y[i] * mx
        rows[3, i], rows[4, i], rows[5, i], rows[6, i] = mx, my, mz, residual


@disjoint_kernel
def _kept(weights: Floats, count: int, places: Ints32) -> int:
    """Indices of the weights that are not negative; how many."""
    found = 0
    for i in range(count):
        places[found] = i
        found += 1 if weights[i] >= 0 else 0
    return found


@disjoint_kernel
def _add_all(rows: Floats, weights: Floats, places: Ints32, count: int, sums: Floats) -> None:
    """Shares of points in the normal equations, one after the other.

    sums (28,): the lower triangle of A row by row, then -g and the weighted squares. All stay in
    registers, which numba does for nothing but single variables.
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
    """Normal equations of one Gauss-Newton step on the points of (6, N); returns how many took
    part, and the sum of their weighted squares.

    Blocks of points go through one step after the other, so that the compiler works on several
    at once; sums are added up in the order of the points.
    """
    height, width = points.shape[0], points.shape[1]
    shown, facing = points.reshape(-1), normals.reshape(-1)
    # on a closed sphere the first column has a neighbour before it: the last
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
        nearest[:count] = 1e9
        best[:count] = -1
        for beside in range(-1, 2):
            _nearest_in_line(
                shown, width, pixels[0], pixels[1], beside, x, y, z, count, nearest, best
            )
        _weighed(
            source, start, places, shown, facing, x, y, z, inside[3], nearest, best, T, gate,
            numbers, count, rows, weights,
        )  # fmt: skip
        count = _kept(weights, count, places)
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
    """As `_accumulate`, on a target whose points are in no order."""
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
        _add(A, g, row, at[0], at[1], at[2], mx, my, mz, residual, weight)
        squares += weight * residual * residual
        used += 1
    return used, squares


@kernel
def refine_in_place(
    source: Floats32, points: Floats32, normals: Floats32, camera: Floats,
    heads: Ints32, chain: Ints32, T: Floats, numbers: Floats, information: Floats,
) -> tuple[int, float]:  # fmt: skip
    """Gauss-Newton on T; the points that took part in the last step, 0 where it was lost, and
    their mean weighted square before it.
    """
    iterations, minimum = int(numbers[0]), int(numbers[5])
    thinned = iterations - int(numbers[10])
    A, g, step = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    before, turn = np.zeros((3, 3)), np.zeros((3, 3))
    used, squares = 0, 0.0
    room, indices = np.empty((19, BLOCK)), np.empty((4, BLOCK), np.int32)
    whole = few = transpose_points(source, 1)
    if int(numbers[9]) > 1 and thinned > 0:
        few = transpose_points(source, int(numbers[9]))
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
            # a little damping: a direction that no point holds does not move
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


def numbers_of(p: RefinementParameters, kind: int) -> Floats:
    """The parameters as the kernel takes them, and the kind of the source's camera."""
    return np.array(
        [p.iterations, p.first_gate, p.last_gate, p.normal_cosine, p.reference_depth,
         p.minimum_points, p.growth, 1.0 / p.weight_depth, kind, p.thinning, p.last_iterations],
        float,
    )  # fmt: skip


def compared(surface: Surface, p: RefinementParameters) -> LookupTarget:
    """A surface made ready for `refine_in_place`."""
    return target_of(surface, p.nearest, p.reach)


def refine(
    source: Floats32, target: Surface, T_target_source: Floats, p: RefinementParameters,
    kind: int = PINHOLE,
) -> Refined | None:  # fmt: skip
    """Lay a source's points onto the target's surface, from a transform near by: Sec. III-E.

    Parameters
    ----------
    source : (N, 6) float32 points and normals, of `overlap.sampled` with the stride of `p`
    target : (h, w) surface, or points in no order
    T_target_source : (4, 4) where to start
    kind : of the source's camera, `camera.kind_of`: by what its points weigh

    Returns
    -------
    refined : or None where fewer than `minimum_points` stay within the gates, or they fix no step
    """
    T, information = np.array(T_target_source, float), np.zeros((6, 6))
    t = compared(target, p)
    used, mean_square = refine_in_place(
        source, t.points, t.normals, t.camera, t.heads, t.chain, T, numbers_of(p, kind), information
    )
    return Refined(T, information, used, mean_square) if used else None


def refined_all(
    source: Surface, target: Surface, hypotheses: Floats, p: RefinementParameters
) -> Floats:
    """Each of the hypotheses (n, 4, 4) refined; those that lose the surface are left out."""
    return refined_with_index(source, target, hypotheses, p)[0]


def refined_with_index(
    source: Surface, target: Surface, hypotheses: Floats, p: RefinementParameters
) -> tuple[Floats, list[int]]:
    """`refined_all`, and of which of the hypotheses each is."""
    points, t = sampled(source, p.stride), compared(target, p)
    numbers, information = numbers_of(p, kind_of(source.camera)), np.zeros((6, 6))
    kept, index = [], []
    for k, hypothesis in enumerate(hypotheses):
        T = hypothesis.copy()
        used, _ = refine_in_place(
            points, t.points, t.normals, t.camera, t.heads, t.chain, T, numbers, information
        )
        if used:
            kept.append(T)
            index.append(k)
    return np.array(kept).reshape(-1, 4, 4), index


# Covariance of a transform.

Method = Literal["information-scaled", "votes-and-spread"]
#: What made a pair's covariance, and what a place's.
PAIR_METHOD: Method = "information-scaled"
PLACE_METHOD: Method = "votes-and-spread"

#: Of turn, then shift, as refinement orders them, to shift, then turn.
_SHIFT_FIRST = [3, 4, 5, 0, 1, 2]


@dataclass(frozen=True)
class CovarianceParameters:
    """The numbers of covariances; how they were chosen: docs/uncertainty.md."""

    independent: float = 5.3  #: points per direction that err independently, however many there are
    least_square: float = 1e-7  #: of the mean weighted square: no sensor is surer
    most: float = 10.0  #: deviation of what nothing holds, metres and radians
    lever: float = 1.0  #: a radian counts as much as this many metres
    free: float = 30.0  #: times the least deviation, from which on a direction is free


@dataclass(frozen=True, eq=False)
class Free:
    """A direction along which a transform is hardly held.

    Parameters
    ----------
    translation, rotation : (3,) each, together of length 1: the error, metres and radians,
        along this direction
    deviation : standard deviation along it, metres where it shifts, radians where it turns
    """

    translation: Floats
    rotation: Floats
    deviation: float


def crossing(v: Floats) -> Floats:
    """[v]x (3, 3): crossing(v) @ u = v x u."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def adjoint(R: Floats, lever: Floats) -> Floats:
    """How an error (x, r) is told elsewhere: (6, 6).

    Parameters
    ----------
    R : (3, 3) old parent's axes in the new one's
    lever : (3,) from the old child's origin to the new one's, along the new axes
    """
    result = np.zeros((6, 6))
    result[:3, :3], result[3:, 3:] = R, R
    result[:3, 3:] = -crossing(lever) @ R  # what turns moves all that is away from the origin
    return result


def transported(covariance: Floats, R: Floats, lever: Floats) -> Floats:
    """A covariance told in other axes and of another point of the same body: A S A^T.

    Of T_a_b with rotation R and translation t, and transforms without error beside it:

    * T_c_a T_a_b: (R_c_a, 0)
    * T_a_b T_b_d, as of a robot's base: (identity, R t_b_d)
    * the inverse T_b_a: (R^T, -R^T t)

    Parameters
    ----------
    covariance : (6, 6)
    R, lever : see `adjoint`
    """
    A = adjoint(R, lever)
    moved: Floats = A @ covariance @ A.T
    return (moved + moved.T) / 2


def pair_covariance(
    there: Refined | None, back: Refined | None, T: Floats, p: CovarianceParameters | None = None
) -> Floats | None:
    """Covariance of a transform that lies halfway between two refinements: Sec. III-E.

    Parameters
    ----------
    there, back : the last refinement of each direction, or None where it was lost
    T : (4, 4) T_match_query

    Returns
    -------
    (6, 6) of T, or None where both were lost
    """
    p = p or CovarianceParameters()
    information, squares = [], []
    if there is not None:  # its error is of the match's origin, which is not where the query is
        informed = there.information[np.ix_(_SHIFT_FIRST, _SHIFT_FIRST)]
        onward = adjoint(np.eye(3), -T[:3, 3])
        information.append(onward.T @ informed @ onward)
        squares.append(there.mean_square)
    if back is not None:  # told in the query's axes; that it is the inverse's changes the sign
        informed = back.information[np.ix_(_SHIFT_FIRST, _SHIFT_FIRST)]
        onward = adjoint(T[:3, :3].T, np.zeros(3))
        information.append(onward.T @ informed @ onward)
        squares.append(back.mean_square)
    if not information:
        return None
    noise = max(float(np.mean(squares)), p.least_square) / p.independent
    scale = _scale(p)
    held = np.mean(information, axis=0) * np.outer(1 / scale, 1 / scale) / noise
    values, vectors = np.linalg.eigh((held + held.T) / 2)
    variances = 1 / np.maximum(values, 1 / p.most**2)
    result: Floats = (vectors * variances) @ vectors.T * np.outer(1 / scale, 1 / scale)
    return (result + result.T) / 2


def free_directions(covariance: Floats, p: CovarianceParameters | None = None) -> tuple[Free, ...]:
    """Directions whose deviation is far above the least one, the freest first.

    A lone plane has three: two shifts within it, and the turn about its normal; a corridor has
    one, along it; a corner none.

    Parameters
    ----------
    covariance : (6, 6)
    p : see CovarianceParameters
    """
    p = p or CovarianceParameters()
    scale = _scale(p)
    values, vectors = np.linalg.eigh(covariance * np.outer(scale, scale))
    deviations = np.sqrt(np.maximum(values, 0.0))
    found = []
    for i in range(5, 0, -1):
        if deviations[i] > p.free * deviations[0]:
            towards = vectors[:, i] / scale
            length = float(np.linalg.norm(towards))
            towards = towards / length * np.sign(towards[np.abs(towards).argmax()])
            found.append(Free(towards[:3], towards[3:], float(deviations[i]) * length))
    return tuple(found)


def place_covariance(average: PoseAverage, poses: Floats, covariances: Floats) -> Floats:
    """Covariance of an averaged pose, from its votes' covariances and how far they lie apart.

    Two frames make each vote, and one of them, the query, is the same for all: half of the mean
    of their covariances is kept whole, the other half divided by their number, as is what they
    differ by, which holds the errors of the map's poses.

    Parameters
    ----------
    average : of `average_poses`
    poses : (n, 4, 4) that were averaged
    covariances : (n, 6, 6) of each
    """
    own: Floats = covariances[average.members].mean(axis=0)
    n = len(average.members)
    if n == 1:
        return own
    apart = np.array([error_of(average.T, one) for one in poses[average.members]])
    result: Floats = own * (0.5 + 0.5 / n) + apart.T @ apart / (n * (n - 1))
    return result


def error_of(T: Floats, true: Floats) -> Floats:
    """(x, y, z, rx, ry, rz) by which a transform (4, 4) is off; see the module."""
    turn = true[:3, :3] @ T[:3, :3].T
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    sine = float(np.linalg.norm(axis))  # twice that of the angle
    angle = rotation_angle(turn)
    rotation = axis / 2 if sine < 1e-9 else axis / sine * angle
    return np.concatenate([true[:3, 3] - T[:3, 3], rotation])


def _scale(p: CovarianceParameters) -> Floats:
    """What makes metres of an error's six numbers."""
    return np.array([1.0, 1.0, 1.0, p.lever, p.lever, p.lever])
