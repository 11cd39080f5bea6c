"""Sec. III-E, refinement: point-to-plane ICP, from a transform to the best one near it.

    points of the source, surface of the target, T  --refine-->  T, information

Projective point-to-plane alignment: every point is compared with the plane that the target saw in
its direction. Depth errors of structured-light sensors grow with z^2, so far points weigh less.
Where the target has no viewpoint, a point is compared with the plane of the nearest one that faces
the same way; all else is the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.pose.rigid import solve_positive, turned
from sceneprint.geometry.registration.overlap import LookupTarget, nearest_alike, sampled, target_of
from sceneprint.geometry.surface.camera import PINHOLE, depth_at, depth_of, grown, kind_of, project
from sceneprint.types import Floats, Floats32, Ints32, Surface


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
def _nearest_pixel(
    camera: Floats, points: Floats32, u: int, v: int, x: float, y: float, z: float
) -> tuple[int, int, float]:
    """Of the 3 x 3 pixels about (u, v), the one whose point is nearest: column, row, squared."""
    column, row, nearest = -9, -1, 1e9
    for line in range(v - 1, v + 2):
        for place in range(u - 1, u + 2):
            ex, ey, ez = (
                x - points[line, place, 0], y - points[line, place, 1],
                z - points[line, place, 2],
            )  # fmt: skip
            square = ex * ex + ey * ey + ez * ez
            if square < nearest and depth_at(camera, points, line, place) > 0:
                nearest, column, row = square, place, line
    return column, row, nearest


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


@kernel
def _accumulate(
    source: Floats32, step: int, points: Floats32, normals: Floats32, camera: Floats, T: Floats,
    gate: float, numbers: Floats, A: Floats, g: Floats,
) -> tuple[int, float]:  # fmt: skip
    """Normal equations of one Gauss-Newton step on every `step`-th point; returns how many took
    part, and the sum of their weighted squares.
    """
    height, width = points.shape[0], points.shape[1]
    least_cosine, reference, kind, per_depth = numbers[3], numbers[4], numbers[8], numbers[7]
    # on a closed sphere the first column has a neighbour before it: the last
    edge = 0.0 if camera[0] == 1 and camera[6] > 0 else 1.0
    row = np.zeros(6)
    used, squares = 0, 0.0
    for i in range(0, len(source), step):
        px, py, pz = source[i, 0], source[i, 1], source[i, 2]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        column, line, depth = project(camera, x, y, z)
        if not (column >= edge and line >= 1 and column < width - edge and line < height - 1):
            continue
        u = int(column)
        if u == width - 1:  # of a closed sphere; negative columns count from the last
            u -= width
        u, v, square = _nearest_pixel(camera, points, u, int(line), x, y, z)
        if v < 0:
            continue
        mx, my, mz = normals[v, u, 0], normals[v, u, 1], normals[v, u, 2]
        residual = (
            (x - points[v, u, 0]) * mx + (y - points[v, u, 1]) * my + (z - points[v, u, 2]) * mz
        )
        limit = gate * grown(depth, reference, numbers[6])
        if abs(residual) > limit or square > 9.0 * limit * limit:
            continue
        nx, ny, nz = source[i, 3], source[i, 4], source[i, 5]
        cosine = (
            (T[0, 0] * nx + T[0, 1] * ny + T[0, 2] * nz) * mx
            + (T[1, 0] * nx + T[1, 1] * ny + T[1, 2] * nz) * my
            + (T[2, 0] * nx + T[2, 1] * ny + T[2, 2] * nz) * mz
        )
        if cosine < least_cosine:
            continue
        tukey = 1.0 - (residual / limit) ** 2
        near, far = np.float32(depth_of(kind, px, py, pz) * per_depth), depth * per_depth
        weight = tukey * tukey / (0.25 + (near**4 + far**4) * 0.125)
        _add(A, g, row, x, y, z, mx, my, mz, residual, weight)
        squares += weight * residual * residual
        used += 1
    return used, squares


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
            used, squares = _accumulate(
                source, each, points, normals, camera, T, gate, numbers, A, g
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
        turned(before, step[:3], turn)
        for a in range(3):
            for b in range(3):
                T[a, b] = turn[a, b]
        turned(np.eye(3), step[:3], turn)
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
    p : see RefinementParameters
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
