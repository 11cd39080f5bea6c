"""Sec. III-E, evidence: how well two surfaces agree under a transform.

    points of the source, surface of the target, T  --agreement-->  inliers, violations

Points are looked up where the target's camera would see them: no search tree, and what the
sensor saw *through* counts too. A point that lies before the surface that the target saw
violates free space: had it been there, the target would have seen it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneprint.geometry.kernel import kernel
from sceneprint.types import Camera, Floats, Floats32, Intrinsics, Surface


@dataclass(frozen=True)
class AgreementParameters:
    """The numbers of agreement; lengths grow by max(1, z^2 / `reference_depth`^2)."""

    surface_tolerance: float = 0.05  #: of a point from the target's plane, metres
    point_tolerance: float = 0.15  #: of a point from the target's point, metres
    normal_cosine: float = 0.7  #: of the angle between normals that agree
    free_space_margin: float = 0.1  #: before the surface, metres
    reference_depth: float = 5.0**0.5  #: where a depth sensor's noise starts to matter, metres
    edge_px: int = 2  #: a violation keeps this far from any pixel that agrees, pixels
    stride: int = 5  #: of the pixels that are looked up


@dataclass(frozen=True)
class Agreement:
    """Counts of the source's points."""

    points: int  #: all of them
    inliers: int  #: that lie on the target's surface, normals alike
    violations: int  #: that lie where the target saw through


def sampled(surface: Surface, stride: int) -> Floats32:
    """Valid pixels of every `stride`-th row and column: (N, 6) float32, points and normals."""
    half = stride // 2
    valid = surface.valid[half::stride, half::stride]
    points = surface.points[half::stride, half::stride][valid]
    normals = surface.normals[half::stride, half::stride][valid]
    return np.ascontiguousarray(np.concatenate([points, normals], axis=1))


def camera_of(k: Camera | None) -> Floats:
    """fx, fy, cx, cy as kernels take them."""
    assert isinstance(k, Intrinsics)
    return np.array([k.fx, k.fy, k.cx, k.cy])


@kernel
def weigh_agreement(
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
        if not z > 0.1:
            continue
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        column, line = x / z * camera[0] + camera[2] + 0.5, y / z * camera[1] + camera[3] + 0.5
        if not (column >= 0 and line >= 0 and column < width and line < height):
            continue
        u, v = int(column), int(line)
        tz = points[v, u, 2]
        if tz <= 0:
            continue
        dx, dy, dz = x - points[v, u, 0], y - points[v, u, 1], z - tz
        mx, my, mz = normals[v, u, 0], normals[v, u, 1], normals[v, u, 2]
        plane = abs(dx * mx + dy * my + dz * mz)
        grow = max(1.0, (z / reference) ** 2)
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
        if dz < -margin * grow and plane > margin * grow:
            # at an edge, a pixel near by may show the surface that the point is on
            nearest = tz
            for line_ in range(max(v - edge, 0), min(v + edge + 1, height)):
                for column_ in range(max(u - edge, 0), min(u + edge + 1, width)):
                    there = points[line_, column_, 2]
                    if there > 0:
                        nearest = min(nearest, there)
            if z < nearest - margin * grow:
                violations += weights[i]
    return inliers, violations


@kernel
def _weigh_all(
    source: Floats32, weights: Floats32, points: Floats32, normals: Floats32, camera: Floats,
    transforms: Floats, tolerances: Floats, out: Floats,
) -> None:  # fmt: skip
    for k in range(len(transforms)):
        inliers, violations = weigh_agreement(
            source, weights, points, normals, camera, transforms[k], tolerances
        )
        out[k, 0] = inliers
        out[k, 1] = violations


def tolerances(p: AgreementParameters) -> Floats:
    """The parameters as the kernel takes them."""
    return np.array(
        [
            p.surface_tolerance, p.point_tolerance, p.normal_cosine,
            p.free_space_margin, p.reference_depth, p.edge_px,
        ]
    )  # fmt: skip


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
    target : (h, w) surface
    transforms : (n, 4, 4) T_target_source
    p : see AgreementParameters
    weights : (N,) of the points; default: 1 each

    Returns
    -------
    (n, 2) weight of the inliers, and of the violations
    """
    out = np.zeros((len(transforms), 2))
    w = np.ones(len(source), np.float32) if weights is None else weights
    _weigh_all(
        source, w, target.points, target.normals, camera_of(target.camera),
        np.ascontiguousarray(transforms), tolerances(p), out,
    )  # fmt: skip
    return out


def agreement(
    source: Floats32, target: Surface, T_target_source: Floats, p: AgreementParameters
) -> Agreement:
    """How a source's points fit what the target saw under one transform; see `agreements`."""
    (inliers, violations) = agreements(source, target, T_target_source[None], p)[0].tolist()
    return Agreement(len(source), round(inliers), round(violations))
