"""Selection of a cloud's points by range, its principal axes, and averages by cell (Sec. III).

    points (N, 3)  --select_in_range-->  points within a model's range
    points (N, 3)  --principal_axes-->  axes (3, 3) that rotate with the cloud
    points (N, 3), axes  --average_cells-->  means (V, 4), side of a cell

Sums over points are sums of integers, so they do not depend on the order of the points.
"""

from __future__ import annotations

import math
import secrets
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import UselessFrame
from sceneprint.geometry.kernel import kernel
from sceneprint.types import Cloud, Floats, Floats32

#: Number of integer steps of a coordinate in sums of powers: sums over 5 million points stay below
#: 2^63.
_SQUARED = 2.0**20
_CUBED = 2.0**13


@dataclass(frozen=True)
class CloudParameters:
    """Parameters for clouds; the defaults suit indoor depth sensors.

    Do not change a default: model files that omit these parameters depend on it.
    """

    minimum_range: float = 0.3  #: minimum range of a point, metres
    maximum_range: float = 10.0  #: maximum range of a point, metres
    minimum_points: int = 64  #: minimum number of points, voxels or pixels of a usable frame
    voxel_angle: float = 1.0 / 146.0  #: side of a voxel seen from the viewpoint, rad
    voxel_size: float = 0.02  #: side of a voxel without a viewpoint, metres
    seed_px: float = 5.2  #: distance between patches, voxels
    validation_seed_px: float = 8.2  #: the same for validation, voxels
    maximum_patches: int = 1200  #: maximum number of patches; patches grow if there are more
    maximum_validation_patches: int = 600  #: the same for validation
    maximum_pixels: int = 160 * 120 * 4  #: maximum number; voxels and pixels grow if there are more
    same_surface: float = 0.03  #: maximum difference of points that are averaged, share of range
    radius_px: int = 3  #: radius of the neighbourhood of a normal, voxels
    range_gate: float = 0.05  #: maximum difference of neighbours in pass 1, share of 1/range
    plane_gate: float = 0.006  #: maximum distance from the plane in pass 2, share of 1/range
    noise_gate: float = 0.006  #: constant term of the maximum distance in pass 2, 1/metres
    minimum_samples: int = 9  #: minimum number of neighbours that determine a plane
    minimum_spread: float = 0.3  #: minimum determinant of their 2 x 2 covariance, pixel^4
    minimum_cosine: float = 0.12  #: minimum cosine of the angle of incidence
    image_angle: float = 1.0 / 146.0  #: side of a pixel of the range image, rad
    image_radius_px: int = 3  #: radius of the window of a normal of the range image, pixels
    gap_px: int = 6  #: maximum length of a gap that is closed in a range image, pixels
    gap_cosine: float = 0.95  #: minimum cosine between the normals of its two sides


def select_in_range(cloud: Cloud, p: CloudParameters) -> Floats32:
    """Return the points (M, 3) within the model's range, float32, C-contiguous.

    If the cloud has no viewpoint, return all points.

    Raises
    ------
    UselessFrame : If fewer than `minimum_points` points remain
    """
    points = np.ascontiguousarray(cloud.points, np.float32)
    if cloud.has_viewpoint:
        keep = np.empty(len(points), np.bool_)
        _select(points, p.minimum_range, p.maximum_range, keep)
        points = points if keep.all() else points[keep]
    if len(points) < p.minimum_points:
        raise UselessFrame(_why_useless(cloud, len(points), p))
    return points


@kernel
def _select(points: Floats32, least: float, most: float, keep: np.ndarray) -> None:
    for i in range(len(points)):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        square = x * x + y * y + z * z
        keep[i] = square >= least * least and square <= most * most


def _why_useless(cloud: Cloud, within: int, p: CloudParameters) -> str:
    name = f"{cloud.name}: " if cloud.name else ""
    count = len(cloud.points)
    if count < p.minimum_points:
        return (
            f"{name}{count} points are too few to show a surface. "
            f"Send a cloud of at least {p.minimum_points} points."
        )
    ranges = np.linalg.norm(cloud.points.astype(float), axis=1)
    span = f"the model's range of {p.minimum_range:g} to {p.maximum_range:g} m"
    middle = float(np.median(ranges))
    advice = "use a model for this range (such as lidar), or specify another viewpoint"
    if middle > 100 * p.minimum_range:
        advice = f"if the coordinates are millimetres, set 1000 units per metre; or {advice}"
    return (
        f"{name}{within} of its {count} points lie within {span}, but {p.minimum_points} are "
        f"required; the median distance from the viewpoint is {middle:.3g} m. Check units and "
        f"viewpoint: {advice}."
    )


@kernel
def _moments(points: Floats32, scale: float, second: np.ndarray) -> None:
    """Add the products x_i x_j of all points to `second` (3, 3) int64, in integer steps."""
    for i in range(len(points)):
        x = np.int64(np.rint(points[i, 0] * scale))
        y = np.int64(np.rint(points[i, 1] * scale))
        z = np.int64(np.rint(points[i, 2] * scale))
        second[0, 0] += x * x
        second[0, 1] += x * y
        second[0, 2] += x * z
        second[1, 1] += y * y
        second[1, 2] += y * z
        second[2, 2] += z * z


@kernel
def _skews(points: Floats32, scale: float, axes: Floats, third: np.ndarray) -> None:
    """Add the cubes of coordinates along each axis to `third` (3,) int64, in integer steps."""
    for i in range(len(points)):
        x, y, z = points[i, 0] * scale, points[i, 1] * scale, points[i, 2] * scale
        for k in range(3):
            along = np.int64(np.rint(axes[k, 0] * x + axes[k, 1] * y + axes[k, 2] * z))
            third[k] += along * along * along


def principal_axes(points: Floats32) -> Floats:
    """Return the principal axes of a cloud as the rows of a rotation (3, 3).

    The axes are sorted by descending second moment. The first two point in the direction of a
    positive third moment; the third completes a right-handed frame. Axes with equal moments, such
    as those of a sphere, are arbitrary. `points @ axes.T` are coordinates along the axes.

    Parameters
    ----------
    points : (N, 3) float32
    """
    reach = float(np.abs(points).max(initial=0.0)) * 3.0**0.5
    if not reach > 0:
        return np.eye(3)
    second = np.zeros((3, 3), np.int64)
    _moments(points, _SQUARED / reach, second)
    whole = second.astype(float)
    whole = np.triu(whole) + np.triu(whole, 1).T
    _, vectors = np.linalg.eigh(whole)
    axes = np.ascontiguousarray(vectors.T[::-1])
    third = np.zeros(3, np.int64)
    _skews(points, _CUBED / reach, axes, third)
    axes[:2] *= np.where(third[:2] < 0, -1.0, 1.0)[:, None]
    axes[2] = np.cross(axes[0], axes[1])
    return axes


#: Number of integer steps from 0 to 1 in sums: sums over 5 million points stay below 2^63.
_STEPS = 2.0**38
#: Maximum number of cells per half axis of a cloud without a viewpoint: three coordinates must fit
#: into one key.
_REACH = 1 << 20
#: Cells are enlarged if their number exceeds this multiple of the maximum.
_ROOM = 4

Ints64 = NDArray[np.int64]


@kernel
def direction_cell(x: float, y: float, z: float, angle: float) -> int:
    """Return the key of the cell of a direction, on a cube with faces divided into equal angles."""
    n = int(np.ceil(np.pi / 2 / angle))
    ax, ay, az = abs(x), abs(y), abs(z)
    if az >= ax and az >= ay:
        face, along, a, b = 4, z, x, y
    elif ay >= ax:
        face, along, a, b = 2, y, z, x
    else:
        face, along, a, b = 0, x, y, z
    if along < 0:
        face += 1
    depth = max(abs(along), 1e-300)
    u = int((np.arctan(a / depth) + np.pi / 4) / angle)
    v = int((np.arctan(b / depth) + np.pi / 4) / angle)
    return (face * n + min(max(u, 0), n - 1)) * n + min(max(v, 0), n - 1)


@kernel
def metric_cell(x: float, y: float, z: float, size: float) -> int:
    """Return the key of the cell of a position in a grid of cubes."""
    a = min(max(int(np.floor(x / size)), -_REACH), _REACH - 1) + _REACH
    b = min(max(int(np.floor(y / size)), -_REACH), _REACH - 1) + _REACH
    c = min(max(int(np.floor(z / size)), -_REACH), _REACH - 1) + _REACH
    return (a * 2 * _REACH + b) * 2 * _REACH + c


@kernel
def hash_key(key: int, secret: int) -> int:
    """Return the hash of a key, for tables whose size is a power of two.

    The secret prevents attacks with clouds that are crafted so that their cells share a slot.
    Results must not depend on it.
    """
    h = (key ^ secret) * 0x9E3779B97F4A7C1
    h ^= h >> 31
    h *= 0x1D8E4E27C47D124F
    return h >> 20


@kernel
def _gather(
    points: Floats32, axes: Floats, centre: Floats, seen: bool, side: float, step: float,
    unit: float, secret: int, keys: Ints64, bins: Ints64, sums: Ints64,
) -> int:  # fmt: skip
    """Sum the points of each occupied cell; return the cell count, -1 if there are too many.

    The sums are count, unit / r and direction if `seen`; otherwise they are count, 0 and
    coordinates / unit.
    """
    size = 16
    while size < 2 * len(keys):
        size *= 2
    table = np.full(size, -1, np.int32)
    mask = size - 1
    n = 0
    for i in range(len(points)):
        px, py, pz = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        x = axes[0, 0] * px + axes[0, 1] * py + axes[0, 2] * pz
        y = axes[1, 0] * px + axes[1, 1] * py + axes[1, 2] * pz
        z = axes[2, 0] * px + axes[2, 1] * py + axes[2, 2] * pz
        if seen:
            r = np.sqrt(px * px + py * py + pz * pz)
            key = direction_cell(x, y, z, side)
            shell = np.int64(np.log(r / unit) / step)
            scale, inverse = _STEPS / r, unit / r * _STEPS
        else:
            key, shell = metric_cell(x, y, z, side), np.int64(0)
            scale, inverse = _STEPS / unit, 0.0
        at = hash_key(int(key * 1000003 + shell), secret) & mask
        while table[at] >= 0 and (keys[table[at]] != key or bins[table[at]] != shell):
            at = (at + 1) & mask
        k = table[at]
        if k < 0:
            if n == len(keys):
                return -1
            k = n
            table[at] = np.int32(n)
            keys[n], bins[n] = key, shell
            sums[n] = 0
            n += 1
        sums[k, 0] += 1
        sums[k, 1] += np.int64(np.rint(inverse))
        sums[k, 2] += np.int64(np.rint(px * scale))
        sums[k, 3] += np.int64(np.rint(py * scale))
        sums[k, 4] += np.int64(np.rint(pz * scale))
    return n


@kernel
def _merge_shells(keys: Ints64, bins: Ints64, order: Ints64, sums: Ints64, out: Ints64) -> int:
    """Write cells in the order of their keys; merge adjacent shells in the same direction."""
    n, i = 0, 0
    while i < len(order):
        out[n] = sums[order[i]]
        if i + 1 < len(order):
            a, b = order[i], order[i + 1]
            if keys[a] == keys[b] and bins[a] + 1 == bins[b]:
                out[n] += sums[b]
                i += 1
        n += 1
        i += 1
    return n


def centroid(points: Floats32) -> Floats:
    """Return the mean of points (N, 3), independent of their order."""
    unit = max(float(np.abs(points).max()) * 2, 1e-9)
    whole = np.rint(points.astype(float) * (_STEPS / unit)).astype(np.int64)
    mean: Floats = whole.sum(axis=0) / len(points) * (unit / _STEPS)
    return mean


def average_cells(
    points: Floats32, axes: Floats, centre: Floats, seen: bool, unit: float, p: CloudParameters
) -> tuple[Floats, float]:
    """Average points by cell; return the means (V, 4) and the cell side, enlarged for large clouds.

    Parameters
    ----------
    points : (N, 3) float32
    axes : (3, 3) axes of the grid, rows
    centre : (3,) origin of the grid
    seen : whether `centre` is a viewpoint; if so, cells are bins of direction and range
    unit : length unit of the sums, metres
    """
    side = p.voxel_angle if seen else p.voxel_size
    room = min(_ROOM * p.maximum_pixels, len(points))
    keys, bins = np.empty(room, np.int64), np.empty(room, np.int64)
    sums, out = np.empty((room, 5), np.int64), np.empty((room, 5), np.int64)
    step, secret = math.log1p(p.same_surface), secrets.randbits(62)
    while True:
        n = _gather(points, axes, centre, seen, side, step, unit, secret, keys, bins, sums)
        if 0 <= n <= p.maximum_pixels:
            break
        wider = max(math.sqrt(n / p.maximum_pixels), 1.05) if n > 0 else math.sqrt(_ROOM)
        side, step = side * wider, step * wider
    order = np.lexsort((bins[:n], keys[:n]))
    n = _merge_shells(keys[:n], bins[:n], order, sums, out)
    return out[:n, 1:] / out[:n, :1] / _STEPS, side
