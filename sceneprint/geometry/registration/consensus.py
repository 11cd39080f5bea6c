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

from sceneprint.geometry.kernel import disjoint_kernel, kernel
from sceneprint.geometry.rigid import rotation_of_covariance
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


@disjoint_kernel
def _lengths(points: Floats, i: int, lengths: Floats) -> None:
    """From point i to each later one; points (3, M)."""
    x, y, z = points[0], points[1], points[2]
    ix, iy, iz = x[i], y[i], z[i]
    for j in range(i + 1, len(lengths)):
        dx, dy, dz = x[j] - ix, y[j] - iy, z[j] - iz
        lengths[j] = np.sqrt(dx * dx + dy * dy + dz * dz)


@disjoint_kernel
def _as_long(
    da: Floats, db: Floats, i: int, tolerance: float, minimum: float, places: Ints32
) -> int:
    """Which of the later correspondences are as far from i in both frames; how many."""
    found = 0
    for j in range(i + 1, len(da)):
        apart = (abs(da[j] - db[j]) > tolerance) | (da[j] < minimum) | (db[j] < minimum)
        places[found] = j
        found += 0 if apart else 1
    return found


@kernel
def _alike_angles(a: float, b: float, most: float) -> bool:
    """Whether two angles, given by their cosines, differ by no more than `most`, which is below pi.

    Angles differ by no less than their cosines do, and by most where one of them is 0: an
    arccosine is needed only between these bounds.
    """
    a, b = min(max(a, -1.0), 1.0), min(max(b, -1.0), 1.0)
    apart = abs(a - b)
    if apart > most + 1e-9:
        return False
    if apart < 1.0 - np.cos(most) - 1e-9:
        return True
    return not abs(np.arccos(a) - np.arccos(b)) > most


@kernel
def _compatible(
    p: Floats, n: Floats, q: Floats, m: Floats, i: int, j: int, tolerance: float, angle: float
) -> bool:
    """Whether two pairs of correspondences whose lengths agree have alike normals as well."""
    ax, ay, az = p[0, j] - p[0, i], p[1, j] - p[1, i], p[2, j] - p[2, i]
    bx, by, bz = q[0, j] - q[0, i], q[1, j] - q[1, i], q[2, j] - q[2, i]
    ha = ax * n[0, i] + ay * n[1, i] + az * n[2, i]
    hb = bx * m[0, i] + by * m[1, i] + bz * m[2, i]
    if abs(ha - hb) > tolerance:
        return False
    ga = ax * n[0, j] + ay * n[1, j] + az * n[2, j]
    gb = bx * m[0, j] + by * m[1, j] + bz * m[2, j]
    if abs(ga - gb) > tolerance:
        return False
    ca = n[0, i] * n[0, j] + n[1, i] * n[1, j] + n[2, i] * n[2, j]
    cb = m[0, i] * m[0, j] + m[1, i] * m[1, j] + m[2, i] * m[2, j]
    if not _alike_angles(ca, cb, angle):
        return False
    # the signed triple product tells a scene from its mirror image
    ta = (
        ax * (n[1, i] * n[2, j] - n[2, i] * n[1, j])
        + ay * (n[2, i] * n[0, j] - n[0, i] * n[2, j])
        + az * (n[0, i] * n[1, j] - n[1, i] * n[0, j])
    )
    tb = (
        bx * (m[1, i] * m[2, j] - m[2, i] * m[1, j])
        + by * (m[2, i] * m[0, j] - m[0, i] * m[2, j])
        + bz * (m[0, i] * m[1, j] - m[1, i] * m[0, j])
    )
    alike: bool = abs(ta - tb) <= 2 * tolerance
    return alike


@kernel
def _graph(
    p: Floats, n: Floats, q: Floats, m: Floats,
    tolerance: float, angle: float, minimum: float, bits: NDArray[np.uint64],
) -> None:  # fmt: skip
    """Bit j of row i: correspondences i and j are compatible. All arrays (3, M)."""
    count = p.shape[1]
    da, db, places = np.empty(count), np.empty(count), np.empty(count, np.int32)
    for i in range(count):
        _lengths(p, i, da)
        _lengths(q, i, db)
        for j in places[: _as_long(da, db, i, tolerance, minimum, places)]:
            if _compatible(p, n, q, m, i, j, tolerance, angle):
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
    """Weighted Kabsch over positions and normals, (3, M) each; False where fewer than three take
    part.
    """
    total, used = 0.0, 0
    a, b = np.zeros(3), np.zeros(3)
    for i in range(len(weights)):
        if weights[i] > 0:
            used += 1
            total += weights[i]
            for d in range(3):
                a[d] += weights[i] * p[d, i]
                b[d] += weights[i] * q[d, i]
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
                        (q[r, i] - b[r]) * (p[c, i] - a[c]) + normal_weight * m[r, i] * n[c, i]
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
) -> None:  # fmt: skip
    """Weight (1 - d^2 / distance^2)^2 of each correspondence under T; all arrays (3, M)."""
    px, py, pz, qx, qy, qz = p[0], p[1], p[2], q[0], q[1], q[2]
    ax, ay, az, bx, by, bz = n[0], n[1], n[2], m[0], m[1], m[2]
    xx, xy, xz, tx = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    yx, yy, yz, ty = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    zx, zy, zz, tz = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    square = distance * distance
    for i in range(len(weights)):
        x = xx * px[i] + xy * py[i] + xz * pz[i] + tx - qx[i]
        y = yx * px[i] + yy * py[i] + yz * pz[i] + ty - qy[i]
        z = zx * px[i] + zy * py[i] + zz * pz[i] + tz - qz[i]
        u = 1.0 - (x * x + y * y + z * z) / square
        nx = xx * ax[i] + xy * ay[i] + xz * az[i]
        ny = yx * ax[i] + yy * ay[i] + yz * az[i]
        nz = zx * ax[i] + zy * ay[i] + zz * az[i]
        c = nx * bx[i] + ny * by[i] + nz * bz[i]
        weights[i] = (u * u if u > 0 else 0.0) if c > cosine else 0.0


@kernel
def _largest(row: Ints32, order: Ints32) -> None:
    """Indices of the largest of a row, largest first, of equals the earlier."""
    found = 0
    for j in range(len(row)):
        if found == len(order) and row[j] <= row[order[found - 1]]:
            continue
        place = found if found < len(order) else found - 1
        while place > 0 and row[order[place - 1]] < row[j]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = j
        found = min(found + 1, len(order))


@kernel
def _hypotheses(
    p: Floats, n: Floats, q: Floats, m: Floats, common: Ints32, n_seeds: int, n_support: int,
    normal_weight: float, rounds: int, distance: float, cosine: float, T: Floats,
) -> int:  # fmt: skip
    count = len(common)
    support = np.zeros(count)
    for i in range(count):
        total = 0
        for j in range(count):
            total += common[i, j]
        support[i] = total
    weights, found = np.zeros(count), 0
    order = np.empty(min(n_support, count), np.int32)
    for _ in range(n_seeds):
        seed = int(np.argmax(support))
        if support[seed] <= 0:
            break
        row = common[seed]
        _largest(row, order)
        weights[:] = 0.0
        weights[seed] = max(row[order[0]], 1)
        for k in order:
            weights[k] = max(float(row[k]), weights[k])
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
    a = np.ascontiguousarray(source.means[pairs[:, 0]].T)
    n = np.ascontiguousarray(source.normals[pairs[:, 0]].T)
    b = np.ascontiguousarray(target.means[pairs[:, 1]].T)
    m = np.ascontiguousarray(target.normals[pairs[:, 1]].T)
    bits = np.zeros((len(pairs), (len(pairs) + 63) // 64), np.uint64)
    _graph(a, n, b, m, p.distance_tolerance, p.angle_tolerance, p.minimum_distance, bits)
    common = np.zeros((len(pairs), len(pairs)), np.int32)
    _second_order(bits, common)
    T = np.zeros((p.n_seeds, 4, 4))
    found = _hypotheses(
        a, n, b, m, common, p.n_seeds, p.n_support, p.normal_weight, p.rounds,
        p.inlier_distance, p.inlier_cosine, T,
    )  # fmt: skip
    return T[:found]
