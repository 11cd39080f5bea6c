"""Conversion of a depth image into inverse depth, points and unit normals (Sec. III).

    depth (H, W)  --inverse_depth-->  1/z (h, w), with the intrinsics of the reduced map
    1/z (h, w)  --fit_surface-->  points, normals (h, w, 3)

The inverse depth of a plane is linear in the image, 1/z = q + a dx + b dy, and the noise of a
structured-light sensor is uniform in it. A least-squares fit of (q, a, b) over a window gives the
normal and the denoised point. The first pass selects samples by depth, the second by distance from
the plane.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import UselessFrame
from sceneprint.geometry.kernel import kernel
from sceneprint.types import DepthFrame, Floats32, Intrinsics, Surface


@dataclass(frozen=True)
class DepthParameters:
    """Parameters of the reduction."""

    minimum_depth: float = 0.3  #: minimum depth of a sample, metres; nearer samples are missing
    maximum_depth: float = 9.0  #: maximum depth of a sample, metres; farther samples are missing
    same_surface: float = 0.03  #: maximum difference of averaged samples, share of nearest depth
    focal_length_px: float = 146.0  #: focal length that halving the image approximates, pixels
    maximum_pixels: int = 160 * 120 * 4  #: maximum number of pixels after the halvings
    minimum_valid: int = 64  #: minimum number of valid pixels of a usable frame
    minimum_side: int = 8  #: minimum number of rows and columns of a usable image


@kernel
def _in_range(depth: Floats32, minimum: float, maximum: float) -> Floats32:
    height, width = depth.shape
    q = np.zeros((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            z = depth[y, x]
            if z >= minimum and z <= maximum:  # false for NaN
                q[y, x] = np.float32(1.0) / z
    return q


@kernel
def _halve(q: Floats32, same_surface: float) -> Floats32:
    height, width = q.shape[0] // 2, q.shape[1] // 2
    half = np.zeros((height, width), np.float32)
    keep = np.float32(1.0 / (1.0 + same_surface))
    zero, one = np.float32(0.0), np.float32(1.0)
    for y in range(height):
        for x in range(width):
            a, b = q[2 * y, 2 * x], q[2 * y, 2 * x + 1]
            c, d = q[2 * y + 1, 2 * x], q[2 * y + 1, 2 * x + 1]
            nearest = max(a, b, c, d)
            least = nearest * keep
            wa = one if a >= least else zero
            wb = one if b >= least else zero
            wc = one if c >= least else zero
            wd = one if d >= least else zero
            # if all four samples are missing, the mean is 0, which means missing
            half[y, x] = (wa * a + wb * b + wc * c + wd * d) / (wa + wb + wc + wd)
    return half


def halve_camera(intrinsics: Intrinsics) -> Intrinsics:
    """Return the camera of an image that is halved in size; pixel centres are at integers.

    An odd last row or column is removed.
    """
    return replace(
        intrinsics,
        width=intrinsics.width // 2,
        height=intrinsics.height // 2,
        fx=intrinsics.fx / 2,
        fy=intrinsics.fy / 2,
        cx=(intrinsics.cx - 0.5) / 2,
        cy=(intrinsics.cy - 0.5) / 2,
    )


def halvings(intrinsics: Intrinsics, p: DepthParameters) -> int:
    """Return the number of halvings after which a pixel covers the angle that the model expects."""
    times, camera = 0, intrinsics
    while min(camera.width, camera.height) >= 4 and (
        camera.fx > p.focal_length_px * 2**0.5 or camera.width * camera.height > p.maximum_pixels
    ):
        camera, times = halve_camera(camera), times + 1
    return times


def inverse_depth(frame: DepthFrame, p: DepthParameters) -> tuple[Floats32, Intrinsics]:
    """Compute the inverse depth of an image, reduced to the resolution of the model.

    A halving averages only the inverse depths on the nearest surface in each 2 x 2 block, so it
    does not invent points between an edge and its background.

    Parameters
    ----------
    frame : depth (H, W) in metres

    Returns
    -------
    q : (h, w) float32, 1/z in 1/metres; 0 if missing
    intrinsics : intrinsics of the reduced map

    Raises
    ------
    UselessFrame : If fewer than `minimum_valid` pixels lie within the range, or the image has
        fewer than `minimum_side` rows or columns
    ValueError : If the sizes of depth and intrinsics differ
    """
    camera = frame.intrinsics
    if frame.depth.shape != (camera.height, camera.width):
        raise ValueError(
            f"depth has shape {frame.depth.shape}, but the intrinsics are for "
            f"({camera.height}, {camera.width}). Pass the intrinsics of this image."
        )
    if min(frame.depth.shape) < p.minimum_side:
        raise UselessFrame(
            f"{frame.name or 'The frame'}: {camera.width} x {camera.height} samples show no "
            f"surface. Send an image of at least {p.minimum_side} rows and columns."
        )
    q = _in_range(np.ascontiguousarray(frame.depth, np.float32), p.minimum_depth, p.maximum_depth)
    for _ in range(halvings(camera, p)):
        q, camera = _halve(q, p.same_surface), halve_camera(camera)
    n_valid = int(np.count_nonzero(q))
    if n_valid < p.minimum_valid:
        raise UselessFrame(_why_useless(frame, p))
    return q, camera


def _why_useless(frame: DepthFrame, p: DepthParameters) -> str:
    samples = frame.depth[np.isfinite(frame.depth) & (frame.depth > 0)]
    name = f"{frame.name}: " if frame.name else ""
    if not samples.size:
        return f"{name}every depth sample is missing. Check the sensor, or send another frame."
    within = (samples >= p.minimum_depth) & (samples <= p.maximum_depth)
    counted = f"{within.sum()} of its {samples.size} valid depth samples lie within"
    span = f"the model's range of {p.minimum_depth:g} to {p.maximum_depth:g} m"
    if within.mean() > 0.5:
        return (
            f"{name}only {counted} {span}, too few for a surface at this focal length. "
            "Check fx and fy, or send a frame that shows more of the scene."
        )
    return (
        f"{name}{counted} {span}; their median is {np.median(samples):.3g} m. "
        "Check the depth scale (stored units per metre), or use a model for this range."
    )


#: Maximum difference, in `double_resolution`, between samples of one surface, share of the nearest
#: depth.
SAME_SURFACE = 0.05


@kernel
def _double(depth: Floats32, same_surface: float) -> Floats32:
    height, width = depth.shape
    large = np.zeros((2 * height, 2 * width), np.float32)
    for y in range(2 * height):
        v = max(min((y + 0.5) / 2 - 0.5, height - 1.0), 0.0)
        y0 = min(int(v), max(height - 2, 0))
        for x in range(2 * width):
            own = depth[y // 2, x // 2]
            large[y, x] = own
            if not own > 0 or height < 2 or width < 2:
                continue
            u = max(min((x + 0.5) / 2 - 0.5, width - 1.0), 0.0)
            x0 = min(int(u), width - 2)
            a, b = depth[y0, x0], depth[y0, x0 + 1]
            c, d = depth[y0 + 1, x0], depth[y0 + 1, x0 + 1]
            least, most = min(a, b, c, d), max(a, b, c, d)
            if not (least > 0 and most - least <= same_surface * least):
                continue  # interpolation would invent points between an edge and its background
            s, t = u - x0, v - y0
            # a plane is linear in inverse depth
            inverse = (1 - t) * ((1 - s) / a + s / b) + t * ((1 - s) / c + s / d)
            large[y, x] = np.float32(1.0 / inverse)
    return large


def double_resolution(frame: DepthFrame) -> DepthFrame:
    """Return the frame at twice the width and height, interpolated within surfaces.

    Lookups of the nearest pixel then see slopes instead of steps.
    """
    k = frame.intrinsics
    camera = replace(
        k, width=2 * k.width, height=2 * k.height, fx=2 * k.fx, fy=2 * k.fy,
        cx=2 * k.cx + 0.5, cy=2 * k.cy + 0.5,
    )  # fmt: skip
    depth = np.ascontiguousarray(frame.depth, np.float32)
    return replace(frame, depth=_double(depth, SAME_SURFACE), intrinsics=camera)


@dataclass(frozen=True)
class NormalParameters:
    """Parameters of the plane fit."""

    radius_px: int = 3  #: half the side of the window, pixels of the reduced map
    depth_gate: float = 0.05  #: maximum difference in the first pass, share of 1/z at the centre
    plane_gate: float = 0.006  #: second pass: samples within gate * (1 + 1/z) of the plane, 1/m
    minimum_samples: int = 9  #: minimum number of samples of a plane
    minimum_spread: float = 0.3  #: minimum determinant of the samples' covariance (2, 2), pixel^4
    minimum_cosine: float = 0.12  #: minimum cosine of the angle of incidence


@kernel
def _weigh(
    row: Floats32, centre: Floats32, expected: Floats32, gate: Floats32, w: Floats32, wr: Floats32
) -> None:
    """Write the weights (0 or 1) of a row of samples, and their weighted offsets from `centre`."""
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

    A sample counts if |1/z - centre - plane| < constant + relative * centre. Rows are summed one
    offset at a time, so that an inner loop writes a single array and can be vectorized.
    """
    height, width = q.shape
    one = np.float32(1.0)
    padded = np.zeros((height + 2 * radius, width + 2 * radius), np.float32)
    padded[radius : radius + height, radius : radius + width] = q
    line = np.zeros((5, width), np.float32)  # sums of n, x, xx, r, xr for one dy
    sums = np.zeros((9, width), np.float32)  # sums of n, x, y, xx, xy, yy, r, xr, yr
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
            # the solid angle 1 / (fx fy ray^3) times the squared range (z ray)^2 over the cosine
            areas[y, x] = z * z / (fx * fy * ray * cosine)
            valid[y, x] = True


def fit_surface(q: Floats32, intrinsics: Intrinsics, p: NormalParameters) -> Surface:
    """Fit a plane in inverse depth around each pixel; return the points and unit normals.

    A pixel is invalid if its window does not determine a plane or the incidence is grazing.

    Parameters
    ----------
    q : (h, w) float32, 1/z in 1/metres; 0 if missing
    """
    height, width = q.shape
    first, second = np.zeros((2, 5, height, width), np.float32)
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
