"""Sec. III-E, evidence: how well two surfaces agree under a transform.

    points of the source, surface of the target, T  --agreement-->  inliers, violations

Points are looked up where the target's camera would see them: no search tree, and what the
sensor saw *through* counts too. A point that lies before the surface that the target saw
violates free space: had it been there, the target would have seen it. Where the target has no
viewpoint, points are looked up by place, and nothing is known of free space.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.projecting import depth_at, grown, project
from sceneprint.geometry.targets import Target, nearest_alike, target_of
from sceneprint.types import Floats, Floats32, Ints32, Sphere, Surface

#: Of the surface of a depth image: 160 x 120.
DEPTH_PIXELS = 19_200


@dataclass(frozen=True)
class AgreementParameters:
    """The numbers of agreement; lengths grow by max(1, (z / `reference_depth`)^`growth`)."""

    surface_tolerance: float = 0.05  #: of a point from the target's plane, metres
    point_tolerance: float = 0.15  #: of a point from the target's point, metres
    normal_cosine: float = 0.7  #: of the angle between normals that agree
    free_space_margin: float = 0.1  #: before the surface, metres
    reference_depth: float = 5.0**0.5  #: where a depth sensor's noise starts to matter, metres
    edge_px: int = 2  #: a violation keeps this far from any pixel that agrees, pixels
    stride: int = 5  #: of the pixels that are looked up
    growth: int = 2  #: of lengths with depth: 2 as a depth sensor's noise, 1 or 0 as a scanner's
    nearest: float = 0.1  #: points this near the target's camera are not looked up, metres


@dataclass(frozen=True)
class Agreement:
    """Counts of the source's points."""

    points: int  #: all of them
    inliers: int  #: that lie on the target's surface, normals alike
    violations: int | None  #: that lie where the target saw through; None if it has no viewpoint


def sampled(surface: Surface, stride: int) -> Floats32:
    """Valid pixels of every `stride`-th row and column; of a cloud, about as many points.

    Two frames are to have equal say, whatever saw them: a sphere of more pixels than
    `DEPTH_PIXELS` is strode through faster. A stride of 1 takes all.

    Returns
    -------
    (N, 6) float32, points and normals
    """
    if isinstance(surface.camera, Sphere) and stride > 1:
        more = surface.camera.width * surface.camera.height / DEPTH_PIXELS
        stride = round(stride * max(more, 1.0) ** 0.5)
    half = stride // 2
    rows, columns = slice(half, None, stride), slice(half, None, stride)
    if surface.camera is None:
        rows, columns = slice(None), slice(None, None, stride * stride)
    valid = surface.valid[rows, columns]
    points = surface.points[rows, columns][valid]
    normals = surface.normals[rows, columns][valid]
    return np.ascontiguousarray(np.concatenate([points, normals], axis=1))


@kernel
def _weigh_seen(
    source: Floats32, weights: Floats32, points: Floats32, normals: Floats32, camera: Floats,
    T: Floats, tolerances: Floats,
) -> tuple[float, float]:  # fmt: skip
    """Weight of inliers and of violations of the source (N, 6) on the target's maps under T."""
    height, width = points.shape[0], points.shape[1]
    on_surface, on_point, least_cosine = tolerances[0], tolerances[1], tolerances[2]
    margin, reference, edge = tolerances[3], tolerances[4], int(tolerances[5])
    inliers, violations = 0.0, 0.0
    for i in range(len(source)):
        px, py, pz = source[i, 0], source[i, 1], source[i, 2]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        column, line, depth = project(camera, x, y, z)
        if not (column >= 0 and line >= 0 and column < width and line < height):
            continue
        u, v = int(column), int(line)
        seen = depth_at(camera, points, v, u)
        if seen <= 0:
            continue
        dx, dy, dz = x - points[v, u, 0], y - points[v, u, 1], z - points[v, u, 2]
        mx, my, mz = normals[v, u, 0], normals[v, u, 1], normals[v, u, 2]
        plane = abs(dx * mx + dy * my + dz * mz)
        grow = grown(depth, reference, tolerances[6])
        if plane < on_surface * grow:
            nx, ny, nz = source[i, 3], source[i, 4], source[i, 5]
            cosine = (
                (T[0, 0] * nx + T[0, 1] * ny + T[0, 2] * nz) * mx
                + (T[1, 0] * nx + T[1, 1] * ny + T[1, 2] * nz) * my
                + (T[2, 0] * nx + T[2, 1] * ny + T[2, 2] * nz) * mz
            )
            gate = on_point * grow
            if cosine > least_cosine and dx * dx + dy * dy + dz * dz < gate * gate:
                inliers += weights[i]
                continue
        if depth - seen < -margin * grow and plane > margin * grow:
            # at an edge, a pixel near by may show the surface that the point is on
            nearest = seen
            for line_ in range(max(v - edge, 0), min(v + edge + 1, height)):
                for column_ in range(u - edge, u + edge + 1):
                    beside = column_
                    if column_ < 0 or column_ >= width:
                        if camera[0] == 0 or camera[6] == 0:
                            continue
                        beside = column_ % width  # around the back of a closed sphere
                    there = depth_at(camera, points, line_, beside)
                    if there > 0:
                        nearest = min(nearest, there)
            if depth < nearest - margin * grow:
                violations += weights[i]
    return inliers, violations


@kernel
def _weigh_near(
    source: Floats32, weights: Floats32, points: Floats32, normals: Floats32, camera: Floats,
    heads: Ints32, chain: Ints32, T: Floats, tolerances: Floats,
) -> float:  # fmt: skip
    """Weight of inliers on a target whose points are in no order."""
    inliers = 0.0
    at, facing = np.empty(3), np.empty(3)
    for i in range(len(source)):
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
            inliers += weights[i]
    return inliers


@kernel
def weigh_agreement(
    source: Floats32, weights: Floats32, points: Floats32, normals: Floats32, camera: Floats,
    heads: Ints32, chain: Ints32, T: Floats, tolerances: Floats,
) -> tuple[float, float]:  # fmt: skip
    """Weight of inliers and of violations of the source (N, 6) on a target under T."""
    if camera[0] == 2:
        inliers = _weigh_near(source, weights, points, normals, camera, heads, chain, T, tolerances)
        return inliers, 0.0
    return _weigh_seen(source, weights, points, normals, camera, T, tolerances)


@kernel
def _weigh_all(
    source: Floats32, weights: Floats32, points: Floats32, normals: Floats32, camera: Floats,
    heads: Ints32, chain: Ints32, transforms: Floats, tolerances: Floats, out: Floats,
) -> None:  # fmt: skip
    for k in range(len(transforms)):
        inliers, violations = weigh_agreement(
            source, weights, points, normals, camera, heads, chain, transforms[k], tolerances
        )
        out[k, 0] = inliers
        out[k, 1] = violations


def tolerances(p: AgreementParameters) -> Floats:
    """The parameters as the kernel takes them."""
    return np.array(
        [
            p.surface_tolerance, p.point_tolerance, p.normal_cosine,
            p.free_space_margin, p.reference_depth, p.edge_px, p.growth,
        ]
    )  # fmt: skip


def looked_up(surface: Surface, p: AgreementParameters) -> Target:
    """A surface made ready for `weigh_agreement`."""
    return target_of(surface, p.nearest, p.point_tolerance)


def agreements(
    source: Floats32,
    target: Surface,
    transforms: Floats,
    p: AgreementParameters,
    weights: Floats32 | None = None,
) -> Floats:
    """How a source's points fit what the target saw, under each of some transforms: Sec. III-E.

    Parameters
    ----------
    source : (N, 6) float32 of `sampled`
    target : (h, w) surface, or points in no order, which show no violations
    transforms : (n, 4, 4) T_target_source
    p : see AgreementParameters
    weights : (N,) of the points; default: 1 each

    Returns
    -------
    (n, 2) weight of the inliers, and of the violations
    """
    out = np.zeros((len(transforms), 2))
    w = np.ones(len(source), np.float32) if weights is None else weights
    t = looked_up(target, p)
    _weigh_all(
        source, w, t.points, t.normals, t.camera, t.heads, t.chain,
        np.ascontiguousarray(transforms), tolerances(p), out,
    )  # fmt: skip
    return out


def agreement(
    source: Floats32, target: Surface, T_target_source: Floats, p: AgreementParameters
) -> Agreement:
    """How a source's points fit what the target saw under one transform; see `agreements`."""
    (inliers, violations) = agreements(source, target, T_target_source[None], p)[0].tolist()
    known = target.camera is not None
    return Agreement(len(source), round(inliers), round(violations) if known else None)
