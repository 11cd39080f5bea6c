"""Range images of clouds from their viewpoints, with planes fitted to the pixels.

    points (N, 3)  --range_image-->  Surface (h, w) with camera Sphere

On the sphere around the viewpoint, the inverse range of a plane is linear in the direction u: 1/r =
a . u. A least-squares fit of `a` over a window gives the normal and the denoised point, as in
`depth_image.py`.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import UselessFrame
from sceneprint.geometry.kernel import cached_per_frame, kernel
from sceneprint.geometry.surface.cloud import CloudParameters, select_in_range
from sceneprint.geometry.surface.voxels import solve
from sceneprint.types import Cloud, Floats, Floats32, Sphere, Surface

#: Minimum cosine of the angle between an axis and the direction of a point that is near it.
_NEAR_POLE = math.cos(math.radians(30.0))
#: Maximum width of an empty wedge within an image, pixels.
_WEDGE_PX = 8


def directions(camera: Sphere) -> Floats:
    """Return the unit vectors (h, w, 3) through the centres of the pixels, in the sensor's axes."""
    azimuth = camera.left + camera.step * np.arange(camera.width)
    elevation = camera.top - camera.step * np.arange(camera.height)
    rays = np.empty((camera.height, camera.width, 3))
    a, b = (camera.pole + 1) % 3, (camera.pole + 2) % 3
    rays[..., a] = np.cos(elevation)[:, None] * np.cos(azimuth)
    rays[..., b] = np.cos(elevation)[:, None] * np.sin(azimuth)
    rays[..., camera.pole] = np.sin(elevation)[:, None]
    return rays


@kernel
def _near_axes(points: Floats32, least: np.float32, near: NDArray[np.int64]) -> None:
    """Add the number of points that are near each axis to `near`."""
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        limit = least * np.sqrt(x * x + y * y + z * z)
        near[0] += abs(x) > limit
        near[1] += abs(y) > limit
        near[2] += abs(z) > limit


def pole_of(points: Floats32) -> int:
    """Return the axis with the fewest points near it; ties prefer z, then y."""
    near = np.zeros(3, np.int64)
    _near_axes(points, np.float32(_NEAR_POLE), near)
    return min((2, 1, 0), key=lambda axis: int(near[axis]))


@kernel
def to_angles(points: Floats32, pole: int, out: Floats) -> None:
    """Write the azimuth, elevation and range of each point to `out` (N, 3)."""
    first, second = (pole + 1) % 3, (pole + 2) % 3
    for i in range(len(points)):
        a, b = float(points[i, first]), float(points[i, second])
        c = float(points[i, pole])
        flat = a * a + b * b
        out[i, 0] = np.arctan2(b, a)
        out[i, 1] = np.arctan2(c, np.sqrt(flat))
        out[i, 2] = np.sqrt(flat + c * c)


def fit_camera(angles: Floats, pole: int, p: CloudParameters) -> Sphere:
    """Return the camera that covers all points, with pixels enlarged to fit `maximum_pixels`."""
    low, high = float(angles[:, 1].min()), float(angles[:, 1].max())
    step = p.image_angle
    while True:
        around = math.ceil(2 * math.pi / step)
        column = ((angles[:, 0] + math.pi) * (around / (2 * math.pi))).astype(np.int64) % around
        occupied = np.flatnonzero(np.bincount(column, minlength=around))
        ends = np.append(occupied, occupied[0] + around)
        widest = int(np.diff(ends).argmax())
        unit = 2 * math.pi / around
        height = max(math.ceil((high - low) / unit), 1)
        top = (high + low) / 2 + (height - 1) / 2 * unit
        if ends[widest + 1] - ends[widest] <= _WEDGE_PX:
            first, width = 0, around
        else:  # the image starts at the end of the widest empty wedge
            first = int(ends[widest + 1])
            width = max(int(ends[widest]) + around - first + 1, 2)
        if width * height <= p.maximum_pixels:
            left = math.remainder(-math.pi + (first + 0.5) * unit, 2 * math.pi)
            return Sphere(width, height, unit, left, top, pole)
        step *= max(math.sqrt(width * height / p.maximum_pixels), 1.01)


#: Ratio of the resolution of `spread_points` to that of the range image.
FINER = 2
#: Maximum number of points stored for a scan; docs/clouds.md gives the measurements.
SPREAD_POINTS = 8192

#: Number of integer steps from 0 to 1 in sums: sums over 5 million points stay below 2^63.
_STEPS = 2.0**38
#: Maximum ratio of a window's width to its height.
_WIDEST = 8.0


def range_image(cloud: Cloud, p: CloudParameters) -> Surface:
    """Convert a cloud to an image of points and normals of the nearest surfaces.

    Small gaps, such as between the rings of a spinning sensor, are closed if both sides lie on the
    same plane. The camera is a Sphere cropped to the points; `pole_of` selects its pole.

    Parameters
    ----------
    cloud : cloud with a viewpoint

    Raises
    ------
    UselessFrame : If fewer than `minimum_points` points are within range, or fewer pixels show
        points
    """
    pole, angles = _angles_of(cloud, p.minimum_range, p.maximum_range, p.minimum_points)
    camera = fit_camera(angles, pole, p)
    q, u = _average_pixels(angles, camera, p)
    if int(np.count_nonzero(q)) < p.minimum_points:
        raise UselessFrame(
            f"{cloud.name or 'The cloud'}: all its points lie in {np.count_nonzero(q)} pixels of "
            f"{math.degrees(camera.step):.2g} degrees, too few to show a surface. "
            "Send a cloud that shows more of the scene, or check its viewpoint."
        )
    gates = np.array([p.range_gate, p.noise_gate, p.plane_gate])
    limits = np.array([p.minimum_samples, p.minimum_spread * camera.step**4])
    planes = np.zeros((camera.height, camera.width, 3))
    flat = np.cos(camera.top - camera.step * np.arange(camera.height))
    _fit(q, u, p.image_radius_px, camera.is_closed, flat, gates, limits, planes)
    rays = directions(camera)
    closed = planes.copy()
    _close(planes, closed, rays, q, p.gap_px, gates, p.gap_cosine)
    by_row = [maps.transpose(1, 0, 2) for maps in (planes, closed, rays)]
    _close(by_row[0], by_row[1], by_row[2], q.T, p.gap_px, gates, p.gap_cosine)
    return _lift_surface(closed, rays, camera, p)


@cached_per_frame
def _angles_of(cloud: Cloud, nearest: float, farthest: float, least: int) -> tuple[int, Floats]:
    """Return the pole of a cloud, and the azimuth, elevation and range of each point, (N, 3)."""
    limits = CloudParameters(
        minimum_range=nearest, maximum_range=farthest, minimum_points=least
    )  # fmt: skip
    points = select_in_range(cloud, limits)
    pole, angles = pole_of(points), np.empty((len(points), 3))
    to_angles(points, pole, angles)
    return pole, angles


def spread_points(cloud: Cloud, image: Surface, p: CloudParameters) -> Surface:
    """Return unordered points of a scan, denser than its range image, for fine refinement.

    A pixel of the range image covers .9 degrees: half a metre of wall at 30 m, and several metres
    of ground. Where finer pixels do not determine a plane, such as between distant rings, the
    points of the range image are used.

    Parameters
    ----------
    cloud, p : arguments of `range_image`
    image : result of `range_image`

    Returns
    -------
    surface : (1, N) without a camera; points of the finer pixels come first
    """
    finer = replace(
        p,
        image_angle=p.image_angle / FINER,
        maximum_pixels=p.maximum_pixels * FINER**2,
        gap_px=p.gap_px * FINER,
    )
    both = range_image(cloud, finer), image
    points, normals, areas = (
        np.concatenate([getattr(view, name)[view.valid] for view in both])[None]
        for name in ("points", "normals", "areas")
    )
    return Surface(points, normals, np.ones(areas.shape, np.bool_), areas, None)


@kernel
def _nearest(angles: Floats, frame: Floats, pixel: NDArray[np.int64], nearest: Floats) -> None:
    """Write each point's pixel, and the smallest range in each pixel."""
    height, width = nearest.shape
    step, left, top = frame[0], frame[1], frame[2]
    for i in range(len(angles)):
        turn, around = (angles[i, 0] - left) / step + 0.5, 2 * np.pi / step
        if turn < 0:
            turn += around
        x = int(turn)
        if x >= width:  # at the seam, rounding can exceed either side
            x = 0 if turn > (width + around) / 2 else width - 1
        y = min(max(int((top - angles[i, 1]) / step + 0.5), 0), height - 1)
        pixel[i] = y * width + x
        nearest[y, x] = min(nearest[y, x], angles[i, 2])


@kernel
def _sum(
    angles: Floats, pixel: NDArray[np.int64], nearest: Floats, frame: Floats, share: float,
    pole: int, sums: NDArray[np.int64],
) -> None:  # fmt: skip
    """Sum the count, inverse range and direction of the points on each pixel's nearest surface."""
    first, second = (pole + 1) % 3, (pole + 2) % 3
    least, steps = frame[3], frame[4]
    for i in range(len(angles)):
        k = pixel[i]
        r = angles[i, 2]
        if r > nearest[k] * (1.0 + share):
            continue
        flat = np.cos(angles[i, 1])
        sums[k, 0] += 1
        sums[k, 1] += np.int64(np.rint(least / r * steps))
        sums[k, 2 + first] += np.int64(np.rint(flat * np.cos(angles[i, 0]) * steps))
        sums[k, 2 + second] += np.int64(np.rint(flat * np.sin(angles[i, 0]) * steps))
        sums[k, 2 + pole] += np.int64(np.rint(np.sin(angles[i, 1]) * steps))


@kernel
def _divide(sums: NDArray[np.int64], least: float, q: Floats, u: Floats) -> None:
    """Write the mean inverse range (n,) and mean direction (n, 3) from the sums of `_sum`."""
    for k in range(len(sums)):
        count = float(max(sums[k, 0], 1))
        q[k] = float(sums[k, 1]) / count / _STEPS / least
        for d in range(3):
            u[k, d] = float(sums[k, 2 + d]) / count / _STEPS


def _average_pixels(angles: Floats, camera: Sphere, p: CloudParameters) -> tuple[Floats, Floats]:
    """Average inverse range (h, w) and direction (h, w, 3) over each pixel's nearest surface.

    `angles` (N, 3) are azimuth, elevation and range. An empty pixel has the inverse range 0. Mean
    directions are not normalised, so the means of points on a plane 1/r = a . u satisfy the same
    equation.
    """
    shape = (camera.height, camera.width)
    least = max(p.minimum_range, 1e-9)
    frame = np.array([camera.step, camera.left, camera.top, least, _STEPS])
    pixel, nearest = np.empty(len(angles), np.int64), np.full(shape, np.inf)
    _nearest(angles, frame, pixel, nearest)
    sums = np.zeros((nearest.size, 5), np.int64)
    _sum(angles, pixel, nearest.reshape(-1), frame, p.same_surface, camera.pole, sums)
    q, u = np.empty(shape), np.empty((*shape, 3))
    _divide(sums, least, q.reshape(-1), u.reshape(-1, 3))
    return q, u


@kernel
def _fit(
    q: Floats,
    u: Floats,
    radius: int,
    closed: bool,
    flat: Floats,
    gates: Floats,
    limits: Floats,
    planes: Floats,
) -> None:
    """Fit the plane 1/r = a . u around each pixel with a point, and write `a`; 0 without a plane.

    The first pass selects pixels by range, the second by distance from the plane. `flat` is the
    cosine of each row's elevation: pixels are narrower towards the poles, so windows contain more
    of them.
    """
    height, width = q.shape
    b, a = np.zeros(3), np.zeros(3)
    for y in range(height):
        wide = min(int(radius / max(flat[y], 1.0 / _WIDEST) + 0.5), (width - 1) // 2)
        for x in range(width):
            centre = q[y, x]
            if centre <= 0:
                continue
            for turn in range(2):
                n = 0
                xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                b[:] = 0.0
                gate = gates[0] * centre if turn == 0 else gates[1] + gates[2] * centre
                for line in range(max(y - radius, 0), min(y + radius + 1, height)):
                    for column in range(x - wide, x + wide + 1):
                        if closed:
                            column = column % width
                        elif column < 0 or column >= width:
                            continue
                        there = q[line, column]
                        if there <= 0:
                            continue
                        ux, uy, uz = u[line, column, 0], u[line, column, 1], u[line, column, 2]
                        expected = centre
                        if turn == 1:
                            expected = a[0] * ux + a[1] * uy + a[2] * uz
                        if not abs(there - expected) < gate:
                            continue
                        n += 1
                        xx += ux * ux
                        xy += ux * uy
                        xz += ux * uz
                        yy += uy * uy
                        yz += uy * uz
                        zz += uz * uz
                        b[0] += ux * there
                        b[1] += uy * there
                        b[2] += uz * there
                det = solve(xx, xy, xz, yy, yz, zz, b, a)
                if n < limits[0] or det < limits[1] * float(n) ** 3:
                    break
                if turn == 1:
                    planes[y, x] = a


@kernel
def _close(
    planes: Floats, out: Floats, rays: Floats, q: Floats, longest: int, gates: Floats,
    cosine: float,
) -> None:  # fmt: skip
    """Fill the gaps in each column between planes that agree across the gap.

    A gap that contains another surface, such as a wire before a wall, is not filled: nothing was
    observed behind that surface.
    """
    height, width = planes.shape[0], planes.shape[1]
    for x in range(width):
        last = -1
        for y in range(height):
            b = planes[y, x]
            bb = b[0] * b[0] + b[1] * b[1] + b[2] * b[2]
            if bb <= 0:
                continue
            gap = y - last - 1
            if last >= 0 and 0 < gap <= longest:
                a = planes[last, x]
                aa = a[0] * a[0] + a[1] * a[1] + a[2] * a[2]
                ab = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
                if ab > cosine * np.sqrt(aa * bb):
                    for k in range(last + 1, y):
                        ray = rays[k, x]
                        above = a[0] * ray[0] + a[1] * ray[1] + a[2] * ray[2]
                        below = b[0] * ray[0] + b[1] * ray[1] + b[2] * ray[2]
                        if abs(above - below) < gates[1] + gates[2] * max(above, below):
                            share = (k - last) / (y - last)
                            there = (1.0 - share) * above + share * below
                            if q[k, x] > 0 and abs(q[k, x] - there) >= gates[1] + gates[2] * there:
                                continue
                            for d in range(3):
                                out[k, x, d] = (1.0 - share) * a[d] + share * b[d]
            last = y


@kernel
def _lift(
    planes: Floats, rays: Floats, flat: Floats, numbers: Floats,
    points: Floats32, normals: Floats32, areas: Floats32, valid: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Intersect rays with planes; `numbers` are minimum cosine, range limits and squared step."""
    for y in range(len(planes)):
        for x in range(planes.shape[1]):
            a, ray = planes[y, x], rays[y, x]
            inverse = a[0] * ray[0] + a[1] * ray[1] + a[2] * ray[2]
            length = np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
            if not length > 0 or not inverse / length >= numbers[0]:
                continue
            # accept ranges from half the sensor's minimum to twice its maximum
            if not (inverse * numbers[2] * 2 > 1 and inverse * numbers[1] < 2):
                continue
            for d in range(3):
                points[y, x, d] = ray[d] / inverse
                normals[y, x, d] = -a[d] / length
            solid = numbers[3] * max(flat[y], 0.0) / (inverse * inverse)
            areas[y, x] = solid / (inverse / length)
            valid[y, x] = True


def _lift_surface(planes: Floats, rays: Floats, camera: Sphere, p: CloudParameters) -> Surface:
    shape = (camera.height, camera.width)
    flat = np.cos(camera.top - camera.step * np.arange(camera.height))
    numbers = np.array([p.minimum_cosine, p.minimum_range, p.maximum_range, camera.step**2])
    points, normals = np.zeros((2, *shape, 3), np.float32)
    areas, valid = np.zeros(shape, np.float32), np.zeros(shape, np.bool_)
    _lift(planes, rays, flat, numbers, points, normals, areas, valid)
    return Surface(points, normals, valid, areas, camera)
