"""All ordered pairs of patches, counted by their four invariants.

Patches (P)  --count_pairs-->  PairCounts (B bins)

All pairs are used: a sample of them would make the signature of one frame differ from itself
(docs/paper.md, R11). The inner loops run over all later patches at once and write one array
each, which is what lets the compiler work on eight numbers at a time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneprint.geometry.bins import TableLayout, bin_edges, hints
from sceneprint.geometry.kernel import cached_at, kernel
from sceneprint.geometry.properties import PropertyParameters
from sceneprint.types import Floats, Floats32, Ints32


@kernel
def _lengths(x: Floats, y: Floats, z: Floats, i: int, d: Floats) -> None:
    ix, iy, iz = x[i], y[i], z[i]
    for j in range(i + 1, len(d)):
        rx, ry, rz = x[j] - ix, y[j] - iy, z[j] - iz
        d[j] = np.sqrt(rx * rx + ry * ry + rz * rz)


@kernel
def _inverses(d: Floats, i: int, inverse: Floats) -> None:
    for j in range(i + 1, len(d)):
        inverse[j] = 1.0 / (d[j] + 1e-300)  # pairs in one place are left out by their distance


@kernel
def _projections(points: Floats, normals: Floats, i: int, inverse: Floats, i_u: Floats) -> None:
    """n_i . u, with u from patch i to patch j."""
    x, y, z = points[0], points[1], points[2]
    ix, iy, iz = x[i], y[i], z[i]
    ax, ay, az = normals[0, i], normals[1, i], normals[2, i]
    for j in range(i + 1, len(i_u)):
        along = (x[j] - ix) * ax + (y[j] - iy) * ay + (z[j] - iz) * az
        i_u[j] = along * inverse[j]


@kernel
def _other_projections(
    points: Floats, normals: Floats, i: int, inverse: Floats, j_u: Floats
) -> None:
    """n_j . u, with u from patch i to patch j."""
    x, y, z = points[0], points[1], points[2]
    nx, ny, nz = normals[0], normals[1], normals[2]
    ix, iy, iz = x[i], y[i], z[i]
    for j in range(i + 1, len(j_u)):
        along = (x[j] - ix) * nx[j] + (y[j] - iy) * ny[j] + (z[j] - iz) * nz[j]
        j_u[j] = along * inverse[j]


@kernel
def _sines(points: Floats, normals: Floats, i: int, inverse: Floats, sine: Floats) -> None:
    """u . (n_i x n_j): sine part of the dihedral angle about u, from n_i to n_j."""
    x, y, z = points[0], points[1], points[2]
    nx, ny, nz = normals[0], normals[1], normals[2]
    ix, iy, iz = x[i], y[i], z[i]
    ax, ay, az = nx[i], ny[i], nz[i]
    for j in range(i + 1, len(sine)):
        rx, ry, rz = x[j] - ix, y[j] - iy, z[j] - iz
        cx, cy, cz = ry * az - rz * ay, rz * ax - rx * az, rx * ay - ry * ax
        sine[j] = (cx * nx[j] + cy * ny[j] + cz * nz[j]) * inverse[j]


@kernel
def _cosines(normals: Floats, i: int, i_u: Floats, j_u: Floats, cosine: Floats) -> None:
    """n_i . n_j less what both have along u: cosine part of the dihedral angle."""
    nx, ny, nz = normals[0], normals[1], normals[2]
    ax, ay, az = nx[i], ny[i], nz[i]
    for j in range(i + 1, len(cosine)):
        cosine[j] = ax * nx[j] + ay * ny[j] + az * nz[j] - i_u[j] * j_u[j]


@kernel
def _turns(cosine: Floats, sine: Floats, i: int, turn: Floats) -> None:
    """Diamond angle of the dihedral angle, as `_diamond`."""
    for j in range(i + 1, len(turn)):
        t = sine[j] / (abs(cosine[j]) + abs(sine[j]) + 1e-300)
        turn[j] = 2.0 - t if cosine[j] < 0.0 else (4.0 + t if sine[j] < 0.0 else t)


@kernel
def _bins(
    values: Floats, sign: float, edges: Floats, hints: Ints32, origin: float, extent: float,
    i: int, bins: Ints32,
) -> None:  # fmt: skip
    """Index of the first edge above sign * value. Cells of hints are narrower than bins."""
    last, per_unit = len(hints) - 1, len(hints) / extent
    for j in range(i + 1, len(values)):
        value = sign * values[j]
        cell = min(max(int((value - origin) * per_unit), 0), last)
        b = hints[cell]
        if value >= edges[b]:
            b += 1
        bins[j] = b


@kernel
def _count(
    points: Floats, normals: Floats, radius: float, colinearity: float,
    distance: Floats, angle: Floats, dihedral: Floats,
    hints: Ints32, n_angles: int, n_dihedrals: int, weights: Floats32, counts: Floats32,
) -> tuple[int, float]:  # fmt: skip
    """Add the weight of both orders of every pair; returns number and weight of all."""
    n = points.shape[1]
    d, inverse, i_u, j_u = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    sine, cosine, turn = np.empty(n), np.empty(n), np.empty(n)
    row, mu = np.empty(n, np.int32), np.empty(n, np.int32)
    alpha, phi = np.empty(n, np.int32), np.empty(n, np.int32)
    n_pairs, total = 0, 0.0
    for i in range(n):
        _lengths(points[0], points[1], points[2], i, d)
        _inverses(d, i, inverse)
        _projections(points, normals, i, inverse, i_u)
        _other_projections(points, normals, i, inverse, j_u)
        _sines(points, normals, i, inverse, sine)
        _cosines(normals, i, i_u, j_u, cosine)
        _turns(cosine, sine, i, turn)
        _bins(d, 1.0, distance, hints[0], 0.0, radius, i, row)
        _bins(i_u, -1.0, angle, hints[1], -1.0, 2.0, i, mu)
        _bins(j_u, -1.0, angle, hints[1], -1.0, 2.0, i, alpha)
        _bins(turn, 1.0, dihedral, hints[2], 0.0, 4.0, i, phi)
        for j in range(i + 1, n):
            if d[j] >= radius or d[j] <= 0.0:
                continue
            last = phi[j] if phi[j] < n_dihedrals else 0
            weight = weights[i] * weights[j]
            if abs(i_u[j]) <= colinearity:  # (i, j): angles of n_i and n_j to u
                bin_ij = (row[j] * n_angles + mu[j]) * n_angles + alpha[j]
                counts[bin_ij * n_dihedrals + last] += weight
                total += weight
                n_pairs += 1
            if abs(j_u[j]) <= colinearity:  # (j, i): u turns round, the normals change places
                other_mu, other_alpha = n_angles - 1 - alpha[j], n_angles - 1 - mu[j]
                bin_ji = (row[j] * n_angles + other_mu) * n_angles + other_alpha
                counts[bin_ji * n_dihedrals + last] += weight
                total += weight
                n_pairs += 1
    return n_pairs, total


@dataclass(frozen=True, eq=False)
class PairCounts:
    """All ordered pairs of one level, by bin.

    Parameters
    ----------
    weights : (B,) float32, sum of the weights of the pairs in each bin
    n_pairs : number of pairs
    total : sum of all their weights
    """

    weights: Floats32
    n_pairs: int
    total: float


def count_pairs(
    means: Floats, normals: Floats, weights: Floats, layout: TableLayout, p: PropertyParameters
) -> PairCounts:
    """Count all ordered pairs of patches by bin, each with the product of its weights.

    Parameters
    ----------
    means, normals : (P, 3) float64, metres and unit length
    weights : (P,) of the patches
    layout, p : of the model
    """
    distance, angle, dihedral = bin_edges(layout, p)
    starts = np.stack(
        [hints(distance, 0.0, p.radius), hints(angle, -1.0, 2.0), hints(dihedral, 0.0, 4.0)]
    )
    counts = np.zeros(layout.n_bins, np.float32)
    n_pairs, total = _count(
        np.ascontiguousarray(means.T), np.ascontiguousarray(normals.T),
        p.radius, p.colinearity, distance, angle, dihedral,
        starts, layout.angle_bins, layout.dihedral_bins, weights.astype(np.float32), counts,
    )  # fmt: skip
    return PairCounts(counts, n_pairs, total)


def compiled_at() -> tuple[str, str]:
    """Folder and name pattern of a file that is there once this code has been compiled."""
    return cached_at(_count)
