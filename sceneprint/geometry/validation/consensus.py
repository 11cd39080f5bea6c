"""Sec. III-E, consensus: patch correspondences to a few rigid transforms they agree on.

    correspondences (M)  --consensus-->  transforms (S, 4, 4), best supported first

Two correspondences are compatible when a rigid motion could carry both: their patches lie as far
apart, at the same heights over each other's planes, at the same angle, and turn the same way
round. A seed correspondence and those compatible with it that are also compatible with each other
(second-order compatibility: Chen et al., SC2-PCR, CVPR 2022) give one transform, refined over all
correspondences that it explains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.pose.rigid import rotation_of_covariance
from sceneprint.types import Floats, Ints32, Patches


@dataclass(frozen=True)
class ConsensusParameters:
    """The numbers of the compatibility graph and of the hypotheses drawn from it."""

    distance_tolerance: float = 0.12  #: of lengths and heights, metres
    angle_tolerance: float = 0.5  #: of the angle between two patches' normals, radians
    minimum_distance: float = 0.15  #: nearer pairs constrain no rotation, metres
    n_seeds: int = 40  #: transforms that are tried
    n_support: int = 16  #: correspondences that a seed's first transform is fitted to
    normal_weight: float = 0.05  #: of agreeing normals beside agreeing positions, square metres
    rounds: int = 3  #: of fitting again to what a transform explains
    inlier_distance: float = 0.15  #: between patches under a transform, metres
    inlier_cosine: float = 0.85  #: of the angle between their normals


@kernel
def _graph(
    p: Floats, n: Floats, q: Floats, m: Floats,
    tolerance: float, angle: float, minimum: float, bits: NDArray[np.uint64],
) -> None:  # fmt: skip
    """Bit j of row i: correspondences i and j are compatible. All arrays (M, 3)."""
    count = len(p)
    for i in range(count):
        for j in range(i + 1, count):
            ax, ay, az = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
            bx, by, bz = q[j, 0] - q[i, 0], q[j, 1] - q[i, 1], q[j, 2] - q[i, 2]
            da, db = np.sqrt(ax * ax + ay * ay + az * az), np.sqrt(bx * bx + by * by + bz * bz)
            if abs(da - db) > tolerance or da < minimum or db < minimum:
                continue
            ha = ax * n[i, 0] + ay * n[i, 1] + az * n[i, 2]
            hb = bx * m[i, 0] + by * m[i, 1] + bz * m[i, 2]
            if abs(ha - hb) > tolerance:
                continue
            ga = ax * n[j, 0] + ay * n[j, 1] + az * n[j, 2]
            gb = bx * m[j, 0] + by * m[j, 1] + bz * m[j, 2]
            if abs(ga - gb) > tolerance:
                continue
            ca = n[i, 0] * n[j, 0] + n[i, 1] * n[j, 1] + n[i, 2] * n[j, 2]
            cb = m[i, 0] * m[j, 0] + m[i, 1] * m[j, 1] + m[i, 2] * m[j, 2]
            ca, cb = min(max(ca, -1.0), 1.0), min(max(cb, -1.0), 1.0)
            if abs(np.arccos(ca) - np.arccos(cb)) > angle:
                continue
            # the signed triple product tells a scene from its mirror image
            ta = (
                ax * (n[i, 1] * n[j, 2] - n[i, 2] * n[j, 1])
                + ay * (n[i, 2] * n[j, 0] - n[i, 0] * n[j, 2])
                + az * (n[i, 0] * n[j, 1] - n[i, 1] * n[j, 0])
            )
            tb = (
                bx * (m[i, 1] * m[j, 2] - m[i, 2] * m[j, 1])
                + by * (m[i, 2] * m[j, 0] - m[i, 0] * m[j, 2])
                + bz * (m[i, 0] * m[j, 1] - m[i, 1] * m[j, 0])
            )
            if abs(ta - tb) > 2 * tolerance:
                continue
            bits[i, j >> 6] |= np.uint64(1) << np.uint64(j & 63)
            bits[j, i >> 6] |= np.uint64(1) << np.uint64(i & 63)


@kernel
def _second_order(bits: NDArray[np.uint64], common: Ints32) -> None:
    """common[i, j]: how many are compatible with both, where i and j are compatible; else 0."""
    count, words = bits.shape
    m1, m2 = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333)
    m4, h = np.uint64(0x0F0F0F0F0F0F0F0F), np.uint64(0x0101010101010101)
    for i in range(count):
        for j in range(i + 1, count):
            if not (bits[i, j >> 6] >> np.uint64(j & 63)) & np.uint64(1):
                continue
            total = 0
            for k in range(words):
                v = bits[i, k] & bits[j, k]
                v = v - ((v >> np.uint64(1)) & m1)
                v = (v & m2) + ((v >> np.uint64(2)) & m2)
                v = (v + (v >> np.uint64(4))) & m4
                total += int((v * h) >> np.uint64(56))
            common[i, j] = total
            common[j, i] = total


@kernel
def _fit(
    p: Floats, n: Floats, q: Floats, m: Floats, weights: Floats, normal_weight: float, T: Floats
) -> bool:
    """Weighted Kabsch over positions and normals; False where fewer than three take part."""
    total, used = 0.0, 0
    a, b = np.zeros(3), np.zeros(3)
    for i in range(len(weights)):
        if weights[i] > 0:
            used += 1
            total += weights[i]
            for d in range(3):
                a[d] += weights[i] * p[i, d]
                b[d] += weights[i] * q[i, d]
    if used < 3:
        return False
    for d in range(3):
        a[d] /= total
        b[d] /= total
    H = np.zeros((3, 3))
    for i in range(len(weights)):
        w = weights[i]
        if w > 0:
            for r in range(3):
                for c in range(3):
                    H[r, c] += w * (
                        (q[i, r] - b[r]) * (p[i, c] - a[c]) + normal_weight * m[i, r] * n[i, c]
                    )
    R = np.empty((3, 3))
    rotation_of_covariance(H, R)
    for r in range(3):
        for c in range(3):
            T[r, c] = R[r, c]
        T[r, 3] = b[r] - (R[r, 0] * a[0] + R[r, 1] * a[1] + R[r, 2] * a[2])
        T[3, r] = 0.0
    T[3, 3] = 1.0
    return True


@kernel
def _explained(
    p: Floats, n: Floats, q: Floats, m: Floats, T: Floats,
    distance: float, cosine: float, weights: Floats,
) -> float:  # fmt: skip
    """Weight (1 - d^2 / distance^2)^2 of each correspondence under T; returns their sum."""
    total = 0.0
    for i in range(len(weights)):
        x = T[0, 0] * p[i, 0] + T[0, 1] * p[i, 1] + T[0, 2] * p[i, 2] + T[0, 3] - q[i, 0]
        y = T[1, 0] * p[i, 0] + T[1, 1] * p[i, 1] + T[1, 2] * p[i, 2] + T[1, 3] - q[i, 1]
        z = T[2, 0] * p[i, 0] + T[2, 1] * p[i, 1] + T[2, 2] * p[i, 2] + T[2, 3] - q[i, 2]
        u = 1.0 - (x * x + y * y + z * z) / (distance * distance)
        nx = T[0, 0] * n[i, 0] + T[0, 1] * n[i, 1] + T[0, 2] * n[i, 2]
        ny = T[1, 0] * n[i, 0] + T[1, 1] * n[i, 1] + T[1, 2] * n[i, 2]
        nz = T[2, 0] * n[i, 0] + T[2, 1] * n[i, 1] + T[2, 2] * n[i, 2]
        agree = nx * m[i, 0] + ny * m[i, 1] + nz * m[i, 2] > cosine
        weights[i] = u * u if u > 0 and agree else 0.0
        total += weights[i]
    return total


@kernel
def _hypotheses(
    p: Floats, n: Floats, q: Floats, m: Floats, common: Ints32, n_seeds: int, n_support: int,
    normal_weight: float, rounds: int, distance: float, cosine: float, T: Floats,
) -> int:  # fmt: skip
    count = len(p)
    support = np.zeros(count)
    for i in range(count):
        for j in range(count):
            support[i] += common[i, j]
    weights, found = np.zeros(count), 0
    for _ in range(n_seeds):
        seed = int(np.argmax(support))
        if support[seed] <= 0:
            break
        row = common[seed]
        order = np.argsort(-row, kind="mergesort")
        weights[:] = 0.0
        weights[seed] = max(row[order[0]], 1)
        for k in range(min(n_support, count)):
            weights[order[k]] = max(float(row[order[k]]), weights[order[k]])
        for j in range(count):  # what this seed speaks for, others need not repeat
            if row[j] > 0:
                support[j] *= 1.0 - 0.5 * row[j] / row[order[0]]
        support[seed] = 0.0
        if not _fit(p, n, q, m, weights, normal_weight, T[found]):
            continue
        for _ in range(rounds):
            _explained(p, n, q, m, T[found], distance, cosine, weights)
            if not _fit(p, n, q, m, weights, normal_weight, T[found]):
                break
        found += 1
    return found


def consensus(source: Patches, target: Patches, pairs: Ints32, p: ConsensusParameters) -> Floats:
    """Transforms from source to target on which correspondences agree.

    Parameters
    ----------
    source, target : patches of the two frames
    pairs : (M, 2) int32 correspondences, index in source and in target
    p : see ConsensusParameters

    Returns
    -------
    (S, 4, 4) at most `n_seeds` transforms T_target_source; none where no three agree
    """
    if len(pairs) < 3:
        return np.empty((0, 4, 4))
    a = np.ascontiguousarray(source.means[pairs[:, 0]])
    n = np.ascontiguousarray(source.normals[pairs[:, 0]])
    b = np.ascontiguousarray(target.means[pairs[:, 1]])
    m = np.ascontiguousarray(target.normals[pairs[:, 1]])
    bits = np.zeros((len(a), (len(a) + 63) // 64), np.uint64)
    _graph(a, n, b, m, p.distance_tolerance, p.angle_tolerance, p.minimum_distance, bits)
    common = np.zeros((len(a), len(a)), np.int32)
    _second_order(bits, common)
    T = np.zeros((p.n_seeds, 4, 4))
    found = _hypotheses(
        a, n, b, m, common, p.n_seeds, p.n_support, p.normal_weight, p.rounds,
        p.inlier_distance, p.inlier_cosine, T,
    )  # fmt: skip
    return T[:found]
