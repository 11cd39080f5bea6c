"""Input of Sec. III, clouds: the plane through the neighbours of each point.

inverse ranges (N), directions (N, 3), Links  --plane_seen-->    planes
places (N, 3), Links                          --plane_facing-->  normals, feet
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.types import Floats, Ints32

Ints64 = NDArray[np.int64]


@kernel
def solve(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, b: Floats, out: Floats
) -> float:
    """out = A^-1 b of a symmetric 3 x 3 matrix A; its determinant, and no `out` where <= 0."""
    cxx, cxy, cxz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    det = xx * cxx + xy * cxy + xz * cxz
    if det > 0:
        cyy, cyz, czz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
        out[0] = (cxx * b[0] + cxy * b[1] + cxz * b[2]) / det
        out[1] = (cxy * b[0] + cyy * b[1] + cyz * b[2]) / det
        out[2] = (cxz * b[0] + cyz * b[1] + czz * b[2]) / det
    return det


@kernel
def plane_seen(
    q: Floats, u: Floats, offsets: Ints64, indices: Ints32, gates: Floats, limits: Floats,
    planes: Floats,
) -> None:  # fmt: skip
    """a of 1/r = a . u among the neighbours of each point; left 0 where nothing fixes it.

    Two passes, as in `spheres.py`: what is near in range, then what is near the plane.
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
    """Eigenvalues of a symmetric 3 x 3 matrix, by Jacobi, and the eigenvector of the least.

    `m` is used up.
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
def plane_facing(
    places: Floats, offsets: Ints64, indices: Ints32, gate: float, limits: Floats,
    normals: Floats, at: Floats,
) -> None:  # fmt: skip
    """Principal components of the neighbours of each point, towards the origin.

    `at` becomes the point's foot on the plane. Two passes: all, then what is near the plane.
    Left 0 where nothing fixes it.
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
                for d in range(3):  # about the point itself: nothing is lost far from the origin
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
