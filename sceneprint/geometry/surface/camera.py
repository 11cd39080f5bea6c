"""Projection of points into a camera, and rectification of depth images to a pinhole camera.

    camera  --camera_of-->  array        array, point  --project-->  column, line, depth
    points (6, N)  --move_all, project_all, select_inside, gather_pixels-->  pixels, by block
    range (H, W)  --ray_to_axis-->  z (H, W)  --undistort-->  z (H, W) of a pinhole

Kernels support a pinhole and a sphere around a viewpoint. "Depth" means depth along the axis of a
pinhole, and range on a sphere; noise and gates depend on it. An empty pixel has the point (0, 0, 0)
and the depth 0.

`ray_to_axis` is applied to the distorted image, before `undistort`: the ray of a sample passes
through its distorted pixel. In rectification, (x, y) denotes the direction (x/z, y/z).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import disjoint_kernel, kernel
from sceneprint.types import Floats, Floats32, Intrinsics, Ints32

TURN = 2.0 * math.pi
#: Number of points per block of a kernel: a block's coordinates fit into the first-level cache.
BLOCK = 256


@kernel
def depth_of(kind: float, x: float, y: float, z: float) -> float:
    """Return the depth of a point, given in the camera's frame; 0 for an unknown kind of camera."""
    if kind == 0:
        return z
    if kind == 1:
        return float(np.sqrt(x * x + y * y + z * z))
    return 0.0


@kernel
def _project_sphere(camera: Floats, x: float, y: float, z: float) -> tuple[float, float, float]:
    depth = np.sqrt(x * x + y * y + z * z)
    if not depth > camera[1]:
        return -1.0, -1.0, depth
    a, b, c = x, y, z
    if camera[5] == 1:
        a, b, c = z, x, y
    elif camera[5] == 0:
        a, b, c = y, z, x
    # asin would be inaccurate near the pole
    elevation = np.arctan2(c, np.sqrt(a * a + b * b))
    turn = TURN / camera[2]
    column = (np.arctan2(b, a) - camera[3]) / camera[2] + 0.5
    column -= np.floor(column / turn) * turn
    if column >= camera[6] > 0:  # at the seam, rounding can yield the column after the last one
        column = 0.0
    return column, (camera[4] - elevation) / camera[2] + 0.5, depth


@kernel
def project(camera: Floats, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Project a point; return its column (-1 if it is too near), line and depth.

    The integer parts of column and line are the pixel's indices.
    """
    if camera[0] == 0:
        if not z > camera[1]:
            return -1.0, -1.0, z
        return x / z * camera[2] + camera[4] + 0.5, y / z * camera[3] + camera[5] + 0.5, z
    return _project_sphere(camera, x, y, z)


@kernel
def transpose_points(source: Floats32, step: int) -> Floats32:
    """Return every `step`-th row of points (N, 6), transposed to (6, n)."""
    chosen = np.empty((6, (len(source) + step - 1) // step), np.float32)
    for a in range(6):
        for i in range(chosen.shape[1]):
            chosen[a, i] = source[i * step, a]
    return chosen


@disjoint_kernel
def move_all(points: Floats32, T: Floats, first: int, count: int, out: Floats) -> None:
    """Transform `count` points of (6, N), from index `first`, by T; write them to `out` (3, n)."""
    for a in range(3):
        x, y, z, own = points[0], points[1], points[2], out[a]
        xx, xy, xz, shift = T[a, 0], T[a, 1], T[a, 2], T[a, 3]
        for i in range(count):
            n = np.uint64(first + i)
            own[i] = xx * x[n] + xy * y[n] + xz * z[n] + shift


@disjoint_kernel
def project_all(camera: Floats, points: Floats, count: int, out: Floats) -> None:
    """Write the columns, lines and depths of points (3, n) to `out` (3, n); see `project`."""
    x, y, z, column, line, depth = points[0], points[1], points[2], out[0], out[1], out[2]
    for i in range(count):
        column[i], line[i], depth[i] = project(camera, x[i], y[i], z[i])


@disjoint_kernel
def select_inside(
    projected: Floats, count: int, left: float, right: float, top: float, bottom: float,
    places: Ints32,
) -> int:  # fmt: skip
    """Write the indices of points with columns in [left, right) and lines in [top, bottom).

    Return their number.
    """
    column, line, n_inside = projected[0], projected[1], 0
    for i in range(count):
        inside = (column[i] >= left) & (line[i] >= top) & (column[i] < right) & (line[i] < bottom)
        places[n_inside] = i
        n_inside += 1 if inside else 0
    return n_inside


@disjoint_kernel
def gather(values: Floats, places: Ints32, count: int, out: Floats) -> None:
    """Write the values (m, N) at `places` to `out` (m, n)."""
    for a in range(len(values)):
        own, chosen = values[a], out[a]
        for i in range(count):
            chosen[i] = own[np.uint64(places[i])]


@disjoint_kernel
def gather_pixels(projected: Floats, places: Ints32, count: int, out: Ints32) -> None:
    """Write the pixels (column, line) of the points at `places` to `out` (2, n)."""
    for a in range(2):
        own, chosen = projected[a], out[a]
        for i in range(count):
            chosen[i] = np.int32(own[np.uint64(places[i])])


@kernel
def depth_at(camera: Floats, points: Floats32, line: int, column: int) -> float:
    """Return the depth of a pixel; 0 if it is empty."""
    x, y, z = points[line, column, 0], points[line, column, 1], points[line, column, 2]
    return depth_of(camera[0], x, y, z)


@kernel
def growth_at(depth: float, reference: float, power: float) -> float:
    """Return the growth of lengths at a depth, (depth / reference)^power, but at least 1.

    The power is 0, 1 or 2.
    """
    ratio = depth / reference
    if power == 2:
        return max(1.0, ratio * ratio)
    return max(1.0, ratio) if power == 1 else 1.0


_BLOCK = 2**18  #: number of samples per block; it limits the memory for a 16-megapixel image
_STEPS = 20  #: maximum number of Newton steps; real lenses need 4
_TOLERANCE = 1e-7  #: maximum residual of the inversion in x/z, approximately 1e-4 pixels


def undistort(depth: Floats32, intrinsics: Intrinsics) -> Floats32:
    """Remove lens distortion from a depth image.

    Each pixel gets the nearest sample: interpolation would invent points between an edge and its
    background. Pixels outside the field of view become 0, and so do pixels where the distortion
    polynomial folds back on itself and therefore describes no lens.

    Parameters
    ----------
    depth : (H, W), 0 if missing
    intrinsics : intrinsics of the image, with its distortion

    Returns
    -------
    depth : (H, W) depth image for `intrinsics.without_distortion()`

    Raises
    ------
    ValueError : If the sizes of image and intrinsics differ
    """
    _check_size(depth, intrinsics)
    if not any(intrinsics.distortion):
        return np.array(depth, dtype=np.float32)
    # index -1, for pixels without a sample, selects the appended zero
    samples = np.append(depth.astype(np.float32, copy=False).ravel(), np.float32(0.0))
    return samples[_sources(intrinsics)].reshape(depth.shape)


def ray_to_axis(depth: Floats32, intrinsics: Intrinsics) -> Floats32:
    """Convert ranges along the pixels' rays to z along the optical axis.

    Parameters
    ----------
    depth : (H, W) metres along the ray, 0 if missing
    intrinsics : intrinsics of the image, with its distortion

    Returns
    -------
    depth : (H, W) metres along the axis, 0 if missing or if the pixel has no ray

    Raises
    ------
    ValueError : If the sizes of image and intrinsics differ
    """
    _check_size(depth, intrinsics)
    return depth.astype(np.float32, copy=False) * _cosines(intrinsics)


@lru_cache(maxsize=2)
def _sources(intrinsics: Intrinsics) -> NDArray[np.int32]:
    """Return the index of each pixel's sample, (H * W,); -1 for pixels without a sample."""
    c, k = intrinsics, _coefficients(intrinsics)
    sources = np.full(c.width * c.height, -1, dtype=np.int32)
    for block, x, y in _directions(c):
        with np.errstate(all="ignore"):  # a direction that overflows has no sample
            x_seen, y_seen = _distort(x, y, k)
            u, v = c.fx * x_seen + c.cx, c.fy * y_seen + c.cy
            inside = (u >= -0.5) & (u < c.width - 0.5) & (v >= -0.5) & (v < c.height - 0.5)
            inside &= _unfolded(x, y, k)
        column = np.minimum(np.floor(u[inside] + 0.5), c.width - 1)
        row = np.minimum(np.floor(v[inside] + 0.5), c.height - 1)
        sources[block][inside] = row * c.width + column
    sources.flags.writeable = False  # shared by all frames of the camera
    return sources


@lru_cache(maxsize=2)
def _cosines(intrinsics: Intrinsics) -> Floats32:
    """Return the cosines (H, W) between the pixels' rays and the axis; 0 if there is no ray."""
    c, k = intrinsics, _coefficients(intrinsics)
    cosines = np.zeros(c.width * c.height, dtype=np.float32)
    for block, x, y in _directions(c):
        with np.errstate(all="ignore"):
            x_ray, y_ray, known = _invert(x, y, k)
            length = np.sqrt(1.0 + x_ray * x_ray + y_ray * y_ray)
            cosines[block] = np.where(known & np.isfinite(length), 1.0 / length, 0.0)
    cosines.flags.writeable = False
    return cosines.reshape(c.height, c.width)


def _check_size(depth: Floats32, intrinsics: Intrinsics) -> None:
    if depth.shape != (intrinsics.height, intrinsics.width):
        raise ValueError(
            f"depth has shape {depth.shape}, but the intrinsics are for "
            f"({intrinsics.height}, {intrinsics.width})"
        )


def _coefficients(intrinsics: Intrinsics) -> tuple[float, ...]:
    """Return k1, k2, p1, p2, k3, k4, k5, k6; missing coefficients are 0."""
    return (*intrinsics.distortion, *(0.0,) * (8 - len(intrinsics.distortion)))


def _directions(c: Intrinsics) -> Iterator[tuple[slice, Floats, Floats]]:
    """Yield x/z and y/z of the pixels, block by block in row-major order."""
    for start in range(0, c.width * c.height, _BLOCK):
        block = slice(start, min(start + _BLOCK, c.width * c.height))
        v, u = np.divmod(np.arange(block.start, block.stop), c.width)
        with np.errstate(over="ignore"):
            yield block, (u - c.cx) / c.fx, (v - c.cy) / c.fy


def _radial(r2: Floats, k: tuple[float, ...]) -> tuple[Floats, Floats, Floats]:
    """Return the radial factor, its derivative with respect to r2, and its denominator."""
    k1, k2, _, _, k3, k4, k5, k6 = k
    below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    factor = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
    slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)
    return factor, (slope - factor * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6))) / below, below


def _distort(x: Floats, y: Floats, k: tuple[float, ...]) -> tuple[Floats, Floats]:
    """Distort directions by the Brown-Conrady model, with a quotient of radial polynomials if k4 to
    k6 are not 0; the coefficients `k` are in OpenCV's order.
    """
    p1, p2 = k[2:4]
    r2 = x * x + y * y
    radial = _radial(r2, k)[0]
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


def _jacobian(x: Floats, y: Floats, k: tuple[float, ...]) -> tuple[Floats, Floats, Floats]:
    """Return the elements xx, xy and yy of the symmetric Jacobian of `_distort`."""
    p1, p2 = k[2:4]
    radial, slope, _ = _radial(x * x + y * y, k)
    slope = 2.0 * slope
    return (
        radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y,
        radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )


def _unfolded(x: Floats, y: Floats, k: tuple[float, ...]) -> NDArray[np.bool_]:
    """Return a mask of the directions (x, y) before the first fold of the distortion."""
    unfolded = x * x + y * y < _first_fold(k) ** 2
    for fraction in np.linspace(0.125, 1.0, 8):  # tangential terms move the fold
        xx, xy, yy = _jacobian(fraction * x, fraction * y, k)
        unfolded &= xx * yy - xy * xy > 0.0  # false for NaN
    return unfolded


def _first_fold(k: tuple[float, ...]) -> float:
    """Return the smallest tan(angle to the axis) at which the radial function stops growing."""
    r = np.tan(np.linspace(0.0, math.radians(89.9), 4096))
    with np.errstate(all="ignore"):  # the quotient may have poles
        radial, slope, below = _radial(r * r, k)
        grows = (radial + 2.0 * r * r * slope > 0.0) & (below > 0.0)
    return math.inf if grows.all() else float(r[max(int(np.argmin(grows)) - 1, 0)])


def _invert(
    x_seen: Floats, y_seen: Floats, k: tuple[float, ...]
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Undistort (x_seen, y_seen) by Newton's method; return the directions and a validity mask."""
    x, y = x_seen, y_seen
    for _ in range(_STEPS):
        x_off, y_off = (a - b for a, b in zip(_distort(x, y, k), (x_seen, y_seen), strict=True))
        if max(np.abs(x_off).max(), np.abs(y_off).max()) < _TOLERANCE:
            break
        xx, xy, yy = _jacobian(x, y, k)
        determinant = xx * yy - xy * xy
        x = x - (yy * x_off - xy * y_off) / determinant
        y = y - (xx * y_off - xy * x_off) / determinant
    x_back, y_back = _distort(x, y, k)
    valid = np.hypot(x_back - x_seen, y_back - y_seen) < 2.0 * _TOLERANCE
    return x, y, valid & _unfolded(x, y, k)
