"""Input of Sec. III: a map of inverse depth to points and unit normals.

    1/z (h, w)  --surface-->  points, normals (h, w, 3)

In the image, the inverse depth of a plane is linear: 1/z = q + a dx + b dy. A least-squares
fit of (q, a, b) over a window gives normal and denoised point at once, always facing the
sensor. Two passes: the first takes what is near in depth, the second what is near the plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.types import Floats32, Intrinsics, Surface


@dataclass(frozen=True)
class NormalParameters:
    """The numbers of the plane fit."""

    radius_px: int = 3  #: half the window's side, pixels of the reduced map
    depth_gate: float = 0.05  #: first pass: samples within this share of the centre's 1/z
    plane_gate: float = 0.006  #: second pass: samples within gate (1 + 1/z) of the plane, 1/m
    minimum_samples: int = 9  #: fewer fix no plane
    minimum_spread: float = 0.3  #: determinant of the samples' 2 x 2 covariance, pixel^4
    minimum_cosine: float = 0.12  #: of the angle of incidence; more grazing is rejected


@kernel
def _weigh(
    row: Floats32, centre: Floats32, expected: Floats32, gate: Floats32, w: Floats32, wr: Floats32
) -> None:
    """Weights (0 or 1) of one row of samples, and weighted differences to the centre."""
    zero, one = np.float32(0.0), np.float32(1.0)
    for x in range(len(w)):
        near = abs(row[x] - centre[x] - expected[x]) < gate[x]
        w[x] = one if near and row[x] > zero else zero
    for x in range(len(w)):
        wr[x] = w[x] * (row[x] - centre[x])


@kernel
def _add(target: Floats32, factor: np.float32, term: Floats32) -> None:
    for x in range(len(target)):
        target[x] += factor * term[x]


@kernel
def _fit(
    q: Floats32, radius: int, constant: np.float32, relative: np.float32,
    planes: Floats32, out: Floats32,
) -> None:  # fmt: skip
    """Fit 1/z - centre = c + a dx + b dy around every pixel: out[:, y, x] = c, a, b, n, det.

    A sample counts while |1/z - centre - plane| < constant + relative * centre. Whole rows
    are accumulated offset by offset, and every inner loop writes one array: only so does
    the compiler find it safe to work on eight or sixteen pixels at once.
    """
    height, width = q.shape
    one = np.float32(1.0)
    padded = np.zeros((height + 2 * radius, width + 2 * radius), np.float32)
    padded[radius : radius + height, radius : radius + width] = q
    line = np.zeros((5, width), np.float32)  # of one dy: n, x, xx, r, xr
    sums = np.zeros((9, width), np.float32)  # n, x, y, xx, xy, yy, r, xr, yr
    w, wr = np.zeros(width, np.float32), np.zeros(width, np.float32)
    expected, gate = np.zeros(width, np.float32), np.zeros(width, np.float32)
    for y in range(height):
        sums[:] = np.float32(0.0)
        centre = q[y]
        for x in range(width):
            gate[x] = constant + relative * centre[x]
        for dy in range(-radius, radius + 1):
            line[:] = np.float32(0.0)
            fy = np.float32(dy)
            for dx in range(-radius, radius + 1):
                fx = np.float32(dx)
                p0, p1, p2 = planes[0, y], planes[1, y], planes[2, y]
                for x in range(width):
                    expected[x] = p0[x] + p1[x] * fx + p2[x] * fy
                row = padded[y + dy + radius, dx + radius : dx + radius + width]
                _weigh(row, centre, expected, gate, w, wr)
                _add(line[0], one, w)
                _add(line[1], fx, w)
                _add(line[2], fx * fx, w)
                _add(line[3], one, wr)
                _add(line[4], fx, wr)
            _add(sums[0], one, line[0])
            _add(sums[1], one, line[1])
            _add(sums[2], fy, line[0])
            _add(sums[3], one, line[2])
            _add(sums[4], fy, line[1])
            _add(sums[5], fy * fy, line[0])
            _add(sums[6], one, line[3])
            _add(sums[7], one, line[4])
            _add(sums[8], fy, line[3])
        for x in range(width):
            n = max(sums[0, x], one)
            mx, my, mr = sums[1, x] / n, sums[2, x] / n, sums[6, x] / n
            xx = sums[3, x] / n - mx * mx
            xy = sums[4, x] / n - mx * my
            yy = sums[5, x] / n - my * my
            xr = sums[7, x] / n - mx * mr
            yr = sums[8, x] / n - my * mr
            det = xx * yy - xy * xy
            safe = det if det > np.float32(1e-3) else one
            a = (yy * xr - xy * yr) / safe
            b = (xx * yr - xy * xr) / safe
            out[0, y, x] = mr - a * mx - b * my
            out[1, y, x] = a
            out[2, y, x] = b
            out[3, y, x] = sums[0, x]
            out[4, y, x] = det


@kernel
def _lift(
    q: Floats32, fit: Floats32, camera: Floats32, limits: Floats32,
    points: Floats32, normals: Floats32, areas: Floats32, valid: NDArray[np.bool_],
) -> None:  # fmt: skip
    height, width = q.shape
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    for y in range(height):
        for x in range(width):
            if q[y, x] <= 0 or fit[3, y, x] < limits[0] or fit[4, y, x] < limits[1]:
                continue
            plane_q = q[y, x] + fit[0, y, x]
            if plane_q < np.float32(0.8) * q[y, x] or plane_q > np.float32(1.25) * q[y, x]:
                continue
            xn, yn = (np.float32(x) - cx) / fx, (np.float32(y) - cy) / fy
            # the plane alpha xn + beta yn + gamma = 1/z has the normal -(alpha, beta, gamma)
            alpha, beta = fit[1, y, x] * fx, fit[2, y, x] * fy
            gamma = plane_q - alpha * xn - beta * yn
            length = np.sqrt(alpha * alpha + beta * beta + gamma * gamma)
            ray = np.sqrt(xn * xn + yn * yn + np.float32(1.0))
            cosine = plane_q / (length * ray)
            if cosine < limits[2]:
                continue
            z = np.float32(1.0) / plane_q
            points[y, x, 0], points[y, x, 1], points[y, x, 2] = xn * z, yn * z, z
            normals[y, x, 0] = -alpha / length
            normals[y, x, 1] = -beta / length
            normals[y, x, 2] = -gamma / length
            # solid angle 1 / (fx fy ray^3), times squared range (z ray)^2, over the cosine
            areas[y, x] = z * z / (fx * fy * ray * cosine)
            valid[y, x] = True


def surface(q: Floats32, intrinsics: Intrinsics, p: NormalParameters) -> Surface:
    """Points and unit normals by a least-squares plane in inverse depth around each pixel.

    Parameters
    ----------
    q : (h, w) float32, 1/z in 1/metres; 0 where missing
    intrinsics : of this map
    p : see NormalParameters

    Returns
    -------
    surface : points in metres, normals towards the sensor; pixels whose window fixes no
        plane, or whose surface is seen at grazing incidence, are not valid
    """
    height, width = q.shape
    first, second = (
        np.zeros((5, height, width), np.float32),
        np.zeros((5, height, width), np.float32),
    )
    zero, gate = np.float32(0.0), np.float32(p.plane_gate)
    _fit(q, p.radius_px, zero, np.float32(p.depth_gate), np.zeros_like(first), first)
    _fit(q, p.radius_px, gate, gate, first, second)
    camera = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy], np.float32)
    limits = np.array([p.minimum_samples, p.minimum_spread, p.minimum_cosine], np.float32)
    points = np.zeros((height, width, 3), np.float32)
    normals = np.zeros((height, width, 3), np.float32)
    areas = np.zeros((height, width), np.float32)
    valid = np.zeros((height, width), np.bool_)
    _lift(q, second, camera, limits, points, normals, areas, valid)
    return Surface(points, normals, valid, areas, intrinsics)
