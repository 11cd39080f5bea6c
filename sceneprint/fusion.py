"""Fusion of depth images of a place into a mesh, by a truncated signed distance function (TSDF).

views (V)  --fuse-->  TriangleMesh, voxel

Only this module imports Open3D, at the first fusion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import InvalidRequest, MissingDependency, UselessFrame
from sceneprint.geometry.rigid import inverse, transform_points
from sceneprint.geometry.surface.coverage import TriangleMesh
from sceneprint.geometry.surface.depth_image import halve_camera
from sceneprint.types import DepthFrame, Floats, Floats32

#: Debian packages that contain the system libraries that Open3D loads.
PACKAGES = "libgl1 libegl1 libx11-6 libusb-1.0-0 libgomp1"


def open3d(feature: str) -> Any:
    """Import open3d, limit it to one thread, and return the module.

    Parameters
    ----------
    feature : subject of the error message, such as "A reconstruction"

    Raises
    ------
    MissingDependency : If Open3D or a system library that it requires is missing
    """
    try:
        import open3d as module
    except (ImportError, OSError) as error:
        raise MissingDependency(
            f"{feature} requires Open3D, which cannot be imported ({error}). Install it (pip "
            f"install open3d) and, on Debian or Ubuntu, its libraries: apt-get install {PACKAGES}"
        ) from error
    module.utility.set_max_threads(1)  # several threads would sum in random order
    module.utility.set_verbosity_level(module.utility.VerbosityLevel.Error)
    return module


#: Number of voxels along the edge of a block.
_SIDE = 8
#: Truncation distance: half the width of the band around a surface, along the ray, in voxels.
#: Surfaces at less than asin(1 / 6), 10 degrees, to the ray get holes; a wider band would merge the
#: two sides of thin objects.
BAND = 6.0


@dataclass(frozen=True)
class FusionParameters:
    """Parameters of a fusion."""

    voxel_m: float | None = None  #: edge of a voxel; None selects the smallest possible edge
    nearest_m: float = 0.3  #: minimum depth of a fused sample
    farthest_m: float = 6.0  #: maximum depth of a fused sample; more distant samples are inaccurate
    finest_m: float = 0.01  #: minimum edge if `voxel_m` is None; smaller voxels would store noise
    #: Maximum number of blocks. A block of 512 voxels takes 4 KiB and gives about 50 points, so the
    #: maximum takes 64 MiB and gives a mesh file of about 50 MB.
    most_blocks: int = 16_384
    most_samples: int = 640 * 480  #: maximum number of samples per view; larger images are thinned


def fuse(
    views: Sequence[DepthFrame], p: FusionParameters | None = None
) -> tuple[TriangleMesh, float]:
    """Fuse several depth images into one mesh, deterministically.

    Parameters
    ----------
    views : images with poses T_parent_view (4, 4), in one parent frame

    Returns
    -------
    mesh : mesh in the parent frame, with points sorted by x, then y, then z
    voxel : edge of the voxels, metres

    Raises
    ------
    MissingDependency : If Open3D or a system library that it requires is missing
    UselessFrame : If no sample of the views lies within the range
    InvalidRequest : If voxels of the requested size would need too many blocks
    """
    p = p or FusionParameters()
    o3d = open3d("A reconstruction")
    prepared = [prepare_view(view, p) for view in views]
    points = [_sensor_points(view) for view in prepared]
    if not sum(map(len, points)):
        raise UselessFrame(
            f"No sample of the {len(views)} views lies between {p.nearest_m:g} and "
            f"{p.farthest_m:g} m, so there is no surface to fuse. Select other frames."
        )
    voxel = _select_voxel(prepared, points, p)
    return _extract_mesh(o3d, prepared, points, voxel, p), voxel


def prepare_view(view: DepthFrame, p: FusionParameters) -> DepthFrame:
    """Return a view with at most `most_samples` samples, all within the depth range.

    Large images are subsampled, not averaged, because a mean across an edge would be a false
    surface.
    """
    depth, camera = np.asarray(view.depth, np.float32), view.intrinsics
    while depth.size > p.most_samples:
        camera = halve_camera(camera)
        # the retained sample is a quarter pixel above and to the left of the new pixel's centre
        depth = depth[: 2 * camera.height : 2, : 2 * camera.width : 2]
        camera = replace(camera, cx=camera.cx + 0.25, cy=camera.cy + 0.25)
    with np.errstate(invalid="ignore"):
        good = (depth >= p.nearest_m) & (depth <= p.farthest_m)  # false for NaN
    in_range: Floats32 = np.ascontiguousarray(np.where(good, depth, np.float32(0)))
    return replace(view, depth=in_range, intrinsics=camera)


def _sensor_points(view: DepthFrame) -> Floats:
    """Return the points (N, 3) of a view in its sensor's frame, metres."""
    k = view.intrinsics
    y, x = np.nonzero(view.depth)
    z = view.depth[y, x].astype(np.float64)
    return np.stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z], axis=1)


def _select_voxel(
    views: Sequence[DepthFrame], points: Sequence[Floats], p: FusionParameters
) -> float:
    """Return the edge of the voxels, metres: `p.voxel_m`, or a small edge without gaps.

    If `p.voxel_m` is None, the edge grows until `p.most_blocks` suffice. Raise InvalidRequest if
    `p.voxel_m` needs more blocks.
    """
    if p.voxel_m is not None:
        count = _count_blocks(views, points, p.voxel_m)
        if count > p.most_blocks:
            # the number of blocks on surfaces is inversely proportional to the squared edge
            enough = p.voxel_m * math.sqrt(count / p.most_blocks) * 1.05
            raise InvalidRequest(
                f"Voxels of {p.voxel_m:g} m need {count} blocks of memory, but the limit is "
                f"{p.most_blocks}. Request {enough:.3f} m or more, or fewer views.",
                (("voxel_m", "is too small for the extent of the views"),),
            )
        return p.voxel_m
    pixels = [
        float(np.median(own[:, 2])) / min(view.intrinsics.fx, view.intrinsics.fy)
        for view, own in zip(views, points, strict=True)
        if len(own)
    ]
    voxel = max(p.finest_m, round(2 * float(np.median(pixels)), 3))
    while _count_blocks(views, points, voxel) > p.most_blocks:
        voxel = round(voxel * 1.25, 4)
    return voxel


def _count_blocks(views: Sequence[DepthFrame], points: Sequence[Floats], voxel: float) -> int:
    """Return the number of blocks that the surfaces of all views touch."""
    blocks = [
        _band_blocks(_require_pose(v), own, voxel) for v, own in zip(views, points, strict=True)
    ]
    return len(np.unique(np.concatenate(blocks), axis=0))


def _band_blocks(T: Floats, points: Floats, voxel: float) -> NDArray[np.int32]:
    """Return the indices (B, 3) of the blocks that a view's band touches; T is T_parent_view."""
    if not len(points):
        return np.zeros((0, 3), np.int32)
    band, edge = BAND * voxel, _SIDE * voxel
    z = points[:, 2:]
    keys = []
    for offset in np.linspace(-band, band, 5):  # steps shorter than a block
        cells = np.floor(transform_points(T, points * np.maximum((z + offset) / z, 0.0)) / edge)
        packed = (cells.astype(np.int64) + (1 << 20)) @ np.array([1 << 42, 1 << 21, 1])
        keys.append(np.unique(packed))
    packed = np.unique(np.concatenate(keys))
    cells = np.stack([packed >> 42, (packed >> 21) & 0x1FFFFF, packed & 0x1FFFFF], axis=1)
    return (cells - (1 << 20)).astype(np.int32)


def _extract_mesh(
    o3d: Any,
    views: Sequence[DepthFrame],
    points: Sequence[Floats],
    voxel: float,
    p: FusionParameters,
) -> TriangleMesh:
    core, geometry = o3d.core, o3d.t.geometry
    grid = geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1,), (1,)), voxel_size=voxel,
        block_resolution=_SIDE, block_count=2048, device=core.Device("CPU:0"),
    )  # fmt: skip
    for view, own in zip(views, points, strict=True):
        T = _require_pose(view)
        blocks, k = _band_blocks(T, own, voxel), view.intrinsics
        if not len(blocks):
            continue
        camera = np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1.0]])
        grid.integrate(
            core.Tensor(blocks), geometry.Image(core.Tensor(view.depth)), core.Tensor(camera),
            core.Tensor(inverse(T)), 1.0, p.farthest_m, BAND,
        )  # fmt: skip
    try:
        # this threshold accepts surfaces that only one view observed
        mesh = grid.extract_triangle_mesh(0.5)
    except RuntimeError as error:  # Open3D raises this for a mesh without points
        raise UselessFrame(
            f"The {len(views)} views give no surface at voxels of {voxel:g} m. Request smaller "
            "voxels, or select other frames."
        ) from error
    return _sort_mesh(
        mesh.vertex.positions.numpy().astype(np.float64),
        mesh.vertex.normals.numpy().astype(np.float64),
        mesh.triangle.indices.numpy().astype(np.int32),
    )


def _sort_mesh(points: Floats, normals: Floats, triangles: NDArray[np.int32]) -> TriangleMesh:
    """Sort the points and triangles of a mesh, because Open3D's hash table has a random order."""
    order = np.lexsort(points.T[::-1])
    place = np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    triangles = place[triangles].reshape(-1, 3)
    start = triangles.argmin(axis=1) if len(triangles) else np.zeros(0, np.intp)
    # rotate each triangle so that its lowest index comes first, with the same winding
    order_of_corners = (start[:, None] + np.arange(3)) % 3
    triangles = np.take_along_axis(triangles, order_of_corners, axis=1)
    triangles = triangles[np.lexsort(triangles.T[::-1])]
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return TriangleMesh(points[order], (normals / np.maximum(length, 1e-12))[order], triangles)


def _require_pose(view: DepthFrame) -> Floats:
    if view.pose is None:
        raise ValueError(f"The view {view.name!r} has no pose. Pass views with T_parent_view.")
    return view.pose


#: Colours of the views, starting with the query's grey; if there are more views, they repeat.
PALETTE = np.array(
    [
        (150, 154, 160), (49, 112, 184), (222, 126, 46), (52, 160, 105), (158, 84, 172),
        (205, 168, 50), (70, 172, 190), (196, 72, 82), (128, 110, 76), (110, 120, 200),
    ],
    np.uint8,
)  # fmt: skip
