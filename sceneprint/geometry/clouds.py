"""Input of Sec. III, clouds: which points are looked at, and in which axes.

    points (N, 3)  --within_range-->  points of a model's range
    points (N, 3)  --principal_axes-->  axes (3, 3) that turn with the cloud

Every sum over points is one of whole numbers: it is the same in whatever order they come.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneprint.errors import UselessFrame
from sceneprint.geometry.kernel import kernel
from sceneprint.types import Cloud, Floats, Floats32

#: Steps of a coordinate in sums of squares, and of cubes: those of 5 million points stay below
#: 2^63.
_SQUARED = 2.0**20
_CUBED = 2.0**13


@dataclass(frozen=True)
class CloudParameters:
    """The numbers of what is done with a cloud; for depth sensors indoors.

    Never change a default: models whose file does not hold these numbers were made with them.
    """

    minimum_range: float = 0.3  #: nearer points are left out, metres
    maximum_range: float = 10.0  #: and farther ones, metres
    minimum_points: int = 64  #: fewer points, voxels or pixels hold no geometry
    voxel_angle: float = 1.0 / 146.0  #: side of a voxel seen from the viewpoint, rad
    voxel_size: float = 0.02  #: side of a voxel where there is no viewpoint, metres
    seed_px: float = 5.2  #: from patch to patch, voxels
    validation_seed_px: float = 8.2  #: and of those for validation, voxels
    maximum_patches: int = 1200  #: patches grow until there are no more
    maximum_validation_patches: int = 600  #: and those for validation
    maximum_pixels: int = 160 * 120 * 4  #: voxels and pixels grow until there are no more
    same_surface: float = 0.03  #: points of a pixel within this share of range are averaged
    radius_px: int = 3  #: of the neighbourhood that a normal is of, voxels
    range_gate: float = 0.05  #: of neighbours, first pass: as share of 1/range
    plane_gate: float = 0.006  #: second pass: from the plane, as share of 1/range
    noise_gate: float = 0.006  #: second pass: and beyond that share, 1/metres of 1/range
    minimum_samples: int = 9  #: fewer neighbours fix no plane
    minimum_spread: float = 0.3  #: determinant of their 2 x 2 covariance, pixel^4
    minimum_cosine: float = 0.12  #: of the angle of incidence; more grazing is rejected
    image_angle: float = 1.0 / 146.0  #: side of a pixel of the range image, rad
    image_radius_px: int = 3  #: of the window that a normal of it is of, pixels
    gap_px: int = 6  #: longest gap of a range image that is closed, pixels
    gap_cosine: float = 0.95  #: between the normals of its two sides


def within_range(cloud: Cloud, p: CloudParameters) -> Floats32:
    """The points of a cloud that a model looks at: (M, 3) float32, C-contiguous.

    Parameters
    ----------
    cloud : points about the viewpoint, metres
    p : see CloudParameters

    Raises
    ------
    UselessFrame : fewer than `minimum_points`.
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


def _why_useless(cloud: Cloud, kept: int, p: CloudParameters) -> str:
    name = f"{cloud.name}: " if cloud.name else ""
    given = len(cloud.points)
    if given < p.minimum_points:
        return (
            f"{name}{given} points are too few to show a surface. "
            f"Send a cloud of at least {p.minimum_points} points."
        )
    ranges = np.linalg.norm(cloud.points.astype(float), axis=1)
    span = f"the model's range of {p.minimum_range:g} to {p.maximum_range:g} m"
    middle = float(np.median(ranges))
    advice = "use a model made for this range (such as lidar), or give another viewpoint"
    if middle > 100 * p.minimum_range:
        advice = f"if the coordinates are millimetres, say 1000 units per metre; or {advice}"
    return (
        f"{name}{kept} of its {given} points lie within {span}, {p.minimum_points} are needed; "
        f"their median is {middle:.3g} m from the viewpoint. Check units and viewpoint: {advice}."
    )


@kernel
def _moments(points: Floats32, scale: float, second: np.ndarray) -> None:
    """Sums of x_i x_j, in whole steps: (3, 3) int64."""
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
    """Sums of the cubes along each axis, in whole steps: (3,) int64."""
    for i in range(len(points)):
        x, y, z = points[i, 0] * scale, points[i, 1] * scale, points[i, 2] * scale
        for k in range(3):
            along = np.int64(np.rint(axes[k, 0] * x + axes[k, 1] * y + axes[k, 2] * z))
            third[k] += along * along * along


def principal_axes(points: Floats32) -> Floats:
    """Axes of a cloud that turn with it: rows, of falling second moment about the origin.

    The first two point to where the third moment is positive; the third makes a right-handed
    frame. Where moments tie, as of a sphere, the axes are any.

    Parameters
    ----------
    points : (N, 3) float32

    Returns
    -------
    axes : (3, 3), a rotation: `points @ axes.T` are coordinates along them
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
