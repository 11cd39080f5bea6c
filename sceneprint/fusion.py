"""Views of one place fused to one surface, by a truncated signed distance.

views (V)  --fuse-->  Mesh, voxel     by Open3D, which this file alone loads

Open3D is loaded when asked for, and refused by name where it is missing.
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

#: Debian packages with the system libraries that Open3D loads.
PACKAGES = "libgl1 libegl1 libx11-6 libusb-1.0-0 libgomp1"


def open3d(what: str) -> Any:
    """The open3d module, to work in one thread.

    Parameters
    ----------
    what : needs it, as a message begins

    Raises
    ------
    MissingDependency : it, or a system library it needs, is absent.
    """
    try:
        import open3d as module
    except (ImportError, OSError) as error:
        raise MissingDependency(
            f"{what} needs Open3D, which cannot be imported here ({error}). Install it "
            f"(pip install open3d), and on Debian or Ubuntu: apt-get install {PACKAGES}"
        ) from error
    module.utility.set_max_threads(1)  # one process, one processor; and one order of sums
    module.utility.set_verbosity_level(module.utility.VerbosityLevel.Error)
    return module


#: Voxels along the edge of a block: space is kept in blocks, where a surface is.
_SIDE = 8
#: Voxels before and behind a surface, along the ray, in which its distance is kept: where a ray
#: meets it at less than asin(1 / 6), 10 degrees, there are holes; more would melt thin things.
BAND = 6.0


@dataclass(frozen=True)
class FusionParameters:
    """The numbers of a fusion."""

    voxel_m: float | None = None  #: edge of a voxel; None: as fine as the views and blocks allow
    nearest_m: float = 0.3  #: nearer samples are not fused
    farthest_m: float = 6.0  #: farther samples are too uncertain to be fused
    finest_m: float = 0.01  #: least edge that is chosen: below it sensors see noise
    #: A block of 512 voxels has 4 KiB, and some 50 points of surface: so many take 64 MiB, and
    #: their mesh is a file of about 50 MB.
    most_blocks: int = 16_384
    most_samples: int = 640 * 480  #: of a view; a larger image is thinned


def fuse(
    views: Sequence[DepthFrame], p: FusionParameters | None = None
) -> tuple[TriangleMesh, float]:
    """One surface of several views; the same one for the same views.

    Parameters
    ----------
    views : each with pose T_parent_view, in one parent frame

    Returns
    -------
    mesh : in the parent frame, points in rising order of x, then y, then z
    voxel : edge of the voxels it was made of, metres

    Raises
    ------
    MissingDependency : Open3D, or a system library it needs, is absent.
    UselessFrame : no sample of any view lies within the range.
    InvalidRequest : voxels of the wanted size take more blocks than there may be.
    """
    p = p or FusionParameters()
    o3d = open3d("A reconstruction")
    kept = [within(view, p) for view in views]
    points = [_points(view) for view in kept]
    if not sum(map(len, points)):
        raise UselessFrame(
            f"No sample of the {len(views)} views lies between {p.nearest_m:g} and "
            f"{p.farthest_m:g} m, so there is no surface to fuse. Choose other frames."
        )
    voxel = _chosen_voxel(kept, points, p)
    return _meshed(o3d, kept, points, voxel, p), voxel


def within(view: DepthFrame, p: FusionParameters) -> DepthFrame:
    """A view as it is fused: thinned to `most_samples`, and without what lies out of range.

    Thinned by leaving samples out: a mean over an edge would be a surface that is not there.
    """
    depth, camera = np.asarray(view.depth, np.float32), view.intrinsics
    while depth.size > p.most_samples:
        camera = halve_camera(camera)
        # of each 2 x 2 samples the first; its ray is half a (new) quarter pixel up and left
        depth = depth[: 2 * camera.height : 2, : 2 * camera.width : 2]
        camera = replace(camera, cx=camera.cx + 0.25, cy=camera.cy + 0.25)
    with np.errstate(invalid="ignore"):
        good = (depth >= p.nearest_m) & (depth <= p.farthest_m)  # false for NaN as well
    kept: Floats32 = np.ascontiguousarray(np.where(good, depth, np.float32(0)))
    return replace(view, depth=kept, intrinsics=camera)


def _points(view: DepthFrame) -> Floats:
    """(N, 3) samples of a view in its own frame."""
    k = view.intrinsics
    y, x = np.nonzero(view.depth)
    z = view.depth[y, x].astype(np.float64)
    return np.stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z], axis=1)


def _chosen_voxel(
    views: Sequence[DepthFrame], points: Sequence[Floats], p: FusionParameters
) -> float:
    """The wanted edge, or the least at which pixels leave no gaps and blocks suffice."""
    if p.voxel_m is not None:
        count = _count(views, points, p.voxel_m)
        if count > p.most_blocks:
            # blocks are of surfaces: their number falls with the square of the edge
            enough = p.voxel_m * math.sqrt(count / p.most_blocks) * 1.05
            raise InvalidRequest(
                f"Voxels of {p.voxel_m:g} m take {count} blocks of memory, and there may be "
                f"{p.most_blocks}. Ask for {enough:.3f} m or more, or for fewer views.",
                (("voxel_m", "is too small for the extent of the views"),),
            )
        return p.voxel_m
    pixels = [
        float(np.median(own[:, 2])) / min(view.intrinsics.fx, view.intrinsics.fy)
        for view, own in zip(views, points, strict=True)
        if len(own)
    ]
    voxel = max(p.finest_m, round(2 * float(np.median(pixels)), 3))
    while _count(views, points, voxel) > p.most_blocks:
        voxel = round(voxel * 1.25, 4)
    return voxel


def _count(views: Sequence[DepthFrame], points: Sequence[Floats], voxel: float) -> int:
    """How many blocks the surfaces of all views touch."""
    blocks = [_blocks(_pose(v), own, voxel) for v, own in zip(views, points, strict=True)]
    return len(np.unique(np.concatenate(blocks), axis=0))


def _blocks(T: Floats, points: Floats, voxel: float) -> NDArray[np.int32]:
    """(B, 3) the blocks within the band along the rays of a view, by T_parent_view."""
    if not len(points):
        return np.zeros((0, 3), np.int32)
    band, edge = BAND * voxel, _SIDE * voxel
    z = points[:, 2:]
    keys = []
    for offset in np.linspace(-band, band, 5):  # at a slant too, steps are less than a block
        cells = np.floor(transform_points(T, points * np.maximum((z + offset) / z, 0.0)) / edge)
        packed = (cells.astype(np.int64) + (1 << 20)) @ np.array([1 << 42, 1 << 21, 1])
        keys.append(np.unique(packed))
    packed = np.unique(np.concatenate(keys))
    cells = np.stack([packed >> 42, (packed >> 21) & 0x1FFFFF, packed & 0x1FFFFF], axis=1)
    return (cells - (1 << 20)).astype(np.int32)


def _meshed(
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
        T = _pose(view)
        blocks, k = _blocks(T, own, voxel), view.intrinsics
        if not len(blocks):
            continue
        camera = np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1.0]])
        grid.integrate(
            core.Tensor(blocks), geometry.Image(core.Tensor(view.depth)), core.Tensor(camera),
            core.Tensor(inverse(T)), 1.0, p.farthest_m, BAND,
        )  # fmt: skip
    try:
        made = grid.extract_triangle_mesh(0.5)  # what one view saw counts
    except RuntimeError as error:  # Open3D's word for a mesh without any point
        raise UselessFrame(
            f"The {len(views)} views make no surface of voxels of {voxel:g} m. Ask for smaller "
            "ones, or choose other frames."
        ) from error
    return _in_order(
        made.vertex.positions.numpy().astype(np.float64),
        made.vertex.normals.numpy().astype(np.float64),
        made.triangle.indices.numpy().astype(np.int32),
    )


def _in_order(points: Floats, normals: Floats, triangles: NDArray[np.int32]) -> TriangleMesh:
    """A mesh whose order does not depend on that of a hash table."""
    order = np.lexsort(points.T[::-1])
    place = np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    triangles = place[triangles].reshape(-1, 3)
    start = triangles.argmin(axis=1) if len(triangles) else np.zeros(0, np.intp)
    turned = (start[:, None] + np.arange(3)) % 3  # its least index first; the winding stays
    triangles = np.take_along_axis(triangles, turned, axis=1)
    triangles = triangles[np.lexsort(triangles.T[::-1])]
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return TriangleMesh(points[order], (normals / np.maximum(length, 1e-12))[order], triangles)


def _pose(view: DepthFrame) -> Floats:
    if view.pose is None:
        raise ValueError(f"view {view.name!r} has no pose")
    return view.pose


#: Colours of the views, repeated where there are more of them; the query's grey first.
PALETTE = np.array(
    [
        (150, 154, 160), (49, 112, 184), (222, 126, 46), (52, 160, 105), (158, 84, 172),
        (205, 168, 50), (70, 172, 190), (196, 72, 82), (128, 110, 76), (110, 120, 200),
    ],
    np.uint8,
)  # fmt: skip
