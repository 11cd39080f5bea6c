"""Input of Sec. III, clouds: points to voxels, each a mean of points and the plane it lies on.

    Cloud (N)  --voxels-->  Voxels (V), a Surface (1, V)

About a viewpoint voxels grow with range, as those of VCCS do for a cloud of one camera (Papon
2013): a cell is a bin of direction, on the cube, and of the logarithm of range, so that a voxel
is to a cloud what a pixel is to a depth image. Without a viewpoint all are of one size. The grid
lies in the cloud's own axes: turning the cloud turns the voxels with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import UselessFrame
from sceneprint.geometry.surface.cloud import (
    CloudParameters,
    centroid,
    principal_axes,
    thinned,
    within_range,
)
from sceneprint.geometry.surface.planes import Links, linked, plane_facing, plane_seen
from sceneprint.types import Cloud, Floats, Floats32, Surface

#: Side of a square that has the area of the neighbourhood's disc, in its radii.
_SQUARE = math.sqrt(math.pi)
#: Voxels this far apart touch, in sides: two means in cells side by side.
_TOUCHING = 2.0
#: Surfaces this near are one, in sides of a voxel.
_GAP = 0.25


@dataclass(frozen=True, eq=False)
class Voxels(Surface):
    """The surface of a cloud as V voxels, in an order that is none of the points'; camera None.

    Parameters
    ----------
    cloud : whose they are
    axes : (3, 3) principal axes, rows
    centre : (3,) metres: the viewpoint; or the centroid where there is none
    sides : (V,) float32, of each voxel across, metres
    links : of voxels that touch, with no gap between their surfaces
    """

    cloud: Cloud
    axes: Floats
    centre: Floats
    sides: Floats32
    links: Links

    @property
    def plain(self) -> Surface:
        """Points and normals alone."""
        return Surface(self.points, self.normals, self.valid, self.areas, None)


def voxels(cloud: Cloud, p: CloudParameters) -> Voxels:
    """Voxels of a cloud, with the normals of the planes they lie on, towards the viewpoint.

    Parameters
    ----------
    cloud : points about the viewpoint, metres
    p : see CloudParameters

    Raises
    ------
    UselessFrame : fewer than `minimum_points` points are within range, or voxels hold one.
    """
    points = within_range(cloud, p)
    if cloud.has_viewpoint:
        return _seen(cloud, points, p)
    return _fused(cloud, points, p)


def _seen(cloud: Cloud, points: Floats32, p: CloudParameters) -> Voxels:
    axes, centre = principal_axes(points), np.zeros(3)
    unit = max(p.minimum_range, 1e-9)
    means, side = thinned(points, axes, centre, True, unit, p)
    _check(len(means), cloud, p)
    q, u = means[:, 0] / unit, np.ascontiguousarray(means[:, 1:])
    length = np.sqrt((u * u).sum(axis=1))
    rays = u / length[:, None]
    log_range = -np.log(q)
    reach = (2 * p.radius_px + 1) / _SQUARE * side
    places = rays / reach
    near = linked(places, log_range / p.range_gate)
    gates = np.array([p.range_gate, p.noise_gate, p.plane_gate])
    limits = np.array([p.minimum_samples, p.minimum_spread * side**4])
    planes = np.zeros((len(q), 3))
    plane_seen(q, u, near.offsets, near.indices, gates, limits, planes)
    inverse = (planes * rays).sum(axis=1)
    norm = np.sqrt((planes * planes).sum(axis=1))
    within = (inverse * p.maximum_range * 2 > 1) & (inverse * p.minimum_range < 2)
    keep = (norm > 0) & within & (inverse >= p.minimum_cosine * norm)
    inverse, norm = np.where(keep, inverse, 1.0), np.where(keep, norm, 1.0)
    cosines = inverse / norm
    solid = side * side * _share(rays @ axes.T)
    gaps = np.maximum(p.noise_gate / inverse + p.plane_gate, side * _GAP) / inverse
    return _made(
        cloud, axes, centre, keep, near, places, _TOUCHING * side / reach,
        at=rays / inverse[:, None],
        normals=-planes / norm[:, None],
        areas=solid / (inverse * inverse * cosines),
        sides=side / inverse,
        gaps=gaps,
    )  # fmt: skip


def _share(rays: Floats) -> Floats:
    """Solid angle of a cell of the cube, as a share of the square of its angle."""
    a = np.sort(np.abs(rays), axis=1)
    tangents = (a[:, :2] / a[:, 2:]) ** 2
    shares: Floats = (1 + tangents).prod(axis=1) / (1 + tangents.sum(axis=1)) ** 1.5
    return shares


def _fused(cloud: Cloud, points: Floats32, p: CloudParameters) -> Voxels:
    centre = centroid(points)
    axes = principal_axes((points - centre).astype(np.float32))
    unit = max(float(np.abs(points - centre).max()), 1e-9)
    means, side = thinned(points, axes, centre, False, unit, p)
    _check(len(means), cloud, p)
    at = means[:, 1:] * unit
    reach = (2 * p.radius_px + 1) / _SQUARE * side
    places = at / reach
    near = linked(places, np.zeros(len(places)))
    limits = np.array([p.minimum_samples, p.minimum_spread * side**4])
    normals, feet = np.zeros_like(at), at.copy()
    plane_facing(at, near.offsets, near.indices, side, limits, normals, feet)
    keep = (normals != 0).any(axis=1)
    crossed = np.where(keep, np.abs(normals @ axes.T).sum(axis=1), 1.0)  # cells, by a plane
    return _made(
        cloud, axes, centre, keep, near, places, _TOUCHING * side / reach,
        at=feet + centre,
        normals=normals,
        areas=side * side / crossed,
        sides=np.full(len(at), side),
        gaps=np.full(len(at), side),
    )  # fmt: skip


def _check(n: int, cloud: Cloud, p: CloudParameters) -> None:
    if n < p.minimum_points:
        name = f"{cloud.name}: " if cloud.name else ""
        raise UselessFrame(
            f"{name}its {len(cloud.points)} points fill {n} voxels, and {p.minimum_points} are "
            "needed to show a surface. Send a cloud that sees more of the scene."
        )


def _made(
    cloud: Cloud, axes: Floats, centre: Floats, keep: NDArray[np.bool_], near: Links,
    places: Floats, reach: float, *, at: Floats, normals: Floats, areas: Floats, sides: Floats,
    gaps: Floats,
) -> Voxels:  # fmt: skip
    return Voxels(
        points=at[keep].astype(np.float32)[None],
        normals=normals[keep].astype(np.float32)[None],
        valid=np.ones((1, int(keep.sum())), np.bool_),
        areas=areas[keep].astype(np.float32)[None],
        camera=None,
        cloud=cloud,
        axes=axes,
        centre=centre,
        sides=sides[keep].astype(np.float32),
        links=near.among(keep, near.touching(places, reach, at, normals, gaps)),
    )
